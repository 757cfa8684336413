"""The gait clock against the spline that it stands for."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.interpolate import PchipInterpolator

from hasrl_jax.envs.cassie import clock
from hasrl_jax.envs.cassie.settings import ClockConfig

CONFIG = ClockConfig()
SPEEDS = (-0.3, 0.0, 1.0, 2.5, 4.0)
PHASE = np.linspace(0, 1, 2001, endpoint=False)


def _spline(speed: float) -> tuple[PchipInterpolator, PchipInterpolator]:
    """Left and right force clock through the inner edges of each interval, over three cycles of length 1."""
    swing = (0.30 + 0.40 / 3 * abs(speed)) / 2
    stance = (0.70 - 0.40 / 3 * abs(speed)) / 2
    lengths = np.tile([swing, stance, swing, stance], 3)
    ends = np.cumsum(lengths)
    starts = ends - lengths
    times = np.stack([starts + 0.1 * lengths, ends - 0.1 * lengths], axis=1).ravel()
    right = np.repeat(np.tile([-1.0, 0.0, 1.0, 0.0], 3), 2)  # the right foot swings first
    return PchipInterpolator(times, -right), PchipInterpolator(times, right)


@pytest.mark.parametrize("speed", SPEEDS)
def test_equals_the_published_spline_in_the_middle_of_three_cycles(speed: float) -> None:
    ours = clock.force_clocks(PHASE, clock.swing_fraction(speed, CONFIG, np), np)
    left, right = _spline(speed)
    np.testing.assert_allclose(ours[:, 0], left(1 + PHASE), atol=1e-9)
    np.testing.assert_allclose(ours[:, 1], right(1 + PHASE), atol=1e-9)


@pytest.mark.parametrize("speed", SPEEDS)
def test_the_right_foot_is_half_a_cycle_behind_the_left(speed: float) -> None:
    swing = clock.swing_fraction(speed, CONFIG, np)
    here = clock.force_clocks(PHASE, swing, np)
    later = clock.force_clocks(np.mod(PHASE + 0.5, 1.0), swing, np)
    np.testing.assert_allclose(here[:, 0], later[:, 1], atol=1e-9)
    np.testing.assert_allclose(here[:, 0], -here[:, 1], atol=1e-12)


def test_plateaus() -> None:
    swing = clock.swing_fraction(np.zeros(4), CONFIG, np)  # 0.30 of each half cycle
    phase = np.array([0.075, 0.325, 0.575, 0.825])  # middles of right swing, stance, left swing, stance
    expected = [[1, -1], [0, 0], [-1, 1], [0, 0]]
    np.testing.assert_allclose(clock.force_clocks(phase, swing, np), expected, atol=1e-12)


def test_numpy_equals_jax() -> None:
    speed = np.linspace(-0.3, 4, len(PHASE))
    ours = clock.force_clocks(PHASE, clock.swing_fraction(speed, CONFIG, np), np)
    # The middle of a transition is steep: one unit in the last place of a float32 phase is 1e-6 of the clock.
    theirs = clock.force_clocks(jnp.asarray(PHASE), clock.swing_fraction(jnp.asarray(speed), CONFIG, jnp), jnp)
    np.testing.assert_allclose(ours, theirs, atol=1e-4)
    np.testing.assert_allclose(clock.phase_signal(PHASE, np), clock.phase_signal(jnp.asarray(PHASE), jnp), atol=1e-5)


def test_cycle_and_swing_at_known_speeds() -> None:
    np.testing.assert_allclose(clock.cycle_seconds(np.array([0.0, 3.0, -3.0]), CONFIG, np), [0.9, 0.65, 0.65])
    np.testing.assert_allclose(clock.swing_fraction(np.array([0.0, 3.0, 99.0]), CONFIG, np), [0.3, 0.7, 0.9])


def test_a_foot_always_swings_a_little() -> None:
    slower = ClockConfig(swing_fraction=0.3, swing_fraction_per_speed=-0.2)
    np.testing.assert_allclose(clock.swing_fraction(np.array([1.0, 2.0, 4.0]), slower, np), [0.1, 0.05, 0.05])


def test_the_cycle_can_stay_up_to_a_speed_and_quicken_above_it() -> None:
    config = ClockConfig(cycle_s=0.75, cycle_per_speed_s=-0.05, quicken_above_m_s=2.0)
    speed = np.array([0.0, 2.0, -2.0, 3.0, -4.0])
    np.testing.assert_allclose(clock.cycle_seconds(speed, config, np), [0.75, 0.75, 0.75, 0.70, 0.65])
