"""The most that C MuJoCo can do on this machine: processes that step physics and nothing else.

Each process first records a stretch of the task under random actions, then replays its controls from its start
states with `mj_step(model, data, nstep)`, so the contacts are those of an untrained policy. No policy, no
observation, no reward and no randomness is left in the timed loop.
"""

import multiprocessing
import time
from multiprocessing.connection import Connection
from typing import NamedTuple

import mujoco
import numpy as np

from hasrl_jax.collect.plan import make_plan
from hasrl_jax.config.schema import Config
from hasrl_jax.envs.cpu_engine import PHYSICS_STATE, CpuEnvs
from hasrl_jax.envs.registry import make_task


class Stretch(NamedTuple):
    """One environment between two resets."""

    model: mujoco.MjModel  # with the fields of this episode
    data: mujoco.MjData
    start: np.ndarray  # physics state
    controls: np.ndarray  # [environment steps, nu]


class PhysicsLimit:
    """Processes that replay physics on demand; use as a context manager."""

    def __init__(self, config: Config, num_processes: int, env_steps: int):
        context = multiprocessing.get_context("spawn")
        self._connections, self._processes = [], []
        for index in range(num_processes):
            ours, theirs = context.Pipe()
            process = context.Process(target=_serve, args=(theirs, config, env_steps, index), daemon=True)
            process.start()
            theirs.close()
            self._connections.append(ours)
            self._processes.append(process)
        for connection in self._connections:
            connection.recv()

    def __enter__(self) -> "PhysicsLimit":
        return self

    def __exit__(self, *_: object) -> None:
        for connection, process in zip(self._connections, self._processes, strict=True):
            connection.close()
            process.join()

    def round(self) -> tuple[float, float]:
        """Replays once in all processes; returns environment steps per wall second, and per CPU second."""
        started = time.perf_counter()
        for connection in self._connections:
            connection.send("replay")
        replies = [connection.recv() for connection in self._connections]
        steps, cpu_seconds = (sum(column) for column in zip(*replies, strict=True))
        return steps / (time.perf_counter() - started), steps / cpu_seconds


def _serve(connection: Connection, config: Config, env_steps: int, seed: int) -> None:
    """The life of one process: records, then replays whenever it is asked."""
    stretches = record(config, env_steps, seed)
    replay(stretches, config.physics.steps_per_env_step)
    connection.send("ready")
    while True:
        try:
            connection.recv()
        except EOFError:
            return
        cpu = time.process_time()
        replay(stretches, config.physics.steps_per_env_step)
        connection.send((sum(len(stretch.controls) for stretch in stretches), time.process_time() - cpu))


def record(config: Config, env_steps: int, seed: int) -> list[Stretch]:
    """About `env_steps` environment steps under the actions of a policy that has learnt nothing."""
    task, num_envs = make_task(config), make_plan(config).envs_per_worker
    envs = CpuEnvs(task, num_envs, config.collect.max_episode_steps)
    rng = np.random.default_rng([config.seed, seed])
    state = envs.reset(rng)
    std = np.exp(config.network.initial_log_std)
    starts, stretches = list(state.physics.copy()), []
    controls: list[list[np.ndarray]] = [[] for _ in range(num_envs)]
    fields = [_fields_of(state.model_fields, env) for env in range(num_envs)]
    horizon = -(-env_steps // num_envs)
    for t in range(horizon):
        action = std * rng.standard_normal((num_envs, task.action_size))
        control = task.control(state.task, action, np)
        for env in range(num_envs):
            controls[env].append(control[env])
        state, _ = envs.step(state, action, rng)
        for env in np.flatnonzero(state.is_first | (t == horizon - 1)).tolist():
            model = _with_fields(task.model, fields[env])
            stretches.append(Stretch(model, mujoco.MjData(model), starts[env], np.array(controls[env])))
            starts[env], controls[env] = state.physics[env].copy(), []
            fields[env] = _fields_of(state.model_fields, env)
    return stretches


def replay(stretches: list[Stretch], steps_per_env_step: int) -> None:
    """The timed loop."""
    for stretch in stretches:
        model, data = stretch.model, stretch.data
        mujoco.mj_resetData(model, data)
        mujoco.mj_setState(model, data, stretch.start, PHYSICS_STATE)
        for control in stretch.controls:
            data.ctrl = control
            mujoco.mj_step(model, data, steps_per_env_step)


def _fields_of(model_fields: dict[str, np.ndarray], env: int) -> dict[str, np.ndarray]:
    return {name: values[env : env + 1].copy() for name, values in model_fields.items()}


def _with_fields(model: mujoco.MjModel, fields: dict[str, np.ndarray]) -> mujoco.MjModel:
    model = model.__copy__()
    write_fields(model, fields, 0)
    return model


def write_fields(model: mujoco.MjModel, fields: dict[str, np.ndarray], row: int) -> None:
    """The fields of one robot, row `row` of each [E, ...], into its model."""
    for name, values in fields.items():
        if name == "timestep":
            model.opt.timestep = values[row]
        else:
            getattr(model, name)[:] = values[row]
