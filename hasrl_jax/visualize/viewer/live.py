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
from hasrl_jax.envs import frames
from hasrl_jax.envs.gymnasium import TaskEnv
from hasrl_jax.envs.model import load_model
from hasrl_jax.envs.registry import Robot
from hasrl_jax.envs.task import Command
from hasrl_jax.evaluate.rollout import Player
from hasrl_jax.policy.numpy_networks import Parameters
from hasrl_jax.visualize.render import AVERAGE_S, followed, recent_means

MAX_BEHIND_S = 0.1  # what is missed beyond this is given up, not caught up with
PACE_WINDOW_S = 1.0  # over which the pace is measured
UNITS = {"height": "m", "heading_error": "rad", "angle": "rad"}  # of the measures that have a line of their own


class Push(NamedTuple):
    """A horizontal force on the robot, for as long as its task's pushes last."""

    force_n: float
    direction_deg: float  # asked for: from where the robot faces, 90 to its left; seen: the same from the world's x


class Controls(NamedTuple):
    """What a person asks for."""

    command: tuple[float, ...] = ()  # in the order of the task's commands; those that are left out take their default
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
    measures: dict[str, float]  # means of the task's measures over the last AVERAGE_S
    episodes: int  # that have begun
    falls: int
    last_end: str  # why the episode before ended; empty before there was one
    push: Push | None  # that acts now
    randomized: bool


class Live:
    """A policy that acts under changing controls, episode after episode, on the ground that it was trained for.

    Args:
      config: of the policy. The nominal robot is not pushed but by the controls.
      parameters: as `learn.ppo.export_parameters` returns them.
      seed: of the environments.
      randomized: the robot of the first episode, where the task has randomised ones.
      robot: another model of the robot; None is the task's own.
    """

    def __init__(
        self, config: Config, parameters: Parameters, seed: int, randomized: bool = False, robot: Robot | None = None
    ):
        spec, longest = tasks.find(config.task), int(limits_of(CollectConfig, "max_episode_steps").high)
        nominal = spec.undisturbed(from_dict({"collect": {"max_episode_steps": longest}}, config))
        self._players = {False: Player(TaskEnv(nominal, robot=robot), parameters, seed)}
        if spec.randomized:
            self._players[True] = Player(TaskEnv(spec.randomized(nominal), robot=robot), parameters, seed)
        task = self._players[False].env.task
        self.commands: tuple[Command, ...] = task.commands
        self.can_push, self.can_randomize = task.with_push is not None, True in self._players
        self._push_s = task.push_s
        self.model = load_model(task.asset, config.physics, task.ground, visual=True)
        self._data = mujoco.MjData(self.model)
        self._episodes, self._falls, self._last_end = 0, 0, ""
        self._episode = self._begin(randomized)

    @property
    def step_s(self) -> float:
        """Duration of an environment step of the running episode, s."""
        return self._episode.player.env.step_s

    def advance(self, controls: Controls) -> None:
        """Does what the controls ask for, and one environment step unless they pause."""
        if controls.reset:
            self._last_end = "reset"
            self._episode = self._begin(controls.randomized)
        episode = self._episode
        if controls.push:
            push = controls.push._replace(direction_deg=controls.push.direction_deg + self._facing_deg())
            angle = np.deg2rad(push.direction_deg)
            episode.player.env.push(push.force_n * np.cos(angle), push.force_n * np.sin(angle))
            episode.push, episode.push_left_s = push, self._push_s
        if controls.paused:
            return
        if self.commands and controls.command != episode.command:
            episode.player.command(*controls.command)
            episode.command = controls.command
        step_s = self.step_s
        if episode.push_left_s <= 1e-9:
            episode.push = None
        outcome = episode.player.step()
        episode.time_s += step_s
        episode.push_left_s -= step_s
        episode.recent.append([outcome.info[name] for name in episode.player.env.task.measures])
        if outcome.ended:
            self._falls += outcome.terminated
            without_a_fall = "simulation failed" if outcome.info["diverged"] else "time limit"
            self._last_end = "fell" if outcome.terminated else without_a_fall
            self._episode = self._begin(controls.randomized)

    def view(self) -> View:
        """The robot and the readouts as they are now."""
        episode = self._episode
        env = episode.player.env
        env.place_ground(self.model)
        self._pose()
        return View(
            qpos=env.qpos.copy(),
            position=self._data.xpos.copy(),
            orientation=self._data.xquat.copy(),
            time_s=episode.time_s,
            measures=recent_means(env.task.measures, episode.recent),
            episodes=self._episodes,
            falls=self._falls,
            last_end=self._last_end,
            push=episode.push,
            randomized=episode.randomized,
        )

    def _pose(self) -> None:
        """Where the bodies of the robot are now."""
        self._data.qpos[:] = self._episode.player.env.qpos
        mujoco.mj_kinematics(self.model, self._data)

    def _facing_deg(self) -> float:
        """How far the robot has turned to the left of the world's x."""
        self._pose()
        return float(np.rad2deg(frames.heading(self._data.xquat[1], np)))

    def _begin(self, randomized: bool) -> "Episode":
        randomized = randomized and self.can_randomize
        player = self._players[randomized]
        player.begin()
        self._episodes += 1
        return Episode(player, randomized, deque(maxlen=max(1, round(AVERAGE_S / player.env.step_s))))


@dataclass
class Episode:
    """The running episode of `Live`."""

    player: Player
    randomized: bool
    recent: deque[list[float]]  # the task's measures over the last AVERAGE_S
    command: tuple[float, ...] | None = None  # in force; None before the first
    time_s: float = 0.0
    push: Push | None = None
    push_left_s: float = 0.0


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


def readout(view: View, commands: tuple[Command, ...], pace: float) -> list[tuple[str, str]]:
    """Names and values to show beside the robot. `pace`: simulated per elapsed time."""
    measures = view.measures
    rows = [("time", f"{view.time_s:.1f} s")]
    shown = {"left_force", "right_force", "left_toe_force", "right_toe_force", "motor_power", "phase", "heading"}
    for command in commands:
        if command.measure in measures:
            rows.append((command.name.replace("_", " "), followed(command, measures)))
            shown |= {command.measure, f"{command.name}_command"}
    if "left_force" in measures:
        rows.append(("feet", f"left {measures['left_force']:.0f} N, right {measures['right_force']:.0f} N"))
    if "motor_power" in measures:
        rows.append(("motors", f"{measures['motor_power']:.0f} W"))
    others = {name: value for name, value in measures.items() if name not in shown}
    rows += [(name.replace("_", " "), f"{value:+z.2f} {UNITS.get(name, '')}".strip()) for name, value in others.items()]
    rows.append(("falls", f"{view.falls}" + (f", last end: {view.last_end}" if view.last_end else "")))
    rows.append(("robot", "randomised" if view.randomized else "nominal"))
    rows.append(("pace", "real time" if pace > 0.95 else f"behind: {pace:.0%} of real time"))
    return rows
