"""Turning things about the vertical: headings, and what is seen from one. Angles in rad, positive to the left."""

from typing import Any

from hasrl_jax.envs.layout import columns, numbers
from hasrl_jax.types import Array


def up_in_body_frame(quat: Array, xp: Any) -> Array:
    """The world's vertical in the frame that `quat` (w, x, y, z) orients, [..., 4] -> [..., 3]."""
    w, x, y, z = numbers(quat)
    return columns([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], xp)


def rotated(vector: Array, quat: Array, xp: Any) -> Array:
    """A vector of the frame that `quat` (w, x, y, z) orients, in the world: v + 2 w (u x v) + 2 u x (u x v), [..., 3].

    Args:
      vector: [..., 3].
      quat: (w, u) [..., 4].
    """
    w, axis = quat[..., :1], quat[..., 1:]
    turned_once = 2 * cross(axis, vector, xp)
    return vector + w * turned_once + cross(axis, turned_once, xp)


def cross(a: Array, b: Array, xp: Any) -> Array:
    """a x b, [..., 3]; `numpy.cross` takes several times as long."""
    (ax, ay, az), (bx, by, bz) = numbers(a), numbers(b)
    return columns([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], xp)


def heading(quat: Array, xp: Any) -> Array:
    """Yaw angle, [..., 4] -> [...]."""
    w, x, y, z = numbers(quat)
    return xp.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def wrapped(angle: Array, xp: Any) -> Array:
    """The same direction within -pi to pi, [...]."""
    return xp.arctan2(xp.sin(angle), xp.cos(angle))


def turned(vector: Array, angle: Array, xp: Any) -> Array:
    """A vector whose first two numbers are horizontal, turned by `angle`: [..., n], [...] -> [..., n]."""
    cos, sin, (x, y) = xp.cos(angle), xp.sin(angle), numbers(vector[..., :2])
    horizontal = columns([cos * x - sin * y, sin * x + cos * y], xp)
    return xp.concatenate([horizontal, vector[..., 2:]], axis=-1)


def turned_quaternion(quat: Array, angle: Array, xp: Any) -> Array:
    """An orientation (w, x, y, z) turned by `angle`, with w >= 0: [..., 4], [...] -> [..., 4]."""
    cos, sin = xp.cos(angle / 2), xp.sin(angle / 2)
    w, x, y, z = numbers(quat)
    result = columns([cos * w - sin * z, cos * x - sin * y, cos * y + sin * x, cos * z + sin * w], xp)
    return xp.where(result[..., :1] < 0, -result, result)
