"""The ground: flat, flights of stairs, blocks of random heights, or slopes, drawn anew for every episode.

It changes along x alone. An episode's ground is a table of blocks, from which come both the boxes that the robot treads
on and the height above ground in the task. Boxes have sharp edges and cost the physics a fifth; a height field slants
every riser by a cell, and at cells of 2.5 cm doubles the cost.
"""

import itertools
from typing import Any

import mujoco
import numpy as np

from hasrl_jax.envs.cassie.settings import TerrainConfig
from hasrl_jax.envs.draws import between
from hasrl_jax.envs.layout import columns
from hasrl_jax.types import Array

BLOCKS = 96  # after the level start; behind the last one the ground stays level
START, HEIGHT, SLOPE = range(
    3
)  # rows of a ground: where a block begins along x, m; its height there, m; its rise per m
# The boxes are compiled longer than any draw, so that the radius which MuJoCo computes for each is an upper bound.
LONGEST_M = 8.0
PLATFORM_M = 4000.0  # length of the level ground before and behind
HALF_WIDTH_M, HALF_THICKNESS_M = 50.0, 1.0
_DRAWN = 6  # length, approach, whether level at all; of stairs also rise, steps and landing


def num_uniforms(config: TerrainConfig) -> int:
    """Uniform numbers that an episode's ground consumes: what all its blocks share, and one for each if they differ."""
    if config.kind == "flat":
        return 0
    return _DRAWN + (BLOCKS if config.kind != "steps" or config.step_noise_m > 0 else 0)


def draw(uniforms: Array, config: TerrainConfig, xp: Any) -> Array:
    """The ground of an episode.

    Args:
      uniforms: [..., num_uniforms].

    Returns:
      [..., 3, 1 + BLOCKS], rows as `START`, `HEIGHT` and `SLOPE` say, beginning with the level start at height 0;
      [..., 0, 0] where the ground is flat.
    """
    if config.kind == "flat":
        return xp.zeros((*uniforms.shape[:-1], 0, 0))
    length, approach, level, rise, count, landing = (uniforms[..., index, None] for index in range(_DRAWN))
    of_blocks = uniforms[..., _DRAWN:]
    lengths = between(length, config.step_depth_m) + xp.zeros((*uniforms.shape[:-1], BLOCKS))
    slopes = xp.zeros_like(lengths)
    if config.kind == "steps":
        number, block = xp.floor(between(count, (config.steps[0], config.steps[1] + 1))), np.arange(1, 1 + BLOCKS)
        place = xp.mod(block, 2 * number)
        heights = between(rise, config.step_height_m) * xp.minimum(place, 2 * number - place)
        heights = heights + (2 * of_blocks - 1) * config.step_noise_m if of_blocks.shape[-1] else heights
        lengths = lengths + xp.where(xp.mod(block, number) == 0, between(landing, config.landing_m), 0.0)
    elif config.kind == "rough":
        heights = between(of_blocks, config.step_height_m)
    else:
        slopes = xp.tan(np.pi / 180 * between(of_blocks, config.slope_deg))
        heights = xp.cumsum(lengths * slopes, axis=-1) - lengths * slopes
    first = config.flat_start_m + between(approach, config.approach_m)
    starts = first + xp.cumsum(lengths, axis=-1) - lengths
    uneven = level >= config.level_share
    none = xp.zeros_like(first)
    rows = (
        xp.concatenate([first - PLATFORM_M, starts], axis=-1),
        xp.concatenate([none, xp.where(uneven, heights, 0.0)], axis=-1),
        xp.concatenate([none, xp.where(uneven, slopes, 0.0)], axis=-1),
    )
    return xp.stack(rows, axis=-2)


def height_at(x: Array, ground: Array, xp: Any) -> Array | float:
    """Height of the ground above the start, m.

    Args:
      x: where, m, [...].
      ground: as `draw` returns it, [..., 3, 1 + BLOCKS].
    """
    if not ground.shape[-1]:
        return 0.0
    index = (x[..., None] >= ground[..., START, 1:]).sum(axis=-1)
    start, height, slope = (xp.take_along_axis(ground[..., row, :], index[..., None], -1)[..., 0] for row in range(3))
    return height + slope * (x - start)


def mean_height(x: Array, half_length_m: float, ground: Array, xp: Any) -> Array | float:
    """Mean height of the ground within `half_length_m` before and behind x, m, [...]: it does not jump at an edge."""
    if not ground.shape[-1] or half_length_m == 0:
        return height_at(x, ground, xp)
    start, height, slope = ground[..., START, :], ground[..., HEIGHT, :], ground[..., SLOPE, :]
    end = xp.concatenate([start[..., 1:], start[..., -1:] + PLATFORM_M], axis=-1)
    low = xp.maximum(start, x[..., None] - half_length_m)
    high = xp.minimum(end, x[..., None] + half_length_m)
    middle = 0.5 * (low + high) - start
    return (xp.maximum(high - low, 0.0) * (height + slope * middle)).sum(axis=-1) / (2 * half_length_m)


