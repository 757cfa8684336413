"""A library of periodic gaits over forward speed, lateral speed and pelvis height.

Of every gait it holds a reference motion, as curves over the phase of the gait clock, and whole states of the robot,
from which an episode can begin in the middle of a stride. `evaluate/record_gaits.py` records one from a policy.
Source: Li et al. 2021, whose library has 6 Bezier coefficients for each motor and stance leg.
Differs from it: the curves also hold the pelvis and the springs, and come from a policy instead of an optimization.

The mirror image of a gait is the gait of the opposite lateral speed, half a cycle later. So a file holds lateral speeds
to the left only, and what it holds of walking straight on is its own mirror image.
"""

import functools
import hashlib
import json
import zipfile
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np

from hasrl_jax.envs import layout
from hasrl_jax.envs.cassie import bezier
from hasrl_jax.envs.cassie.ids import MOTOR_SIGNS
from hasrl_jax.envs.layout import AXIAL, QUATERNION, SAME, VECTOR, Entry
from hasrl_jax.errors import ConfigError
from hasrl_jax.types import Array

FIELD = "cassie.reference.gaits"
USUAL = "library"  # recorded from released-steer
FAST = "library_fast"  # from released-fast: faster, further to the side, lower
_FOLDER = Path(__file__).parent
# Those of the package: file, and its SHA-256.
PACKAGED = {
    USUAL: (_FOLDER / "gaits.npz", "03abdca0a2df544d1065e51d8683c82da4977a6f9c8f59cf82336584a49a6a37"),
    FAST: (_FOLDER / "gaits_fast.npz", "5df6c5f4b8cb66b23deab543bdababb084cc98f98d0adef355faecb9620e62d8"),
}
# What a curve says of each phase, in order.
MOTION = (
    Entry("motor_positions", "rad", MOTOR_SIGNS, legs=True),
    Entry("springs", "rad", SAME * 2, legs=True, parts=("left-shin", "right-shin")),
    Entry("pelvis_position", "m", VECTOR, note="along and across the heading from a steady point; height"),
    Entry("pelvis_rotation", "", AXIAL, note="x, y, z of the quaternion relative to the heading to keep, w > 0"),
)
PLACES, MOTION_SIZE = layout.places(MOTION), layout.size(MOTION)
# Of a whole state: the pelvis, then 14 numbers of qpos and 13 of qvel for each leg, the achilles rod's ball among them.
_LEG_QPOS = (-1.0, -1.0, 1.0, 1.0, -1.0, -1.0, 1.0, *SAME * 7)
_LEG_QVEL = (-1.0, -1.0, 1.0, -1.0, -1.0, 1.0, *SAME * 7)
STATE = (
    Entry("pelvis_position", "m", VECTOR),
    Entry("pelvis_orientation", "", QUATERNION),
    Entry("leg_positions", "", _LEG_QPOS * 2, legs=True),
    Entry("pelvis_velocity", "m/s", VECTOR),
    Entry("pelvis_angular_velocity", "rad/s", AXIAL),
    Entry("leg_velocities", "", _LEG_QVEL * 2, legs=True),
)
QPOS_SIZE = 35
AXES = ("forward_m_s", "lateral_m_s", "height_m")


class Library(NamedTuple):
    """Gaits on a regular grid: F forward speeds, L lateral speeds, H heights, each evenly spaced."""

    forward_m_s: np.ndarray  # [F]
    lateral_m_s: np.ndarray  # [L]; in a file only those that are not negative
    height_m: np.ndarray  # [H]
    curves: np.ndarray  # [F, L, H, 2, Q, 6] Bezier coefficients of MOTION
    states: np.ndarray  # [F, L, H, N, 67] STATE at phases 0, 1/N, ..., to half a step of the policy
    standing: np.ndarray  # [H, Q] MOTION while the robot stands
    standing_states: np.ndarray  # [H, 67]
    cycle_s: np.ndarray  # [F] duration of a gait cycle
    policy_rate_hz: float  # of the policy that was recorded
    joints: tuple[str, ...]  # of the robot, in the order of qpos

    @property
    def bounds(self) -> dict[str, tuple[float, float]]:
        """Lowest and highest value of each of AXES."""
        return {name: (float(getattr(self, name)[0]), float(getattr(self, name)[-1])) for name in AXES}


