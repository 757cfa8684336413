"""`bench scaling`: how the CPU pool grows with the number of workers, and what each worker costs the learner.

Every number of workers has a pool of its own, all open at once and idle except when their turn comes, so that rounds
alternate and other work on the machine slows all of them alike. Each worker always has the same work to do. From its
costs follows what machines would do that are not here (`scaling_model`), checked against everything measured: all
cores, fewer of them, and Ray on this machine where it is installed.
"""

import argparse
import os
import statistics
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from typing import NamedTuple

import jax
import psutil

from hasrl_jax.bench import collector, learner, scaling_model
from hasrl_jax.bench.report import format_table
from hasrl_jax.collect.buffer import merge
from hasrl_jax.collect.cpu import to_trajectory
from hasrl_jax.collect.plan import MOST_ENVS, Plan, make_plan
from hasrl_jax.collect.ray.cluster import import_ray
from hasrl_jax.collect.ray.pool import RayPool
from hasrl_jax.collect.supervisor import CpuPool
from hasrl_jax.config.checks import check
from hasrl_jax.config.convert import from_dict
from hasrl_jax.config.schema import Config, available_cores
from hasrl_jax.envs.registry import make_task
from hasrl_jax.errors import ConfigError
from hasrl_jax.learn import ppo

MODEL_CORES = (8, 16, 32, 64, 128, 256)
MODEL_DEVICES = (1, 2, 4, 8)


class Place(NamedTuple):
    """A pool, and where it runs."""

    pool: CpuPool | RayPool
    backend: str
    cores: int  # that it may use


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
    parser.add_argument("--cores", type=int, nargs="*", default=[], metavar="C", help="also on so many cores alone")
    parser.add_argument("--ray", type=int, nargs="*", default=[], metavar="N", help="also so many workers under Ray")
    parser.add_argument("--updates", type=int, default=3, help="timed updates of the learner, for the model")
    parser.add_argument(
        "--device-speed", type=float, default=10.0, help="assumed: an accelerator's update over that of all cores here"
    )


def measure(arguments: argparse.Namespace) -> dict:
    """A cell per number of workers.

    Raises:
      ConfigError: an impossible argument.
    """
    numbers = sorted({1, *arguments.num_workers})
    configs = {number: collector.make_config(arguments, arguments.physics, number) for number in numbers}
    check_arguments(arguments, configs)
    task = make_task(configs[1])
    learner_state = ppo.init_learner(
        configs[1], task.observation_size, task.action_size, task.mirror, jax.random.key(configs[1].seed)
    )
    with ExitStack() as stack:
        places = []
        for config in configs.values():
            pool = stack.enter_context(CpuPool(config, make_plan(config), task))
            places.append(Place(pool, "cpu_pool", available_cores()))
        for cores in arguments.cores:
            config = collector.make_config(arguments, arguments.physics, cores)
            with on_cores(cores):  # the workers keep what they are born with
                pool = stack.enter_context(CpuPool(config, make_plan(config), task))
            places.append(Place(pool, "cpu_pool", cores))
        for number in arguments.ray:
            config = replace(collector.make_config(arguments, arguments.physics, number), backend="ray")
            places.append(
                Place(stack.enter_context(RayPool(config, make_plan(config), task)), "ray", available_cores())
            )
        rounds = [
            [measure_round(place, learner_state, iteration) for place in places]
            for iteration in range(arguments.rounds + 1)
        ]
        cells = [
            summarize(place, figures) for place, figures in zip(places, zip(*rounds[1:], strict=True), strict=True)
        ]
    alone = cells[0]["env_steps_per_second"]
    for cell in cells:
        cell["ideal_env_steps_per_second"] = alone * min(cell["cores"], cell["num_workers"])
        cell["share_of_ideal"] = cell["env_steps_per_second"] / cell["ideal_env_steps_per_second"]
    costs = costs_of(cells, update_seconds(configs[1], make_plan(configs[1]), arguments.updates))
    for cell in cells:
        predicted = scaling_model.collecting_here(costs, cell["num_workers"], cell["cores"])
        cell["predicted_env_steps_per_second"] = predicted
    speed = arguments.device_speed
    return {
        "task": arguments.task,
        "physics": arguments.physics,
        "hidden": arguments.hidden,
        "symmetric": arguments.symmetric,
        "rounds": arguments.rounds,
        "cells": cells,
        "costs": costs._asdict(),
        "device_speed": speed,
        "model": [
            scaling_model.predict(costs, cores, devices, speed)._asdict()
            for cores in MODEL_CORES
            for devices in MODEL_DEVICES
        ],
        "most_workers": {devices: scaling_model.most_workers(costs, devices, speed) for devices in MODEL_DEVICES},
    }


