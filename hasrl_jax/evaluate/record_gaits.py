"""Records a gait library from a policy that walks as commanded, see `envs/cassie/gaits.py`.

All gaits are walked side by side. Since no policy walks exactly as told, each is told again by what it missed, so that
a gait's place in the library is how it moves, not what was asked for; its clock is that of its place.
"""

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from hasrl_jax.config import tasks
from hasrl_jax.config.schema import Config
from hasrl_jax.envs import layout
from hasrl_jax.envs.cassie import bezier, clock, commands, gaits
from hasrl_jax.envs.cassie.ids import CassieIds, cassie_ids
from hasrl_jax.envs.cassie.settings import CassieConfig
from hasrl_jax.envs.cpu_engine import CpuEnvs
from hasrl_jax.envs.registry import make_task
from hasrl_jax.envs.task import Task
from hasrl_jax.errors import ConfigError
from hasrl_jax.policy import actor
from hasrl_jax.policy.numpy_networks import Parameters

STEPS = {"forward_m_s": 0.5, "lateral_m_s": 0.5, "height_m": 0.1}
BOUNDS = {"forward_m_s": (-0.5, 2.5), "lateral_m_s": (0.0, 0.3), "height_m": (0.8, 1.0)}
TRIALS = 6  # walks of the whole grid, of which each gait's best is kept
STAND_TRIALS = 3
SETTLE_CYCLES, KEPT_CYCLES = 5, 4
NOT_A_STAND = 1e-6  # yaw rate, rad/s, under which the clock goes on where no speed is commanded
MOST_WOBBLE_RAD = 0.2  # standard deviation of a joint over the cycles, or a gait is not periodic
MOST_STANDING_RAD_S = 0.5  # of a joint; and m/s of the pelvis, of a robot that stands
FAST_M_S, FAST_HEIGHT_M = (2.5, 4.0), 0.82  # between these speeds gaits go down to that height
LOWER_M = 0.02  # by which one that was told to stand and did not is told again
COMMANDS = ("forward", "lateral", "yaw_rate", "height")


class Walked(NamedTuple):
    """G robots that have settled: K cycles, at the N phases 0, 1/N, ... of each, to half an environment step."""

    states: np.ndarray  # [K, N, G, 67] with the pelvis' place from a point of constant velocity
    phase: np.ndarray  # [K, N, G] which each state has, in [0, 1)
    measured: np.ndarray  # [G, 3] mean forward and lateral speed, m/s, and height, m; NaN where one fell


def make_grid(bounds: Mapping[str, tuple[float, float]]) -> dict[str, np.ndarray]:
    """Evenly spaced values, about STEPS apart, from the lower to the upper bound of each of `gaits.AXES`.

    Raises:
      ConfigError: names the option whose bounds are not in order.
    """
    grid = {}
    for name in gaits.AXES:
        low, high = bounds[name]
        if not -math.inf < low < high < math.inf:
            option = f"--{name.replace('_', '-')}"
            raise ConfigError(f"{option}: got {low:g} {high:g}; expected the lower of two numbers first")
        grid[name] = np.linspace(low, high, max(2, round((high - low) / STEPS[name]) + 1))
    return grid


def record(config: Config, parameters: Parameters, grid: Mapping[str, np.ndarray]) -> gaits.Library:
    """Walks and fits every gait, and a stand at every height.

    Args:
      config: of a policy in the heading frame; the nominal robot is recorded, under the physics that are given.
      parameters: as `learn.ppo.export_parameters` returns them.
      grid: evenly spaced values of each of `gaits.AXES`, lateral speeds from 0 on.

    Raises:
      ConfigError: the policy cannot be told all of this, its slowest gait cycle is no even number of environment steps,
        or a robot fell or has no periodic gait.
    """
    config = tasks.find(config.task).undisturbed(config)
    task = make_task(config)
    if tuple(command.name for command in task.commands) != COMMANDS:
        raise ConfigError(f"--policy: expected one that is told {', '.join(COMMANDS)}; try released-steer")
    cycle_s = config.settings.clock.cycle_s
    count = round(cycle_s / task.env_step_s)
    if count % 2 or abs(count * task.env_step_s - cycle_s) > 1e-9:
        raise ConfigError(f"cassie.clock.cycle_s: got {cycle_s:g}; expected an even number of policy steps")
    cells = np.stack(np.meshgrid(*(grid[name] for name in gaits.AXES), indexing="ij"), axis=-1)
    wanted = walkable(cells.reshape(-1, 3), config.settings)
    told = gait = np.insert(wanted, 2, NOT_A_STAND, axis=1)
    walked = walk(config, task, parameters, gait, told, count)
    require_upright(walked, told)
    gain = np.ones((len(told), 1))
    for _ in range(TRIALS - 1):
        tried = told.copy()
        tried[:, [0, 1, 3]] += gain * (wanted - walked.measured)
        trial = walk(config, task, parameters, gait, tried, count)
        better = missed(trial, wanted) < missed(walked, wanted)
        told = np.where(better[:, None], tried, told)
        gain = np.where(better[:, None], gain, gain / 2)
        walked = Walked(
            np.where(better[:, None], trial.states, walked.states),
            np.where(better, trial.phase, walked.phase),
            np.where(better[:, None], trial.measured, walked.measured),
        )
    require_periodic(walked, wanted)
    standing_states = stand(config, task, parameters, np.asarray(grid["height_m"]), count)
    return library(config, task, grid, walked, standing_states)


