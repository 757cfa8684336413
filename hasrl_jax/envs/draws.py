"""From uniform numbers to what a task draws."""

from collections.abc import Callable
from typing import Any

import numpy as np

from hasrl_jax.types import Array


def between(uniform: Array, bounds: tuple[float, float]) -> Array:
    """A uniform number in [0, 1) moved to [low, high)."""
    low, high = bounds
    return low + (high - low) * uniform


def anywhere(flags: np.ndarray) -> bool:
    """Whether any of `flags` [...] is set; `any` takes a scalar for an array, slowly."""
    return bool(flags.any() if flags.ndim else flags)


def redrawn(due: Array, draw: Callable[[], tuple[Array, ...]], kept: tuple[Array, ...], xp: Any) -> tuple[Array, ...]:
    """What `draw` returns where it is due, what was kept elsewhere.

    Under NumPy nothing is computed when nothing is due, which is most of the time: for a single environment a draw
    costs as much as a physics step.

    Args:
      due: [...] bool.
      draw: returns arrays of the shapes of `kept`.
      kept: arrays [..., *].
    """
    if xp is np and not anywhere(due):
        return kept
    return tuple(
        xp.where(due.reshape(due.shape + (1,) * (old.ndim - due.ndim)), new, old)
        for new, old in zip(draw(), kept, strict=True)
    )
