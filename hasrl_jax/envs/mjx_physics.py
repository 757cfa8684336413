"""One physics step of MJX that agrees with C MuJoCo.

The JAX implementation of MJX leaves out three things that C MuJoCo and MuJoCo Warp compute, and all change how Cassie
moves: the velocity-dependent part of a closed loop's reference acceleration, that an actuator at its force limit
damps nothing, and DC motors. They are added here from the outside.
"""

import contextlib
import io
from typing import NamedTuple

import jax.numpy as jnp
import mujoco
import numpy as np

from hasrl_jax.envs import motors
from hasrl_jax.types import Array

with contextlib.redirect_stdout(io.StringIO()):  # it prints that the optional Warp is missing
    from mujoco import mjx as mjx


class Loops(NamedTuple):
    """The `connect` constraints of a model, C of them; each holds two points of two bodies together."""

    body: np.ndarray  # [C, 2]
    anchor: np.ndarray  # [C, 2, 3] the points in the bodies' frames, m
    root: np.ndarray  # [C, 2] the body at the root of each body's tree
    moved_by: np.ndarray  # [C, 2, nv] 1 where the degree of freedom moves the body


def find_loops(model: mujoco.MjModel) -> Loops:
    """Reads the constraints once."""
    connects = np.flatnonzero(model.eq_type == mujoco.mjtEq.mjEQ_CONNECT)
    body = np.stack([model.eq_obj1id[connects], model.eq_obj2id[connects]], axis=1)
    moved_by = np.zeros((model.nbody, model.nv))
    for child in range(1, model.nbody):  # parents come before their children
        moved_by[child] = moved_by[model.body_parentid[child]] + (model.dof_bodyid == child)
    return Loops(body, model.eq_data[connects, :6].reshape(-1, 2, 3), model.body_rootid[body], moved_by[body])


def physics_step(model: mjx.Model, data: mjx.Data, loops: Loops, curve: motors.Curve | None) -> mjx.Data:
    """Advances one environment by one physics step.

    Args:
      model: one environment's robot.
      data: its qpos, qvel, ctrl and qacc_warmstart; anything else is overwritten.
      loops: from `find_loops`.
      curve: of the motors, where the model's actuators are the PD loops of `motors.without_curve`.
    """
    if model.impl == mjx.Impl.WARP:
        return mjx.step(model, data)
    data = _forward(model, data, loops, curve) if len(loops.body) or curve else mjx.forward(model, data)
    if model.opt.integrator != mujoco.mjtIntegrator.mjINT_IMPLICITFAST:
        return mjx.euler(model, data)
    return mjx.implicit(_without_saturated_damping(model, data), data)


def _forward(model: mjx.Model, data: mjx.Data, loops: Loops, curve: motors.Curve | None) -> mjx.Data:
    """`mjx.forward`, in whose order of stages the missing parts fit between the velocities and the solver."""
    data = mjx.sensor_pos(model, mjx.fwd_position(model, data))
    data = mjx.sensor_vel(model, mjx.fwd_velocity(model, data))
    if len(loops.body):
        bias = loop_accelerations(data, loops).reshape(-1)
        # The rows of `connect` constraints come first.
        reference = data._impl.efc_aref.at[: len(bias)].add(-bias)
        data = data.tree_replace({"_impl.efc_aref": reference})
    data = mjx.fwd_actuation(model, data)
    if curve:
        data = _along_curve(model, data, curve)
    data = mjx.fwd_acceleration(model, data)
    return mjx.sensor_acc(model, mjx.solve(model, data))


def _along_curve(model: mjx.Model, data: mjx.Data, curve: motors.Curve) -> mjx.Data:
    """`data` with the torques that motors of this curve give."""
    speed = data._impl.actuator_velocity
    force = motors.limited(curve, data.actuator_force, speed, model.actuator_forcerange[:, 1], jnp)
    joint_force = data.qfrc_actuator + data._impl.actuator_moment.T @ (force - data.actuator_force)
    return data.replace(actuator_force=force, qfrc_actuator=joint_force)


def loop_accelerations(data: mjx.Data, loops: Loops) -> Array:
    """How fast the gap of each loop would accelerate at zero joint acceleration, m/s^2: [C, 3].

    With the gap's velocity J(q) v this is (dJ/dt) v, the difference between the accelerations of the two anchors,

        a = a_lin + a_ang x r + w x (v_lin + w x r),      (a_ang, a_lin) = sum over degrees of freedom of (dS/dt) v

    where r is the anchor's offset from the centre of mass of its tree, to which MuJoCo refers spatial vectors.

    Source: Featherstone, Rigid Body Dynamics Algorithms, section 2.10 (spatial acceleration of a point).
    """
    spatial = jnp.asarray(loops.moved_by, data.qvel.dtype) @ (data.cdof_dot * data.qvel[:, None])
    rotation = jnp.einsum("cbij,cbj->cbi", data.xmat[loops.body], jnp.asarray(loops.anchor, data.qvel.dtype))
    offset = data.xpos[loops.body] + rotation - data.subtree_com[loops.root]
    angular, linear = data.cvel[loops.body][..., :3], data.cvel[loops.body][..., 3:]
    point_velocity = linear + jnp.cross(angular, offset)
    acceleration = spatial[..., 3:] + jnp.cross(spatial[..., :3], offset) + jnp.cross(angular, point_velocity)
    return acceleration[:, 0] - acceleration[:, 1]


def _without_saturated_damping(model: mjx.Model, data: mjx.Data) -> mjx.Model:
    """The model for the implicit integration: an actuator at its force limit no longer reacts to velocity."""
    low, high = model.actuator_forcerange[:, 0], model.actuator_forcerange[:, 1]
    saturated = model.actuator_forcelimited & ((data.actuator_force <= low) | (data.actuator_force >= high))
    keep = jnp.where(saturated, 0.0, 1.0)[:, None]
    return model.tree_replace(
        {"actuator_biasprm": model.actuator_biasprm * keep, "actuator_gainprm": model.actuator_gainprm * keep}
    )
