"""The centralised buffer: what the workers collected, side by side with re-based indices (paper III.A)."""

from typing import Any, NamedTuple

import numpy as np


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