def build(config: TerrainConfig, spec: mujoco.MjSpec) -> None:
    """Replaces the plane `floor` of a model's description by the level start and BLOCKS boxes behind one another."""
    floor = spec.geom("floor")
    edges = np.arange(BLOCKS + 1) * LONGEST_M
    edges = config.flat_start_m + np.concatenate([[-PLATFORM_M], edges[:-1], [edges[-1] + PLATFORM_M]])
    top = floor.pos[2]
    for index, (start, end) in enumerate(itertools.pairwise(edges)):
        box = floor if index == 0 else spec.worldbody.add_geom()
        for name in ("contype", "conaffinity", "condim", "priority", "friction", "material"):
            setattr(box, name, getattr(floor, name))
        box.rgba = [0.7, 0.7, 0.7, 1.0] if index % 2 else [1.0, 1.0, 1.0, 1.0]  # or a picture shows no steps
        box.type = mujoco.mjtGeom.mjGEOM_BOX
        box.size = [(end - start) / 2, HALF_WIDTH_M, HALF_THICKNESS_M]
        box.pos = [(start + end) / 2, 0, top - HALF_THICKNESS_M]
        if config.kind == "slopes":  # MuJoCo never reads the orientation of a geom that is compiled without one
            box.quat = [1.0, 0.0, 1e-3, 0.0]


def model_fields(ground: Array, model: mujoco.MjModel, config: TerrainConfig, xp: Any) -> dict[str, Array]:
    """The MjModel fields that place an episode's blocks; none where the ground is flat.

    Args:
      ground: of the episode, as `draw` returns it.
      model: compiled after `build`; only its boxes change.

    Returns:
      `geom_pos` and `geom_size` [..., ngeom, 3], of slopes also `geom_quat` [..., ngeom, 4], and `bvh_aabb`
      [..., nbvh, 6]: the boxes around groups of geoms (center, half sizes) by which MuJoCo finds contacts.
    """
    if config.kind == "flat":
        return {}
    start, height, slope = ground[..., START, :], ground[..., HEIGHT, :], ground[..., SLOPE, :]
    end = xp.concatenate([start[..., 1:], start[..., -1:] + PLATFORM_M], axis=-1)
    along = 0.5 * (end - start)
    cos = 1 / xp.sqrt(1 + slope**2)
    sin, top = slope * cos, float(model.geom_pos[0, 2]) + HALF_THICKNESS_M
    # The middle of the upper face, and half a thickness below it at a right angle.
    x = start + along + HALF_THICKNESS_M * sin
    z = top + height + slope * along - HALF_THICKNESS_M * cos
    none = xp.zeros_like(start)
    pos = columns([x, none, z], xp)
    size = columns([along / cos, none + HALF_WIDTH_M, none + HALF_THICKNESS_M], xp)

    first, last = _blocks_of_nodes(model)
    reach = 2 * HALF_THICKNESS_M * xp.abs(sin).max(axis=-1, keepdims=True)  # a slanting box stands out over its ends
    low, high = start[..., first] - reach, end[..., last] + reach
    highest = xp.abs(height).max(axis=-1, keepdims=True) + LONGEST_M * xp.abs(slope).max(axis=-1, keepdims=True)
    zero = xp.zeros_like(low)
    tall = zero + highest + 2 * HALF_THICKNESS_M
    bounds = columns([(low + high) / 2, zero, zero + top, (high - low) / 2, zero + HALF_WIDTH_M, tall], xp)
    fields = {"geom_pos": pos, "geom_size": size, "bvh_aabb": bounds}
    if config.kind == "slopes":
        half = 0.5 * xp.arctan(slope)
        fields["geom_quat"] = columns([xp.cos(half), none, -xp.sin(half), none], xp)

    def complete(changed: Array, values: np.ndarray) -> Array:
        """`changed` [..., count, k] followed by the rest of `values` [n, k] as it is."""
        rest = values[changed.shape[-2] :]
        return xp.concatenate([changed, xp.zeros((*changed.shape[:-2], *rest.shape)) + rest], axis=-2)

    return {name: complete(changed, getattr(model, name)) for name, changed in fields.items()}


def _blocks_of_nodes(model: mujoco.MjModel) -> tuple[np.ndarray, np.ndarray]:
    """First and last block under every node of the tree by which MuJoCo finds contacts with the world, [nodes] each.

    The tree splits along x, so the blocks of a node are neighbors; block i is geom i.
    """
    nodes = int(model.body_bvhnum[0])
    first, last = np.zeros(nodes, int), np.zeros(nodes, int)
    for node in range(nodes - 1, -1, -1):  # children come after their parents
        children = model.bvh_child[node]
        if children[0] < 0:
            first[node] = last[node] = model.bvh_nodeid[node]
        else:
            first[node], last[node] = first[children].min(), last[children].max()
    return first, last
