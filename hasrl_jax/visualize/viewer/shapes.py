"""The shapes of a model as triangles."""

from typing import NamedTuple

import mujoco
import numpy as np

HIDDEN_GROUP = 3  # geoms of this group and above are hidden, as in MuJoCo's own viewer
SEGMENTS = 24  # around a round shape


class Shape(NamedTuple):
    """A geom as triangles, in the frame of its body."""

    name: str
    body: int
    vertices: np.ndarray  # [V, 3] m, in the geom's own frame
    faces: np.ndarray  # [F, 3] int
    position: np.ndarray  # [3] of the geom's frame in its body's
    orientation: np.ndarray  # [4] (w, x, y, z)
    color: tuple[int, int, int]


def shapes(model: mujoco.MjModel) -> list[Shape]:
    """Every visible geom of the moving bodies."""
    visible = (model.geom_group < HIDDEN_GROUP) & (model.geom_bodyid > 0)
    return [_shape(model, geom) for geom in np.flatnonzero(visible).tolist()]


def _shape(model: mujoco.MjModel, geom: int) -> Shape:
    vertices, faces = triangles(model.geom_type[geom], model.geom_size[geom])
    material = model.geom_matid[geom]
    rgba = model.mat_rgba[material] if material >= 0 else model.geom_rgba[geom]
    red, green, blue = (int(255 * share) for share in rgba[:3])
    return Shape(
        name=f"geom-{geom}",
        body=int(model.geom_bodyid[geom]),
        vertices=vertices,
        faces=faces,
        position=model.geom_pos[geom].copy(),
        orientation=model.geom_quat[geom].copy(),
        color=(red, green, blue),
    )


def triangles(kind: int, size: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices [V, 3] and faces [F, 3] of a primitive geom of MuJoCo with `size` [3].

    Raises:
      ValueError: a kind of geom that is not drawn.
    """
    import trimesh.creation

    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        mesh = trimesh.creation.box(2 * size)
    elif kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
        mesh = trimesh.creation.cylinder(size[0], 2 * size[1], sections=SEGMENTS)
    elif kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        mesh = trimesh.creation.capsule(2 * size[1], size[0], count=[SEGMENTS, SEGMENTS])
        mesh.apply_translation(-mesh.bounds.mean(axis=0))  # some versions put one end at the origin
    elif kind == mujoco.mjtGeom.mjGEOM_SPHERE:
        mesh = trimesh.creation.uv_sphere(size[0], count=[SEGMENTS, SEGMENTS])
    elif kind == mujoco.mjtGeom.mjGEOM_ELLIPSOID:
        mesh = trimesh.creation.uv_sphere(1.0, count=[SEGMENTS, SEGMENTS])
        mesh.apply_scale(size)
    else:
        raise ValueError(f"geom kind {kind}: expected a box, cylinder, capsule, sphere or ellipsoid")
    return np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces, np.uint32)
