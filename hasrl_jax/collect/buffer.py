"""The rollout buffer: what the workers collected, side by side with re-based indices (paper III.A)."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from hasrl_jax.types import SEGMENT_FIELDS, Trajectory


class Collected(NamedTuple):
    """A batch of experience.

    `fields` holds flat arrays over the N steps of all slots; trajectory i is the steps
    `start[i]` to `end[i]`.
    """

    fields: dict[str, np.ndarray]  # the per-step arrays of shared_memory.slot_specs, [N, ...]
    start: np.ndarray  # [S] int32, re-based to the centralised buffer
    end: np.ndarray  # [S] int32
    initial_carry: np.ndarray  # [S, L, 2, W]
    version: np.ndarray  # [S] int32, of the parameters that acted
    statistics: list[dict[str, Any]]  # one per slot
    seconds: float  # that collecting it took


def merge(
    slots: list[dict[str, np.ndarray]], statistics: list[dict[str, Any]], version: int | list[int], seconds: float
) -> Collected:
    """Copies slots into one buffer and shifts their start and end indices accordingly.

    Args:
      slots: arrays of `shared_memory.slot_specs`, all of the same sizes; free to be written again afterwards.
      statistics: one per slot.
      version: of the parameters that acted, for all slots or for each.
      seconds: that collecting them took.
    """
    counts = [int(slot["num_segments"][0]) for slot in slots]
    offsets = [position * len(slots[0]["mask"]) for position in range(len(slots))]
    per_step = slots[0].keys() - {"start", "end", "initial_carry", "num_segments"}
    return Collected(
        fields={name: np.concatenate([slot[name] for slot in slots]) for name in sorted(per_step)},
        start=np.concatenate([s["start"][:n] + o for s, n, o in zip(slots, counts, offsets, strict=True)]),
        end=np.concatenate([s["end"][:n] + o for s, n, o in zip(slots, counts, offsets, strict=True)]),
        initial_carry=np.concatenate([s["initial_carry"][:n] for s, n in zip(slots, counts, strict=True)]),
        version=np.repeat(np.broadcast_to(np.asarray(version, np.int32), len(slots)), counts),
        statistics=statistics,
        seconds=seconds,
    )


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
        if name in SEGMENT_FIELDS:
            padded = np.zeros((rows, *array.shape[1:]), array.dtype)
            padded[:segments] = array
        else:
            padded = np.zeros((rows, max_length, *array.shape[1:]), array.dtype)
            padded[inside] = array[source]
        return padded

    return Trajectory(**{name: place(name) for name in Trajectory._fields})
