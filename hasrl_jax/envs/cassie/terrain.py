"""The ground: flat, stairs, or blocks of random heights, drawn anew for every episode.

It changes along x alone, in blocks of one length per episode, and `heights` is the one formula behind both the boxes
that the robot treads on and the height above ground in the task. Boxes have sharp edges and cost the physics a fifth;
a height field slants every riser by a cell, and at cells of 2.5 cm doubles the cost.
"""

import itertools
from typing import Any

import mujoco
import numpy as np

from hasrl_jax.envs.cassie.settings import TerrainConfig
from hasrl_jax.envs.draws import between
from hasrl_jax.types import Array

BLOCKS = 96  # after the flat start; behind the last one the ground stays level
FLIGHT = 8  # steps that a flight of stairs leads up, before as many lead down
# The boxes are compiled at their longest, which makes the radius that MuJoCo computes for each an upper bound.
LONGEST_M = 2.0
PLATFORM_M = 4000.0  # of the level ground before and behind, where blocks are LONGEST_M long; it scales with them
HALF_WIDTH_M, HALF_THICKNESS_M = 50.0, 1.0


def num_uniforms(config: TerrainConfig) -> int:
    """Uniform numbers that an episode's ground consumes: none, length and rise, or length and a height per block."""
    return {"flat": 0, "steps": 2, "rough": 1 + BLOCKS}[config.kind]


def heights(uniforms: Array, config: TerrainConfig, xp: Any) -> Array:
    """Height of the start and of each block above the start, m: [..., num_uniforms] -> [..., 1 + BLOCKS]."""
    drawn = between(uniforms[..., 1:], config.step_height_m)
    if config.kind == "rough":
        return xp.concatenate([xp.zeros_like(drawn[..., :1]), drawn], axis=-1)
    place = np.arange(1 + BLOCKS) % (2 * FLIGHT)
    return drawn * np.minimum(place, 2 * FLIGHT - place)


def height_at(x: Array, uniforms: Array, config: TerrainConfig, xp: Any) -> Array | float:
    """Height of the ground above the start, m.

    Args:
      x: where, m, [...].
      uniforms: of the episode, [..., num_uniforms].
    """
    if config.kind == "flat":
        return 0.0
    block = xp.floor((x - config.flat_start_m) / between(uniforms[..., 0], config.step_depth_m))
    index = xp.clip(block + 1, 0, BLOCKS).astype(int)
    return xp.take_along_axis(heights(uniforms, config, xp), index[..., None], axis=-1)[..., 0]


def build(config: TerrainConfig, spec: mujoco.MjSpec) -> None:
    """Replaces the plane `floor` of a model's description by the level start and BLOCKS boxes behind one another."""
    floor = spec.geom("floor")
    edges = np.arange(BLOCKS + 1) * LONGEST_M
    edges = config.flat_start_m + np.concatenate([[-PLATFORM_M], edges[:-1], [edges[-1] + PLATFORM_M]])
    top = floor.pos[2]
    for index, (start, end) in enumerate(itertools.pairwise(edges)):
        box = floor if start < config.flat_start_m else spec.worldbody.add_geom()
        for name in ("contype", "conaffinity", "condim", "priority", "friction", "material"):
            setattr(box, name, getattr(floor, name))
        box.rgba = [0.7, 0.7, 0.7, 1.0] if index % 2 else [1.0, 1.0, 1.0, 1.0]  # or a picture shows no steps
        box.type = mujoco.mjtGeom.mjGEOM_BOX
        box.size = [(end - start) / 2, HALF_WIDTH_M, HALF_THICKNESS_M]
        box.pos = [(start + end) / 2, 0, top - HALF_THICKNESS_M]


def model_fields(uniforms: Array, model: mujoco.MjModel, config: TerrainConfig, xp: Any) -> dict[str, Array]:
    """The MjModel fields that place an episode's blocks; none where the ground is flat.

    Args:
      uniforms: of the episode, [..., num_uniforms].
      model: compiled after `build`; only its boxes' lengths along x and heights change.

    Returns:
      `geom_pos` and `geom_size` [..., ngeom, 3], and `bvh_aabb` [..., nbvh, 6]: the boxes around groups of geoms
      (center, half sizes) by which MuJoCo finds contacts, along z wide enough for every height.
    """
    if config.kind == "flat":
        return {}
    start, scale = config.flat_start_m, between(uniforms[..., :1], config.step_depth_m) / LONGEST_M
    height = heights(uniforms, config, xp)
    boxes, nodes = np.flatnonzero(model.geom_bodyid == 0), int(model.body_bvhnum[0])

    def scaled(values: np.ndarray, count: int, about: float) -> Array:
        """The first `count` of `values` [n, k] with x stretched about a point, [..., count, k]."""
        x = about + (values[:count, 0] - about) * scale
        rest = xp.zeros((*x.shape, values.shape[1] - 1)) + values[:count, 1:]
        return xp.concatenate([x[..., None], rest], axis=-1)

    def complete(changed: Array, values: np.ndarray) -> Array:
        """`changed` [..., count, k] followed by the rest of `values` [n, k] as it is."""
        rest = values[changed.shape[-2] :]
        return xp.concatenate([changed, xp.zeros((*changed.shape[:-2], *rest.shape)) + rest], axis=-2)

    up = xp.stack([xp.zeros_like(height), xp.zeros_like(height), height], axis=-1)
    pos = scaled(model.geom_pos, len(boxes), start) + up
    center = scaled(model.bvh_aabb[:, :3], nodes, start)
    half = scaled(model.bvh_aabb[:, 3:], nodes, 0.0)
    highest = max(abs(end) for end in config.step_height_m) * (FLIGHT if config.kind == "steps" else 1)
    bounds = xp.concatenate([center, half + np.array([0.0, 0.0, highest])], axis=-1)
    return {
        "geom_pos": complete(pos, model.geom_pos),
        "geom_size": complete(scaled(model.geom_size, len(boxes), 0.0), model.geom_size),
        "bvh_aabb": complete(bounds, model.bvh_aabb),
    }
