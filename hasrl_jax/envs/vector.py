"""Many environments behind gymnasium's vector interface: `gymnasium.make_vec("hasrl_jax/Cassie-v0", num_envs=64)`.

They are the collectors' own `CpuEnvs`: one call steps them all, on one core.
"""

import weakref
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from hasrl_jax.config.checks import check
from hasrl_jax.config.convert import from_dict
from hasrl_jax.config.files import recipe
from hasrl_jax.config.schema import Config
from hasrl_jax.envs.cpu_engine import CpuEnvs, EnvState, StepResult
from hasrl_jax.envs.gymnasium import commanded, info_names, known_render_mode, spaces, whole_command
from hasrl_jax.envs.registry import make_task
from hasrl_jax.envs.scene import Scene, camera_of
from hasrl_jax.errors import ConfigError

MODES = (AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP)


def make(task: str = "cassie", config: Config | None = None, **arguments: Any) -> "TaskVectorEnv":
    """A registered task as a gymnasium vector environment.

    Args:
      task: its name, see `config.tasks.find`; takes the place of `config.task`.
      config: default: the one that trains the task, `config.files.recipe`.
      **arguments: further arguments of `TaskVectorEnv`.

    Raises:
      ConfigError: an unknown task or impossible values.
    """
    return TaskVectorEnv(recipe(task) if config is None else from_dict({"task": task}, config), **arguments)


