"""Dynamics randomisation: uniform numbers in, randomised model fields out.

Both physics engines apply the same fields, so the same draws give the same robot.
Source: paper section II.D; ranges of the published implementation.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import mujoco
import numpy as np

from hasrl_jax.envs import motors
from hasrl_jax.envs.cassie.ids import NO_NAMES, SIDES
from hasrl_jax.envs.cassie.settings import RandomizeConfig
from hasrl_jax.envs.draws import between
from hasrl_jax.envs.layout import columns
from hasrl_jax.types import Array

DAMPED_JOINTS = ("hip-roll", "hip-yaw", "hip-pitch", "achilles-rod", "knee", "shin", "tarsus", "foot-crank", "foot")
SPRINGS = ("shin", "heel-spring")  # joints of the leaf springs
PELVIS = "cassie-pelvis"
# Drawn only where a setting says more than the paper; how many numbers each consumes at a reset.
BEYOND_PAPER = {
    "pd_gain_scale": 10,
    "torque_scale": 10,
    "spring_scale": 4,
    "payload_kg": 1,
    "center_of_mass_m": 3,
    "control_delay_s": 1,
    "torque_lag_s": 1,
    "velocity_bias_m_s": 2,
    "velocity_lag_s": 1,
    "yaw_drift_rad_s": 1,
    "start_turned_rad": 1,
    "floor_slope_deg": 2,  # and its direction
    "policy_period_scale": 0,
    "observation_noise": 0,
}


class Nominal(NamedTuple):
    """Constants of the nominal model that the randomised fields scale."""

    timestep: float
    body_mass: np.ndarray  # [nbody]
    body_inertia: np.ndarray  # [nbody, 3]
    body_ipos: np.ndarray  # [nbody, 3]
    dof_damping: np.ndarray  # [nv]
    geom_friction: np.ndarray  # [ngeom, 3]
    geom_quat: np.ndarray  # [ngeom, 4]
    jnt_stiffness: np.ndarray  # [njnt]
    actuator_gainprm: np.ndarray  # [nu, 10]
    actuator_biasprm: np.ndarray  # [nu, 10]
    actuator_forcerange: np.ndarray  # [nu, 2]
    actuator_dynprm: np.ndarray  # [nu, 10]
    subtree: np.ndarray  # [nbody, nbody] 1 where the column's body hangs on the row's body
    dof_draw: np.ndarray  # [nv] which damping draw scales this degree of freedom, -1 for none
    num_damping: int
    springs: np.ndarray  # [4] joints of the leaf springs
    pelvis: int  # body
    is_floor: np.ndarray  # [ngeom] bool: the planes of the world
    gain_columns: np.ndarray  # [10] 1 where `actuator_gainprm` holds a PD gain
    weights: "WeightTerms"


class WeightTerms(NamedTuple):
    """What the inverse weights need that no draw changes; the joint-space inertia is linear in the mass factors."""

    armature: np.ndarray  # [nv, nv] of the motors, kg m^2
    inertia: np.ndarray  # [nbody, nv, nv] of each body, kg m^2
    jacobian: np.ndarray  # [nbody, 6, nv] of each body's center of mass
    dof_average: np.ndarray  # [nv, nv] averages over the degrees of freedom that share a weight


def nominal(
    model: mujoco.MjModel, joints: Mapping[str, str] = NO_NAMES, bodies: Mapping[str, str] = NO_NAMES
) -> Nominal:
    """Reads the constants once.

    Args:
      model: the compiled nominal robot.
      joints: what `model` calls them, by their name in our file, where it differs.
      bodies: the same for bodies.
    """
    subtree = np.eye(model.nbody)
    for body in range(model.nbody - 1, 0, -1):
        subtree[model.body_parentid[body]] += subtree[body]
    names = [f"{side}-{joint}" for side in SIDES for joint in DAMPED_JOINTS]
    damped = [model.joint(joints.get(name, name)).id for name in names]
    springs = [f"{side}-{joint}" for side in SIDES for joint in SPRINGS]
    gain_columns = np.zeros(model.actuator_gainprm.shape[1])
    has_curve = motors.curve_of(model) is not None
    gain_columns[[motors.STIFFNESS, motors.DAMPING] if has_curve else 0] = 1.0
    return Nominal(
        timestep=model.opt.timestep,
        body_mass=model.body_mass.copy(),
        body_inertia=model.body_inertia.copy(),
        body_ipos=model.body_ipos.copy(),
        dof_damping=model.dof_damping.copy(),
        geom_friction=model.geom_friction.copy(),
        geom_quat=model.geom_quat.copy(),
        jnt_stiffness=model.jnt_stiffness.copy(),
        actuator_gainprm=model.actuator_gainprm.copy(),
        actuator_biasprm=model.actuator_biasprm.copy(),
        actuator_forcerange=model.actuator_forcerange.copy(),
        actuator_dynprm=model.actuator_dynprm.copy(),
        subtree=subtree,
        dof_draw=np.array([damped.index(joint) if joint in damped else -1 for joint in model.dof_jntid]),
        num_damping=len(damped),
        springs=np.array([model.joint(joints.get(name, name)).id for name in springs]),
        pelvis=model.body(bodies.get(PELVIS, PELVIS)).id,
        is_floor=(model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE) & (model.geom_bodyid == 0),
        gain_columns=gain_columns,
        weights=_weight_terms(model),
    )


def _weight_terms(model: mujoco.MjModel) -> WeightTerms:
    """From the kinematics of the initial pose of `model`, qpos0."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    jacobian = np.zeros((model.nbody, 6, model.nv))
    inertia = np.zeros((model.nbody, model.nv, model.nv))
    for body in range(1, model.nbody):
        linear, angular = jacobian[body, :3], jacobian[body, 3:]
        mujoco.mj_jacBodyCom(model, data, linear, angular, body)
        frame = data.ximat[body].reshape(3, 3)
        rotational = frame @ np.diag(model.body_inertia[body]) @ frame.T
        inertia[body] = model.body_mass[body] * linear.T @ linear + angular.T @ rotational @ angular
    shared = np.eye(model.nv)
    for joint in np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_BALL):
        own = slice(model.jnt_dofadr[joint], model.jnt_dofadr[joint] + 3)
        shared[own, own] = 1 / 3
    return WeightTerms(np.diag(model.dof_armature), inertia, jacobian, shared)