def mirrored(values: np.ndarray, entries: tuple[Entry, ...]) -> np.ndarray:
    """The mirror image of what `entries` list along the last axis."""
    index, sign = layout.signed_permutation(entries)
    return values[..., index] * sign


def mirrored_curves(curves: np.ndarray) -> np.ndarray:
    """Coefficients [..., 2, Q, 6] of the mirror image, half a cycle later: the halves change places."""
    index, sign = layout.signed_permutation(MOTION)
    return curves[..., ::-1, :, :][..., index, :] * sign[:, None]


def joint_names(model: mujoco.MjModel) -> tuple[str, ...]:
    """The joints of a robot, in the order of qpos."""
    return tuple(model.joint(index).name for index in range(model.njnt))


def save(path: Path, library: Library) -> None:
    """Writes a library whose lateral speeds are not negative."""
    arrays = {name: value for name, value in library._asdict().items() if isinstance(value, np.ndarray)}
    arrays |= {name: value.astype(np.float32) for name, value in arrays.items() if name not in AXES}
    about = {name: value for name, value in library._asdict().items() if name not in arrays}
    with open(path, "wb") as file:
        np.savez_compressed(file, allow_pickle=False, about=np.array(json.dumps(about)), **arrays)


def load(source: str) -> Library:
    """The gaits of one of PACKAGED or of a file, with those of negative lateral speeds.

    Raises:
      ConfigError: there is no such file, it is damaged, or it is not the one of this release.
    """
    path, sha256 = PACKAGED.get(source, (Path(source), ""))
    try:
        changed = path.stat().st_mtime_ns
    except (OSError, ValueError):
        raise ConfigError(
            f"{FIELD}: got {source!r}, which does not exist; expected {', '.join(PACKAGED)}, or a file of `hasrl gaits`"
        ) from None
    return _load(path, changed, sha256)


@functools.lru_cache(maxsize=4)
def _load(path: Path, changed: int, sha256: str) -> Library:
    """`load` of an existing file; `changed`, the time of its last change, keeps an older one from being returned."""
    try:
        content = path.read_bytes()
        if sha256 and hashlib.sha256(content).hexdigest() != sha256:
            raise ConfigError(f"{FIELD}: {path} is not the file of this release; install the package again")
        with np.load(path, allow_pickle=False) as file:
            about = json.loads(str(file["about"]))
            arrays = {name: file[name].astype(float) for name in Library._fields if name not in about}
        if "cycle_s" in about:  # files of earlier releases: one for all
            arrays["cycle_s"] = np.full(len(arrays["forward_m_s"]), about.pop("cycle_s"))
        half = Library(**arrays, **about | {"joints": tuple(about["joints"])})
        _require_whole(half)
    except (OSError, ValueError, KeyError, TypeError, zipfile.BadZipFile) as error:
        raise ConfigError(f"{FIELD}: {path} holds no gaits ({' '.join(str(error).split())})") from None
    return both_sides(half)


def _require_whole(library: Library) -> None:
    """Raises a ValueError where sizes do not fit or numbers are not finite."""
    grid = tuple(len(getattr(library, name)) for name in AXES)
    phases = library.states.shape[3:4]
    shapes = {
        "cycle_s": grid[:1],
        "curves": (*grid, bezier.HALVES, MOTION_SIZE, bezier.COEFFICIENTS),
        "states": (*grid, *phases, layout.size(STATE)),
        "standing": (grid[2], MOTION_SIZE),
        "standing_states": (grid[2], layout.size(STATE)),
    }
    for name, shape in shapes.items():
        values = getattr(library, name)
        if values.shape != shape or not np.isfinite(values).all():
            raise ValueError(f"{name} is {values.shape}; expected {shape}, all finite")
    for name in AXES:
        steps = np.diff(getattr(library, name))
        if not len(steps) or steps.min() <= 0 or np.ptp(steps) > 1e-6:
            raise ValueError(f"{name} is not evenly spaced")
    if library.lateral_m_s[0] != 0 or phases[0] % 2:
        raise ValueError("lateral_m_s does not begin at 0, or the number of states is odd")


