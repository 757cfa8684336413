"""The eight reward terms of the paper, each a pure function of arrays with leading batch axes.

r = s (w1 S_F + w2 S_V + w3 e^-(E_pel+E_foot) + w4 e^-P_m + w5 e^-E_v + w6 e^-H_p + w7 e^-T_p + w8 e^-A_p)

Source: paper section II.C and Table I; the definitions behind the symbols are those of the
published implementation. Differs from the paper: a ninth term, the power of the motors, whose usual weight is zero.
"""

from typing import Any

import numpy as np

from hasrl_jax.envs.cassie.settings import RewardConfig
from hasrl_jax.envs.layout import columns, summed, total
from hasrl_jax.types import Array

SCORES = ("foot_force", "foot_velocity")
TERMS = (
    *SCORES,
    "orientation",
    "pelvis_motion",
    "velocity",
    "hip_roll",
    "torque_change",
    "action_change",
    "motor_power",
)
MAX_FOOT_FORCE_N = 350.0
STAND_FOOT_FORCE_N = 120.0  # a foot under less than half of the robot's 320 N counts as planted
MAX_FOOT_SPEED_M_S = 2.0
CLOCK_GAIN = 1.2
# World orientation (w, x, y, z) of a foot body that stands flat and points ahead.
NEUTRAL_FOOT_QUAT = np.array([-0.24790886, -0.24679713, -0.66093967, 0.66392102])
_W, _X, _Y, _Z = NEUTRAL_FOOT_QUAT
TOE_AXIS = np.array([1 - 2 * (_Y**2 + _Z**2), 2 * (_X * _Y - _W * _Z), 2 * (_X * _Z + _W * _Y)])  # ahead, in its frame


def clock_score(clock: Array, magnitude: Array, limit: Array | float, xp: Any) -> Array:
    """S_F and S_V: sum over the feet of tan(pi/4 * 1.2 * clock * min(|x|, limit) / limit).

    Args:
      clock: force or velocity clock of each foot in [-1, 1], [..., 2].
      magnitude: ground force (N) or foot speed (m/s), non-negative, [..., 2].
    """
    share = xp.minimum(magnitude, limit) / limit
    return total(xp.tan(xp.pi / 4 * CLOCK_GAIN * clock * share))


def quaternion_error(quat: Array, reference: Array, xp: Any) -> Array:
    """1 - <reference, quat>^2, the squared sine of half the angle between them: [..., 4] -> [...]."""
    return 1.0 - summed(quat * reference, xp) ** 2


def turned_quaternion_error(products: Array, angle: Array, xp: Any) -> Array:
    """`quaternion_error` from `reference` turned by `angle` about the vertical, from `turn_products` or their mean.

        <q_z(angle) reference, q>^2 = cos^2(angle/2) A + 2 cos(angle/2) sin(angle/2) B + sin^2(angle/2) C

    so that a mean over physics steps is exact for an angle that is known only after them.

    Args:
      products: [..., n, 3] A, B and C.
      angle: rad, [...].

    Returns:
      [..., n].
    """
    cos, sin = xp.cos(angle / 2), xp.sin(angle / 2)
    return 1.0 - total(products * columns([cos * cos, 2 * cos * sin, sin * sin], xp)[..., None, :])


def turn_products(quat: Array, reference: np.ndarray, xp: Any) -> Array:
    """A = a^2, B = a b and C = b^2, [..., 4] -> [..., 3]: a = <reference, quat>, b = <k reference, quat>."""
    w, x, y, z = reference
    a, b = total(quat * reference), total(quat * np.array([-z, -y, x, w]))
    return columns([a * a, a * b, b * b], xp)


def pelvis_motion(
    lateral_m: Array,
    height_error_m: Array,
    speed: Array,
    angular_velocity: Array,
    acceleration: Array,
    config: RewardConfig,
) -> Array:
    """P_m: lateral drift, height error beyond a band that widens with speed, rotation and acceleration.

    Args:
      lateral_m: sideways drift of the pelvis, m, [...].
      height_error_m: pelvis height less the one asked for, m, [...].
      speed: commanded forward speed, m/s, [...].
      angular_velocity: of the pelvis, rad/s, [..., 3].
      acceleration: of the pelvis, gravity removed, m/s^2, [..., 3].
    """
    drift = abs(lateral_m)
    drift = drift * (drift >= 0.05)
    height_error = abs(height_error_m)
    band = config.height_band_m + config.height_band_per_speed * abs(speed)
    height_error = config.height_sharpness * (height_error * (height_error >= band))
    shaking = total(abs(angular_velocity)) + total(abs(acceleration))
    return drift + height_error + config.shaking * shaking


def weights(config: RewardConfig) -> np.ndarray:
    """What every term counts, in the order of `TERMS`, [9]."""
    return np.array([config.scale * getattr(config, name) for name in TERMS])


def weighted_terms(errors: dict[str, Array], weight: np.ndarray, xp: Any) -> Array:
    """The weighted, scaled terms in the order of `TERMS`, [..., 9]; their sum is the reward.

    Args:
      errors: the two scores S_F and S_V under `SCORES`, and for every other term the non-negative error E whose
        exp(-E) is rewarded, each [...].
      weight: as `weights` returns it.
    """
    values = columns([errors[name] for name in TERMS], xp)
    values = xp.concatenate([values[..., : len(SCORES)], xp.exp(-values[..., len(SCORES) :])], axis=-1)
    return values * weight
