"""Gymnasium's planar walker, walking at a commanded speed."""

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import gymnasium
import numpy as np

from hasrl_jax.config.limits import Limits, Range
from hasrl_jax.config.schema import Config
from hasrl_jax.config.tasks import TaskSpec
from hasrl_jax.envs import layout
from hasrl_jax.envs.draws import between
from hasrl_jax.envs.layout import NEGATED, SAME, Entry
from hasrl_jax.envs.model import load_model
from hasrl_jax.envs.task import Command, Reading, Reset, Task, Transition
from hasrl_jax.types import Array

ASSET = Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets" / "walker2d_v5.xml"
LEGS = 6 * SAME  # thigh, leg and foot of the right leg, then of the left; all turn about the lateral axis
OBSERVATION = (
    Entry("height", "m", SAME),
    Entry("pitch", "rad", SAME),
    Entry("joint_positions", "rad", LEGS, legs=True),
    Entry("velocity", "m/s", 2 * SAME),  # forward and up
    Entry("pitch_rate", "rad/s", SAME),
    Entry("joint_velocities", "rad/s", LEGS, legs=True),
    Entry("clock", "", 2 * NEGATED),  # sin and cos of the phase: half a cycle swaps the legs
    Entry("speed_command", "m/s", SAME),
)
ACTION = (Entry("torques", "", LEGS, legs=True),)  # as a share of their limit
SPEED_LIMITS_M_S = (-2.0, 4.0)
THIGHS = np.array([0, 0, 0, 0.5, 0, 0, -0.5, 0, 0])  # each thigh's share of the angle between them, by coordinate


@dataclass(frozen=True)
class Settings:
    speed_m_s: Annotated[Range, Limits(*SPEED_LIMITS_M_S)] = (0.5, 1.5)  # range of the commanded speed
    sharpness: Annotated[float, Limits(0.1, 100)] = 2.0  # of exp(-sharpness * error^2), s^2/m^2
    # What makes it walk and not hop: the thighs apart by stride_rad * sin(2 pi phase), and it starts like that
    gait: Annotated[float, Limits(0, 10)] = 1.0  # weight of exp(-8 * error^2) of that
    stride_rad: Annotated[float, Limits(0, 2)] = 0.6  # amplitude
    cycle_s: Annotated[float, Limits(0.1, 10)] = 0.8  # of the clock
    effort: Annotated[float, Limits(0, 10)] = 0.02  # weight of the summed squared torques
    start_noise: Annotated[float, Limits(0, 1)] = 0.05  # half width of the start pose, rad and m
    min_height_m: Annotated[float, Limits(0, 1.25)] = 0.8  # the episode ends when the torso is lower
    max_pitch_rad: Annotated[float, Limits(0.1, 3)] = 0.8  # or leans further


class WalkerState(NamedTuple):
    """What the task remembers of an episode."""

    speed: Array  # [...] commanded, m/s
    phase: Array  # [...] of the gait clock, in [0, 1)


def make(config: Config) -> Task:
    """The task with its model compiled."""
    settings: Settings = config.settings
    model = load_model(ASSET, config.physics)
    return Task(
        name="walker",
        asset=ASSET,
        model=model,
        steps_per_env_step=config.physics.steps_per_env_step,
        observation=OBSERVATION,
        action=ACTION,
        reward_terms=("alive", "speed", "gait", "effort"),
        measures=("forward_speed", "forward_command"),
        mirror=layout.mirror(OBSERVATION, ACTION),
        reset_uniforms=2 + model.nq,
        reset=partial(reset, settings, model.qpos0.copy()),
        control=control,
        step=partial(step, settings, config.physics.env_step_s),
        commands=(
            Command("forward", "m/s", 1.0, settings.speed_m_s, SPEED_LIMITS_M_S, "forward_speed", 0.1, "up-down"),
        ),
        with_command=with_command,
    )


def reset(settings: Settings, start: np.ndarray, uniforms: Array, xp: Any) -> Reset:
    """Upright, in mid-stride, with a little noise, from uniform numbers [..., 2 + nq]."""
    state = WalkerState(between(uniforms[..., 0], settings.speed_m_s), uniforms[..., 1])
    stride = settings.stride_rad * xp.sin(2 * np.pi * state.phase)
    qpos = (
        start + stride[..., None] * THIGHS + between(uniforms[..., 2:], (-settings.start_noise, settings.start_noise))
    )
    qvel = xp.zeros_like(qpos)
    return Reset(state, observe(state, qpos, qvel, xp), qpos, qvel, {})


def control(state: WalkerState, action: Array, xp: Any) -> Array:
    """Torques as a share of their limit, [..., 6]."""
    return xp.clip(action, -1.0, 1.0)


def step(
    settings: Settings,
    env_step_s: float,
    state: WalkerState,
    action: Array,
    reading: Reading,
    uniforms: Array,
    xp: Any,
) -> Transition:
    """Rewards standing, the commanded speed, legs that take turns, and little effort."""
    speed, height, pitch = reading.qvel[..., 0], reading.qpos[..., 1], reading.qpos[..., 2]
    fell = (height < settings.min_height_m) | (xp.abs(pitch) > settings.max_pitch_rad)
    alive = xp.where(fell, 0.0, 0.3)
    follows = xp.exp(-settings.sharpness * (speed - state.speed) ** 2)
    apart = reading.qpos[..., 3] - reading.qpos[..., 6] - settings.stride_rad * xp.sin(2 * np.pi * state.phase)
    gait = xp.where(fell, 0.0, settings.gait * xp.exp(-8 * apart**2))
    effort = -settings.effort * (control(state, action, xp) ** 2).sum(axis=-1)
    terms = xp.stack([alive, follows, gait, effort], axis=-1)
    measures = xp.stack([speed, state.speed], axis=-1)
    state = state._replace(phase=xp.mod(state.phase + env_step_s / settings.cycle_s, 1.0))
    observation = observe(state, reading.qpos, reading.qvel, xp)
    return Transition(state, observation, terms.sum(axis=-1), fell, terms, measures)


def observe(state: WalkerState, qpos: Array, qvel: Array, xp: Any) -> Array:
    """What the policy sees, as `OBSERVATION` lists it; where the robot stands along its path it does not."""
    angle = 2 * np.pi * state.phase
    told = xp.stack([xp.sin(angle), xp.cos(angle), state.speed], axis=-1)
    return xp.concatenate([qpos[..., 1:], qvel, told], axis=-1)


def with_command(state: WalkerState, observation: Array, command: Array, xp: Any) -> tuple[WalkerState, Array]:
    """Another speed, from now to the end of the episode."""
    return state._replace(speed=command[..., 0]), xp.concatenate([observation[..., :-1], command], axis=-1)


SPEC = TaskSpec(name="walker", make=make, recipe=Path(__file__).parent / "walker.yaml", settings=Settings)
