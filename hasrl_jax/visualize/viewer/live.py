"""What the viewer shows, without any drawing: controls in, one environment step, poses and readouts out."""

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import mujoco
import numpy as np

from hasrl_jax.config import tasks
from hasrl_jax.config.checks import limits_of
from hasrl_jax.config.convert import from_dict
from hasrl_jax.config.schema import CollectConfig, Config
from hasrl_jax.envs.gymnasium import TaskEnv
from hasrl_jax.envs.model import load_model
from hasrl_jax.errors import ConfigError
from hasrl_jax.policy.actor import Acting, act, start
from hasrl_jax.policy.numpy_networks import Parameters
from hasrl_jax.visualize.render import PUSH_S, SPEED_AVERAGE_S, recent_means

MAX_BEHIND_S = 0.1  # what is missed beyond this is given up, not caught up with
PACE_WINDOW_S = 1.0  # over which the pace is measured


class Push(NamedTuple):
    """A horizontal force on the whole robot for PUSH_S."""

    force_n: float
    direction_deg: float  # 0 pushes forward, 90 to the left


class Controls(NamedTuple):
    """What a person asks for."""

    forward_m_s: float = 0.0
    lateral_m_s: float = 0.0
    paused: bool = False
    randomized: bool = False  # the robot of the next episode
    reset: bool = False  # begin an episode now
    push: Push | None = None  # begins now


class View(NamedTuple):
    """What there is to see after an environment step."""

    qpos: np.ndarray  # [nq]
    position: np.ndarray  # [nbody, 3] of each body's frame, m
    orientation: np.ndarray  # [nbody, 4] (w, x, y, z)
    time_s: float  # since the episode began
    measures: dict[str, float]  # means of the task's measures over the last SPEED_AVERAGE_S
    falls: int
    push: Push | None  # that acts now
    randomized: bool


class Live:
    """A policy that walks under changing controls, episode after episode.

    Args:
      config: of the policy; its task must be "cassie". The nominal robot is not pushed but by the controls; the
        randomised one is as `config.settings.randomize` has it. The ground is level, whatever the policy has met.
      parameters: as `learn.ppo.export_parameters` returns them.
      seed: of the environments.
      randomized: the robot of the first episode.

    Raises:
      ConfigError: another task.
    """

    def __init__(self, config: Config, parameters: Parameters, seed: int, randomized: bool = False):
        if config.task != "cassie":
            raise ConfigError(f"the viewer commands speeds, and task {config.task!r} has none; give a policy of cassie")
        longest = limits_of(CollectConfig, "max_episode_steps").high
        changes = {"collect": {"max_episode_steps": longest}, "cassie": {"terrain": {"kind": "flat"}}}
        nominal = from_dict(changes, tasks.find(config.task).undisturbed(config))
        drawn = from_dict({"cassie": {"randomize": {"enabled": True, "share": 1.0}}}, nominal)
        self._envs = {False: TaskEnv(nominal), True: TaskEnv(drawn)}
        for env in self._envs.values():
            env.reset(seed=seed)
        self._config, self._parameters = nominal, parameters
        self.model = load_model(self._envs[False].task.asset, config.physics, visual=True)
        self._data = mujoco.MjData(self.model)
        self._falls = 0
        self._episode = self._begin(randomized)

    @property
    def step_s(self) -> float:
        """Duration of an environment step of the running episode, s."""
        return self._episode.env.step_s

    def advance(self, controls: Controls) -> None:
        """Does what the controls ask for, and one environment step unless they pause."""
        if controls.reset:
            self._episode = self._begin(controls.randomized)
        episode = self._episode
        if controls.push:
            episode.push, episode.push_left_s = controls.push, PUSH_S
        if controls.paused:
            return
        command = controls.forward_m_s, controls.lateral_m_s
        if command != episode.command:
            episode.observation, episode.command = episode.env.set_command(*command), command
        _apply_push(episode)
        is_first = np.array([episode.time_s == 0])
        action, episode.acting = act(episode.acting, episode.observation[None], is_first)
        episode.time_s += self.step_s
        episode.observation, _, terminated, truncated, info = episode.env.step(action[0])
        episode.recent.append([info[name] for name in episode.env.task.measures])
        if terminated or truncated:
            self._falls += terminated
            self._episode = self._begin(controls.randomized)

    def view(self) -> View:
        """The robot and the readouts as they are now."""
        episode = self._episode
        self._data.qpos[:] = episode.env.qpos
        mujoco.mj_kinematics(self.model, self._data)
        return View(
            qpos=episode.env.qpos.copy(),
            position=self._data.xpos.copy(),
            orientation=self._data.xquat.copy(),
            time_s=episode.time_s,
            measures=recent_means(episode.env.task.measures, episode.recent),
            falls=self._falls,
            push=episode.push,
            randomized=episode.randomized,
        )

    def _begin(self, randomized: bool) -> "Episode":
        env = self._envs[randomized]
        observation, _ = env.reset()
        acting = start(self._config, env.task, self._parameters, 1)
        return Episode(env, randomized, observation, acting, deque(maxlen=round(SPEED_AVERAGE_S / env.step_s)))


