"""From uniform numbers to what a task draws."""

from hasrl_jax.types import Array


def between(uniform: Array, bounds: tuple[float, float]) -> Array:
    """A uniform number in [0, 1) moved to [low, high)."""
    low, high = bounds
    return low + (high - low) * uniform
