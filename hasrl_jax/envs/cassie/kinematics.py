"""What encoders and an IMU say of the pelvis: how high it is above the feet that stand, and how fast it moves.

A foot stands as far as the leaf spring of its shin is bent. The height is that of the pelvis above the soles of the
feet that stand. The velocity goes on with the accelerometer, and is drawn to that at which the lower ends of the
standing soles would be at rest:

    c_i = clip((-shin_i - 0.03 rad) / 0.03 rad, 0, 1),   w_i = (c_i + 0.01) / sum(c + 0.01)
    h = sum_i w_i h_i,   u = sum_i w_i u_i
    v' = v + a dt,   v <- v' + 0.5 min(1, c_left + c_right) (u - v')

The orientation, of which the vertical is used, is taken to be known, as an IMU's filter gives it.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import mujoco
import numpy as np

from hasrl_jax.envs import frames
from hasrl_jax.envs.cassie.ids import NO_NAMES, SIDES, CassieIds
from hasrl_jax.errors import ConfigError
from hasrl_jax.types import Array

UNLOADED_RAD = 0.03  # bend of a shin up to which its foot bears nothing
BEND_RAD = 0.03  # and by which it bends further until the foot stands for certain; half of the weight bends it by 0.06
TRUST = 0.5  # in the feet that stand, against the accelerometer, per environment step


class Legs(NamedTuple):
    """Both legs as chains of J hinges, left leg first; lengths in m, in the frame of the body before each hinge."""

    encoder: np.ndarray  # [2, J] which encoder measures each, from the hip to the foot
    shin: np.ndarray  # [2] which one measures the bend of the shin
    zero: np.ndarray  # [2, J] joint angle at which the frames below are given, rad
    position: np.ndarray  # [J, 2, 3] of the hinge
    frame: np.ndarray  # [J, 2, 3, 3] orientation of the body that the hinge turns
    axis: np.ndarray  # [J, 2, 3] of the hinge, in that body's frame
    ends: np.ndarray  # [2, 2, 3] leg, centers of the sole's round ends in the foot's frame
    radius: np.ndarray  # [2] of the ends, m
    ground_m: float  # height of level ground in the world


def legs(model: mujoco.MjModel, ids: CassieIds, joints: Mapping[str, str] = NO_NAMES) -> Legs:
    """Reads both chains from a model.

    Args:
      model: of the robot.
      ids: where its encoders are.
      joints: what `model` calls them, by their name in our file, where it differs.

    Raises:
      ConfigError: a hinge between pelvis and foot has no encoder, or the sole is no capsule.
    """
    encoders = ids.encoder_qpos.tolist()
    chains = [_chain(model, encoders, joints.get(f"{side}-foot", f"{side}-foot")) for side in SIDES]
    both = {name: np.stack([chain[name] for chain in chains]) for name in chains[0]}
    along = {name: np.moveaxis(both[name], 1, 0) for name in ("position", "frame", "axis")}
    shins = [encoders.index(model.joint(joints.get(f"{side}-shin", f"{side}-shin")).qposadr[0]) for side in SIDES]
    ground = np.flatnonzero(model.geom_bodyid == 0)[0]
    is_box = model.geom_type[ground] == mujoco.mjtGeom.mjGEOM_BOX
    ground_m = model.geom_pos[ground, 2] + is_box * model.geom_size[ground, 2]
    return Legs(**(both | along), shin=np.array(shins), ground_m=float(ground_m))


def _chain(model: mujoco.MjModel, encoders: list[int], foot_joint: str) -> dict[str, np.ndarray]:
    """The fields of `Legs` for one leg."""
    foot = int(model.jnt_bodyid[model.joint(foot_joint).id])
    bodies = [foot]
    while model.body_parentid[model.body_parentid[bodies[0]]] != 0:
        bodies.insert(0, int(model.body_parentid[bodies[0]]))
    found: dict[str, list[Any]] = {name: [] for name in ("encoder", "zero", "position", "frame", "axis")}
    offset, turn = np.zeros(3), np.eye(3)
    for body in bodies:
        offset, turn = offset + turn @ model.body_pos[body], turn @ _matrix(model.body_quat[body])
        if model.body_jntnum[body] == 0:
            continue
        joint = model.body_jntadr[body]
        place = model.jnt_qposadr[joint]
        if place not in encoders:
            raise ConfigError(f"cassie.observe: got blind; joint {model.joint(joint).name} of a leg has no encoder")
        found["encoder"].append(encoders.index(place))
        found["zero"].append(model.qpos0[place])
        found["position"].append(offset + turn @ model.jnt_pos[joint])
        found["frame"].append(turn)
        found["axis"].append(model.jnt_axis[joint])
        offset, turn = -model.jnt_pos[joint], np.eye(3)
    collides = (model.geom_contype | model.geom_conaffinity) > 0
    soles = np.flatnonzero((model.geom_bodyid == foot) & collides & (model.geom_type == mujoco.mjtGeom.mjGEOM_CAPSULE))
    if len(soles) != 1:
        raise ConfigError(f"cassie.observe: got blind; {foot_joint} turns {len(soles)} capsules, not one sole")
    sole = soles[0]
    half = _matrix(model.geom_quat[sole]) @ [0, 0, model.geom_size[sole, 1]]
    found["ends"] = [offset + model.geom_pos[sole] + half, offset + model.geom_pos[sole] - half]
    return {name: np.array(values) for name, values in found.items()} | {"radius": model.geom_size[sole, 0]}


def player_constants() -> dict[str, float]:
    """What who plays a blind policy elsewhere must know of `estimate`."""
    return {"unloaded_rad": UNLOADED_RAD, "bend_rad": BEND_RAD, "trust": TRUST}


def _matrix(quat: np.ndarray) -> np.ndarray:
    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, quat)
    return matrix.reshape(3, 3)


def soles(chain: Legs, angle: Array, speed: Array, turning: Array, xp: Any) -> tuple[Array, Array]:
    """Both ends of both soles as seen from the pelvis.

    Args:
      angle: of the hinges, rad, [..., 2, J].
      speed: of the hinges, rad/s, [..., 2, J].
      turning: angular velocity of the pelvis in its own frame, rad/s, [..., 3].

    Returns:
      Positions of the ends' centers (m) and their velocities less that of the pelvis (m/s), in the pelvis' frame at
      this moment, [..., 2 legs, 2 ends, 3] each.
    """
    batch = angle.shape[:-1]
    at, moving = xp.zeros((*batch, 3)), xp.zeros((*batch, 3))
    omega = xp.zeros((*batch, 3)) + turning[..., None, :]
    turn: Array = np.eye(3)
    for hinge in range(angle.shape[-1]):
        step = (turn @ chain.position[hinge][..., None])[..., 0]
        at, moving = at + step, moving + frames.cross(omega, step, xp)
        axis = (turn @ (chain.frame[hinge] @ chain.axis[hinge][..., None]))[..., 0]
        omega = omega + axis * speed[..., hinge, None]
        turn = turn @ (chain.frame[hinge] @ _turns(chain.axis[hinge], angle[..., hinge] - chain.zero[:, hinge], xp))
    arms = (turn[..., None, :, :] @ chain.ends[..., None])[..., 0]
    return at[..., None, :] + arms, moving[..., None, :] + frames.cross(omega[..., None, :], arms, xp)


def _turns(axis: np.ndarray, angle: Array, xp: Any) -> Array:
    """Rotation by `angle` [..., 2] about `axis` [2, 3], [..., 2, 3, 3]: I + sin K + (1 - cos) K^2."""
    x, y, z = axis.T
    zero = np.zeros_like(x)
    skew = np.moveaxis(np.array([[zero, -z, y], [z, zero, -x], [-y, x, zero]]), -1, 0)
    return np.eye(3) + xp.sin(angle)[..., None, None] * skew + (1 - xp.cos(angle))[..., None, None] * (skew @ skew)


def height(chain: Legs, angle: Array, quat: Array, xp: Any) -> Array:
    """Height of the pelvis above the soles that stand, counted as that above level ground is, m, [...].

    Args: as those of `estimate`.
    """
    return _above(chain, angle, xp.zeros_like(angle), xp.zeros_like(quat[..., 1:]), quat, xp)[0]


def estimate(
    chain: Legs,
    angle: Array,
    speed: Array,
    turning: Array,
    quat: Array,
    acceleration: Array,
    velocity: Array,
    elapsed_s: Array,
    xp: Any,
) -> tuple[Array, Array]:
    """What the robot can tell of its height and velocity after an environment step.

    Args:
      angle: that every encoder reads, rad, [..., 16].
      speed: the same, rad/s.
      turning: angular velocity of the pelvis in its own frame, rad/s, [..., 3].
      quat: orientation of the pelvis in the world, [..., 4].
      acceleration: of the pelvis in its own frame, gravity removed, m/s^2, [..., 3].
      velocity: the estimate before, along the axes of the world, m/s, [..., 3].
      elapsed_s: duration of the environment step, s, [...].

    Returns:
      Height of the pelvis above the soles that stand, m, [...], and its velocity in the world, m/s, [..., 3].
    """
    above, stands, slip = _above(chain, angle, speed, turning, quat, xp)
    trust = TRUST * xp.minimum(stands, 1.0)[..., None]
    predicted = velocity + frames.rotated(acceleration, quat, xp) * elapsed_s[..., None]
    return above, predicted + trust * (frames.rotated(-slip, quat, xp) - predicted)


def _above(chain: Legs, angle: Array, speed: Array, turning: Array, quat: Array, xp: Any) -> tuple[Array, Array, Array]:
    """Height above the standing soles, how many feet stand [...], and the soles' velocity less the pelvis' [..., 3]."""
    ends, moving = soles(chain, angle[..., chain.encoder], speed[..., chain.encoder], turning, xp)
    down = -frames.up_in_body_frame(quat, xp)
    depth = (ends * down[..., None, None, :]).sum(axis=-1)  # [..., legs, ends]
    heel_lower = depth[..., 0] > depth[..., 1]
    moving = xp.where(heel_lower[..., None], moving[..., 0, :], moving[..., 1, :])
    stands = xp.clip((-angle[..., chain.shin] - UNLOADED_RAD) / BEND_RAD, 0.0, 1.0)
    weight = stands + 0.01
    weight = weight / weight.sum(axis=-1, keepdims=True)
    above = (weight * (depth.max(axis=-1) + chain.radius)).sum(axis=-1) + chain.ground_m
    return above, stands.sum(axis=-1), (weight[..., None] * moving).sum(axis=-2)
