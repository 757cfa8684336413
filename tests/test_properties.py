"""What holds for any input: returns, minibatches, buffers, the gait clock, and tables of named quantities."""

import contextlib
from typing import Any

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from hasrl_jax.collect.buffer import merge, pad_segments
from hasrl_jax.config.checks import check
from hasrl_jax.config.convert import from_dict
from hasrl_jax.envs import layout
from hasrl_jax.envs.cassie import clock
from hasrl_jax.envs.cassie.settings import ClockConfig
from hasrl_jax.errors import ConfigError
from hasrl_jax.learn import returns
from hasrl_jax.learn.batching import minibatch_indices
from hasrl_jax.types import SEGMENT_FIELDS, Trajectory

settings.register_profile("tests", deadline=None, derandomize=True, max_examples=60)
settings.load_profile("tests")

ROWS, STEPS = 2, 6
NUMBERS = st.floats(-100, 100, width=32)
REWARDS = arrays(np.float32, (ROWS, STEPS), elements=NUMBERS)
FLAGS = arrays(bool, (ROWS, STEPS))


def _compute(setting: str) -> Any:
    call = returns.advantage_and_target
    return jax.jit(lambda *fields, discount, decay: call(*fields, discount, decay, setting))


COMPUTE = {setting: _compute(setting) for setting in ("gae", "return")}


@given(
    reward=REWARDS,
    value=REWARDS,
    bootstrap=REWARDS,
    terminated=FLAGS,
    truncated=FLAGS,
    mask=FLAGS,
    discount=st.floats(0, 1, width=32),
    decay=st.floats(0, 1, width=32),
    garbage=st.sampled_from([np.nan, np.inf, 1e30]),
)
def test_returns_are_sums_up_to_the_next_end(
    reward: np.ndarray,
    value: np.ndarray,
    bootstrap: np.ndarray,
    terminated: np.ndarray,
    truncated: np.ndarray,
    mask: np.ndarray,
    discount: float,
    decay: float,
    garbage: float,
) -> None:
    """A_t = sum_k (discount decay)^k delta_{t+k}, forwards from t to the end, the cut or the last valid step."""
    fields = [np.where(mask, x, np.float32(garbage)) for x in (reward, value)]
    given_fields = *fields, terminated, truncated, np.where(mask, bootstrap, np.float32(garbage)), mask
    for setting, kept in (("gae", decay), ("return", 1.0)):
        advantage, target = COMPUTE[setting](*given_fields, discount=discount, decay=decay)
        for row, t in np.ndindex(ROWS, STEPS):
            if not mask[row, t]:
                assert advantage[row, t] == target[row, t] == 0
                continue
            total, weight, k = 0.0, 1.0, t
            while True:
                last = k + 1 == STEPS or not mask[row, k + 1]
                following = 0.0 if last else float(value[row, k + 1])
                if terminated[row, k]:
                    following = 0.0
                elif truncated[row, k]:
                    following = float(bootstrap[row, k])
                total += weight * (float(reward[row, k]) + discount * following - float(value[row, k]))
                if last or terminated[row, k] or truncated[row, k]:
                    break
                weight, k = weight * discount * kept, k + 1
            np.testing.assert_allclose(advantage[row, t], total, rtol=1e-4, atol=1e-2)
            np.testing.assert_allclose(target[row, t], total + value[row, t], rtol=1e-4, atol=1e-2)


@settings(max_examples=20)
@given(size=st.integers(1, 5), count=st.integers(1, 5), seed=st.integers(0, 2**31))
def test_minibatches_are_a_partition(size: int, count: int, seed: int) -> None:
    indices = np.asarray(minibatch_indices(jax.random.PRNGKey(seed), size * count, size))
    assert indices.shape == (count, size)
    assert sorted(indices.ravel().tolist()) == list(range(size * count))


@settings(max_examples=20)
@given(rows=st.integers(1, 50), size=st.integers(2, 50))
def test_minibatches_that_do_not_divide_the_rows_are_refused(rows: int, size: int) -> None:
    if rows % size:
        with pytest.raises(ValueError, match=f"{size} does not divide the {rows} trajectories"):
            minibatch_indices(jax.random.PRNGKey(0), rows, size)


