"""Dynamics randomisation: uniform numbers in, randomised model fields out.

Both physics engines apply the same fields, so the same draws give the same robot.
Source: paper section II.D; ranges of the published implementation.
"""

from typing import Any, NamedTuple

import mujoco
import numpy as np

from hasrl_jax.envs.cassie.settings import RandomizeConfig
from hasrl_jax.envs.draws import between
from hasrl_jax.types import Array

DAMPED_JOINTS = ("hip-roll", "hip-yaw", "hip-pitch", "achilles-rod", "knee", "shin", "tarsus", "foot-crank", "foot")


class Nominal(NamedTuple):
    """Constants of the nominal model that the randomised fields scale."""

    timestep: float
    body_mass: np.ndarray  # [nbody]
    body_inertia: np.ndarray  # [nbody, 3]
    dof_damping: np.ndarray  # [nv]
    geom_friction: np.ndarray  # [ngeom, 3]
    subtree: np.ndarray  # [nbody, nbody] 1 where the column's body hangs on the row's body
    dof_draw: np.ndarray  # [nv] which damping draw scales this degree of freedom, -1 for none
    num_damping: int


def nominal(model: mujoco.MjModel) -> Nominal:
    """Reads the constants once. `model`: the compiled nominal robot."""
    subtree = np.eye(model.nbody)
    for body in range(model.nbody - 1, 0, -1):
        subtree[model.body_parentid[body]] += subtree[body]
    damped = [model.joint(f"{side}-{joint}").id for side in ("left", "right") for joint in DAMPED_JOINTS]
    return Nominal(
        timestep=model.opt.timestep,
        body_mass=model.body_mass.copy(),
        body_inertia=model.body_inertia.copy(),
        dof_damping=model.dof_damping.copy(),
        geom_friction=model.geom_friction.copy(),
        subtree=subtree,
        dof_draw=np.array([damped.index(joint) if joint in damped else -1 for joint in model.dof_jntid]),
        num_damping=len(damped),
    )


def num_uniforms(constants: Nominal) -> int:
    """Uniform numbers that `model_fields` consumes: damping, mass, friction (3), physics rate, whether at all."""
    return constants.num_damping + len(constants.body_mass) - 1 + 3 + 1 + 1


def is_drawn(uniforms: Array, config: RandomizeConfig) -> Array:
    """Whether an episode's robot is a drawn one, [...] bool; `uniforms` as in `model_fields`."""
    return (uniforms[..., -1] < config.share) & config.enabled


def model_fields(uniforms: Array, constants: Nominal, config: RandomizeConfig, xp: Any) -> dict[str, Array]:
    """MjModel fields for one episode; nothing (the nominal robot) when randomisation is off.

    Args:
      uniforms: [..., num_uniforms] in [0, 1).

    Returns:
      `body_mass` [..., nbody], `body_inertia` [..., nbody, 3], `body_subtreemass` [..., nbody],
      `dof_damping` [..., nv], `geom_friction` [..., ngeom, 3] and `timestep` [...] in seconds.

    Differs from the published code: inertias scale with their mass, and the physics rate is really used
    (the physics step is scaled, the number of physics steps per environment step stays).
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
    mass = constants.body_mass * mass_scale
    return {
        "body_mass": mass,
        "body_inertia": constants.body_inertia * mass_scale[..., None],
        "body_subtreemass": mass @ constants.subtree.T,
        "dof_damping": constants.dof_damping * damping_scale[..., constants.dof_draw],
        "geom_friction": xp.where(drawn[..., None], friction[..., None, :], constants.geom_friction),
        "timestep": constants.timestep * rate_scale[..., 0],
    }
