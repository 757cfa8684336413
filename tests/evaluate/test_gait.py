"""Gait figures of made-up walks whose answers are known."""

import numpy as np
import pytest

from hasrl_jax.evaluate import gait

STEP_S = 0.025
WEIGHT_N = 33.0 * gait.GRAVITY_M_S2


def _walk(cycle: int, stance: int, shift: int, cycles: int = 20) -> tuple[np.ndarray, np.ndarray]:
    """Forces [T, 1] of two feet that stand for `stance` of `cycle` steps, the right one `shift` steps later."""
    time = np.arange(cycle * cycles)
    left = np.where((time - 5) % cycle < stance, WEIGHT_N, 0.0)
    right = np.where((time - 5 - shift) % cycle < stance, WEIGHT_N, 0.0)
    return left[:, None], right[:, None]


def test_an_even_walk() -> None:
    left, right = _walk(cycle=30, stance=18, shift=15)
    ones = np.ones(left.shape)
    figures = gait.describe(left, right, 200.0 * ones, 1.25 * ones, 33.0, STEP_S)
    np.testing.assert_allclose(figures["step_frequency_hz"], 2 / (30 * STEP_S), rtol=0.03)
    np.testing.assert_allclose(figures["duty_factor"], 0.6, atol=0.01)
    np.testing.assert_allclose(figures["duty_asymmetry"], 0.0, atol=0.01)
    np.testing.assert_allclose(figures["phase_offset"], 0.5)
    np.testing.assert_allclose(figures["cost_of_transport"], 200 / (WEIGHT_N * 1.25))


def test_a_foot_that_scuffs_the_ground_after_it_lifted_has_not_landed() -> None:
    left, right = _walk(cycle=30, stance=14, shift=15)
    ones = np.ones(left.shape)
    lifted = np.flatnonzero(np.diff(left[:, 0]) < 0)
    scuffing = left.copy()
    scuffing[lifted + 3] = 0.4 * WEIGHT_N
    clean, scuffed = (gait.describe(force, right, ones, ones, 33.0, STEP_S) for force in (left, scuffing))
    assert scuffed["step_frequency_hz"] == clean["step_frequency_hz"]
    assert scuffed["phase_offset"] == clean["phase_offset"]


def test_a_limp_is_seen() -> None:
    left, right = _walk(cycle=20, stance=12, shift=7)
    longer, _ = _walk(cycle=20, stance=16, shift=7)
    figures = gait.describe(left, right, 0 * left, 0 * left + 1, 33.0, STEP_S)
    np.testing.assert_allclose(figures["phase_offset"], 7 / 20)
    figures = gait.describe(longer, right, 0 * left, 0 * left + 1, 33.0, STEP_S)
    np.testing.assert_allclose(figures["duty_asymmetry"], 4 / 20, atol=0.02)


def test_only_the_time_until_a_fall_counts() -> None:
    left, right = _walk(cycle=30, stance=18, shift=15)
    power, speed = 100.0 * np.ones(left.shape), np.ones(left.shape)
    short = [np.where(np.arange(len(left))[:, None] < 300, values, np.nan) for values in (left, right, power, speed)]
    whole = gait.describe(*(values[:300] for values in (left, right, power, speed)), 33.0, STEP_S)
    cut = gait.describe(*short, 33.0, STEP_S)
    for name in whole:
        np.testing.assert_allclose(cut[name], whole[name], err_msg=name)


@pytest.mark.parametrize("force", [0.0, WEIGHT_N])
def test_standing_and_flying_have_no_rhythm(force: float) -> None:
    still = np.full((200, 1), force)
    figures = gait.describe(still, still, 0 * still, 0 * still, 33.0, STEP_S)
    assert all(np.isnan(figures[name]).all() for name in figures)


def test_time_on_the_toe_counts_per_step() -> None:
    """Three environment steps of 60 N after each of 20 stances of the left foot, two of 15 N after the right one's."""
    left, right = _walk(cycle=30, stance=18, shift=15)
    toes = []
    for force, steps, newtons in ((left, 3, 60.0), (right, 2, 15.0)):
        toe = np.zeros_like(force)
        for end in np.flatnonzero(np.diff(force[:, 0]) < 0):
            toe[end + 1 : end + 1 + steps] = newtons
        toes.append(toe)
    per_second = np.array([2 / (30 * STEP_S)])
    np.testing.assert_allclose(gait.trailing(*toes, STEP_S, per_second), 3 * STEP_S / 2, rtol=0.05)
    halved = [np.where(np.arange(len(toe))[:, None] < len(toe) // 2, toe, np.nan) for toe in toes]  # a fall
    np.testing.assert_allclose(gait.trailing(*halved, STEP_S, per_second), 3 * STEP_S / 2, rtol=0.1)
