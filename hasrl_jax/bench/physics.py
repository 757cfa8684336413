"""`bench physics`: where the time of a physics step goes, and what other ways to step would cost.

Every way steps the same robots from the same states under the same controls, in turns, and its CPU time is taken, which
hardly feels other work on the machine. `deviation` is the largest difference of any position or velocity after one
environment step from stepping each robot with a model of its own, all sensors and MuJoCo's defaults.
"""

import argparse
import copy
import statistics
import time
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import mujoco
import numpy as np
from mujoco import rollout

from hasrl_jax.bench.collector import PHYSICS, with_physics
from hasrl_jax.bench.physics_limit import write_fields
from hasrl_jax.bench.report import format_table
from hasrl_jax.config.checks import check
from hasrl_jax.config.convert import from_dict
from hasrl_jax.envs.cpu_engine import PHYSICS_STATE, CpuEnvs, EnvState
from hasrl_jax.envs.registry import make_task
from hasrl_jax.envs.task import Task
from hasrl_jax.errors import ConfigError

WARM_UP = 20  # environment steps before the first that is measured: the robots have landed, and some lie
TIMERS = {  # what does not overlap, of MuJoCo's own timers; what is left is the smooth acceleration, sensors and checks
    "kinematics": mujoco.mjtTimer.mjTIMER_POS_KINEMATICS,
    "inertia": mujoco.mjtTimer.mjTIMER_POS_INERTIA,
    "collision, broad phase": mujoco.mjtTimer.mjTIMER_COL_BROAD,
    "collision, narrow phase": mujoco.mjtTimer.mjTIMER_COL_NARROW,
    "making constraints": mujoco.mjtTimer.mjTIMER_POS_MAKE,
    "velocity": mujoco.mjtTimer.mjTIMER_VELOCITY,
    "actuation": mujoco.mjtTimer.mjTIMER_ACTUATION,
    "solving constraints": mujoco.mjtTimer.mjTIMER_CONSTRAINT,
    "integration": mujoco.mjtTimer.mjTIMER_ADVANCE,
}
BEFORE, ENGINE = "a model per robot", "the engine"


class Moment(NamedTuple):
    """One environment step to be repeated."""

    state: EnvState
    control: np.ndarray  # [E, nu]


