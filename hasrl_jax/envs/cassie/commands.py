"""What an episode draws again and again: commanded speeds, and pushes on the pelvis."""

from typing import Any

import numpy as np

from hasrl_jax.envs.cassie.settings import CommandConfig, PushConfig
from hasrl_jax.envs.draws import between
from hasrl_jax.types import Array

COMMAND_UNIFORMS = 4  # forward, lateral, stand or not, time until the next draw
PUSH_UNIFORMS = 3  # force, direction, time until the push


def draw_command(uniforms: Array, config: CommandConfig, xp: Any) -> tuple[Array, Array]:
    """Uniform numbers [..., 4] to a command [..., 2] in m/s and the seconds until the next draw [...]."""
    forward = between(uniforms[..., 0], config.forward_m_s)
    lateral = between(uniforms[..., 1], config.lateral_m_s)
    stand = uniforms[..., 2:3] < config.stand_probability
    command = xp.where(stand, 0.0, xp.stack([forward, lateral], axis=-1))
    seconds = between(uniforms[..., 3], config.resample_s)
    return command, xp.where(seconds > 0, seconds, xp.inf)


def draw_push(uniforms: Array, config: PushConfig, xp: Any) -> tuple[Array, Array]:
    """Uniform numbers [..., 3] to a force [..., 2] in N, in any horizontal direction, and the seconds until it acts."""
    size = between(uniforms[..., 0:1], config.force_n)
    angle = 2 * np.pi * uniforms[..., 1]
    force = size * xp.stack([xp.cos(angle), xp.sin(angle)], axis=-1)
    return force, between(uniforms[..., 2], config.interval_s)


def next_push(
    push: Array, push_s: Array, elapsed_s: Array, uniforms: Array, config: PushConfig, xp: Any
) -> tuple[Array, Array]:
    """The push [..., 2] and the time until it [...] after `elapsed_s`; one that is over gives way to a new draw."""
    if config.force_n[1] == 0:
        return push, push_s
    remaining = push_s - elapsed_s
    over = remaining <= -config.duration_s
    drawn, drawn_s = draw_push(uniforms, config, xp)
    return xp.where(over[..., None], drawn, push), xp.where(over, drawn_s, remaining)
