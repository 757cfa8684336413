"""Motors whose torque falls with their speed: a PD loop behind the torque-speed curve of a DC motor.

A voltage limit bounds what a motor at the speed w can give, its driver bounds the torque as before:

    -s (1 + w / w0) <= torque <= s (1 - w / w0)        s: stall torque, w0: no-load speed

C MuJoCo and MuJoCo Warp have such an actuator. The JAX implementation of MJX has none: there the curve bounds the force
of the plain PD actuator.

Source: Oregon State University's cassie-mujoco-sim bounds |torque| by 2 t_max (1 - |w| / w0), which is the same curve
with s = 2 t_max where a motor drives. Differs from it where a motor brakes: there the voltage limit takes nothing away.
"""

import copy
from collections.abc import Mapping
from typing import Any, NamedTuple

import mujoco
import numpy as np

from hasrl_jax.types import Array

STALL_PER_LIMIT = 2.0  # stall torque over the torque that the driver allows: half the no-load speed keeps all of it
# Where MuJoCo keeps a DC motor's numbers: in `actuator_gainprm`.
RESISTANCE, CONSTANT, STIFFNESS, DAMPING, VOLTAGE = 0, 1, 4, 6, 7
LAG = 0  # in `actuator_dynprm`: the time constant of a torque that lags, s
POSITION_INPUT = 1  # `actuator_ctrlspec`: the control is a target position
AT_ONCE_S = 1e-9  # time constant of a torque that does not lag; zero is none that MuJoCo takes


class Curve(NamedTuple):
    """The torque-speed curve of each actuator, seen from its joint."""

    stall_torque: np.ndarray  # [nu] N m
    no_load_speed: np.ndarray  # [nu] rad/s


def let_lag(spec: mujoco.MjSpec) -> None:
    """Gives every motor of a description a torque that follows with a time constant, for `with_curve`.

    The torque is then part of the physics state, which only compiling can make room for. Gains stay those of PD loops.

        d torque / dt = (asked for - torque) / time constant

    Source: Oregon State University's cassie-mujoco-sim gives a torque 6 physics steps, 3 ms, late. Differs from it: the
    inductance of a DC motor, which MuJoCo has, delays by its time constant on average, and smooths.
    """
    for actuator in spec.actuators:
        actuator.dyntype, actuator.gaintype = mujoco.mjtDyn.mjDYN_DCMOTOR, mujoco.mjtGain.mjGAIN_DCMOTOR
        actuator.biastype, actuator.actearly, actuator.actdim = mujoco.mjtBias.mjBIAS_DCMOTOR, True, 1
        actuator.dynprm[LAG] = AT_ONCE_S


def with_curve(model: mujoco.MjModel, no_load_speed: Mapping[str, float]) -> mujoco.MjModel:
    """A copy of `model` whose actuators are motors with a torque-speed curve.

    Args:
      model: its actuators are PD loops on joints, each with a torque limit.
      no_load_speed: of each actuator by its name, at the joint, rad/s.
    """
    model = copy.copy(model)
    for index in range(model.nu):
        speed = no_load_speed[model.actuator(index).name]
        stiffness, damping = model.actuator_gainprm[index, 0], -model.actuator_biasprm[index, 2]
        stall = STALL_PER_LIMIT * model.actuator_forcerange[index, 1]
        model.actuator_gainprm[index] = 0
        # With a motor constant of 1 the voltage limit is the no-load speed.
        places = [RESISTANCE, CONSTANT, STIFFNESS, DAMPING, VOLTAGE]
        model.actuator_gainprm[index, places] = speed / stall, 1.0, stiffness, damping, speed
    model.actuator_biasprm[:] = model.actuator_dynprm[:] = 0
    model.actuator_dynprm[model.actuator_actnum > 0, LAG] = AT_ONCE_S
    model.actuator_dyntype[:] = mujoco.mjtDyn.mjDYN_DCMOTOR
    model.actuator_gaintype[:] = mujoco.mjtGain.mjGAIN_DCMOTOR
    model.actuator_biastype[:] = mujoco.mjtBias.mjBIAS_DCMOTOR
    model.actuator_ctrlspec[:] = POSITION_INPUT
    return model


def curve_of(model: mujoco.MjModel) -> Curve | None:
    """The torque-speed curve of a model's motors; None where they have none."""
    if not (model.actuator_gaintype == mujoco.mjtGain.mjGAIN_DCMOTOR).any():
        return None
    prm = model.actuator_gainprm
    return Curve(prm[:, VOLTAGE] * prm[:, CONSTANT] / prm[:, RESISTANCE], prm[:, VOLTAGE] / prm[:, CONSTANT])


def without_curve(model: mujoco.MjModel) -> tuple[mujoco.MjModel, Curve | None]:
    """`model` with plain PD actuators, and the curve that is missing from it; None where there was none."""
    curve = curve_of(model)
    if curve is None:
        return model, None
    plain = copy.copy(model)
    for name, values in pd_parameters(model.actuator_gainprm, np).items():
        getattr(plain, name)[:] = values
    plain.actuator_dyntype[:] = mujoco.mjtDyn.mjDYN_NONE
    plain.actuator_gaintype[:] = mujoco.mjtGain.mjGAIN_FIXED
    plain.actuator_biastype[:] = mujoco.mjtBias.mjBIAS_AFFINE
    plain.actuator_ctrlspec[:] = 0
    return plain, curve


def pd_parameters(gainprm: Array, xp: Any) -> dict[str, Array]:
    """`actuator_gainprm`, `actuator_biasprm` [..., nu, 10] of the PD loops in the `gainprm` of DC motors."""
    stiffness, damping, zero = gainprm[..., STIFFNESS], gainprm[..., DAMPING], xp.zeros_like(gainprm[..., 0])
    rest = [zero] * (gainprm.shape[-1] - 3)
    return {
        "actuator_gainprm": xp.stack([stiffness, zero, zero, *rest], axis=-1),
        "actuator_biasprm": xp.stack([zero, -stiffness, -damping, *rest], axis=-1),
    }


def limited(curve: Curve, torque: Array, speed: Array, torque_limit: Array, xp: Any) -> Array:
    """What a motor really gives, N m; all [..., nu].

    Args:
      curve: of the motors.
      torque: asked for, N m.
      speed: of the joints, rad/s.
      torque_limit: of the drivers, N m.
    """
    share = speed / curve.no_load_speed
    torque = xp.clip(torque, -curve.stall_torque * (1 + share), curve.stall_torque * (1 - share))
    return xp.clip(torque, -torque_limit, torque_limit)
