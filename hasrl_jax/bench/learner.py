"""`bench learner`: seconds per PPO update, for the paper's sizes and for the project's defaults.

Where torch is installed (the extra `compare`), the same update in torch (`compare_torch`) takes turns with ours at the
paper's sizes: `nn.LSTM`, the same losses, epochs, minibatches and optimisers, in a process of its own.
"""

import argparse
import importlib.util
import statistics
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from functools import partial

import jax
import numpy as np

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


def measure(arguments: argparse.Namespace) -> dict:
    """Both presets, or one."""
    names = ["paper", "default"] if arguments.sizes == "both" else [arguments.sizes]
    return {"cells": [{"sizes": name, **measure_size(name, arguments.updates)} for name in names]}


def measure_size(name: str, updates: int) -> dict:
    """One preset; beside torch at the paper's sizes, where the networks of both are the same."""
    config, rows, steps = sizes(name)
    wanted = name == "paper" and importlib.util.find_spec("torch") is not None
    with ExitStack() as stack:
        beside: Callable[[], float] | None = None
        if wanted:
            peer = stack.enter_context(PeerProcess("torch_update", config, rows, rows * steps))
            beside = partial(torch_seconds, peer)
        return measure_cell(config, rows, steps, updates, beside)


def torch_seconds(peer: PeerProcess) -> float:
    """Of one update of the peer on all cores."""
    return peer.iterate(available_cores())[1]


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


def measure_cell(
    config: Config, rows: int, steps: int, updates: int, beside: Callable[[], float] | None = None
) -> dict:
    """Compiles, warms up, and times single updates on the same random trajectories.

    `beside` is called after each, and gives the seconds of another system's update.
    """
    task = make_task(config)
    shapes = task.observation_size, task.action_size, task.mirror
    learner = ppo.init_learner(config, *shapes, jax.random.key(config.seed))
    update = ppo.make_update(config, *shapes, ppo.make_mesh())
    trajectory = random_trajectory(config, rows, steps, *shapes[:2])
    seconds, others = [], []
    for _ in range(updates + 2):
        started = time.perf_counter()
        learner, metrics = update(learner, trajectory)
        jax.block_until_ready((learner, metrics))
        seconds.append(time.perf_counter() - started)
        if beside:
            others.append(beside())
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
        "torch_seconds_per_update": statistics.median(others[2:]) if others else None,
        "env_steps_per_second": rows * steps / median,
        "compile_seconds": seconds[0] - median,
        "recompiles": update.trace_count - 1,
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
        initial_carry=zero_carry(rows, config.network.hidden_size, config.network.symmetric),
        policy_version=np.zeros(rows, np.int32),
    )


def tables(figures: dict) -> str:
    """One row per preset."""
    headers = ["sizes", "batch x steps", "hidden", "epochs", "minibatch", "s/update", "best", "torch s/update"]
    headers += ["torch / ours", "compile s", "recompiles"]
    rows = [
        [
            cell["sizes"],
            f"{cell['trajectories']} x {cell['steps']}",
            cell["hidden"],
            cell["epochs"],
            cell["minibatch_trajectories"],
            cell["seconds_per_update"],
            cell["seconds_fastest"],
            cell["torch_seconds_per_update"] or "-",
            cell["torch_seconds_per_update"] / cell["seconds_per_update"] if cell["torch_seconds_per_update"] else "-",
            cell["compile_seconds"],
            cell["recompiles"],
        ]
        for cell in figures["cells"]
    ]
    return format_table(headers, rows)