def num_uniforms(constants: Nominal) -> int:
    """Uniform numbers that `model_fields` consumes: damping, mass, friction (3), physics rate, whether at all."""
    return constants.num_damping + len(constants.body_mass) - 1 + 3 + 1 + 1


def num_uniforms_beyond(config: RandomizeConfig) -> int:
    """Those that it consumes besides, for what the paper does not draw; none where no such range is set."""
    standard = RandomizeConfig()
    some = any(getattr(config, name) != getattr(standard, name) for name in BEYOND_PAPER)
    return sum(BEYOND_PAPER.values()) if config.enabled and some else 0


def beyond(uniforms: Array, config: RandomizeConfig, xp: Any) -> dict[str, Array]:
    """The draws that the paper does not have, by setting; uniform numbers [..., num_uniforms_beyond]."""
    shift, bias, drift = config.center_of_mass_m, config.velocity_bias_m_s, config.yaw_drift_rad_s
    bounds = {
        "pd_gain_scale": config.pd_gain_scale,
        "torque_scale": config.torque_scale,
        "spring_scale": config.spring_scale,
        "payload_kg": config.payload_kg,
        "center_of_mass_m": (-shift, shift),
        "control_delay_s": config.control_delay_s,
        "torque_lag_s": config.torque_lag_s,
        "velocity_bias_m_s": (-bias, bias),
        "velocity_lag_s": config.velocity_lag_s,
        "yaw_drift_rad_s": (-drift, drift),
        "start_turned_rad": config.start_turned_rad,
        "floor_slope_deg": (0.0, 1.0),
    }
    parts = xp.split(uniforms, np.cumsum([BEYOND_PAPER[name] for name in bounds])[:-1], axis=-1)
    draws = {name: between(part, ends) for (name, ends), part in zip(bounds.items(), parts, strict=True)}
    steepness, direction = (draws["floor_slope_deg"][..., i] for i in range(2))
    angle = 2 * np.pi * direction
    rise = xp.tan(np.deg2rad(1.0) * between(steepness, config.floor_slope_deg))
    return draws | {"floor_slope": rise[..., None] * xp.stack([xp.cos(angle), xp.sin(angle)], axis=-1)}


