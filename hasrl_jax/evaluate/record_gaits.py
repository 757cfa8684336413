"""Records a gait library from a policy that walks as commanded, see `envs/cassie/gaits.py`.

All gaits are walked side by side. Since no policy walks exactly as told, each is told again by what it missed, so that
a gait's place in the library is how it moves, not what was asked for.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from hasrl_jax.config import tasks
from hasrl_jax.config.schema import Config
from hasrl_jax.envs.cassie import bezier, gaits
from hasrl_jax.envs.cassie.ids import CassieIds, cassie_ids
from hasrl_jax.envs.cpu_engine import CpuEnvs
from hasrl_jax.envs.registry import make_task
from hasrl_jax.envs.task import Task
from hasrl_jax.errors import ConfigError
from hasrl_jax.policy import actor
from hasrl_jax.policy.numpy_networks import Parameters

GRID = {
    "forward_m_s": 0.5 * np.arange(-1, 6),
    "lateral_m_s": 0.3 * np.arange(2),
    "height_m": 0.8 + 0.1 * np.arange(3),
}
TRIALS = 3  # walks of the whole grid, of which the last is kept
SETTLE_CYCLES, KEPT_CYCLES = 5, 4
NOT_A_STAND = 1e-6  # yaw rate, rad/s, under which the clock goes on where no speed is commanded
MOST_WOBBLE_RAD = 0.2  # standard deviation of a joint over the cycles, or a gait is not periodic
MOST_STANDING_RAD_S = 0.5  # of a joint; and m/s of the pelvis, of a robot that stands
LOWER_M = 0.02  # by which one that was told to stand and did not is told again
COMMANDS = ("forward", "lateral", "yaw_rate", "height")


class Walked(NamedTuple):
    """G robots that have settled, from phase 0 on: K cycles of N environment steps."""

    states: np.ndarray  # [K, N, G, 67] before each step, with the pelvis' place from a point of constant velocity
    measured: np.ndarray  # [G, 3] mean forward and lateral speed, m/s, and height, m


def record(config: Config, parameters: Parameters, grid: Mapping[str, np.ndarray] | None = None) -> gaits.Library:
    """Walks and fits every gait, and a stand at every height.

    Args:
      config: of a policy in the heading frame; the nominal robot is recorded, under the physics that are given.
      parameters: as `learn.ppo.export_parameters` returns them.
      grid: evenly spaced values of each of `gaits.AXES`, lateral speeds from 0 on; default: GRID.

    Raises:
      ConfigError: the policy cannot be told all of this, its gait cycle is no even number of environment steps, or a
        robot fell or has no periodic gait.
    """
    grid = GRID if grid is None else grid
    config = tasks.find(config.task).undisturbed(config)
    task = make_task(config)
    if tuple(command.name for command in task.commands) != COMMANDS:
        raise ConfigError(f"--policy: expected one that is told {', '.join(COMMANDS)}; try released-steer")
    cycle_s = config.settings.clock.cycle_s
    count = round(cycle_s / task.env_step_s)
    if config.settings.clock.cycle_per_speed_s or count % 2 or abs(count * task.env_step_s - cycle_s) > 1e-9:
        raise ConfigError(f"cassie.clock: got {cycle_s:g} s; expected one even number of policy steps at all speeds")
    cells = np.stack(np.meshgrid(*(grid[name] for name in gaits.AXES), indexing="ij"), axis=-1)
    wanted = cells.reshape(-1, 3)
    told = np.insert(wanted, 2, NOT_A_STAND, axis=1)
    for trial in range(TRIALS):
        walked = walk(config, task, parameters, told, count)
        if trial < TRIALS - 1:
            told[:, [0, 1, 3]] += wanted - walked.measured
    require_periodic(walked, wanted)
    standing_states = stand(config, task, parameters, np.asarray(grid["height_m"]), count)
    return library(task, grid, walked.states, standing_states, cycle_s)


def library(
    task: Task, grid: Mapping[str, np.ndarray], states: np.ndarray, standing_states: np.ndarray, cycle_s: float
) -> gaits.Library:
    """The curves and states of recorded gaits.

    Args:
      task: of the recorded robots.
      grid: as in `record`; F, L and H values.
      states: [K, N, F L H, 67] as in `Walked`.
      standing_states: [H, 67].
      cycle_s: of a gait.
    """
    ids, shape = cassie_ids(task.model), tuple(len(grid[name]) for name in gaits.AXES)
    mean_cycles = np.moveaxis(motion_of(states, ids).mean(axis=0), 1, 0)
    curves = np.array([bezier.fit(samples) for samples in mean_cycles])
    curves = curves.reshape(*shape, *curves.shape[1:])
    straight = curves[:, 0]  # its own mirror image, but for what the recording has of chance
    curves[:, 0] = (straight + gaits.mirrored_curves(straight)) / 2
    return gaits.Library(
        forward_m_s=np.asarray(grid["forward_m_s"], float),
        lateral_m_s=np.asarray(grid["lateral_m_s"], float),
        height_m=np.asarray(grid["height_m"], float),
        curves=curves,
        states=typical_cycles(states).reshape(*shape, *states.shape[1::2]),
        standing=motion_of(standing_states, ids),
        standing_states=standing_states,
        cycle_s=cycle_s,
        policy_rate_hz=1 / task.env_step_s,
        joints=gaits.joint_names(task.model),
    )


def stand(config: Config, task: Task, parameters: Parameters, heights: np.ndarray, count: int) -> np.ndarray:
    """Robots that stand at heights [H], or as high as they can: states [H, 67].

    Raises:
      ConfigError: one fell, or cannot stand, not even a little lower.
    """
    told = np.zeros((len(heights), 4))
    told[:, 3] = heights
    for _ in range(TRIALS):
        walked = walk(config, task, parameters, told, count)
        speeds = np.abs(walked.states[..., gaits.QPOS_SIZE :]).max(axis=(0, 1, 3))
        moves = speeds > MOST_STANDING_RAD_S
        told[:, 3] += np.where(moves, -LOWER_M, heights - walked.measured[:, 2])
    if moves.any():
        raise ConfigError(f"--policy: does not stand, told {_listed(told[moves.argmax()], COMMANDS)}")
    states = walked.states[-1, -1]
    states[:, :2] = 0.0
    return states


def walk(config: Config, task: Task, parameters: Parameters, told: np.ndarray, count: int) -> Walked:
    """Robots that hold commands, `told` [G, 4] as COMMANDS, with `count` environment steps to a cycle.

    Raises:
      ConfigError: one fell.
    """
    assert task.with_command is not None
    envs = CpuEnvs(task, len(told), np.iinfo(np.int64).max)
    rng = np.random.Generator(np.random.Philox(0))
    state = envs.reset(rng)
    at_phase_0 = state.task._replace(phase=np.zeros(len(told)))
    task_state, observation = task.with_command(at_phase_0, state.observation, told, np)
    state = state._replace(task=task_state, observation=observation)
    policy, kept = actor.reset(config, task, parameters, len(told)), []
    for step in range((SETTLE_CYCLES + KEPT_CYCLES) * count):
        if step >= SETTLE_CYCLES * count:
            kept.append(state.physics[:, 1:])
        action, policy = actor.act(policy, state.observation, state.is_first)
        state, result = envs.step(state, action, rng)
        fallen = np.flatnonzero(result.terminated | result.diverged)
        if len(fallen):
            raise ConfigError(f"--policy: a robot fell that was told {_listed(told[fallen[0]], COMMANDS)}")
    states = np.array(kept)
    time_s = task.env_step_s * np.arange(len(states))
    velocity = (states[-count, :, :2] - states[0, :, :2]) / time_s[-count]  # over whole cycles
    states[..., :2] -= velocity * time_s[:, None, None]
    states[..., :2] -= states[..., :2].mean(axis=0)
    measured = np.concatenate([velocity, states[..., 2].mean(axis=0)[:, None]], axis=1)
    return Walked(states.reshape(KEPT_CYCLES, count, *states.shape[1:]), measured)


def motion_of(states: np.ndarray, ids: CassieIds) -> np.ndarray:
    """`gaits.MOTION` of states [..., 67], [..., Q]."""
    rotation = states[..., 4:7] * np.sign(states[..., 3:4])
    shins = ids.passive_qpos[[0, 3]]
    return np.concatenate([states[..., ids.motor_qpos], states[..., shins], states[..., :3], rotation], axis=-1)


def typical_cycles(states: np.ndarray) -> np.ndarray:
    """Of each robot the cycle whose joints are nearest to the mean cycle: [K, N, G, 67] -> [G, N, 67].

    A mean of states would leave the loops of the legs open.
    """
    joints = states[..., 7 : gaits.QPOS_SIZE]
    off = ((joints - joints.mean(axis=0)) ** 2).sum(axis=(1, 3))
    return np.array([states[cycle, :, robot] for robot, cycle in enumerate(off.argmin(axis=0))])


def require_periodic(walked: Walked, wanted: np.ndarray) -> None:
    """Refuses gaits that differ from cycle to cycle; `wanted` [G, 3].

    Raises:
      ConfigError: names the worst of them.
    """
    wobble = walked.states[..., 7 : gaits.QPOS_SIZE].std(axis=0).max(axis=(0, 2))
    worst = wobble.argmax()
    if wobble[worst] > MOST_WOBBLE_RAD:
        which = _listed(wanted[worst], gaits.AXES)
        raise ConfigError(f"--policy: no periodic gait at {which}: joints differ by {wobble[worst]:.2f} rad")


def _listed(values: np.ndarray, names: tuple[str, ...]) -> str:
    return ", ".join(f"{name} {value:.2f}" for name, value in zip(names, values, strict=True))
