"""Padding of flat buffers and the partition into minibatches."""

import jax
import numpy as np
import pytest

from hasrl_jax.collect.buffer import pad_segments
from hasrl_jax.learn.batching import minibatch_indices
from hasrl_jax.types import SEGMENT_FIELDS, Trajectory


def _flat(transitions: int, segments: int) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    fields = {name: rng.normal(size=transitions).astype(np.float32) for name in Trajectory._fields}
    fields |= {"observation": rng.normal(size=(transitions, 3)), "action": rng.normal(size=(transitions, 2))}
    fields |= {name: rng.random(transitions) < 0.5 for name in ("is_first", "terminated", "truncated", "mask")}
    fields |= {"initial_carry": rng.normal(size=(segments, 2, 2, 4)), "policy_version": np.arange(segments) + 1}
    return fields


def test_pad_segments_against_a_loop() -> None:
    starts, ends = [3, 0, 12, 7], [7, 3, 13, 12]
    flat = _flat(15, 4)
    padded = pad_segments(flat, starts, ends, max_length=5, rows=6)
    for name, array in padded._asdict().items():
        assert array.dtype == flat[name].dtype
        for row in range(6):
            if name in SEGMENT_FIELDS:
                expected = flat[name][row] if row < 4 else np.zeros_like(flat[name][0])
            else:
                expected = np.zeros((5, *flat[name].shape[1:]), flat[name].dtype)
                if row < 4:
                    expected[: ends[row] - starts[row]] = flat[name][starts[row] : ends[row]]
            np.testing.assert_array_equal(array[row], expected, err_msg=f"{name} row {row}")


def test_pad_segments_of_an_empty_buffer_is_all_padding() -> None:
    padded = pad_segments(_flat(0, 0), [], [], max_length=4, rows=2)
    assert padded.observation.shape == (2, 4, 3)
    assert not padded.mask.any()


def test_a_segment_without_steps_is_a_row_of_padding() -> None:
    padded = pad_segments(_flat(4, 2), [0, 2], [2, 2], max_length=3, rows=2)
    assert padded.policy_version.tolist() == [1, 2]
    assert not padded.mask[1].any() and not padded.reward[1].any()
    assert padded.reward[0, :2].all()


@pytest.mark.parametrize(
    ("starts", "ends", "rows", "message"),
    [
        ([0, 1, 2], [1, 2, 3], 2, "rows"),
        ([0], [9], 2, "max_length"),
        ([8], [11], 2, "inside a buffer"),
        ([-1], [1], 2, "inside a buffer"),
        ([3], [2], 2, "inside a buffer"),
    ],
)
def test_pad_segments_rejects(starts: list[int], ends: list[int], rows: int, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        pad_segments(_flat(10, len(starts)), starts, ends, max_length=5, rows=rows)


def test_every_row_once_per_epoch_in_a_new_order() -> None:
    first, second = (np.asarray(minibatch_indices(jax.random.PRNGKey(seed), 24, 8)) for seed in (0, 1))
    assert first.shape == (3, 8)
    np.testing.assert_array_equal(np.sort(first.ravel()), np.arange(24))
    np.testing.assert_array_equal(np.sort(second.ravel()), np.arange(24))
    assert (first != second).any()


def test_minibatches_must_divide_the_rows() -> None:
    with pytest.raises(ValueError, match="does not divide"):
        minibatch_indices(jax.random.PRNGKey(0), 10, 4)
