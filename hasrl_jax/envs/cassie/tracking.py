"""Reward terms that compare the robot with a reference motion, each w exp(-k E) with an error E of its own.

Two published rewards are weights of this table: imitation (Xie et al. 2018, `configs/cassie_imitate.yaml`) and the gait
library (Li et al. 2021, `configs/cassie_gaits.yaml`).
"""

from typing import Any, NamedTuple

import numpy as np

from hasrl_jax.envs.cassie import rewards
from hasrl_jax.envs.cassie.settings import TrackingConfig
from hasrl_jax.envs.layout import columns
from hasrl_jax.types import Array

TERMS = (
    "joints",
    "springs",
    "center_of_mass",
    "attitude",
    "path",
    "height",
    "forward_speed",
    "lateral_speed",
    "turning",
    "torque",
    "swing_force",
    "acceleration",
    "action_change",
    "still",
)
# Hip roll, hip yaw, hip pitch, knee, foot; left leg, right leg. Source: Xie et al. 2018.
JOINT_WEIGHTS = np.array([0.15, 0.15, 0.1, 0.05, 0.05] * 2)
GRAVITY_M_S2 = 9.81
NEVER = 1e9  # an error that leaves nothing of its term


class Seen(NamedTuple):
    """What the terms look at, at the end of an environment step; leading axes [...]."""

    reference: dict[str, Array]  # the motion asked for, see `gaits.motion`
    motors: Array  # [..., 10] joint positions, rad
    motor_speeds: Array  # [..., 10] rad/s
    springs: Array  # [..., 2] shin joints, rad
    position: Array  # [..., 3] pelvis along and across the heading from the path to keep, and its height, m
    orientation: Array  # [..., 4] quaternion (w, x, y, z) relative to the heading to keep
    velocity: Array  # [..., 3] of the pelvis along and across the heading, m/s
    command: Array  # [..., 3] forward and lateral speed (m/s), yaw rate (rad/s)
    angular_velocity: Array  # [..., 3] of the pelvis, rad/s
    acceleration: Array  # [..., 3] of the pelvis, gravity removed, m/s^2
    torque_share: Array  # [..., 10] of the torque limit
    foot_force: Array  # [..., 2] mean vertical ground force, N
    force_clock: Array  # [..., 2] of each foot; -1 while it swings
    action_change: Array  # [..., 10]
    standing: Array  # [...] bool: the clock rests


def wanted(config: TrackingConfig) -> bool:
    """Whether any of the terms counts."""
    return any(getattr(config, name).weight for name in TERMS)


def errors(seen: Seen, xp: Any) -> dict[str, Array]:
    """The error of each term, not negative, [...].

    `joints` sums squared differences weighted by JOINT_WEIGHTS, `springs` and the positions squared differences;
    `attitude` is 1 - <q, reference>^2, half of 1 - cos of the angle between them. `swing_force` is the share of 350 N
    under feet that should swing, `acceleration` in units of gravity. Standing still counts while the clock rests only.
    """
    off = seen.position - seen.reference["pelvis_position"]
    rotation = seen.reference["pelvis_rotation"]
    upright = xp.sqrt(xp.maximum(1.0 - (rotation**2).sum(axis=-1, keepdims=True), 0.0))
    orientation = xp.concatenate([upright, rotation], axis=-1)
    speed_error = xp.abs(seen.velocity[..., :2] - seen.command[..., :2])
    turning = seen.angular_velocity - seen.command[..., 2:] * np.array([0.0, 0.0, 1.0])
    loaded = xp.minimum(seen.foot_force, rewards.MAX_FOOT_FORCE_N) / rewards.MAX_FOOT_FORCE_N
    return {
        "joints": ((seen.motors - seen.reference["motor_positions"]) ** 2 * JOINT_WEIGHTS).sum(axis=-1),
        "springs": ((seen.springs - seen.reference["springs"]) ** 2).sum(axis=-1),
        "center_of_mass": (off**2).sum(axis=-1),
        "attitude": rewards.quaternion_error(seen.orientation, orientation, xp),
        "path": (off[..., :2] ** 2).sum(axis=-1),
        "height": xp.abs(off[..., 2]),
        "forward_speed": speed_error[..., 0],
        "lateral_speed": speed_error[..., 1],
        "turning": (turning**2).sum(axis=-1),
        "torque": (seen.torque_share**2).mean(axis=-1),
        "swing_force": (xp.maximum(-seen.force_clock, 0.0) * loaded).sum(axis=-1),
        "acceleration": (seen.acceleration**2).sum(axis=-1) / GRAVITY_M_S2**2,
        "action_change": xp.abs(seen.action_change).mean(axis=-1),
        "still": xp.where(seen.standing, (seen.motor_speeds**2).mean(axis=-1), NEVER),
    }


def weighted_terms(found: dict[str, Array], config: TrackingConfig, xp: Any) -> Array:
    """scale w exp(-k E) of every term in the order of TERMS, [..., 14]; `found`: as `errors` returns them."""
    sharpness = np.array([getattr(config, name).sharpness for name in TERMS])
    weights = np.array([config.scale * getattr(config, name).weight for name in TERMS])
    return weights * xp.exp(-sharpness * columns([found[name] for name in TERMS], xp))