@dataclass
class Episode:
    """The running episode of `Live`."""

    env: TaskEnv
    randomized: bool
    observation: np.ndarray  # [O] to act on next
    acting: Acting
    recent: deque[list[float]]  # the task's measures over the last SPEED_AVERAGE_S
    command: tuple[float, float] | None = None  # in force, m/s; None before the first
    time_s: float = 0.0
    push: Push | None = None
    push_left_s: float = 0.0


def _apply_push(episode: Episode) -> None:
    """Gives the robot the share of the push that falls into the next environment step."""
    if episode.push_left_s <= 0:
        episode.push = None
    if episode.push:
        step_s = episode.env.step_s
        momentum = episode.push.force_n * min(episode.push_left_s, step_s)
        angle = np.deg2rad(episode.push.direction_deg)
        episode.env.push(momentum * np.cos(angle), momentum * np.sin(angle))
        episode.push_left_s = round(episode.push_left_s - step_s, 9)  # no sliver of a step from rounding


class Pace:
    """Holds the simulation to the wall clock, and knows how well it keeps up.

    Args:
      clock: the time in seconds.
    """

    def __init__(self, clock: Callable[[], float] = time.perf_counter):
        self._clock = clock
        self._due = clock()
        self._history: deque[tuple[float, float]] = deque([(self._due, 0.0)])

    def wait_s(self, simulated_s: float) -> float:
        """How long to sleep, s, after a step that simulated so much; 0 when behind."""
        now = self._clock()
        self._due = max(self._due + simulated_s, now - MAX_BEHIND_S)
        self._history.append((now, self._history[-1][1] + simulated_s))
        while len(self._history) > 2 and self._history[0][0] < now - PACE_WINDOW_S:
            self._history.popleft()
        return max(0.0, self._due - now)

    def share(self) -> float:
        """Simulated per elapsed time over about the last PACE_WINDOW_S; 1 is real time."""
        (first, simulated_first), (last, simulated_last) = self._history[0], self._history[-1]
        return (simulated_last - simulated_first) / (last - first) if last > first else 1.0


def readout(view: View, pace: float) -> list[tuple[str, str]]:
    """Names and values to show beside the robot. `pace`: simulated per elapsed time."""
    measures = view.measures
    rows = [("time", f"{view.time_s:.1f} s")]
    if measures:
        for name in ("forward", "lateral"):
            speed, command = measures[f"{name}_speed"], measures[f"{name}_command"]
            rows.append((name, f"{speed:+.2f} of {command:+.2f} m/s"))
        rows.append(("feet", f"left {measures['left_force']:.0f} N, right {measures['right_force']:.0f} N"))
        rows.append(("motors", f"{measures['motor_power']:.0f} W"))
    rows.append(("falls", str(view.falls)))
    rows.append(("robot", "randomised" if view.randomized else "nominal"))
    rows.append(("pace", "real time" if pace > 0.95 else f"behind: {pace:.0%} of real time"))
    return rows