@given(data=st.data(), slots=st.integers(1, 4), steps=st.integers(1, 12), extra=st.integers(0, 3))
def test_what_slots_hold_is_what_the_learner_gets(data: st.DataObject, slots: int, steps: int, extra: int) -> None:
    """Segments of any lengths, cut from slots, merged and padded: the same steps in the same order, each once."""
    written, expected, number = [], [], 0
    for slot in range(slots):
        ends = sorted(data.draw(st.sets(st.integers(1, steps)), label="ends"))
        starts = [0, *ends[:-1]][: len(ends)]
        fields = {name: np.full(steps, -1.0) for name in Trajectory._fields if name not in SEGMENT_FIELDS}
        fields["mask"] = np.zeros(steps, bool)
        for start, end in zip(starts, ends, strict=True):
            values = list(range(number, number + end - start))
            fields["reward"][start:end], fields["mask"][start:end] = values, True
            expected.append((slot, values))
            number += end - start
        room = steps + 1  # entries that this request did not use hold what an earlier one left
        indices = {
            name: np.array([*given, *[99] * (room - len(given))], np.int32)
            for name, given in (("start", starts), ("end", ends))
        }
        carry = np.full((room, 2, 2, 1), slot, np.float32)
        written.append(fields | indices | {"initial_carry": carry, "num_segments": np.array([len(ends)])})
    merged = merge(written, [{}] * slots, list(range(10, 10 + slots)), 0.0)
    segments = {"initial_carry": merged.initial_carry, "policy_version": merged.version}
    rows, length = len(expected) + extra, steps + extra
    padded = pad_segments(merged.fields | segments, merged.start, merged.end, length, rows)
    assert padded.reward.shape == (rows, length)
    for row, (slot, values) in enumerate(expected):
        assert padded.reward[row].tolist() == values + [0.0] * (length - len(values))
        assert padded.mask[row].tolist() == [True] * len(values) + [False] * (length - len(values))
        assert (padded.policy_version[row], padded.initial_carry[row].ravel().tolist()) == (10 + slot, [slot] * 4)
    assert not padded.mask[len(expected) :].any() and not padded.policy_version[len(expected) :].any()


@given(phase=st.floats(0, 1, exclude_max=True), speed=st.floats(-10, 10))
def test_the_feet_share_the_clock(phase: float, speed: float) -> None:
    config = ClockConfig()
    swing = clock.swing_fraction(np.array(speed), config, np)
    assert 0.05 <= swing <= config.max_swing_fraction
    left, right = clock.force_clocks(np.array(phase), swing, np)
    assert -1 <= left <= 1 and abs(left + right) < 1e-9
    other = clock.force_clocks(np.mod(phase + 0.5, 1.0), swing, np)
    np.testing.assert_allclose(other, [right, left], atol=1e-6)
    # Over two feet a swing takes `swing` of the cycle; in its inner part the clock is at its end.
    own = phase / (0.5 * swing)  # place in the swing of the right foot, which begins the cycle
    if 0.1 < own < 0.9:
        assert (left, right) == (1.0, -1.0)
    signal = clock.phase_signal(np.array(phase), np)
    np.testing.assert_allclose(np.mod(np.arctan2(*signal) / (2 * np.pi) - phase + 0.5, 1.0), 0.5, atol=1e-9)


@given(phase=st.floats(0, 1), speed=st.floats(-4, 4))
def test_the_clock_is_steady(phase: float, speed: float) -> None:
    """A step of a thousandth of a cycle changes it by no more than the steepest transition, 1.5 in a width of 0.05."""
    swing = clock.swing_fraction(np.array(speed), ClockConfig(), np)
    here, there = (clock.force_clocks(np.mod(phase + by, 1.0), swing, np) for by in (0.0, 1e-3))
    assert np.abs(here - there).max() <= 1e-3 * 1.5 / 0.05 * 1.01


SIGNS = st.lists(st.sampled_from([1.0, -1.0]), min_size=1, max_size=4)
ENTRIES = st.lists(st.tuples(SIGNS, st.booleans()), min_size=1, max_size=6).map(
    lambda drawn: [
        layout.Entry(f"entry {number}", "", tuple(2 * signs if legs else signs), legs)
        for number, (signs, legs) in enumerate(drawn)
    ]
)


@given(entries=ENTRIES)
def test_a_mirror_undoes_itself_and_keeps_every_quantity_in_its_place(entries: list[layout.Entry]) -> None:
    total, places = layout.size(entries), layout.places(entries)
    assert [index for entry in entries for index in range(total)[places[entry.name]]] == list(range(total))
    mirror = layout.mirror(entries, entries)
    vector = np.arange(1.0, total + 1)
    image = mirror.observation(vector)
    np.testing.assert_array_equal(mirror.observation(image), vector)
    np.testing.assert_array_equal(image, mirror.action(vector))
    for entry in entries:
        own, half = vector[places[entry.name]], entry.size // 2
        other = np.concatenate([own[half:], own[:half]]) if entry.legs else own
        np.testing.assert_array_equal(image[places[entry.name]], np.array(entry.mirror) * other)


@given(discount=st.floats(allow_nan=True, allow_infinity=True))
def test_a_share_is_between_0_and_1(discount: float) -> None:
    expected = contextlib.nullcontext() if 0 <= discount <= 1 else pytest.raises(ConfigError, match=r"ppo\.discount")
    with expected:
        check(from_dict({"ppo": {"discount": discount}}))