# Steps all robots: physics states after an environment step, [E, nstate], and CPU seconds inside MuJoCo.
Step = Callable[[Moment], tuple[np.ndarray, float]]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the physics benchmark."""
    parser.add_argument("--physics", choices=tuple(PHYSICS), default="fast", help="2 kHz x 50, or 400 Hz x 10")
    parser.add_argument("--num-envs", type=int, default=128, metavar="E", help="robots, each drawn anew")
    parser.add_argument("--rounds", type=int, default=20, help="environment steps that every way repeats")


def measure(arguments: argparse.Namespace) -> dict:
    """The parts of a physics step, and every way in turn.

    Raises:
      ConfigError: an impossible argument.
    """
    for name in ("num_envs", "rounds"):
        if getattr(arguments, name) < 1:
            raise ConfigError(f"--{name.replace('_', '-')}: got {getattr(arguments, name)}; expected at least 1")
    config = with_physics(from_dict({}), arguments.physics)
    check(config)
    task = make_task(config)
    moments = record(task, config.collect.max_episode_steps, arguments.num_envs, arguments.rounds)
    ways = {BEFORE: own_models(task, arguments.num_envs)}
    ways |= {name: engine(*change, arguments.num_envs) for name, change in changes(task).items()}
    ends: dict[str, list[np.ndarray]] = {name: [] for name in ways}
    seconds: dict[str, list[float]] = {name: [] for name in ways}
    for number, moment in enumerate([moments[0], *moments]):  # the first one warms up
        for name in list(ways) if number % 2 else reversed(ways):
            end, spent = ways[name](moment)
            seconds[name].append(spent)
            ends[name].append(end)
    per_step = 1e6 / arguments.num_envs
    cells = [
        {
            "way": name,
            "us_per_env_step": per_step * statistics.median(seconds[name][1:]),
            "ratio": statistics.median(
                ours / theirs for ours, theirs in zip(seconds[name][1:], seconds[BEFORE][1:], strict=True)
            ),
            "deviation": max(float(np.abs(a - b).max()) for a, b in zip(ends[name], ends[BEFORE], strict=True)),
        }
        for name in ways
    ]
    return {
        "physics": arguments.physics,
        "num_envs": arguments.num_envs,
        "rounds": arguments.rounds,
        "parts": parts(task, moments[: min(4, len(moments))]),
        "cells": cells,
    }


def record(task: Task, max_episode_steps: int, num_envs: int, rounds: int) -> list[Moment]:
    """Consecutive environment steps of robots under the actions of a policy that has learnt nothing."""
    envs, rng = CpuEnvs(task, num_envs, max_episode_steps), np.random.default_rng(0)
    state, moments = envs.reset(rng), []
    for _ in range(WARM_UP + rounds):
        action = rng.standard_normal((num_envs, task.action_size))
        moments.append(Moment(state, task.control(state.task, action, np)))
        state, _ = envs.step(state, action, rng)
    return moments[WARM_UP:]


def own_models(task: Task, num_envs: int) -> Step:
    """`mujoco.rollout` with a model for each robot."""
    models = [copy.copy(task.model) for _ in range(num_envs)]
    data, steps, engine = mujoco.MjData(task.model), task.steps_per_env_step, rollout.Rollout(nthread=0)
    states = np.empty((num_envs, steps, mujoco.mj_stateSize(task.model, PHYSICS_STATE)))
    sensors = np.empty((num_envs, steps, task.model.nsensordata))

    def step(moment: Moment) -> tuple[np.ndarray, float]:
        for env, model in enumerate(models):
            write_fields(model, moment.state.model_fields, env)
        control = np.repeat(moment.control[:, None], steps, axis=1)
        started = time.thread_time()
        engine.rollout(
            models,
            [data],
            moment.state.physics,
            control,
            skip_checks=True,
            nstep=steps,
            state=states,
            sensordata=sensors,
        )
        return states[:, -1].copy(), time.thread_time() - started

    return step


def changes(task: Task) -> dict[str, tuple[Task, Callable[[CpuEnvs], None]]]:
    """What to try: a name -> a changed task, and what to change of the engine that runs it."""

    def option(name: str, value: float) -> Task:
        model = copy.copy(task.model)
        setattr(model.opt, name, value)
        return replace(task, model=model)

    def without(bit: mujoco.mjtDisableBit) -> Task:
        return option("disableflags", task.model.opt.disableflags | bit.value)

    def islands(envs: CpuEnvs) -> None:
        envs._batch.expand("opt.disableflags")[:] = task.model.opt.disableflags

    def warm(envs: CpuEnvs) -> None:
        envs._warm_start = envs._warm_start.copy()  # what the engine clears is no longer the batch's

    def as_it_is(_: CpuEnvs) -> None:
        pass

    return {
        ENGINE: (task, as_it_is),
        "all sensors in every physics step": (replace(task, end_sensors=()), as_it_is),
        "islands": (task, islands),
        "warm start from the last environment step": (task, warm),
        "sparse Jacobian": (option("jacobian", mujoco.mjtJacobian.mjJAC_SPARSE.value), as_it_is),
        "solver tolerance 1e-6 instead of 1e-8": (option("tolerance", 1e-6), as_it_is),
        "no midphase": (without(mujoco.mjtDisableBit.mjDSBL_MIDPHASE), as_it_is),
        "no sensors (a bound)": (without(mujoco.mjtDisableBit.mjDSBL_SENSOR), as_it_is),
        "no contacts (a bound)": (without(mujoco.mjtDisableBit.mjDSBL_CONTACT), as_it_is),
    }


def engine(task: Task, change: Callable[[CpuEnvs], None], num_envs: int) -> Step:
    """The collectors' engine on a changed task, itself changed."""
    envs = CpuEnvs(task, num_envs, 1, timed=True)
    change(envs)

    def step(moment: Moment) -> tuple[np.ndarray, float]:
        envs.restore(moment.state)
        before = envs.physics_seconds
        end, _, _ = envs._simulate(moment.state, moment.control[:, None])
        return end, envs.physics_seconds - before

    return step