def is_drawn(uniforms: Array, config: RandomizeConfig) -> Array:
    """Whether an episode's robot is a drawn one, [...] bool; `uniforms` as in `model_fields`."""
    return (uniforms[..., -1] < config.share) & config.enabled


def model_fields(
    uniforms: Array, more_uniforms: Array, constants: Nominal, config: RandomizeConfig, xp: Any
) -> dict[str, Array]:
    """MjModel fields for one episode; nothing (the nominal robot) when randomisation is off.

    Args:
      uniforms: [..., num_uniforms] in [0, 1).
      more_uniforms: [..., num_uniforms_beyond].

    Returns:
      `body_mass` [..., nbody], `body_inertia` [..., nbody, 3], `body_subtreemass` [..., nbody], `body_invweight0`
      [..., nbody, 2], `dof_invweight0` [..., nv], `dof_damping` [..., nv], `geom_friction` [..., ngeom, 3] and
      `timestep` [...] in seconds; and what is drawn beyond the paper.

    Differs from the published code: inertias scale with their mass, what MuJoCo derives from masses follows them, and
    the physics rate is really used (the physics step is scaled, the number of physics steps per environment step
    stays).
    """
    if not config.enabled:
        return {}
    drawn = is_drawn(uniforms, config)[..., None]
    cuts = np.cumsum([constants.num_damping, len(constants.body_mass) - 1, 3, 1])
    damping_u, mass_u, friction_u, rate_u, _ = (
        uniforms[..., start:end] for start, end in zip([0, *cuts], [*cuts, None], strict=True)
    )
    # A column of ones serves the degrees of freedom (index -1) and the world body that keep their value.
    ones = xp.ones_like(uniforms[..., :1])
    damping_scale = xp.concatenate([xp.where(drawn, between(damping_u, config.damping_scale), 1.0), ones], axis=-1)
    mass_scale = xp.concatenate([ones, xp.where(drawn, between(mass_u, config.mass_scale), 1.0)], axis=-1)
    rate_scale = xp.where(drawn, between(rate_u, config.physics_rate_scale), 1.0)
    friction = xp.stack(
        [
            between(friction_u[..., i], bounds)
            for i, bounds in enumerate((config.sliding_friction, config.torsional_friction, config.rolling_friction))
        ],
        axis=-1,
    )
    fields: dict[str, Array] = {}
    if more_uniforms.shape[-1]:
        draws = beyond(more_uniforms, config, xp)
        on_pelvis = np.arange(len(constants.body_mass)) == constants.pelvis
        payload = xp.where(drawn, draws["payload_kg"], 0.0) / constants.body_mass[constants.pelvis]
        mass_scale = mass_scale + on_pelvis * payload
        fields = _fields_beyond(draws, drawn, on_pelvis, constants, xp)
        if max(config.torque_lag_s) > 0:
            lag = xp.maximum(xp.where(drawn, draws["torque_lag_s"], 0.0), motors.AT_ONCE_S)
            is_lag = np.arange(constants.actuator_dynprm.shape[1]) == motors.LAG
            fields["actuator_dynprm"] = xp.where(is_lag, lag[..., None], constants.actuator_dynprm)
        if max(config.floor_slope_deg) > 0:
            slope = xp.where(drawn, draws["floor_slope"], 0.0)
            floor = constants.is_floor[:, None]
            fields["geom_quat"] = xp.where(floor, tilted(slope, xp)[..., None, :], constants.geom_quat)
    mass = constants.body_mass * mass_scale
    body_weight, dof_weight = inverse_weights(mass_scale, constants.weights, xp)
    return fields | {
        "body_mass": mass,
        "body_inertia": constants.body_inertia * mass_scale[..., None],
        "body_subtreemass": mass @ constants.subtree.T,
        "body_invweight0": body_weight,
        "dof_invweight0": dof_weight,
        "dof_damping": constants.dof_damping * damping_scale[..., constants.dof_draw],
        "geom_friction": xp.where(drawn[..., None], friction[..., None, :], constants.geom_friction),
        "timestep": constants.timestep * rate_scale[..., 0],
    }


