"""`bench scaling`: how the CPU pool grows with the number of workers, and what each worker costs the learner.

Every number of workers has a pool of its own, all open at once and idle except when their turn comes, so that rounds
alternate and other work on the machine slows all of them alike. Each worker always has the same work to do.
"""

import argparse
import statistics
import time
from contextlib import ExitStack

import jax
import psutil

from hasrl_jax.bench import collector
from hasrl_jax.bench.report import format_table
from hasrl_jax.collect.buffer import merge
from hasrl_jax.collect.cpu import to_trajectory
from hasrl_jax.collect.plan import MOST_ENVS, make_plan
from hasrl_jax.collect.supervisor import CpuPool
from hasrl_jax.config.checks import check
from hasrl_jax.config.convert import from_dict
from hasrl_jax.config.schema import available_cores
from hasrl_jax.envs.registry import make_task
from hasrl_jax.errors import ConfigError
from hasrl_jax.learn import ppo


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the scaling benchmark."""
    default = from_dict({})
    parser.add_argument("--task", default="cassie", metavar="NAME")
    parser.add_argument("--num-workers", type=int, nargs="+", default=[1, 2, 4, 8], metavar="N", help="1 always runs")
    parser.add_argument("--envs-per-worker", type=int, default=MOST_ENVS, metavar="E")
    parser.add_argument("--physics", choices=tuple(collector.PHYSICS), default="fast", help="2 kHz, or 400 Hz")
    parser.add_argument("--hidden", type=int, default=default.network.hidden_size, help="width of the networks")
    parser.add_argument("--symmetric", action="store_true", help="mirror-equivariant networks")
    parser.add_argument("--steps-per-env", type=int, default=64, help="environment steps per environment and round")
    parser.add_argument("--rounds", type=int, default=5, help="measured rounds, after one that warms up")


def measure(arguments: argparse.Namespace) -> dict:
    """A cell per number of workers.

    Raises:
      ConfigError: an impossible argument.
    """
    numbers = sorted({1, *arguments.num_workers})
    configs = [collector.make_config(arguments, arguments.physics, number) for number in numbers]
    for config in configs:
        check(config)
    if arguments.rounds < 1:
        raise ConfigError(f"--rounds: got {arguments.rounds}; expected at least 1")
    task = make_task(configs[0])
    learner = ppo.init_learner(
        configs[0], task.observation_size, task.action_size, task.mirror, jax.random.key(configs[0].seed)
    )
    with ExitStack() as stack:
        pools = [stack.enter_context(CpuPool(config, make_plan(config), task)) for config in configs]
        rounds = [
            [measure_round(pool, learner, iteration) for pool in pools] for iteration in range(arguments.rounds + 1)
        ]
        cells = [summarize(pool, figures) for pool, figures in zip(pools, zip(*rounds[1:], strict=True), strict=True)]
    alone = cells[0]["env_steps_per_second"]
    for cell in cells:
        cell["ideal_env_steps_per_second"] = alone * min(available_cores(), cell["num_workers"])
        cell["share_of_ideal"] = cell["env_steps_per_second"] / cell["ideal_env_steps_per_second"]
    return {
        "task": arguments.task,
        "physics": arguments.physics,
        "hidden": arguments.hidden,
        "symmetric": arguments.symmetric,
        "rounds": arguments.rounds,
        "cells": cells,
    }


def measure_round(pool: CpuPool, learner: ppo.LearnerState, iteration: int) -> dict[str, float]:
    """One iteration of one pool; seconds of the learner's process for each part of the exchange.

    Merging is timed once more after the iteration, on the buffers that lie there, because `finish` does it while the
    workers' last replies come in.
    """
    started = time.perf_counter()
    parameters = ppo.export_parameters(learner)
    exported = time.perf_counter()
    pool.start(parameters, iteration, version=iteration)
    sent = time.perf_counter()
    collected = pool.finish()
    finished = time.perf_counter()
    slots = [pool.slot(index, iteration) for index in range(len(collected.statistics))]
    again = merge(slots, collected.statistics, iteration, seconds=0.0)
    merged = time.perf_counter()
    to_trajectory(again, pool.plan)
    return {
        "env_steps_per_second": len(collected.fields["mask"]) / (finished - exported),
        "export_seconds": exported - started,
        "broadcast_seconds": sent - exported,
        "merge_seconds": merged - finished,
        "pad_seconds": time.perf_counter() - merged,
    }


def summarize(pool: CpuPool, rounds: tuple[dict[str, float], ...]) -> dict:
    """Medians of the rounds, and the memory of the workers."""
    medians = {name: statistics.median(figures[name] for figures in rounds) for name in rounds[0]}
    memory = [psutil.Process(pid).memory_full_info() for pid in pool.process_ids]
    return {
        "num_workers": pool.plan.num_workers,
        "envs_per_worker": pool.plan.envs_per_worker,
        "env_steps": pool.plan.env_steps,
        **medians,
        "worker_resident_mb": statistics.median(entry.rss for entry in memory) / 1e6,
        "worker_own_mb": statistics.median(entry.uss for entry in memory) / 1e6,
    }


def tables(figures: dict) -> str:
    """Speed against perfect scaling, then the cost of each worker."""
    cells = figures["cells"]
    speed = format_table(
        ["workers", "envs", "env steps/s", "min(cores, workers) x one", "share"],
        [
            [
                str(cell["num_workers"]),
                cell["num_workers"] * cell["envs_per_worker"],
                cell["env_steps_per_second"],
                cell["ideal_env_steps_per_second"],
                cell["share_of_ideal"],
            ]
            for cell in cells
        ],
    )
    cost = format_table(
        ["workers", "export ms", "broadcast ms", "per worker", "merge ms", "pad ms", "per worker", "MB", "own MB"],
        [
            [
                str(cell["num_workers"]),
                1e3 * cell["export_seconds"],
                1e3 * cell["broadcast_seconds"],
                1e3 * cell["broadcast_seconds"] / cell["num_workers"],
                1e3 * cell["merge_seconds"],
                1e3 * cell["pad_seconds"],
                1e3 * (cell["merge_seconds"] + cell["pad_seconds"]) / cell["num_workers"],
                cell["worker_resident_mb"],
                cell["worker_own_mb"],
            ]
            for cell in cells
        ],
    )
    steps = cells[0]["env_steps"]
    return (
        f"{figures['task']}, {figures['physics']} physics, hidden {figures['hidden']}, symmetric "
        f"{figures['symmetric']}, {steps} environment steps per worker and round, {available_cores()} cores\n\n{speed}"
        "\n\nThe learner's process, per iteration: parameters from the device (export), their copy to shared memory "
        "and the requests\nto the workers (broadcast), the workers' buffers into one (merge) and into padded "
        f"trajectories (pad); memory of a worker,\nin all and what it shares with nobody.\n\n{cost}"
    )