def parts(task: Task, moments: list[Moment]) -> dict:
    """Microseconds of each part of a physics step, and how many contacts, constraint rows and solver iterations.

    The clock itself takes as long as the smallest part: each part is timed once per step, so what one call of it
    costs is taken off, and the sum without the clock is measured apart.
    """
    model = copy.copy(task.model)
    data = mujoco.MjData(model)
    counts: dict[str, list[float]] = {"contacts": [], "constraint rows": [], "solver iterations": []}
    seconds = dict.fromkeys(TIMERS, 0.0)
    steps, total = 0, 0.0

    def play(moment: Moment, env: int, count: bool) -> None:
        mujoco.mj_resetData(model, data)
        mujoco.mj_setState(model, data, moment.state.physics[env], PHYSICS_STATE)
        data.ctrl[:] = moment.control[env]
        for _ in range(task.steps_per_env_step):
            mujoco.mj_step(model, data)
            if count:
                counts["contacts"].append(data.ncon)
                counts["constraint rows"].append(data.nefc)
                counts["solver iterations"].append(data.solver_niter[0])

    tick = clock_seconds()
    for moment in moments:
        for env in range(len(moment.control)):
            write_fields(model, moment.state.model_fields, env)
            started = time.thread_time()
            play(moment, env, count=False)
            total += time.thread_time() - started
            mujoco.set_mjcb_time(time.thread_time)
            try:
                play(moment, env, count=False)
            finally:
                mujoco.set_mjcb_time(None)
            for name, timer in TIMERS.items():
                seconds[name] += data.timer[timer.value].duration - tick * data.timer[timer.value].number
            play(moment, env, count=True)
            steps += task.steps_per_env_step
    found = {name: 1e6 * max(0.0, spent) / steps for name, spent in seconds.items()}
    whole = 1e6 * total / steps
    return {
        "us": found | {"acceleration, sensors, checks": max(0.0, whole - sum(found.values()))},
        "us_per_physics_step": whole,
        "counts": {name: statistics.fmean(values) for name, values in counts.items()},
    }


def clock_seconds() -> float:
    """What MuJoCo's timers see of a clock in Python when nothing happens between two of its calls."""
    model = mujoco.MjModel.from_xml_string("<mujoco/>")
    data = mujoco.MjData(model)
    mujoco.set_mjcb_time(time.thread_time)
    try:
        mujoco.mj_step(model, data, 1000)
    finally:
        mujoco.set_mjcb_time(None)
    timer = data.timer[mujoco.mjtTimer.mjTIMER_ACTUATION.value]
    return float(timer.duration) / int(timer.number)


def tables(figures: dict) -> str:
    """The parts of a physics step, then the ways to step."""
    found = figures["parts"]
    whole = found["us_per_physics_step"]
    listed = format_table(
        ["part of a physics step", "µs", "share"],
        [[name, us, us / whole] for name, us in found["us"].items()] + [["all", whole, 1.0]],
    )
    ways = format_table(
        ["way", "µs per env step", "ratio", "deviation"],
        [
            [cell["way"], cell["us_per_env_step"], cell["ratio"], f"{cell['deviation']:.1e}"]
            for cell in figures["cells"]
        ],
    )
    counts = ", ".join(f"{value:.2f} {name}" for name, value in found["counts"].items())
    return (
        f"{figures['physics']} physics, {figures['num_envs']} robots drawn at random under an untrained policy, "
        f"{figures['rounds']} rounds; CPU time.\nMeans of a physics step: {counts}.\n\n{listed}\n\n{ways}"
    )
