"""What an episode draws again and again: commands, and pushes on the pelvis."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from hasrl_jax.config.checks import limits_of
from hasrl_jax.envs.cassie.settings import CommandConfig, PushConfig
from hasrl_jax.envs.draws import between, redrawn
from hasrl_jax.envs.layout import NEGATED, SAME, Entry, columns, numbers
from hasrl_jax.envs.task import Command
from hasrl_jax.types import Array

ROUNDING_S = 1e-6  # of times that are summed up; far less than a physics step
PUSH_UNIFORMS = 3  # force, direction, time until the push


class Told(NamedTuple):
    """One thing that the robot can be told."""

    name: str
    field: str  # of `CommandConfig`: its range
    entry: Entry  # how it stands in the observation
    measure: str  # that follows it
    step: float  # of a slider or key


FORWARD = Told("forward", "forward_m_s", Entry("forward_command", "m/s", SAME), "forward_speed", 0.1)
LATERAL = Told("lateral", "lateral_m_s", Entry("lateral_command", "m/s", NEGATED), "lateral_speed", 0.05)
YAW_RATE = Told("yaw_rate", "yaw_rate_rad_s", Entry("yaw_rate_command", "rad/s", NEGATED, std=0.5), "yaw_rate", 0.1)
HEIGHT = Told("height", "height_m", Entry("height_command", "m", SAME, mean=0.9, std=0.1), "height", 0.02)
# In the order of the numbers in a command.
COMMANDS = {"world": (FORWARD, LATERAL), "heading": (FORWARD, LATERAL, YAW_RATE, HEIGHT)}
NAMES = {frame: tuple(told.name for told in those) for frame, those in COMMANDS.items()}
ARROW_KEYS = {"world": ("up-down", "left-right"), "heading": ("up-down", "", "left-right", "")}
# Places in a command of either frame: both speeds, and in the heading frame the yaw rate behind them.
PLANAR, MOTION = slice(0, 2), slice(0, 3)


def num_uniforms(config: CommandConfig) -> int:
    """Uniform numbers that a draw consumes: one per command, which kind, whether a height, and the time it holds."""
    return {"world": 4, "heading": 7}[config.frame]


def named(command: Array, config: CommandConfig) -> dict[str, Array]:
    """The numbers of a command [..., C] by name, each [...]."""
    return dict(zip(NAMES[config.frame], numbers(command), strict=True))


def declared(
    config: CommandConfig, usual_height_m: float, bounds: Mapping[str, tuple[float, float]]
) -> tuple[Command, ...]:
    """What the task says of its commands; `bounds`: narrower limits than those of a range, by its field."""
    return tuple(
        Command(
            name=told.name,
            unit=told.entry.unit,
            default=usual_height_m if told is HEIGHT else 0.0,
            drawn=getattr(config, told.field),
            limits=bounds.get(told.field, limits_of(CommandConfig, told.field)),
            measure=told.measure,
            step=told.step,
            keys=keys,
        )
        for told, keys in zip(COMMANDS[config.frame], ARROW_KEYS[config.frame], strict=True)
    )


def draw_command(uniforms: Array, config: CommandConfig, usual_height_m: float, xp: Any) -> tuple[Array, Array]:
    """Uniform numbers [..., num_uniforms] to a command [..., C] and the seconds until the next draw [...]."""
    draw = _draw_in_world if config.frame == "world" else _draw_in_heading
    seconds = between(uniforms[..., -1], config.resample_s)
    return draw(uniforms, config, usual_height_m, xp), xp.where(seconds > 0, seconds, xp.inf)


def _draw_in_world(uniforms: Array, config: CommandConfig, _: float, xp: Any) -> Array:
    """Both speeds, or none: [..., 2]."""
    forward = between(uniforms[..., 0], config.forward_m_s)
    lateral = between(uniforms[..., 1], config.lateral_m_s)
    stand = uniforms[..., 2:3] < config.stand_probability
    return xp.where(stand, 0.0, columns([forward, lateral], xp))


def _draw_in_heading(uniforms: Array, config: CommandConfig, usual_height_m: float, xp: Any) -> Array:
    """A stand, a straight walk, a turn or side-steps on the spot, or all at once: [..., 4].

    The faster the robot walks, the less it is told to turn and to leave the usual height.
    """
    forward, lateral, yaw_rate, height = (
        between(uniforms[..., index], getattr(config, command.field))
        for index, command in enumerate(COMMANDS["heading"])
    )
    kind, has_height = uniforms[..., 4], uniforms[..., 5] < config.height_probability
    shares = config.stand_probability, config.straight_probability, *2 * [config.alone_probability / 2]
    stand_end, straight_end, turn_end, side_end = np.cumsum(shares)
    on_spot = (kind < stand_end) | ((kind >= straight_end) & (kind < side_end))
    forward = xp.where(on_spot, 0.0, forward)
    lateral = xp.where(kind < turn_end, 0.0, lateral)
    yaw_rate = xp.where((kind < straight_end) | ((kind >= turn_end) & (kind < side_end)), 0.0, yaw_rate)
    speed = xp.abs(forward)
    # At least 0.01 m/s, or a division by zero; so slowly the bound never matters.
    fastest_turn = config.turn_m_s2 / xp.maximum(speed, 0.01)
    widest = max(abs(end) for end in config.yaw_rate_rad_s)
    yaw_rate = yaw_rate * xp.minimum(1.0, fastest_turn / max(widest, 1e-6))
    height = usual_height_m + height_share(speed, config, xp) * has_height * (height - usual_height_m)
    return columns([forward, lateral, yaw_rate, height], xp)


def height_share(speed: Array, config: CommandConfig, xp: Any) -> Array:
    """How much of a height's difference from the usual one is commanded at a forward speed, m/s: [...] -> [...]."""
    low, high = config.height_fade_m_s
    return xp.clip((high - xp.abs(speed)) / max(high - low, 1e-6), 0.0, 1.0)


def next_command(
    command: Array,
    command_s: Array,
    elapsed_s: Array,
    uniforms: Array,
    config: CommandConfig,
    usual_height_m: float,
    xp: Any,
) -> tuple[Array, Array]:
    """The command [..., C] and the time until the next draw [...] after `elapsed_s`."""
    due = command_s <= elapsed_s
    kept = command, command_s - elapsed_s
    command, command_s = redrawn(due, lambda: draw_command(uniforms, config, usual_height_m, xp), kept, xp)
    return command, command_s


def draw_push(uniforms: Array, config: PushConfig, xp: Any) -> tuple[Array, Array]:
    """Uniform numbers [..., 3] to a force [..., 2] in N, in any horizontal direction, and the seconds until it acts."""
    size = between(uniforms[..., 0:1], config.force_n)
    angle = 2 * np.pi * uniforms[..., 1]
    force = size * columns([xp.cos(angle), xp.sin(angle)], xp)
    return force, between(uniforms[..., 2], config.interval_s)


def next_push(
    push: Array, push_s: Array, elapsed_s: Array, uniforms: Array, config: PushConfig, xp: Any
) -> tuple[Array, Array]:
    """The push [..., 2] and the time until it [...] after `elapsed_s`; one that is over gives way to a new draw."""
    remaining = push_s - elapsed_s
    over = remaining <= -config.duration_s + ROUNDING_S
    push, remaining = redrawn(over, lambda: draw_push(uniforms, config, xp), (push, remaining), xp)
    return push, remaining
