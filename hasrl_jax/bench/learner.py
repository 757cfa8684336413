"""`bench learner`: seconds per PPO update, for the paper's sizes and for the project's defaults.

With `--torch` the update of the paper's sizes takes turns with that of `compare_torch` in a process of its own: what
other work on the machine costs, it costs both.
"""

import argparse
import statistics
import time
from collections.abc import Callable
from dataclasses import replace
from importlib import metadata

import jax
import numpy as np

from hasrl_jax.bench.compare import require_packages
from hasrl_jax.bench.compare_peers import PeerProcess
from hasrl_jax.bench.report import format_table
from hasrl_jax.config.convert import from_dict
from hasrl_jax.config.files import shipped
from hasrl_jax.config.schema import Config, available_cores
from hasrl_jax.envs.registry import make_task
from hasrl_jax.learn import ppo
from hasrl_jax.learn.networks import zero_carry
from hasrl_jax.types import Trajectory


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the learner benchmark."""
    parser.add_argument("--sizes", choices=("paper", "default", "both"), default="both")
    parser.add_argument("--updates", type=int, default=5, help="measured updates, after two that warm up")
    parser.add_argument("--torch", action="store_true", help="the paper's sizes in turns with torch")
    parser.add_argument("--threads", type=int, default=available_cores(), metavar="N", help="of torch")


def measure(arguments: argparse.Namespace) -> dict:
    """Both presets, or one; with torch, the paper's sizes.

    Raises:
      ConfigError: torch is asked for and not installed.
    """
    if arguments.torch:
        require_packages(["torch"], "--torch")
    names = ["paper", "default"] if arguments.sizes == "both" else [arguments.sizes]
    cells = [{"sizes": name, **measure_cell(*sizes(name), arguments.updates)} for name in names]
    return {"cells": cells, "torch": in_turns(arguments.updates, arguments.threads) if arguments.torch else None}


def sizes(name: str) -> tuple[Config, int, int]:
    """Configuration, trajectories and steps per trajectory of one update.

    `default` is `configs/cassie_walk.yaml`; `paper` is 100 trajectories of 100 steps in one minibatch, hidden 256,
    10 epochs. Policy steps are never skipped, so that every update does the same work.
    """
    if name == "default":
        config = shipped("cassie_walk")
        collect = config.collect
        rows = collect.env_steps_per_iteration // collect.unroll_length
        return replace(config, ppo=replace(config.ppo, max_kl=0.0)), rows, collect.unroll_length
    config = from_dict({})
    network = replace(config.network, hidden_size=256, normalize_observations=False)
    settings = replace(config.ppo, epochs=10, minibatch_trajectories=100, max_kl=0.0)
    return replace(config, network=network, ppo=settings), 100, 100


def measure_cell(config: Config, rows: int, steps: int, updates: int) -> dict:
    """Compiles, warms up, and times single updates on the same random trajectories."""
    update, once = prepare(config, rows, steps)
    seconds = [once() for _ in range(updates + 2)]
    measured = seconds[2:]
    median = statistics.median(measured)
    return {
        "trajectories": rows,
        "steps": steps,
        "hidden": config.network.hidden_size,
        "epochs": config.ppo.epochs,
        "minibatch_trajectories": config.ppo.minibatch_trajectories,
        "seconds_per_update": median,
        "seconds_fastest": min(measured),
        "env_steps_per_second": rows * steps / median,
        "compile_seconds": seconds[0] - median,
        "recompiles": update.trace_count - 1,
    }


def prepare(config: Config, rows: int, steps: int) -> tuple[ppo.Update, Callable[[], float]]:
    """The program, and what runs it once more on the same random trajectories and returns the seconds it took."""
    task = make_task(config)
    shapes = task.observation_size, task.action_size, task.mirror
    learner = ppo.init_learner(config, *shapes, jax.random.key(config.seed))
    update = ppo.make_update(config, *shapes, ppo.make_mesh())
    trajectory = random_trajectory(config, rows, steps, *shapes[:2])

    def once() -> float:
        nonlocal learner
        started = time.perf_counter()
        learner, metrics = update(learner, trajectory)
        jax.block_until_ready((learner, metrics))
        return time.perf_counter() - started

    return update, once


def in_turns(updates: int, threads: int) -> dict:
    """Ours and torch's update of the paper's sizes, one after the other, so many times after two that warm up."""
    config, rows, steps = sizes("paper")
    _, once = prepare(config, rows, steps)
    with PeerProcess("torch_update", config, rows, rows * steps) as peer:
        pairs = [(once(), peer.iterate(threads)[1]) for _ in range(updates + 2)][2:]
    ours, theirs = ([pair[side] for pair in pairs] for side in (0, 1))
    ratios = sorted(b / a for a, b in pairs)
    return {
        "ours_seconds": statistics.median(ours),
        "torch_seconds": statistics.median(theirs),
        "threads": threads,
        "ratio": statistics.median(ratios),
        "ratio_least": ratios[0],
        "ratio_most": ratios[-1],
        "version": metadata.version("torch"),
    }


def random_trajectory(config: Config, rows: int, steps: int, observation_size: int, action_size: int) -> Trajectory:
    """Full trajectories of noise, each cut by the time limit at its end."""
    rng = np.random.default_rng(config.seed)

    def noise(*shape: int) -> np.ndarray:
        return rng.standard_normal((rows, *shape), np.float32)

    first, last = np.zeros((2, rows, steps), bool)
    first[:, 0], last[:, -1] = True, True
    action = noise(steps, action_size)
    log_prob = -0.5 * np.sum(action**2 + np.log(2 * np.pi), axis=-1, dtype=np.float32)
    return Trajectory(
        observation=noise(steps, observation_size),
        action=action,
        log_prob=log_prob.astype(np.float32),
        value=noise(steps),
        reward=noise(steps),
        is_first=first,
        terminated=np.zeros((rows, steps), bool),
        truncated=last,
        bootstrap_value=noise(steps) * last,
        mask=np.ones((rows, steps), bool),
        initial_carry=zero_carry(rows, config.network.hidden_size, config.network.symmetric, config.network.memory),
        policy_version=np.zeros(rows, np.int32),
    )


def tables(figures: dict) -> str:
    """One row per preset."""
    headers = ["sizes", "batch x steps", "hidden", "epochs", "minibatch", "s/update", "best", "compile s", "recompiles"]
    rows = [
        [
            cell["sizes"],
            f"{cell['trajectories']} x {cell['steps']}",
            cell["hidden"],
            cell["epochs"],
            cell["minibatch_trajectories"],
            cell["seconds_per_update"],
            cell["seconds_fastest"],
            cell["compile_seconds"],
            cell["recompiles"],
        ]
        for cell in figures["cells"]
    ]
    found = figures.get("torch")
    if not found:
        return format_table(headers, rows)
    turns = (
        f"In turns with torch {found['version']} on {found['threads']} threads, the paper's sizes: "
        f"{found['ours_seconds']:.2f} s and {found['torch_seconds']:.2f} s, torch / ours {found['ratio']:.2f} "
        f"({found['ratio_least']:.2f} to {found['ratio_most']:.2f})"
    )
    return f"{format_table(headers, rows)}\n\n{turns}"
