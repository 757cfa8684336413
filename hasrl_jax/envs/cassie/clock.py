"""The gait clock: when each foot should bear weight and when it should move.

Over one cycle, phase 0 to 1: right swing, double stance, left swing, double stance.
Source: paper section II.C; constants of the published implementation.
"""

from typing import Any

from hasrl_jax.envs.cassie.settings import ClockConfig
from hasrl_jax.envs.layout import columns
from hasrl_jax.types import Array

STAND_FORCE_CLOCK = 0.5  # of both feet while the clock rests: both planted score as one does in single stance
EDGE = 0.10  # each interval is shortened at both ends by this share of its own length


def cycle_seconds(speed: Array, config: ClockConfig, xp: Any) -> Array:
    """Duration of a gait cycle in seconds at commanded speed(s) [...] in m/s."""
    return config.cycle_s + config.cycle_per_speed_s * xp.maximum(abs(speed) - config.quicken_above_m_s, 0.0)


def swing_fraction(speed: Array, config: ClockConfig, xp: Any) -> Array:
    """Share of half a cycle in which a foot swings, at commanded speed(s) [...] in m/s."""
    share = config.swing_fraction + config.swing_fraction_per_speed * abs(speed)
    return xp.minimum(xp.maximum(share, 0.05), config.max_swing_fraction)


def phase_signal(phase: Array, xp: Any) -> Array:
    """The two clock inputs of the policy, sin and cos of 2 pi phase: [...] -> [..., 2]."""
    angle = 2 * xp.pi * phase
    return columns([xp.sin(angle), xp.cos(angle)], xp)


def force_clocks(phase: Array, swing: Array, xp: Any) -> Array:
    """Force clocks of the left and right foot, [...] -> [..., 2]; velocity clocks are their negatives.

    A foot's force clock is -1 while that foot swings, +1 while the other foot swings and 0 in
    double stance, with monotone cubic transitions around the interval boundaries.

    Args:
      phase: gait phase in [0, 1), [...].
      swing: swing share of half a cycle, [...] (`swing_fraction`).

    The published clock is a PCHIP interpolant through the inner edges of the intervals. Between two
    edges of different value its slope is zero at both, because the neighbouring segments are flat, so
    it equals the cubic 3u^2 - 2u^3; this closed form needs no spline per episode.
    """
    own_phase = columns([(phase + 0.5) % 1.0, phase], xp)
    swings = _bumps(own_phase, swing, xp)
    return swings[..., ::-1] - swings


def _bumps(phase: Array, swing: Array, xp: Any) -> Array:
    """1 while the swing that starts at phase 0 lasts, 0 outside, smooth at both boundaries; [..., n], [...]."""
    length = 0.5 * swing  # of the swing, in cycles
    stance = 0.5 - length
    # A transition runs from the inner edge of one interval to the inner edge of the next.
    width = EDGE * (length + stance)
    rise_start = -EDGE * stance
    fall_start = length - EDGE * length
    # The rise straddles the start of the cycle: look at it from the nearest period.
    centered = phase - (phase > (0.5 + 0.5 * length)[..., None])
    boundaries = columns([rise_start, fall_start], xp)[..., None]
    passed = _smoothstep((centered[..., None, :] - boundaries) / width[..., None, None], xp)
    return passed[..., 0, :] - passed[..., 1, :]


def _smoothstep(u: Array, xp: Any) -> Array:
    u = xp.minimum(xp.maximum(u, 0.0), 1.0)  # `clip` takes NumPy twice as long
    return u * u * (3.0 - 2.0 * u)