class TaskVectorEnv(VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    """E environments of a task in C MuJoCo.

    Observations are float32 [E, O] and actions float32 [E, A] in [-1, 1]. `info` holds what `TaskEnv` has there, each
    as an array [E] with a mask under `_<name>`. An environment whose simulation diverged is truncated with reward 0.

    Episodes follow one another as gymnasium defines it for the `autoreset_mode`, which is also in the `metadata`:
    `NextStep` (gymnasium's default) spends the step after an episode's end on the reset, with reward 0 and the action
    ignored; `SameStep` returns the new episode's first observation at once, and that of the old one, with its `info`,
    as `final_obs` and `final_info`. The latter wastes no step.

    Args:
      config: reads `task`, `physics`, the task's settings and `collect.max_episode_steps`.
      num_envs: E.
      autoreset_mode: `AutoresetMode.NEXT_STEP` or `AutoresetMode.SAME_STEP`, or their values.
      render_mode: None or "rgb_array".
      width: of rendered frames, pixels.
      height: of rendered frames, pixels.
      camera: name of a camera of the model; default `track`, or the first one.

    Raises:
      ConfigError: impossible values.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 40, "autoreset_mode": MODES[0]}  # noqa: RUF012

    def __init__(
        self,
        config: Config,
        num_envs: int = 1,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        render_mode: str | None = None,
        width: int = 640,
        height: int = 480,
        camera: str | None = None,
    ):
        check(config)
        if not isinstance(num_envs, int) or num_envs < 1:
            raise ConfigError(f"num_envs: got {num_envs!r}; expected a whole number from 1")
        if autoreset_mode not in (*MODES, *(mode.value for mode in MODES)):
            expected = " or ".join(repr(mode.value) for mode in MODES)
            raise ConfigError(f"autoreset_mode: got {autoreset_mode!r}; expected {expected}")
        self.config, self.num_envs = config, num_envs
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        self.render_mode = known_render_mode(render_mode)
        self.frame_size = (height, width)
        self.task = make_task(config)
        self._camera = camera_of(self.task, camera)
        self._scene: Scene | None = None
        self._envs = CpuEnvs(self.task, num_envs, config.collect.max_episode_steps)
        self._state: EnvState | None = None
        self._info_names = info_names(self.task)
        fps = round(1 / self.task.env_step_s)
        self.metadata = self.metadata | {"render_fps": fps, "autoreset_mode": self.autoreset_mode}
        self.single_observation_space, self.single_action_space = spaces(self.task)
        self.observation_space: gymnasium.Space[Any] = batch_space(self.single_observation_space, num_envs)
        self.action_space: gymnasium.Space[Any] = batch_space(self.single_action_space, num_envs)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Starts an episode in every environment.

        Args:
          seed: seeds the one random stream that all environments share; None goes on with it.
          options: `{"command": ...}` commands every robot for its first episode, as in `TaskEnv.reset`.

        Raises:
          ValueError: an unknown option.
          ConfigError: a command that the task does not take.
        """
        super().reset(seed=seed)
        command = commanded(self.task, options)
        self._state = self._envs.reset(self.np_random)
        self._held = np.zeros(self.num_envs, bool)  # their episode is over, and the next one begins with the next step
        self._shown = self._state
        self._last = self._state.observation.astype(np.float32)
        if command is not None:
            self._tell(command)
        return self._last.copy(), {}

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """One environment step of every environment: observation, reward, terminated, truncated, info.

        Raises:
          RuntimeError: there is no episode to step.
          ValueError: actions of the wrong shape.
          DivergenceError: an action that is not finite.
        """
        if self._state is None:
            raise RuntimeError("no episode is running: call reset() first")
        actions = np.asarray(actions, np.float64)
        if actions.shape != self.action_space.shape:
            raise ValueError(f"actions: got shape {actions.shape}; expected {self.action_space.shape}")
        before, held = self._state, self._held
        after, result = self._envs.step(before, actions, self.np_random)
        if held.any():
            after, result = self._envs.keep(before, after, np.flatnonzero(held)), _idle(result, held)
        terminated, truncated = result.terminated, result.truncated | result.diverged
        reward = np.where(result.diverged, 0.0, result.reward)
        ended = terminated | truncated
        self._state = after
        led_to = result.final_observation.astype(np.float32)
        if held.any():
            led_to[held] = after.observation[held]
        if result.diverged.any():
            led_to[result.diverged] = self._last[result.diverged]
        if self.autoreset_mode is AutoresetMode.SAME_STEP:
            info = self._info(result, ~ended)
            self._last = led_to.copy()
            if ended.any():
                info |= {"final_obs": _objects(led_to, ended), "_final_obs": ended.copy()}
                info |= {"final_info": self._info(result, ended), "_final_info": ended.copy()}
                self._last[ended] = after.observation[ended]
            self._shown = after
        else:
            info, self._last = self._info(result, ~held), led_to
            self._shown = self._envs.keep(before, after, np.flatnonzero(ended), fields=False) if ended.any() else after
            self._held = ended.copy()
        return self._last.copy(), reward, terminated.copy(), truncated, info

    def set_command(self, *told: float, **named: float) -> np.ndarray:
        """Commands every robot from now to the end of its episode, see `TaskEnv.set_command`; returns [E, O].

        Raises:
          ConfigError: numbers that are not finite or out of limits, or a command that the task does not take.
          RuntimeError: no episode is running.
        """
        command = whole_command(self.task, told, **named)
        if self._state is None:
            raise RuntimeError("no episode is running: call reset() first")
        self._tell(command)
        return self._last.copy()

    def render(self) -> tuple[np.ndarray, ...] | None:
        """The scene of every environment, each uint8 [height, width, 3]; None without a render mode.

        Raises:
          RuntimeError: there is no OpenGL to render with; or nothing to show before the first `reset`.
        """
        if self.render_mode is None:
            return None
        if self._state is None:
            raise RuntimeError("nothing to render: call reset() first")
        if self._scene is None:
            self._scene = Scene(self.task, self.config.physics, *self.frame_size, self._camera, None)
            weakref.finalize(self, self._scene.close)  # also at exit, while OpenGL can still be called
        poses, fields = self._shown.physics[:, 1 : 1 + self.task.model.nq], self._shown.model_fields
        return tuple(
            self._scene.frame(pose, {name: values[env] for name, values in fields.items()})
            for env, pose in enumerate(poses)
        )

    def close_extras(self, **_: Any) -> None:
        """Frees the renderer."""
        if self._scene is not None:
            self._scene.close()
            self._scene = None

    def _tell(self, command: np.ndarray) -> None:
        """Puts a whole command [C] in force, but not where an episode is over."""
        assert self.task.with_command is not None and self._state is not None
        before, all_of_them = self._state, np.tile(command, (self.num_envs, 1))
        task, observation = self.task.with_command(before.task, before.observation, all_of_them, np)
        told = before._replace(task=task, observation=observation)
        self._state = self._envs.keep(before, told, np.flatnonzero(self._held), fields=False)
        self._last[~self._held] = self._state.observation[~self._held]

    def _info(self, result: StepResult, valid: np.ndarray) -> dict[str, Any]:
        """`info` of the environments where `valid` [E] bool; zero elsewhere."""
        values = np.where(valid[:, None], np.concatenate([result.reward_terms, result.measures], axis=1), 0.0)
        info = dict(zip(self._info_names, np.ascontiguousarray(values.T), strict=True))
        info["diverged"] = result.diverged & valid
        return info | {f"_{name}": valid.copy() for name in info}


def _idle(result: StepResult, held: np.ndarray) -> StepResult:
    """`result` as of a step in which nothing happened where `held`."""

    def put(values: np.ndarray) -> np.ndarray:
        values = values.copy()
        values[held] = 0
        return values

    return StepResult(*map(put, result))


def _objects(rows: np.ndarray, chosen: np.ndarray) -> np.ndarray:
    """An array [E] of objects: the rows [E, *] that are chosen, None elsewhere."""
    found = np.full(len(rows), None, object)
    for index in np.flatnonzero(chosen):
        found[index] = rows[index]
    return found
