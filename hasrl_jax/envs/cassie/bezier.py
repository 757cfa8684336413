"""Periodic curves of two Bezier pieces, one for each half of a gait cycle.

    b(u) = sum_k c_k binomial(5, k) u^k (1 - u)^(5 - k),  u in [0, 1) within a half

Where the halves meet, twice in a cycle, the curve and its slope are continuous.
Source: Li et al. 2021 (6 coefficients per motor and stance leg); that the halves meet is this project's.
"""

import math
from typing import Any

import numpy as np

from hasrl_jax.types import Array

DEGREE = 5
HALVES, COEFFICIENTS = 2, DEGREE + 1


def bernstein(u: Array, xp: Any) -> Array:
    """The polynomials that weigh the coefficients, [...] -> [..., 6]."""
    u = u[..., None]  # NumPy rounds powers of a scalar otherwise than those of an array
    terms = [math.comb(DEGREE, k) * u**k * (1 - u) ** (DEGREE - k) for k in range(COEFFICIENTS)]
    return xp.concatenate(terms, axis=-1)


def value(coefficients: Array, phase: Array, xp: Any) -> Array:
    """Curves at a phase.

    Args:
      coefficients: of both halves of Q curves, [..., 2, Q, 6].
      phase: in [0, 1), [...].

    Returns:
      [..., Q].
    """
    place = HALVES * phase
    is_second = (place >= 1.0)[..., None, None]
    of_half = xp.where(is_second, coefficients[..., 1, :, :], coefficients[..., 0, :, :])
    return (of_half * bernstein(xp.mod(place, 1.0), xp)[..., None, :]).sum(axis=-1)


def fit(samples: np.ndarray, phase: np.ndarray) -> np.ndarray:
    """The curves nearest to samples, by least squares.

    Args:
      samples: [N, Q].
      phase: of each in [0, 1), [N].

    Returns:
      coefficients [2, Q, 6].
    """
    count = len(samples)
    place = HALVES * phase
    design = np.zeros((count, HALVES, COEFFICIENTS))
    design[np.arange(count), (place >= 1).astype(int)] = bernstein(np.mod(place, 1.0), np)
    joined = _joined()
    free, *_ = np.linalg.lstsq(design.reshape(count, -1) @ joined, samples, rcond=None)
    return (joined @ free).reshape(HALVES, COEFFICIENTS, -1).transpose(0, 2, 1)


def _joined() -> np.ndarray:
    """All 12 coefficients of a curve from the 8 that are free, [12, 8].

    Each half begins where the other one ends, in the direction in which that one ended.
    """
    joined = np.zeros((HALVES * COEFFICIENTS, 8))
    for half in range(HALVES):
        own, other = half * COEFFICIENTS, (1 - half) * COEFFICIENTS
        joined[own + np.arange(4), 4 * half + np.arange(4)] = 1.0
        joined[own + 5, 4 * (1 - half)] = 1.0  # the other half's first
    for half in range(HALVES):
        own, other = half * COEFFICIENTS, (1 - half) * COEFFICIENTS
        joined[own + 4] = 2 * joined[own + 5] - joined[other + 1]
    return joined
