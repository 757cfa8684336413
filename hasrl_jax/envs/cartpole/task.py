"""Cart-pole with hidden velocities: a small task that only a policy with memory can hold upright.

The policy sees the cart's position and the pole's angle, never their rates. The answer is known: one
unit of reward for every step the pole stands, so a solved episode returns `collect.max_episode_steps`.
"""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hasrl_jax.config.schema import Config
from hasrl_jax.envs import layout
from hasrl_jax.envs.draws import between
from hasrl_jax.envs.layout import NEGATED, Entry
from hasrl_jax.envs.model import load_model
from hasrl_jax.envs.task import Reading, Reset, Task, Transition
from hasrl_jax.types import Array

ASSET = Path(__file__).parent / "cartpole.xml"
OBSERVATION = (Entry("cart_position", "m", NEGATED), Entry("pole_angle", "0.1 rad", NEGATED))
ACTION = (Entry("push", "", NEGATED, note="as a share of its limit"),)
MAX_ANGLE_RAD = 0.2
MAX_POSITION_M = 1.0
START = 0.05  # half width of the uniform start position (m), angle (rad) and of their rates


class CartpoleState(NamedTuple):
    """The task remembers nothing; one array keeps the pytree non-empty."""

    zero: Array  # [...]


def make(config: Config) -> Task:
    """The task with its model compiled."""
    return Task(
        name="cartpole",
        asset=ASSET,
        model=load_model(ASSET, config.physics),
        steps_per_env_step=config.physics.steps_per_env_step,
        observation=OBSERVATION,
        action=ACTION,
        reset_uniforms=4,
        reward_terms=("upright",),
        measures=("angle",),
        mirror=layout.mirror(OBSERVATION, ACTION),
        reset=reset,
        control=control,
        step=step,
    )


def reset(uniforms: Array, xp: Any) -> Reset:
    """A nearly upright pole, from uniform numbers [..., 4]."""
    start = between(uniforms, (-START, START))
    qpos, qvel = start[..., :2], start[..., 2:]
    return Reset(CartpoleState(xp.zeros(uniforms.shape[:-1])), observe(qpos), qpos, qvel, {})


def control(state: CartpoleState, action: Array, xp: Any) -> Array:
    """The push on the cart as a share of its limit, [..., 1]."""
    return xp.clip(action, -1.0, 1.0)


def step(state: CartpoleState, action: Array, reading: Reading, uniforms: Array, xp: Any) -> Transition:
    """One unit of reward unless the pole leans too far or the cart leaves its track."""
    position, angle = reading.qpos[..., 0], reading.qpos[..., 1]
    terminated = (xp.abs(angle) > MAX_ANGLE_RAD) | (xp.abs(position) > MAX_POSITION_M)
    reward = xp.where(terminated, 0.0, 1.0)
    return Transition(state, observe(reading.qpos), reward, terminated, reward[..., None], angle[..., None])


def observe(qpos: Array) -> Array:
    """Cart position (m) and pole angle (in units of 0.1 rad), [..., 2]; the velocities stay hidden."""
    return qpos * np.array([1.0, 10.0])
