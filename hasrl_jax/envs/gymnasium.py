"""One environment behind the gymnasium interface: `gymnasium.make("hasrl_jax/Cassie-v0")`.

It is the collectors' own `CpuEnvs` with a lone environment, so what is true of one is true of the other.
"""

import weakref
from collections.abc import Mapping, Sequence
from numbers import Real
from typing import Any

import gymnasium
import mujoco
import numpy as np

from hasrl_jax.config.checks import check
from hasrl_jax.config.convert import from_dict
from hasrl_jax.config.files import recipe
from hasrl_jax.config.limits import Limits, check_number
from hasrl_jax.config.schema import Config
from hasrl_jax.envs.cpu_engine import CpuEnvs, EnvState
from hasrl_jax.envs.registration import register
from hasrl_jax.envs.registry import Robot, make_task, make_task_on
from hasrl_jax.envs.scene import Scene, camera_of, place_ground
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


class TaskEnv(gymnasium.Env[np.ndarray, np.ndarray]):
    """A task in C MuJoCo.

    Observations are float32 [O] and actions float32 [A] in [-1, 1]. `info` holds each weighted reward term as
    `reward/<name>`, each of the task's measures by its name, and `diverged`: the simulation failed; such an episode
    is truncated with reward 0, and its last valid observation is returned again.

    Args:
      config: default `configs/cassie_walk.yaml`; reads `task`, `physics`, the task's settings and
        `collect.max_episode_steps`.
      render_mode: None or "rgb_array".
      width: of rendered frames, pixels.
      height: of rendered frames, pixels.
      camera: name of a camera of the model; default `track`, or the first one.
      shadow_px: side of the shadow map; None keeps the model's.
      robot: another model of the robot; None is the task's own.

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
        camera: str | None = None,
        shadow_px: int | None = None,
        robot: Robot | None = None,
    ):
        self._robot = robot
        self.config = recipe("cassie") if config is None else config
        check(self.config)
        self.render_mode = known_render_mode(render_mode)
        self.frame_size, self._shadow_px = (height, width), shadow_px
        self._scene: Scene | None = None
        self._state: EnvState | None = None
        self._ended = False
        self._pushable = False
        self._open()
        self._camera = camera_of(self.task, camera)
        self.metadata = self.metadata | {"render_fps": round(1 / self.task.env_step_s)}
        self.observation_space, self.action_space = spaces(self.task)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Starts an episode.

        Args:
          seed: seeds the random stream; None goes on with it.
          options: `{"command": (1.0, 0.0)}`, or `{"command": {"forward": 1.0}}`, commands the robot for this episode,
            see `set_command`.

        Raises:
          ValueError: an unknown option.
          ConfigError: a command that the task does not take.
        """
        super().reset(seed=seed)
        command = commanded(self.task, options)
        self._state = self._envs.reset(self.np_random)
        self._ended = False
        self._observation = self._state.observation
        if command is not None:
            self._tell(command)
        self._shown = self._state
        return self._seen(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """One environment step; at an episode's end the observation is still the one it led to.

        Raises:
          RuntimeError: there is no episode to step.
          ValueError: an action of the wrong shape.
          DivergenceError: an action that is not finite.
        """
        state = self._running()
        action = np.asarray(action, np.float64)
        if action.shape != self.action_space.shape:
            raise ValueError(f"action: got shape {action.shape}; expected {self.action_space.shape}")
        self._state, result = self._envs.step(state, action, self.np_random)
        diverged = bool(result.diverged)
        terminated, truncated = bool(result.terminated), bool(result.truncated) or diverged
        self._ended = terminated or truncated
        if not diverged:
            self._observation = result.final_observation
        if not self._ended:  # at the end the state is already that of the next episode
            self._shown = self._state
        values = result.reward_terms.tolist() + result.measures.tolist()
        info: dict[str, Any] = dict(zip(self._info_names, values, strict=True))
        info["diverged"] = diverged
        reward = 0.0 if diverged else float(result.reward)
        return self._seen(), reward, terminated, truncated, info

    def render(self) -> np.ndarray | None:
        """The scene as uint8 [height, width, 3]; after an episode's end, its last pose but one.

        Raises:
          RuntimeError: there is no OpenGL to render with; or nothing to show before the first `reset`.
        """
        if self.render_mode is None:
            return None
        if self._state is None:
            raise RuntimeError("nothing to render: call reset() first")
        if self._scene is None:
            self._scene = Scene(self.task, self.config.physics, *self.frame_size, self._camera, self._shadow_px)
            weakref.finalize(self, self._scene.close)  # also at exit, while OpenGL can still be called
        return self._scene.frame(self.qpos, self._shown.model_fields)

    def place_ground(self, model: mujoco.MjModel) -> None:
        """Puts the ground of the running episode into `model`, another copy of the task's; level ground stays."""
        place_ground(self.task, model, self._shown.model_fields)

    def close(self) -> None:
        """Frees the renderer."""
        if self._scene is not None:
            self._scene.close()
            self._scene = None

    def push(self, forward_n: float, lateral_n: float) -> None:
        """Pushes the robot with a force, N along the world's x and y, from now for `task.push_s` seconds.

        Raises:
          ConfigError: the task's robot cannot be pushed; RuntimeError: no episode is running.
        """
        if self.task.with_push is None:
            raise ConfigError(f"push: the robot of task {self.task.name!r} cannot be pushed")
        state = self._running()
        if not self._pushable:  # what can be pushed costs a tenth of a step even while nobody pushes
            self._pushable = True
            self._envs = self._engine()
            self._envs.restore(state)
        force = np.array([forward_n, lateral_n], np.float64)
        self._state = state._replace(task=self.task.with_push(state.task, force, np))

    def set_command(self, *told: float, **named: float) -> np.ndarray:
        """Commands the robot from now to the end of the episode.

        Args:
          *told: the first of the task's commands (`task.commands`) in their order and units.
          **named: others by name; those that are not told take their default.

        Returns:
          The observation to act on: the last one, with the new command.

        Raises:
          ConfigError: numbers that are not finite or out of limits, or a command that the task does not take.
          RuntimeError: no episode is running.
        """
        command = self.check_command(told, **named)
        self._running()
        self._tell(command)
        return self._seen()

    def check_command(self, told: Any, **named: float) -> np.ndarray:
        """A whole command [C] from what is told of it, numbers in order or by name; in force only by `set_command`.

        Raises:
          ConfigError: names the command, the value and what would work.
        """
        return whole_command(self.task, told, **named)

    @property
    def qpos(self) -> np.ndarray:
        """Positions [nq] of the running episode; after its end, those before its last environment step."""
        return self._shown.physics[1 : 1 + self.task.model.nq]

    @property
    def step_s(self) -> float:
        """Duration of an environment step of this episode, s: a randomised robot has its own."""
        fields = self._state.model_fields if self._state else {}
        return float(fields.get("timestep", self.task.model.opt.timestep)) * self.task.steps_per_env_step

    def __getstate__(self) -> dict[str, Any]:
        # What is simulated is arrays, and is copied; the engine and the renderer are made anew.
        left_out = ("task", "_envs", "_scene")
        return {name: value for name, value in vars(self).items() if name not in left_out}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._scene = None
        self._open()
        if self._state is not None:
            self._envs.restore(self._state)

    def _open(self) -> None:
        """Makes the task and the engine that runs it."""
        self.task: Task = make_task(self.config) if self._robot is None else make_task_on(self.config, self._robot)
        self._envs = self._engine()
        self._info_names = info_names(self.task)

    def _engine(self) -> CpuEnvs:
        return CpuEnvs(self.task, None, self.config.collect.max_episode_steps, self._pushable)

    def _running(self) -> EnvState:
        """The state of the running episode."""
        if self._state is None or self._ended:
            raise RuntimeError("no episode is running: call reset() first")
        return self._state

    def _tell(self, command: np.ndarray) -> None:
        """Puts a whole command [C] in force."""
        assert self.task.with_command is not None and self._state is not None
        state, observation = self.task.with_command(self._state.task, self._state.observation, command, np)
        self._state = self._state._replace(task=state, observation=observation)
        self._observation = observation

    def _seen(self) -> np.ndarray:
        """The last observation, float32 [O], an array of the caller's own."""
        return self._observation.astype(np.float32)


def known_render_mode(render_mode: str | None) -> str | None:
    """`render_mode` as it is.

    Raises:
      ConfigError: there is no such mode.
    """
    if render_mode not in (None, "rgb_array"):
        raise ConfigError(f"render_mode: got {render_mode!r}; expected None or 'rgb_array'")
    return render_mode


def spaces(task: Task) -> tuple[gymnasium.spaces.Box, gymnasium.spaces.Box]:
    """Of observations and of actions, both float32."""
    observation = gymnasium.spaces.Box(-np.inf, np.inf, (task.observation_size,), np.float32)
    return observation, gymnasium.spaces.Box(-1.0, 1.0, (task.action_size,), np.float32)


def info_names(task: Task) -> list[str]:
    """What `info` holds: `reward/<name>` for each weighted term, then the measures."""
    return [f"reward/{name}" for name in task.reward_terms] + list(task.measures)


def commanded(task: Task, options: dict[str, Any] | None) -> np.ndarray | None:
    """The whole command [C] that the `options` of a reset hold; None without one.

    Raises:
      ValueError: an unknown option.
      ConfigError: a command that the task does not take.
    """
    options = options or {}
    if set(options) - {"command"}:
        raise ValueError(f"options: unknown {sorted(set(options) - {'command'})}; known is 'command'")
    told = options.get("command")
    return None if told is None else whole_command(task, told)


def whole_command(task: Task, told: Any, **named: float) -> np.ndarray:
    """A whole command [C] from what is told of it, numbers in order or by name; the others take their default.

    Raises:
      ConfigError: names the command, the value and what would work.
    """
    commands = task.commands
    if not commands:
        raise ConfigError(f"command: task {task.name!r} takes no command")
    if isinstance(told, Mapping):
        told, named = (), {**told, **named}
    known = ", ".join(f"{command.name} ({command.unit})" for command in commands)
    if not isinstance(told, Sequence | np.ndarray) or len(told) > len(commands):
        raise ConfigError(f"command: got {told!r}; expected at most {len(commands)} numbers: {known}")
    values = dict(zip((command.name for command in commands), told, strict=False)) | named
    unknown = sorted(values.keys() - {command.name for command in commands})
    if unknown:
        raise ConfigError(f"command: got {unknown[0]!r}; expected {known}")
    whole = [values.get(command.name, command.default) for command in commands]
    for command, value in zip(commands, whole, strict=True):
        if not isinstance(value, Real):
            raise ConfigError(f"command {command.name}: got {value!r}; expected a number, {command.unit}")
        check_number(f"command {command.name}", value, Limits(*command.limits))
    return np.array(whole, np.float64)
