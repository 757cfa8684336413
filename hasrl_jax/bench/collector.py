"""`bench collector`: environment steps per second of the real pool, and as a share of the physics limit.

Rounds of the limit and of the pool alternate, and medians are quoted, because other work on the machine
slows both. The share by CPU time (physics over everything a worker computes) hardly feels such work.
"""

import argparse
import statistics
import time
from dataclasses import replace

import jax
import psutil

from hasrl_jax.bench.physics_limit import PhysicsLimit
from hasrl_jax.bench.report import format_table
from hasrl_jax.collect.plan import MOST_ENVS, make_plan
from hasrl_jax.collect.supervisor import CpuPool
from hasrl_jax.config.checks import check
from hasrl_jax.config.convert import from_dict
from hasrl_jax.config.schema import Config, available_cores
from hasrl_jax.envs.registry import make_task
from hasrl_jax.learn import ppo

# name -> physics step (s), physics steps per environment step, solver iterations and line-search iterations
PHYSICS = {"paper": (0.0005, 50, 50, 50), "fast": (0.0025, 10, 4, 8)}
ITEMS = ("physics", "inference", "environment", "other")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the collector benchmark."""
    default = from_dict({})
    parser.add_argument("--task", default=default.task, metavar="NAME")
    parser.add_argument("--num-workers", type=int, nargs="+", default=sorted({1, available_cores()}), metavar="N")
    parser.add_argument("--envs-per-worker", type=int, default=MOST_ENVS, metavar="E")
    parser.add_argument("--physics", choices=(*PHYSICS, "both"), default="both", help="2 kHz x 50, or 2.5 ms x 10")
    parser.add_argument("--hidden", type=int, default=default.network.hidden_size, help="width of the networks")
    parser.add_argument("--symmetric", action="store_true", help="mirror-equivariant networks")
    parser.add_argument("--steps-per-env", type=int, default=64, help="environment steps per environment and round")
    parser.add_argument("--rounds", type=int, default=5, help="measured rounds, after one that warms up")


def measure(arguments: argparse.Namespace) -> dict:
    """Every combination of physics and number of workers."""
    names = list(PHYSICS) if arguments.physics == "both" else [arguments.physics]
    cells = []
    for name in names:
        for num_workers in arguments.num_workers:
            config = make_config(arguments, name, num_workers)
            check(config)
            cells.append({"physics": name, **measure_cell(config, arguments.rounds)})
    return {"hidden": arguments.hidden, "symmetric": arguments.symmetric, "cells": cells}


def with_physics(config: Config, name: str) -> Config:
    """`config` at one of the physics rates of `PHYSICS`."""
    timestep_s, steps, iterations, line_search = PHYSICS[name]
    physics = replace(
        config.physics,
        timestep_s=timestep_s,
        steps_per_env_step=steps,
        solver_iterations=iterations,
        line_search_iterations=line_search,
    )
    return replace(config, physics=physics)


def make_config(arguments: argparse.Namespace, physics: str, num_workers: int) -> Config:
    """The default configuration with one round of the benchmark as an iteration."""
    config = with_physics(from_dict({"task": arguments.task}), physics)
    return replace(
        config,
        network=replace(config.network, hidden_size=arguments.hidden, symmetric=arguments.symmetric),
        collect=replace(
            config.collect,
            num_workers=num_workers,
            envs_per_worker=arguments.envs_per_worker,
            unroll_length=arguments.steps_per_env,
            env_steps_per_iteration=num_workers * arguments.envs_per_worker * arguments.steps_per_env,
        ),
    )


def measure_cell(config: Config, rounds: int) -> dict:
    """One number of workers at one physics rate."""
    task, plan = make_task(config), make_plan(config)
    sizes = task.observation_size, task.action_size, task.mirror
    parameters = ppo.export_parameters(ppo.init_learner(config, *sizes, jax.random.key(config.seed)))
    measured = []
    with PhysicsLimit(config, plan.num_workers, plan.steps_per_worker) as limit:
        started = time.perf_counter()
        with CpuPool(config, plan, task) as pool:
            start_seconds = time.perf_counter() - started
            for iteration in range(rounds + 1):
                limit_per_second, limit_per_cpu_second = limit.round()
                figures = measure_round(pool, parameters, iteration)
                figures |= {"limit_env_steps_per_second": limit_per_second}
                figures |= {"limit_env_steps_per_cpu_second": limit_per_cpu_second}
                measured.append(figures)
            resident = max(psutil.Process(pid).memory_info().rss for pid in pool.process_ids)
    medians = {name: statistics.median(figures[name] for figures in measured[1:]) for name in measured[0]}
    return {
        "num_workers": plan.num_workers,
        "envs_per_worker": plan.envs_per_worker,
        "rounds": rounds,
        **medians,
        "share_of_limit": medians["env_steps_per_second"] / medians["limit_env_steps_per_second"],
        "share_of_limit_by_cpu_time": medians["env_steps_per_cpu_second"] / medians["limit_env_steps_per_cpu_second"],
        "worker_start_seconds": start_seconds,
        "worker_resident_mb": resident / 1e6,
    }


def measure_round(pool: CpuPool, parameters: dict, iteration: int) -> dict[str, float]:
    """One iteration of the pool: its speed, and where the time of a worker goes, in µs per environment step."""
    started = time.perf_counter()
    pool.start(parameters, iteration, version=iteration)
    collected = pool.finish()
    seconds = time.perf_counter() - started
    workers, steps = collected.statistics, len(collected.fields["mask"])
    cpu = {item: sum(worker[f"{item}_cpu_seconds"] for worker in workers) for item in ITEMS[:-1]}
    total = sum(worker["cpu_seconds"] for worker in workers)
    cpu["other"] = total - sum(cpu.values())
    slowest = max(worker["seconds"] for worker in workers)
    waiting = sum(seconds - worker["cpu_seconds"] for worker in workers)
    return {
        "env_steps_per_second": steps / seconds,
        "env_steps_per_cpu_second": steps / total,
        **{f"{item}_us": 1e6 * cpu[item] / steps for item in ITEMS},
        "transport_us": 1e6 * (seconds - slowest) / steps,  # parameters out, trajectories merged; nobody computes
        "waiting_us": 1e6 * waiting / steps,  # a worker without work or without a core, transport included
    }


def tables(figures: dict) -> str:
    """Speed against the limit, then the time outside physics by item."""
    cells = figures["cells"]
    names = [f"{cell['physics']}, {cell['num_workers']} x {cell['envs_per_worker']}" for cell in cells]
    speed = format_table(
        ["physics, workers x envs", "env steps/s", "limit", "share", "share (CPU time)", "start s", "MB per worker"],
        [
            [
                name,
                cell["env_steps_per_second"],
                cell["limit_env_steps_per_second"],
                cell["share_of_limit"],
                cell["share_of_limit_by_cpu_time"],
                cell["worker_start_seconds"],
                cell["worker_resident_mb"],
            ]
            for name, cell in zip(names, cells, strict=True)
        ],
    )
    columns = (*ITEMS, "transport", "waiting")
    items = format_table(
        ["µs per env step and worker", *columns],
        [[name, *(cell[f"{item}_us"] for item in columns)] for name, cell in zip(names, cells, strict=True)],
    )
    return f"hidden {figures['hidden']}, symmetric {figures['symmetric']}\n\n{speed}\n\n{items}"
