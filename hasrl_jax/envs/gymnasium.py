"""One environment behind the gymnasium interface: `gymnasium.make("hasrl_jax/Cassie-v0")`.

It is the collectors' own `CpuEnvs` with a single environment, so what is true of one is true of the other.
"""

import os
import weakref
from typing import Any

import gymnasium
import mujoco
import numpy as np

from hasrl_jax.config.checks import check, limits_of
from hasrl_jax.config.convert import from_dict
from hasrl_jax.config.files import recipe
from hasrl_jax.config.schema import Config
from hasrl_jax.envs.cassie import task as cassie
from hasrl_jax.envs.cassie.commands import COMMANDS, completed
from hasrl_jax.envs.cassie.settings import CommandConfig
from hasrl_jax.envs.cpu_engine import CpuEnvs, EnvState
from hasrl_jax.envs.model import load_model
from hasrl_jax.envs.registration import register
from hasrl_jax.envs.registry import make_task
from hasrl_jax.envs.task import Task
from hasrl_jax.errors import ConfigError

register()  # so that "hasrl_jax.envs.gymnasium:hasrl_jax/Cassie-v0" also names an environment


def make(task: str = "cassie", config: Config | None = None, **arguments: Any) -> "TaskEnv":
    """A registered task as a gymnasium environment.

    Args:
      task: its name, see `config.tasks.find`; takes the place of `config.task`.
      config: default: the one that trains the task, `config.files.recipe`.
      **arguments: further arguments of `TaskEnv`.

    Raises:
      ConfigError: an unknown task or impossible configuration values.
    """
    return TaskEnv(recipe(task) if config is None else from_dict({"task": task}, config), **arguments)


def fixed_command(
    config: Config,
    forward: float | None = None,
    lateral: float | None = None,
    yaw_rate: float | None = None,
    height: float | None = None,
) -> Config:
    """`config` with Cassie's commands (m/s, rad/s, m) held at the given values; None leaves one to be drawn.

    Raises:
      ConfigError: a command that the robot does not take in the frame of `config`.
    """
    told = {"forward": forward, "lateral": lateral, "yaw_rate": yaw_rate, "height": height}
    held = {name: value for name, value in told.items() if value is not None}
    if not held:
        return config
    if not hasattr(config.settings, "command"):
        raise ConfigError(f"command: task {config.task!r} takes no command")
    settings = config.settings.command
    known = {entry.name: entry.field for entry in COMMANDS[settings.frame]}
    for name in held:
        if name not in known:
            raise ConfigError(f"{name}: cassie.command.frame {settings.frame} has {', '.join(known)}")
    command: dict[str, Any] = dict.fromkeys(("stand_probability", "straight_probability", "alone_probability"), 0.0)
    command |= {known[name]: [value, value] for name, value in held.items()}
    if yaw_rate is not None:
        command["turn_m_s2"] = limits_of(CommandConfig, "turn_m_s2").high
    if height is not None:
        command |= {
            "height_probability": 1.0,
            "height_fade_m_s": [limits_of(CommandConfig, "height_fade_m_s").high] * 2,
        }
    if len(held) == len(known):
        command["resample_s"] = [0.0, 0.0]
    return from_dict({"cassie": {"command": command}}, config)


