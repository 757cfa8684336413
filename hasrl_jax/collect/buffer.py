"""The centralised buffer: what the workers collected, side by side with re-based indices (paper III.A)."""

from typing import Any, NamedTuple

import numpy as np


class Collected(NamedTuple):
    """A batch of experience.

    `fields` holds flat arrays over the N steps of all parts; trajectory i is the steps
    `start[i]` to `end[i]`.
    """

    fields: dict[str, np.ndarray]  # the per-step arrays of shared_memory.slot_specs, [N, ...]
    start: np.ndarray  # [S] int32, re-based to the centralised buffer
    end: np.ndarray  # [S] int32
    initial_carry: np.ndarray  # [S, L, 2, W]
    version: np.ndarray  # [S] int32, of the parameters that acted
    statistics: list[dict[str, Any]]  # one per part
    seconds: float  # that collecting it took


class Part(NamedTuple):
    """What one worker collected."""

    slot: dict[str, np.ndarray]  # arrays of shared_memory.slot_specs
    version: int  # of the parameters that acted
    statistics: dict[str, Any]


def merge(parts: list[Part], seconds: float) -> Collected:
    """Copies slots into one buffer and shifts their start and end indices accordingly.

    Args:
      parts: slots of the same size; afterwards they are free.
      seconds: that collecting them took.
    """
    slots = [part.slot for part in parts]
    counts = [int(slot["num_segments"][0]) for slot in slots]
    offsets = np.cumsum([0, *(len(slot["mask"]) for slot in slots[:-1])]).astype(np.int32)
    per_step = slots[0].keys() - {"start", "end", "initial_carry", "num_segments"}
    return Collected(
        fields={name: np.concatenate([slot[name] for slot in slots]) for name in sorted(per_step)},
        start=np.concatenate([s["start"][:n] + o for s, n, o in zip(slots, counts, offsets, strict=True)]),
        end=np.concatenate([s["end"][:n] + o for s, n, o in zip(slots, counts, offsets, strict=True)]),
        initial_carry=np.concatenate([s["initial_carry"][:n] for s, n in zip(slots, counts, strict=True)]),
        version=np.repeat(np.array([part.version for part in parts], np.int32), counts),
        statistics=[part.statistics for part in parts],
        seconds=seconds,
    )
