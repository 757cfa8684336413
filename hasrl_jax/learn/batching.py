"""From a flat buffer to padded trajectories, and from trajectories to minibatches."""

from collections.abc import Mapping

import jax
import numpy as np

from hasrl_jax.types import Trajectory

PER_TRAJECTORY_FIELDS = ("initial_carry", "policy_version")


def pad_segments(
    flat_fields: Trajectory | Mapping[str, np.ndarray],
    starts: np.ndarray,
    ends: np.ndarray,
    max_length: int,
    rows: int,
) -> Trajectory:
    """Cuts a flat buffer into trajectories, padded with zeros on the right (so `mask` is False there).

    Args:
      flat_fields: the fields of `Trajectory` with one axis N in place of [B, T]; `initial_carry` [S, L, 2, W] and
        `policy_version` [S] have one entry per segment instead. The buffer's own `mask` is carried over.
      starts: [S] int, first transition of each segment.
      ends: [S] int, one past its last transition.
      max_length: T of the result; every segment must fit.
      rows: B of the result; rows beyond S are all padding.

    Returns:
      A NumPy `Trajectory` [rows, max_length, ...] that shares no memory with the buffer.

    Raises:
      ValueError: more segments than rows, or a segment that is longer than `max_length` or leaves the buffer.

    Source: paper III.A and III.B (start and end indices; batches padded with zeros on the right).
    """
    fields = flat_fields._asdict() if isinstance(flat_fields, Trajectory) else dict(flat_fields)
    starts, ends = np.asarray(starts, np.int64), np.asarray(ends, np.int64)
    transitions, segments = len(fields["reward"]), len(starts)
    lengths = ends - starts
    if segments > rows:
        raise ValueError(f"pad_segments: {segments} segments do not fit into {rows} rows")
    if segments and lengths.max() > max_length:
        raise ValueError(f"pad_segments: a segment of {lengths.max()} steps exceeds max_length {max_length}")
    if segments and (lengths.min() < 0 or starts.min() < 0 or ends.max() > transitions):
        raise ValueError(f"pad_segments: segments must be increasing ranges inside a buffer of {transitions}")
    inside = np.zeros((rows, max_length), bool)
    inside[:segments] = np.arange(max_length) < lengths[:, None]
    source = (starts[:, None] + np.arange(max_length))[inside[:segments]]

    def place(name: str) -> np.ndarray:
        array = np.asarray(fields[name])
        if name in PER_TRAJECTORY_FIELDS:
            padded = np.zeros((rows, *array.shape[1:]), array.dtype)
            padded[:segments] = array
        else:
            padded = np.zeros((rows, max_length, *array.shape[1:]), array.dtype)
            padded[inside] = array[source]
        return padded

    return Trajectory(**{name: place(name) for name in Trajectory._fields})


def minibatch_indices(key: jax.Array, num_rows: int, minibatch_rows: int) -> jax.Array:
    """A random partition of the rows of one epoch: [num_minibatches, minibatch_rows] int, each row exactly once.

    Raises:
      ValueError: `num_rows` is not a multiple of `minibatch_rows`.

    Source: paper III.B (random batch sampler). Differs from the paper's published code, which drops the last partial
    minibatch: here none is left over.
    """
    if num_rows % minibatch_rows:
        raise ValueError(
            f"ppo.minibatch_trajectories: {minibatch_rows} does not divide the {num_rows} trajectories of an iteration"
        )
    return jax.random.permutation(key, num_rows).reshape(-1, minibatch_rows)