def check_arguments(arguments: argparse.Namespace, configs: dict[int, Config]) -> None:
    """Raises a ConfigError that names what is impossible."""
    for config in configs.values():
        check(config)
    for name in ("rounds", "updates"):
        if getattr(arguments, name) < 1:
            raise ConfigError(f"--{name}: got {getattr(arguments, name)}; expected at least 1")
    if not arguments.device_speed > 0:
        raise ConfigError(f"--device-speed: got {arguments.device_speed}; expected more than 0")
    for cores in arguments.cores:
        if not 1 <= cores <= available_cores():
            raise ConfigError(f"--cores: got {cores}; expected 1 to {available_cores()}")
    for number in arguments.ray:
        config = replace(collector.make_config(arguments, arguments.physics, number), backend="ray")
        check(config)
        import_ray(config.ray)


@contextmanager
def on_cores(number: int) -> Iterator[None]:
    """This thread, and the processes that it starts, on the first `number` cores that it may use."""
    if number >= available_cores():
        yield
        return
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, sorted(before)[:number])
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


def update_seconds(config: Config, plan: Plan, updates: int) -> float:
    """Seconds of an update for each environment step that one worker brings."""
    rows = plan.rows // config.ppo.minibatch_trajectories * config.ppo.minibatch_trajectories
    config = replace(config, ppo=replace(config.ppo, max_kl=0.0))  # no step is skipped, so every update is as long
    cell = learner.measure_cell(config, rows, plan.max_length, updates)
    return float(cell["seconds_per_update"]) / (rows * plan.max_length)


def costs_of(cells: list[dict], update_s: float) -> scaling_model.Costs:
    """The model's numbers from the cells of `CpuPool` on all cores of this machine."""
    known = [cell for cell in cells if cell["backend"] == "cpu_pool" and cell["cores"] == available_cores()]
    exchanges = [cell["broadcast_seconds"] + cell["merge_seconds"] + cell["pad_seconds"] for cell in known]
    fixed_s, per_worker_s = scaling_model.exchange_line([cell["num_workers"] for cell in known], exchanges)
    busy = [cell for cell in known if cell["num_workers"] >= available_cores()] or known[-1:]
    return scaling_model.Costs(
        env_steps=known[0]["env_steps"],  # of one worker
        cores=available_cores(),
        step_s=busy[0]["step_cpu_seconds"],
        fixed_s=fixed_s,
        per_worker_s=per_worker_s,
        update_s=update_s,
    )


def measure_round(place: Place, learner_state: ppo.LearnerState, iteration: int) -> dict[str, float]:
    """One iteration of one pool; seconds of the learner's process for each part of the exchange.

    Merging is timed once more after the iteration, on the buffers that lie there, because `finish` does it while the
    workers' last replies come in. Ray's buffers are gone by then: its merging is only in its environment steps/s.
    """
    pool = place.pool
    with on_cores(place.cores):
        started = time.perf_counter()
        parameters = ppo.export_parameters(learner_state)
        exported = time.perf_counter()
        pool.start(parameters, iteration, version=iteration)
        sent = time.perf_counter()
        collected = pool.finish()
        finished = time.perf_counter()
        if isinstance(pool, CpuPool):
            slots = [pool.slot(index, iteration) for index in range(len(collected.statistics))]
            collected = merge(slots, collected.statistics, iteration, seconds=0.0)
        merged = time.perf_counter()
        to_trajectory(collected, pool.plan)
        padded = time.perf_counter()
    steps = len(collected.fields["mask"])
    return {
        "env_steps_per_second": steps / (padded - merged + finished - exported),
        "step_cpu_seconds": sum(worker["cpu_seconds"] for worker in collected.statistics) / steps,
        "export_seconds": exported - started,
        "broadcast_seconds": sent - exported,
        "merge_seconds": merged - finished,
        "pad_seconds": padded - merged,
    }