def missed(walked: Walked, wanted: np.ndarray) -> np.ndarray:
    """How far robots are from their gaits [G, 3]: the greater miss, m/s, of the speeds; 1 cm of height is 0.05. [G]"""
    return (np.abs(walked.measured - wanted) * np.array([1.0, 1.0, 5.0])).max(axis=1)


def walkable(cells: np.ndarray, config: CassieConfig) -> np.ndarray:
    """Gaits [G, 3] with heights that the policy can walk at their speeds.

    They are within those that it was told there in training, and the lower from FAST_M_S on, the faster: from the usual
    height no leg reaches far enough.
    """
    speed, usual = cells[:, 0], config.reward.height_m
    share = commands.height_share(speed, config.command, np)
    lowest, highest = (usual + share * (end - usual) for end in config.command.height_m)
    height = np.clip(cells[:, 2], lowest, highest)
    fast = np.interp(np.abs(speed), FAST_M_S, (0.0, 1.0))
    return np.column_stack([cells[:, :2], height + fast * (FAST_HEIGHT_M - height)])


def library(
    config: Config, task: Task, grid: Mapping[str, np.ndarray], walked: Walked, standing_states: np.ndarray
) -> gaits.Library:
    """The curves and states of recorded gaits.

    Args:
      config, task: of the recorded robots.
      grid: as in `record`; F, L and H values.
      walked: by F L H robots.
      standing_states: [H, 67].
    """
    ids, shape = cassie_ids(task.model), tuple(len(grid[name]) for name in gaits.AXES)
    motions, phases = (
        np.moveaxis(values, 2, 0).reshape(values.shape[2], -1, *values.shape[3:])
        for values in (motion_of(walked.states, ids), walked.phase)
    )
    curves = np.array([bezier.fit(samples, phase) for samples, phase in zip(motions, phases, strict=True)])
    curves = curves.reshape(*shape, *curves.shape[1:])
    straight = curves[:, 0]  # its own mirror image, but for what the recording has of chance
    curves[:, 0] = (straight + gaits.mirrored_curves(straight)) / 2
    return gaits.Library(
        forward_m_s=np.asarray(grid["forward_m_s"], float),
        lateral_m_s=np.asarray(grid["lateral_m_s"], float),
        height_m=np.asarray(grid["height_m"], float),
        curves=curves,
        states=typical_cycles(walked.states).reshape(*shape, *walked.states.shape[1::2]),
        standing=motion_of(standing_states, ids),
        standing_states=standing_states,
        cycle_s=clock.cycle_seconds(np.asarray(grid["forward_m_s"], float), config.settings.clock, np),
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
    for _ in range(STAND_TRIALS):
        walked = walk(config, task, parameters, told, told, count)
        require_upright(walked, told)
        speeds = np.abs(walked.states[..., gaits.QPOS_SIZE :]).max(axis=(0, 1, 3))
        moves = speeds > MOST_STANDING_RAD_S
        told[:, 3] += np.where(moves, -LOWER_M, heights - walked.measured[:, 2])
    if moves.any():
        raise ConfigError(f"--policy: does not stand, told {_listed(told[moves.argmax()], COMMANDS)}")
    states = walked.states[-1, -1]
    states[:, :2] = 0.0
    return states


def walk(config: Config, task: Task, parameters: Parameters, gait: np.ndarray, told: np.ndarray, count: int) -> Walked:
    """Robots at `count` phases of a cycle, with the clock of `gait` [G, 4] as COMMANDS while the policy sees `told`."""
    assert task.with_command is not None
    command = slice(layout.places(task.observation)["forward_command"].start, None)
    envs = CpuEnvs(task, len(told), np.iinfo(np.int64).max)
    rng = np.random.Generator(np.random.Philox(0))
    state = envs.reset(rng)
    at_phase_0 = state.task._replace(phase=np.zeros(len(told)))
    task_state, observation = task.with_command(at_phase_0, state.observation, gait, np)
    state = state._replace(task=task_state, observation=observation)
    cycles = np.arange(SETTLE_CYCLES, SETTLE_CYCLES + KEPT_CYCLES)[:, None, None] + (np.arange(count) / count)[:, None]
    cycle_steps = clock.cycle_seconds(gait[:, 0], config.settings.clock, np) / task.env_step_s
    places = np.rint(cycles * cycle_steps).astype(int)  # [K, N, G] steps
    policy, every, fell = actor.reset(config, task, parameters, len(told)), [], np.zeros(len(told), bool)
    for _ in range(places.max() + 1):
        every.append(state.physics[:, 1:])
        seen = state.observation.copy()
        seen[:, command] = told
        action, policy = actor.act(policy, seen, state.is_first)
        state, result = envs.step(state, action, rng)
        fell |= result.terminated | result.diverged
    states = np.array(every)[places, np.arange(len(told))]
    time_s = task.env_step_s * (places - places[0, 0])
    velocity = (states[-1, 0] - states[0, 0])[:, :2] / time_s[-1, 0][:, None]  # over whole cycles
    states[..., :2] -= velocity * time_s[..., None]
    states[..., :2] -= states[..., :2].mean(axis=(0, 1))
    measured = np.column_stack([velocity, states[..., 2].mean(axis=(0, 1))])
    return Walked(states, places / cycle_steps % 1.0, np.where(fell[:, None], np.nan, measured))


def require_upright(walked: Walked, told: np.ndarray) -> None:
    """Raises the ConfigError that names the first of the commands [G, 4] under which a robot fell."""
    fell = np.isnan(walked.measured).any(axis=1)
    if fell.any():
        raise ConfigError(f"--policy: a robot fell that was told {_listed(told[fell.argmax()], COMMANDS)}")


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
