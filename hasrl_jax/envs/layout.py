"""What a vector of named quantities holds and how it looks in a mirror; everything else is derived from the table."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from hasrl_jax.types import Array, Mirror

# How the left-right mirror image (x-z plane) acts on a vector or a rotation whose left is +y.
SAME, NEGATED = (1.0,), (-1.0,)
VECTOR, AXIAL = (1.0, -1.0, 1.0), (-1.0, 1.0, -1.0)
QUATERNION = (1.0, *AXIAL)


class Entry(NamedTuple):
    """One quantity; its place follows from those before it."""

    name: str
    unit: str  # "" without one
    mirror: tuple[float, ...]  # sign of each number in the mirror image; its length is the size of the entry
    legs: bool = False  # the numbers are those of the left leg, then those of the right: a mirror swaps the halves
    mean: float = 0.0  # where a policy that never saw the quantity is given it: roughly its mean
    std: float = 1.0  # and its standard deviation
    noise: float = 0.0  # half width of the uniform error of a noisy measurement, in the unit
    scale: float = 1.0  # of an action: what 1 stands for, in the unit
    parts: tuple[str, ...] = ()  # name of each number, where there are several
    note: str = ""  # where and how it is measured

    @property
    def size(self) -> int:
        return len(self.mirror)


def numbers(vector: Array) -> list[Array]:
    """The numbers of a vector [..., n], each [...]; those of a lone one are scalars, which NumPy handles fastest."""
    # Not by iterating over the vector: that ends with an error, which takes longer than they do.
    places = range(vector.shape[-1])
    return [vector[index] for index in places] if vector.ndim == 1 else [vector[..., index] for index in places]


def total(vector: Array) -> Array:
    """The sum of a vector of few numbers, [..., n] -> [...]: up to seven as `sum` adds them, in half the time."""
    first, *others = numbers(vector)
    for other in others:
        first = first + other
    return first


def summed(vector: Array, xp: Any) -> Array:
    """The sum of a vector, [..., n] -> [...]: what `sum` gives along the last axis, in two thirds of the time."""
    return xp.add.reduce(vector, axis=-1)


def columns(arrays: Sequence[Array], xp: Any) -> Array:
    """Arrays [...] side by side, [..., n]: what `stack` does along the last axis, in a third of the time."""
    if xp is np and getattr(arrays[0], "ndim", 0) == 0:
        return np.array(arrays)
    return xp.concatenate([array[..., None] for array in arrays], axis=-1)


def size(entries: Sequence[Entry]) -> int:
    """Numbers in the whole vector."""
    return sum(entry.size for entry in entries)


def noise(entries: Sequence[Entry]) -> np.ndarray:
    """Half width of the error of each number when measurements are noisy, [N]."""
    return np.concatenate([np.full(entry.size, entry.noise) for entry in entries])


def places(entries: Sequence[Entry]) -> dict[str, slice]:
    """Where each quantity stands."""
    ends = np.cumsum([entry.size for entry in entries]).tolist()
    return {entry.name: slice(end - entry.size, end) for entry, end in zip(entries, ends, strict=True)}


def signed_permutation(entries: Sequence[Entry]) -> tuple[np.ndarray, np.ndarray]:
    """The mirror image of the vector: index [N] and sign [N] with M x = sign * x[index]."""
    index: list[int] = []
    for entry in entries:
        own = np.arange(entry.size)
        index += (len(index) + (np.roll(own, entry.size // 2) if entry.legs else own)).tolist()
    sign = [sign for entry in entries for sign in entry.mirror]
    return np.array(index), np.array(sign, np.float32)


def mirror(observation: Sequence[Entry], action: Sequence[Entry]) -> Mirror:
    """The left-right mirror image of observations and actions."""
    return Mirror(*signed_permutation(observation), *signed_permutation(action))