def _fields_beyond(
    draws: dict[str, Array], drawn: Array, on_pelvis: np.ndarray, constants: Nominal, xp: Any
) -> dict[str, Array]:
    """The fields that only draws beyond the paper change; `drawn` [..., 1], `on_pelvis` [nbody]."""
    gain, torque, spring = (
        xp.where(drawn, draws[name], 1.0) for name in ("pd_gain_scale", "torque_scale", "spring_scale")
    )
    shift = xp.where(drawn, draws["center_of_mass_m"], 0.0)
    is_spring = np.arange(len(constants.jnt_stiffness))[:, None] == constants.springs
    return {
        "actuator_gainprm": constants.actuator_gainprm * (1 + (gain - 1)[..., None] * constants.gain_columns),
        "actuator_biasprm": constants.actuator_biasprm * gain[..., None],
        "actuator_forcerange": constants.actuator_forcerange * torque[..., None],
        "jnt_stiffness": constants.jnt_stiffness * (1 + (spring - 1) @ is_spring.T),
        "body_ipos": constants.body_ipos + on_pelvis[:, None] * shift[..., None, :],
    }


def tilted(slope: Array, xp: Any) -> Array:
    """Orientation (w, x, y, z) of a plane that rises by `slope` m per m along x and y: [..., 2] -> [..., 4].

    Half the angle between its normal n = (-slope, 1) / |(-slope, 1)| and the vertical, about their cross product: the
    quaternion (1 + n_z, -n_y, n_x, 0) made a unit.
    """
    length = xp.sqrt(1 + (slope**2).sum(axis=-1))
    quat = columns([length + 1, slope[..., 1], -slope[..., 0], xp.zeros_like(length)], xp)
    return quat / xp.sqrt((quat**2).sum(axis=-1, keepdims=True))


def inverse_weights(mass_scale: Array, terms: WeightTerms, xp: Any) -> tuple[Array, Array]:
    """What a unit force and a unit torque accelerate in the initial pose: `body_invweight0` and `dof_invweight0`.

    With M the joint-space inertia and J a body's Jacobian, the averages over three axes of the diagonal of J M^-1 J^T,
    and the diagonal of M^-1. MuJoCo scales the softness of constraints with them. A shifted center of mass is left out.

    Args:
      mass_scale: factor on each body's mass and inertia, [..., nbody].

    Returns:
      [..., nbody, 2] in 1/kg and 1/(kg m^2), and [..., nv].
    """
    inertia = xp.einsum("...b,bij->...ij", mass_scale, terms.inertia) + terms.armature
    inverse = xp.linalg.inv(inertia)
    diagonal = (terms.jacobian @ inverse[..., None, :, :] * terms.jacobian).sum(axis=-1)
    body = xp.stack([diagonal[..., :3].mean(axis=-1), diagonal[..., 3:].mean(axis=-1)], axis=-1)
    return body, xp.diagonal(inverse, axis1=-2, axis2=-1) @ terms.dof_average.T
