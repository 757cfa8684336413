"""Loads a model and applies the physics options."""

import copy
from collections.abc import Callable
from pathlib import Path

import mujoco

from hasrl_jax.config.schema import PhysicsConfig


def load_model(
    asset: Path, physics: PhysicsConfig, ground: Callable[[mujoco.MjSpec], None] | None = None, visual: bool = False
) -> mujoco.MjModel:
    """Compiles the MJCF file `asset` with the configured time step, solver and integrator.

    `ground` edits the description first, see `Task.ground`.
    Shapes that only pictures need cost physics 6 % and most of a model's memory, so they come only with `visual`.
    """
    spec = mujoco.MjSpec.from_file(str(asset))
    if ground:
        ground(spec)
    spec.compiler.discardvisual = not visual
    model = spec.compile()
    model.opt.timestep = physics.timestep_s
    model.opt.solver = getattr(mujoco.mjtSolver, f"mjSOL_{physics.solver.upper()}")
    model.opt.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{physics.integrator.upper()}")
    model.opt.iterations = physics.solver_iterations
    model.opt.ls_iterations = physics.line_search_iterations
    return model


def without_islands(model: mujoco.MjModel) -> mujoco.MjModel:
    """A copy of `model` for which MuJoCo does not look for groups of bodies whose constraints it can solve apart.

    A single tree of bodies is one group anyway: the numbers stay the same to the last bit, for 4 % fewer instructions.
    Models of several trees keep the search.
    """
    model = copy.copy(model)
    if model.ntree == 1:
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_ISLAND.value
    return model