def summarize(place: Place, rounds: tuple[dict[str, float], ...]) -> dict:
    """Medians of the rounds, and the memory of the workers."""
    medians = {name: statistics.median(figures[name] for figures in rounds) for name in rounds[0]}
    pool = place.pool
    ids = pool.process_ids if isinstance(pool, CpuPool) else [process for _, process in pool.places.values()]
    memory = [psutil.Process(pid).memory_full_info() for pid in ids]
    return {
        "backend": place.backend,
        "cores": place.cores,
        "num_workers": pool.plan.num_workers,
        "envs_per_worker": pool.plan.envs_per_worker,
        "env_steps": pool.plan.env_steps,
        **medians,
        "worker_resident_mb": statistics.median(entry.rss for entry in memory) / 1e6,
        "worker_own_mb": statistics.median(entry.uss for entry in memory) / 1e6,
    }


def tables(figures: dict) -> str:
    """Speed against perfect scaling, the cost of each worker, and the model with its check."""
    cells = figures["cells"]
    names = [
        f"{cell['num_workers']}{' under Ray' if cell['backend'] == 'ray' else ''} on {cell['cores']} cores"
        for cell in cells
    ]
    speed = format_table(
        ["workers", "envs", "env steps/s", "min(cores, workers) x one", "share", "model", "model / measured"],
        [
            [
                name,
                cell["num_workers"] * cell["envs_per_worker"],
                cell["env_steps_per_second"],
                cell["ideal_env_steps_per_second"],
                cell["share_of_ideal"],
                cell["predicted_env_steps_per_second"],
                cell["predicted_env_steps_per_second"] / cell["env_steps_per_second"],
            ]
            for name, cell in zip(names, cells, strict=True)
        ],
    )
    cost = format_table(
        ["workers", "export ms", "broadcast ms", "per worker", "merge ms", "pad ms", "per worker", "MB", "own MB"],
        [
            [
                name,
                1e3 * cell["export_seconds"],
                1e3 * cell["broadcast_seconds"],
                1e3 * cell["broadcast_seconds"] / cell["num_workers"],
                1e3 * cell["merge_seconds"],
                1e3 * cell["pad_seconds"],
                1e3 * (cell["merge_seconds"] + cell["pad_seconds"]) / cell["num_workers"],
                cell["worker_resident_mb"],
                cell["worker_own_mb"],
            ]
            for name, cell in zip(names, cells, strict=True)
        ],
    )
    return (
        f"{figures['task']}, {figures['physics']} physics, hidden {figures['hidden']}, symmetric "
        f"{figures['symmetric']}, {cells[0]['env_steps']} environment steps per worker and round\n\n{speed}"
        "\n\nThe learner's process, per iteration: parameters from the device (export), their copy to shared memory "
        "and the requests\nto the workers (broadcast), the workers' buffers into one (merge) and into padded "
        f"trajectories (pad); memory of a worker,\nin all and what it shares with nobody.\n\n{cost}\n\n{model(figures)}"
    )


def model(figures: dict) -> str:
    """What machines would do that are not here."""
    costs, found = figures["costs"], figures["model"]
    devices = sorted({cell["devices"] for cell in found})
    rows = []
    for cores in sorted({cell["cores"] for cell in found}):
        row = [cell for cell in found if cell["cores"] == cores]
        rows.append([str(cores), *(f"{cell['env_steps_per_second']:,.0f} ({cell['bottleneck']})" for cell in row)])
    most = ", ".join(f"{number:,.0f} with {count}" for count, number in figures["most_workers"].items())
    headers = ["cores", *(f"{number} accelerator{'s' if number > 1 else ''}" for number in devices)]
    return (
        "Model, env steps/s of collecting and learning under `overlap` or `decoupled`, and what is the bottleneck:\n\n"
        f"{format_table(headers, rows)}\n\n"
        f"Workers that keep one learner busy, by accelerators: {most}.\n"
        f"Measured: {1e6 * costs['step_s']:.0f} µs of a core per environment step; exchange "
        f"{1e3 * costs['fixed_s']:.2f} ms and {1e3 * costs['per_worker_s']:.2f} ms per worker of {costs['env_steps']} "
        f"steps; update {1e6 * costs['update_s']:.0f} µs per environment step on {costs['cores']} cores.\n"
        "Assumed: cores like these, one of them for the learner's process and a worker on each other; an accelerator "
        f"that updates {figures['device_speed']:g} times\nas fast as all cores here; several share the update evenly, "
        "and their all-reduce and the copy of the batch to them cost nothing."
    )