class TaskEnv(gymnasium.Env[np.ndarray, np.ndarray]):
    """A task in C MuJoCo.

    Observations are float32 [O] and actions float32 [A] in [-1, 1]. `info` holds each weighted reward term as
    `reward/<name>`, each of the task's measures by its name, and `diverged`: the simulation failed; such an episode
    is truncated with reward 0, and its last valid observation is returned again.

    Args:
      config: default `configs/cassie_walk.yaml`; reads `task`, `physics`, `cassie` and `collect.max_episode_steps`.
      render_mode: None or "rgb_array".
      width, height: of rendered frames, pixels.
      camera: name of a camera of the model.
      shadow_px: side of the shadow map; None keeps the model's.

    Raises:
      ConfigError: impossible configuration values, or no such camera.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 40}  # noqa: RUF012 (gymnasium's own declaration)

    def __init__(
        self,
        config: Config | None = None,
        render_mode: str | None = None,
        width: int = 640,
        height: int = 480,
        camera: str = "track",
        shadow_px: int | None = None,
    ):
        self.config = recipe("cassie") if config is None else config
        check(self.config)
        if render_mode not in (None, "rgb_array"):
            raise ConfigError(f"render_mode: got {render_mode!r}; expected None or 'rgb_array'")
        self.render_mode = render_mode
        self.frame_size, self._camera, self._shadow_px = (height, width), camera, shadow_px
        self._renderer: mujoco.Renderer | None = None
        self._state: EnvState | None = None
        self._ended = False
        self._open(self.config)
        cameras = [self.task.model.camera(index).name for index in range(self.task.model.ncam)]
        if camera not in cameras:
            raise ConfigError(f"camera: got {camera!r}; expected one of {', '.join(cameras)}")
        self.metadata = self.metadata | {"render_fps": round(1 / self.task.env_step_s)}
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (self.task.observation_size,), np.float32)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (self.task.action_size,), np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Starts an episode.

        Args:
          seed: seeds the random stream; None goes on with it.
          options: `{"command": (forward, lateral)}` holds Cassie's commanded speeds, m/s, for this episode; in the
            heading frame a yaw rate (rad/s) and a height (m) may follow.

        Raises:
          ValueError: an unknown option, or a command that is not so many finite numbers.
        """
        super().reset(seed=seed)
        config = self._config_for(options or {})
        if config != self._running:
            self._open(config)
        self._state = self._envs.reset(self.np_random)
        self._shown, self._ended = self._state, False
        self._observation = self._state.observation[0].astype(np.float32)
        return self._observation.copy(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """One environment step; at an episode's end the observation is still the one it led to.

        Raises:
          RuntimeError: there is no episode to step.
          ValueError: an action of the wrong shape.
          DivergenceError: an action that is not finite.
        """
        if self._state is None or self._ended:
            raise RuntimeError("no episode is running: call reset() first")
        action = np.asarray(action, np.float64)
        if action.shape != self.action_space.shape:
            raise ValueError(f"action: got shape {action.shape}; expected {self.action_space.shape}")
        self._state, result = self._envs.step(self._state, action[None], self.np_random)
        diverged = bool(result.diverged[0])
        terminated, truncated = bool(result.terminated[0]), bool(result.truncated[0]) or diverged
        self._ended = terminated or truncated
        if not diverged:
            self._observation = result.final_observation[0].astype(np.float32)
        if not self._ended:  # at the end the state is already that of the next episode
            self._shown = self._state
        names = [f"reward/{name}" for name in self.task.reward_terms] + list(self.task.measures)
        values = np.concatenate([result.reward_terms[0], result.measures[0]]).tolist()
        info = dict(zip(names, values, strict=True)) | {"diverged": diverged}
        reward = 0.0 if diverged else float(result.reward[0])
        return self._observation.copy(), reward, terminated, truncated, info

    def render(self) -> np.ndarray | None:
        """The scene as uint8 [height, width, 3]; after an episode's end, its last pose but one.

        Raises:
          RuntimeError: there is no OpenGL to render with; or nothing to show before the first `reset`.
        """
        if self.render_mode is None:
            return None
        if self._state is None:
            raise RuntimeError("nothing to render: call reset() first")
        if self._renderer is None:
            self._renderer = self._make_renderer()
        renderer, data = self._renderer, self._render_data
        data.qpos[:] = self.qpos
        if self.task.ground:
            ground = renderer.model.geom_bodyid == 0  # the first geoms of any model
            for name in ("geom_pos", "geom_size"):
                getattr(renderer.model, name)[ground] = self._shown.model_fields[name][0, : ground.sum()]
        mujoco.mj_forward(renderer.model, data)
        renderer.update_scene(data, self._camera)
        return renderer.render()

    def close(self) -> None:
        """Frees the renderer."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

    def push(self, forward_n_s: float, lateral_n_s: float) -> None:
        """Adds momentum to the whole robot at once, N s along the world's x and y.

        Raises:
          ValueError: the task's robot does not float; RuntimeError: no episode is running.
        """
        if self.task.name != "cassie":
            raise ValueError(f"push: task {self.task.name!r} has no floating robot")
        if self._state is None or self._ended:
            raise RuntimeError("no episode is running: call reset() first")
        mass = self._state.model_fields.get("body_mass", np.asarray(self.task.model.body_mass)).sum()
        physics = self._state.physics.copy()
        # The first two degrees of freedom translate all bodies together, so their momentum is mass times velocity.
        velocity = 1 + self.task.model.nq
        physics[0, velocity : velocity + 2] += np.array([forward_n_s, lateral_n_s]) / mass
        self._state = self._state._replace(physics=physics)

    def set_command(self, forward_m_s: float, lateral_m_s: float, *more: float) -> np.ndarray:
        """Commands Cassie these speeds from now to the end of the episode.

        Args:
          forward_m_s: forward speed.
          lateral_m_s: lateral speed, left is positive.
          *more: in the heading frame the yaw rate, rad/s, and the height, m; 0 and the usual one without.

        Returns:
          The observation to act on: the last one, with the new command.

        Raises:
          ConfigError: speeds that are not finite or out of limits, or a task without commands.
          RuntimeError: no episode is running.
        """
        told = (forward_m_s, lateral_m_s, *more)
        self._commanded(told)
        if self._state is None or self._ended:
            raise RuntimeError("no episode is running: call reset() first")
        cassie_config = self.config.settings
        command = np.array([completed(told, cassie_config.command, cassie_config.reward.height_m)], np.float64)
        before = self._state.task, self._state.observation
        task_state, observation = cassie.with_command(cassie_config, *before, command, np)
        self._state = self._state._replace(task=task_state, observation=observation)
        self._observation = observation[0].astype(np.float32)
        return self._observation.copy()

    @property
    def qpos(self) -> np.ndarray:
        """Positions [nq] of the running episode; after its end, those before its last environment step."""
        return self._shown.physics[0, 1 : 1 + self.task.model.nq]

    @property
    def step_s(self) -> float:
        """Duration of an environment step of this episode, s: a randomised robot has its own."""
        fields = self._state.model_fields if self._state else {}
        timestep = fields["timestep"][0] if "timestep" in fields else self.task.model.opt.timestep
        return float(timestep) * self.task.steps_per_env_step

    def _open(self, config: Config) -> None:
        self._running = config
        self.task: Task = make_task(config)
        self._envs = CpuEnvs(self.task, 1, config.collect.max_episode_steps)

    def _config_for(self, options: dict[str, Any]) -> Config:
        unknown = set(options) - {"command"}
        if unknown:
            raise ValueError(f"options: unknown {sorted(unknown)}; known is 'command'")
        return self._commanded(options["command"]) if "command" in options else self.config

    def _commanded(self, told: Any) -> Config:
        """The configuration that holds the command at these numbers, checked."""
        if self.task.name != "cassie":
            raise ConfigError(f"command: task {self.task.name!r} takes no command")
        command, cassie_config = np.asarray(told, np.float64), self.config.settings
        most = len(COMMANDS[cassie_config.command.frame])
        if command.ndim != 1 or not 2 <= len(command) <= most or not np.isfinite(command).all():
            more = "" if most == 2 else ", which a yaw rate in rad/s and a height in m may follow"
            raise ConfigError(f"command: got {told!r}; expected two finite speeds in m/s{more}")
        whole = completed(command.tolist(), cassie_config.command, cassie_config.reward.height_m)
        config = fixed_command(self.config, *whole)
        check(config)
        return config

    def _make_renderer(self) -> mujoco.Renderer:
        # A model of its own: the one that is simulated has no visual shapes and carries the randomised fields.
        model = load_model(self.task.asset, self.config.physics, self.task.ground, visual=True)
        height, width = self.frame_size
        model.vis.global_.offwidth, model.vis.global_.offheight = width, height
        if self._shadow_px is not None:
            model.vis.quality.shadowsize = self._shadow_px
        # The floor acts everywhere but is drawn to its size: draw it endless, or a robot walks off it.
        model.geom_size[model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE, :2] = 0
        model.mat_reflectance[:] = 0  # reflections draw the scene twice, which software rendering pays in full
        model.vis.map.shadowclip = 3  # the edge of the shadow map speckles the floor; put it out of sight
        self._render_data = mujoco.MjData(model)
        try:
            renderer = mujoco.Renderer(model, height, width)
        except Exception as error:  # each OpenGL library fails in its own way
            backend = os.environ.get("MUJOCO_GL") or "not set"
            raise RuntimeError(
                f"cannot render: no OpenGL context (MUJOCO_GL is {backend}); set MUJOCO_GL to egl or osmesa before "
                "Python starts"
            ) from error
        weakref.finalize(self, renderer.close)  # also at exit, while OpenGL can still be called
        return renderer
