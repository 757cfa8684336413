"""`bench mjx`: speed and memory of the MJX mode by number of environments.

Three programs are timed, each on its own: the physics alone, a whole collection (physics, policy, observations, rewards
and resets) and an update of the learner on what was collected. Shares refer to one after the other, as in training
with `schedule: sync`.
"""

import argparse
import logging
import statistics
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from jax.sharding import Mesh, PartitionSpec

from hasrl_jax.bench.mjx_plot import plot
from hasrl_jax.bench.report import claim_file, format_table
from hasrl_jax.collect.mjx import MjxCollector
from hasrl_jax.collect.protocol import Networks
from hasrl_jax.config.checks import check
from hasrl_jax.config.files import load_yaml
from hasrl_jax.config.schema import Config
from hasrl_jax.envs.mjx_engine import MjxEngine, MjxEnvState
from hasrl_jax.envs.registry import make_task
from hasrl_jax.errors import ConfigError
from hasrl_jax.learn import ppo
from hasrl_jax.learn.networks import make_networks
from hasrl_jax.train.devices import prepare_jax
from hasrl_jax.types import Array

log = logging.getLogger("hasrl_jax")
SMALLEST, LARGEST = 256, 2**20  # environments on an accelerator when none are named; powers of two up to the memory
ON_CPU = (8, 16)  # environments when there is no accelerator


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the MJX benchmark."""
    parser.add_argument("--config", default="cassie_walk", metavar="FILE", help="what is measured")
    parser.add_argument(
        "--num-envs", type=int, nargs="+", metavar="N", help=f"default: {SMALLEST}, {2 * SMALLEST}, ... while they fit"
    )
    parser.add_argument("--impl", choices=("jax", "warp"), help="instead of the configuration's")
    parser.add_argument("--unroll-length", type=int, default=32, metavar="T", help="environment steps per round")
    parser.add_argument("--minibatches", type=int, default=4, metavar="M", help="per epoch of the learner")
    parser.add_argument("--rounds", type=int, default=3, help="measured rounds, after one that compiles")
    parser.add_argument("--plot", type=Path, metavar="FILE.png", help="where to draw the figures")


def measure(arguments: argparse.Namespace) -> dict:
    """Every number of environments in ascending order, until the memory ends.

    Raises:
      ConfigError: an impossible argument; MemoryError: not even the smallest number fits.
    """
    counts = {name: [getattr(arguments, name)] for name in ("unroll_length", "minibatches", "rounds")}
    for name, values in (counts | {"num_envs": arguments.num_envs or [1]}).items():
        if min(values) < 1:
            raise ConfigError(f"--{name.replace('_', '-')}: got {min(values)}; expected at least 1")
    base = load_yaml(arguments.config)
    base = replace(base, backend="mjx", compilation_cache=False)  # compilation is measured
    if arguments.impl:
        base = replace(base, mjx=replace(base.mjx, impl=arguments.impl))
    check(base)
    if arguments.plot:
        claim_file(arguments.plot)
    prepare_jax(base)
    if jax.default_backend() == "cpu":
        log.warning(
            "bench mjx is made for accelerators; on a CPU it runs small, for minutes, and its figures say little"
        )
    cells = list(_cells(arguments, base))
    figures = {
        "task": base.task,
        "impl": base.mjx.impl,
        "devices": len(jax.devices()),
        "timestep_s": base.physics.timestep_s,
        "steps_per_env_step": base.physics.steps_per_env_step,
        "solver_iterations": base.physics.solver_iterations,
        "line_search_iterations": base.physics.line_search_iterations,
        "hidden": base.network.hidden_size,
        "symmetric": base.network.symmetric,
        "epochs": base.ppo.epochs,
        "cells": cells,
    }
    if arguments.plot:
        plot(figures, jax.devices()[0].device_kind, arguments.plot)
    return figures


def _cells(arguments: argparse.Namespace, base: Config) -> Iterator[dict]:
    """One measurement after the other; what no longer fits ends them."""
    mesh = ppo.make_mesh()
    for index, num_envs in enumerate(numbers(arguments.num_envs)):
        config = make_config(base, num_envs, arguments.unroll_length, arguments.minibatches, mesh.size)
        try:
            cell = measure_cell(config, mesh, arguments.rounds)
        except (MemoryError, jax.errors.JaxRuntimeError) as error:
            if isinstance(error, jax.errors.JaxRuntimeError) and "RESOURCE_EXHAUSTED" not in str(error):
                raise
            if not index:
                raise MemoryError(f"--num-envs: {num_envs} environments do not fit into the devices' memory") from error
            log.warning("%d environments do not fit into the devices' memory", num_envs)
            return
        log.warning("%d environments: %.0f environment steps/s", num_envs, cell["env_steps_per_second"])
        yield cell


def numbers(chosen: list[int] | None) -> Iterable[int]:
    """Ascending, because the peak of the memory is that of the whole process."""
    if chosen:
        return sorted(set(chosen))
    if jax.default_backend() == "cpu":
        return ON_CPU
    return (2**power for power in range(SMALLEST.bit_length() - 1, LARGEST.bit_length()))


def make_config(base: Config, num_envs: int, unroll_length: int, minibatches: int, num_devices: int) -> Config:
    """`base` with one unroll of every environment as an iteration, and the learner's minibatches to fit."""
    collect = replace(
        base.collect, mode="unrolls", unroll_length=unroll_length, env_steps_per_iteration=num_envs * unroll_length
    )
    per_device = max(1, num_envs // (minibatches * num_devices))
    return replace(
        base,
        collect=collect,
        mjx=replace(base.mjx, num_envs=num_envs),
        ppo=replace(base.ppo, minibatch_trajectories=per_device * num_devices, max_kl=0.0),  # no update is skipped
    )


def measure_cell(config: Config, mesh: Mesh, rounds: int) -> dict[str, Any]:
    """Compiles, then times each program `rounds` times; medians."""
    task = make_task(config)
    sizes = (task.observation_size, task.action_size, task.mirror)
    learner = ppo.init_learner(config, *sizes, jax.random.key(config.seed))
    update = ppo.make_update(config, *sizes, mesh)
    seconds: dict[str, list[float]] = {"physics": [], "collect": [], "update": []}
    overflow = {"contact_overflow": 0, "constraint_overflow": 0}
    with MjxCollector(config, task, mesh, Networks(*make_networks(config.network, *sizes))) as collector:
        steps_per_env = collector.plan.steps_per_env
        physics = physics_only(collector.rollout.engine, mesh, steps_per_env)
        for iteration in range(rounds + 1):
            with _timed(seconds["physics"]) as wait_for:
                wait_for(physics(collector.state.envs))
            with _timed(seconds["collect"]) as wait_for:
                parameters = ppo.acting_parameters(learner, config.network.normalize_observations)
                collector.start(parameters, iteration, version=iteration)
                experience = collector.finish()
                wait_for(experience.trajectory)
            with _timed(seconds["update"]) as wait_for:
                learner, _ = wait_for(update(learner, experience.trajectory))
            overflow = {name: count + int(experience.record[name] or 0) for name, count in overflow.items()}
    median = {name: statistics.median(times[1:]) for name, times in seconds.items()}
    iteration_s = median["collect"] + median["update"]
    env_steps = config.mjx.num_envs * steps_per_env
    return {
        "num_envs": config.mjx.num_envs,
        "steps_per_env": steps_per_env,
        "minibatch_trajectories": config.ppo.minibatch_trajectories,
        "physics_steps_per_second": env_steps * task.steps_per_env_step / median["physics"],
        "env_steps_per_second": env_steps / median["collect"],
        "env_steps_per_second_training": env_steps / iteration_s,
        "physics_share": median["physics"] / iteration_s,
        "policy_share": (median["collect"] - median["physics"]) / iteration_s,
        "learner_share": median["update"] / iteration_s,
        **{f"{name}_compile_seconds": times[0] - median[name] for name, times in seconds.items()},
        "recompiles": collector.rollout.trace_count + update.trace_count - 2,
        "peak_memory_mb": _peak_memory_mb(),
        **overflow,
    }


@contextmanager
def _timed(seconds: list[float]) -> Iterator[Callable[[Any], Any]]:
    """Appends the seconds of the block; what it computes must be passed to the function that it is given."""
    started = time.perf_counter()
    yield jax.block_until_ready
    seconds.append(time.perf_counter() - started)


def physics_only(engine: MjxEngine, mesh: Mesh, steps_per_env: int) -> Callable[[MjxEnvState], Array]:
    """A program that steps the physics under random actions, and nothing else: states [E] -> positions [E, nq]."""

    def run(state: MjxEnvState) -> Array:
        def env_step(state: MjxEnvState, key: Array) -> tuple[MjxEnvState, None]:
            action = 0.2 * jax.random.normal(key, (len(state.qpos), engine.task.action_size))
            with jax.default_matmul_precision("highest"):  # as the environment does
                reading, _ = jax.vmap(engine.simulate)(state, jax.vmap(engine.control)(state, action))
            bad = ~jnp.isfinite(reading.qvel).all(axis=1, keepdims=True)
            qpos, qvel = jnp.where(bad, state.qpos, reading.qpos), jnp.where(bad, 0.0, reading.qvel)
            # The averages are used, or the compiler would leave them out.
            return state._replace(qpos=qpos + 0.0 * jnp.sum(reading.averages), qvel=qvel), None

        keys = jax.random.split(jax.random.PRNGKey(0), steps_per_env)
        return jax.lax.scan(env_step, state, keys)[0].qpos

    split = PartitionSpec("data")
    return jax.jit(jax.shard_map(run, mesh=mesh, in_specs=split, out_specs=split, check_vma=False))


def _peak_memory_mb() -> float | None:
    """The most that any device has held since the start; None where the device does not tell."""
    peaks = [(device.memory_stats() or {}).get("peak_bytes_in_use") for device in jax.local_devices()]
    return max(peak for peak in peaks if peak) / 1e6 if any(peaks) else None


def tables(figures: dict) -> str:
    """Speed, then where the time goes, by number of environments."""
    cells = figures["cells"]
    speed = format_table(
        ["environments", "physics steps/s", "env steps/s", "with learner", "peak MB", "dropped contacts, constraints"],
        [
            [
                str(cell["num_envs"]),
                cell["physics_steps_per_second"],
                cell["env_steps_per_second"],
                cell["env_steps_per_second_training"],
                "unknown" if cell["peak_memory_mb"] is None else cell["peak_memory_mb"],
                f"{cell['contact_overflow']}, {cell['constraint_overflow']}",
            ]
            for cell in cells
        ],
    )
    names = ("physics", "policy", "learner")
    compiled = ("physics", "collect", "update")
    shares = format_table(
        ["environments", *(f"{name} share" for name in names), *(f"{name} compile s" for name in compiled)],
        [
            [
                str(cell["num_envs"]),
                *(cell[f"{name}_share"] for name in names),
                *(cell[f"{name}_compile_seconds"] for name in compiled),
            ]
            for cell in cells
        ],
    )
    about = "{task} on MJX ({impl}), {devices} device(s), {steps_per_env_step} physics steps of {timestep_s:g} s, "
    about += "{solver_iterations}/{line_search_iterations} solver iterations, hidden {hidden}, {epochs} epochs"
    return f"{about.format(**figures)}\n\n{speed}\n\n{shares}"