def both_sides(library: Library) -> Library:
    """`library` with the mirror images of its gaits to the left, which go to the right."""
    half = library.states.shape[3] // 2

    def joined(own: np.ndarray, image: np.ndarray, axis: int) -> np.ndarray:
        others = np.flip(image, axis).take(range(len(library.lateral_m_s) - 1), axis)
        return np.concatenate([others, own], axis)

    return library._replace(
        lateral_m_s=joined(library.lateral_m_s, -library.lateral_m_s, 0),
        curves=joined(library.curves, mirrored_curves(library.curves), 1),
        states=joined(library.states, np.roll(mirrored(library.states, STATE), -half, axis=3), 1),
    )


def require_robot(library: Library, model: mujoco.MjModel) -> None:
    """Refuses gaits of another robot than `model`.

    Raises:
      ConfigError: names the joints of both.
    """
    ours = joint_names(model)
    if library.joints != ours:
        theirs = ", ".join(library.joints[:5])
        raise ConfigError(f"{FIELD}: gaits of a robot with the joints {theirs}…; expected {', '.join(ours[:5])}…")


def motion(
    library: Library, command: tuple[Array, Array, Array], phase: Array, standing: Array, xp: Any
) -> dict[str, Array]:
    """The reference motion, between the gaits of the grid by their distances and outside of it that of its edge.

    Args:
      library: with both sides.
      command: forward and lateral speed, m/s, and height, m; [...] each.
      phase: of the gait clock in [0, 1), [...].
      standing: whether the clock rests, [...] bool.

    Returns:
      MOTION by name, [..., n] each.
    """
    axes = (library.forward_m_s, library.lateral_m_s, library.height_m)
    forward, lateral, height = (_shares(axis, value, xp) for axis, value in zip(axes, command, strict=True))
    shares = forward[..., :, None, None] * lateral[..., None, :, None] * height[..., None, None, :]
    shape = library.curves.shape
    flat = shares.reshape((*phase.shape, -1)) @ library.curves.reshape(np.prod(shape[:3]), -1)
    walking = bezier.value(flat.reshape((*phase.shape, *shape[3:])), phase, xp)
    values = xp.where(standing[..., None], height @ library.standing, walking)
    return {name: values[..., place] for name, place in PLACES.items()}


def _shares(axis: np.ndarray, value: Array, xp: Any) -> Array:
    """How much each of evenly spaced points counts between two of them, [N], [...] -> [..., N]; they sum to 1."""
    inside = xp.clip(value, axis[0], axis[-1])[..., None]
    return xp.maximum(1.0 - xp.abs(inside - axis) / (axis[1] - axis[0]), 0.0)


def start(
    library: Library, command: tuple[Array, Array, Array], phase: Array, standing: Array, xp: Any
) -> tuple[Array, Array, Array]:
    """A state of the gait nearest to a command, facing along x.

    Args:
      library: with both sides.
      command: as in `motion`.
      phase: any in [0, 1), [...].
      standing: as in `motion`.

    Returns:
      qpos [..., 35] and qvel [..., 32] at the last recorded phase up to `phase`, and that phase, [...].
    """
    axes = (library.forward_m_s, library.lateral_m_s, library.height_m)
    nearest = [xp.argmin(xp.abs(value[..., None] - axis), axis=-1) for axis, value in zip(axes, command, strict=True)]
    count = library.states.shape[3]
    index = xp.floor(phase * count).astype(int)
    walking = xp.asarray(library.states)[(*nearest, index)]
    still = xp.asarray(library.standing_states)[nearest[2]]
    state = xp.where(standing[..., None], still, walking)
    return state[..., :QPOS_SIZE], state[..., QPOS_SIZE:], index / count
