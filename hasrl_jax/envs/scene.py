"""Pictures of a task's robot, for the environments that gymnasium sees."""

import os

import mujoco
import numpy as np

from hasrl_jax.config.schema import PhysicsConfig
from hasrl_jax.envs.model import load_model
from hasrl_jax.envs.task import Task
from hasrl_jax.errors import ConfigError

USUAL_CAMERA = "track"


def camera_of(task: Task, camera: str | None) -> str | int:
    """The camera of this name; for None `track`, or the first one, or MuJoCo's free one.

    Raises:
      ConfigError: the model has no such camera.
    """
    names = [task.model.camera(index).name for index in range(task.model.ncam)]
    if camera is None:
        return USUAL_CAMERA if USUAL_CAMERA in names else min(0, len(names) - 1)
    if camera not in names:
        raise ConfigError(f"camera: got {camera!r}; expected one of {', '.join(names) or 'none: the model has none'}")
    return camera


def place_ground(task: Task, model: mujoco.MjModel, model_fields: dict[str, np.ndarray]) -> None:
    """Puts the ground of an episode into `model`, another copy of the task's; level ground stays.

    Args:
      task: whose ground it is.
      model: what is changed.
      model_fields: of the environment whose episode it is.
    """
    ground = model.geom_bodyid == 0  # the first geoms of any model
    for name in ("geom_pos", "geom_size", "geom_quat") if task.ground else ("geom_quat",):
        if name in model_fields:
            getattr(model, name)[ground] = model_fields[name][: ground.sum()]
            model.geom_sameframe[ground] = mujoco.mjtSameFrame.mjSAMEFRAME_NONE


class Scene:
    """Draws a task's robot.

    Args:
      task: whose model is drawn.
      physics: compiles the copy of the model that is drawn.
      height: of a frame, pixels.
      width: of a frame, pixels.
      camera: from `camera_of`.
      shadow_px: side of the shadow map; None keeps the model's.

    Raises:
      RuntimeError: there is no OpenGL to render with.
    """

    def __init__(
        self, task: Task, physics: PhysicsConfig, height: int, width: int, camera: str | int, shadow_px: int | None
    ):
        # A model of its own: the one that is simulated has no visual shapes and carries the randomised fields.
        model = load_model(task.asset, physics, task.ground, visual=True)
        model.vis.global_.offwidth, model.vis.global_.offheight = width, height
        if shadow_px is not None:
            model.vis.quality.shadowsize = shadow_px
        # The floor acts everywhere but is drawn to its size: draw it endless, or a robot walks off it.
        model.geom_size[model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE, :2] = 0
        model.mat_reflectance[:] = 0  # reflections draw the scene twice, which software rendering pays in full
        model.vis.map.shadowclip = 3  # the edge of the shadow map speckles the floor; put it out of sight
        self._task, self._model, self._data, self._camera = task, model, mujoco.MjData(model), camera
        try:
            self._renderer = mujoco.Renderer(model, height, width)
        except Exception as error:  # each OpenGL library fails in its own way
            backend = os.environ.get("MUJOCO_GL") or "not set"
            raise RuntimeError(
                f"cannot render: no OpenGL context (MUJOCO_GL is {backend}); set MUJOCO_GL to egl or osmesa before "
                "Python starts"
            ) from error

    def frame(self, qpos: np.ndarray, model_fields: dict[str, np.ndarray]) -> np.ndarray:
        """The robot in a pose [nq] on the ground of an episode, see `place_ground`: uint8 [height, width, 3]."""
        self._data.qpos[:] = qpos
        place_ground(self._task, self._model, model_fields)
        mujoco.mj_forward(self._model, self._data)
        self._renderer.update_scene(self._data, self._camera)
        return self._renderer.render()

    def close(self) -> None:
        """Frees the renderer; doing so again changes nothing."""
        self._renderer.close()
