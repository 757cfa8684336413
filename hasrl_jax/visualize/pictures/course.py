"""The paths of a steered robot, seen from above."""

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from hasrl_jax.config import tasks
from hasrl_jax.config.convert import from_dict
from hasrl_jax.config.schema import Config
from hasrl_jax.envs.gymnasium import TaskEnv
from hasrl_jax.evaluate.rollout import Player
from hasrl_jax.policy.numpy_networks import Parameters
from hasrl_jax.visualize.course import COURSES, SLICE_S, Leg, check, sliced

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

ARROW_EVERY_S = 1.0
WALKED, ASKED, FALLEN = "#1f6f8b", "#d9a05b", "#b91c1c"


class Path(NamedTuple):
    """T environment steps of one episode; shorter than asked for where the robot fell."""

    position: np.ndarray  # [T, 2] world x and y of the pelvis, m
    heading: np.ndarray  # [T] rad
    asked: np.ndarray  # [T, 2] where a robot would be that did exactly as told from the first moment, m
    fell: bool
    step_s: float  # between two of them


def draw(config: Config, parameters: Parameters, seed: int) -> "Figure":
    """Every course beside the path that its commands describe.

    Raises:
      ConfigError: the policy does not understand the commands of a course.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 4.2), layout="constrained")
    panels = figure.subplot_mosaic([["eight", "slalom"], ["eight", "joystick"]], width_ratios=[1, 2.2])
    for name, axes in panels.items():
        draw_path(axes, str(name), walk(config, parameters, str(name), COURSES[str(name)], seed))
    return figure


def walk(config: Config, parameters: Parameters, name: str, course: list[Leg], seed: int) -> Path:
    """Plays a course with the nominal robot.

    Raises:
      ConfigError: the policy does not understand its commands.
    """
    told = sliced(course)
    slice_steps = round(SLICE_S / config.physics.env_step_s)
    steps = slice_steps * len(told)
    env = TaskEnv(tasks.find(config.task).undisturbed(from_dict({"collect": {"max_episode_steps": steps}}, config)))
    check(name, course, env.task.commands)
    player = Player(env, parameters, seed)
    position, heading, terminated = [], [], False
    for step in range(steps):
        if step % slice_steps == 0:
            player.command(**told[step // slice_steps])
        outcome = player.step()
        position.append(env.qpos[:2].copy())
        heading.append(outcome.info["heading"])
        terminated = outcome.terminated
        if outcome.ended:
            break
    asked = exact(told, slice_steps, env.task.env_step_s)
    return Path(np.array(position), np.array(heading), asked[: len(position)], terminated, env.task.env_step_s)


def exact(told: list[dict[str, float]], slice_steps: int, env_step_s: float) -> np.ndarray:
    """The path of a robot that does exactly as told, from the origin along x: [T, 2] in m.

    The heading is the integral of the yaw rate, the position that of the velocity turned by it.
    """
    rows = [[one.get(name, 0.0) for name in ("forward", "lateral", "yaw_rate")] for one in told]
    forward, lateral, yaw_rate = np.repeat(np.array(rows), slice_steps, axis=0).T
    heading = np.cumsum(yaw_rate) * env_step_s
    velocity = [forward * np.cos(heading) - lateral * np.sin(heading)]
    velocity += [forward * np.sin(heading) + lateral * np.cos(heading)]
    return np.cumsum(np.stack(velocity, axis=1), axis=0) * env_step_s


def draw_path(axes: "Axes", name: str, path: Path) -> None:
    """Both paths, and where the robot faced."""
    axes.plot(*path.asked.T, color=ASKED, linewidth=1.0, linestyle="--", label="as told")
    axes.plot(*path.position.T, color=WALKED, linewidth=1.5, label="walked")
    every = slice(None, None, round(ARROW_EVERY_S / path.step_s))
    facing = np.stack([np.cos(path.heading[every]), np.sin(path.heading[every])])
    axes.quiver(
        *path.position[every].T, *facing, color=WALKED, angles="xy", scale_units="xy", scale=3, units="dots", width=2
    )
    if path.fell:
        axes.plot(*path.position[-1], marker="x", color=FALLEN, markersize=9, label="fell")
    axes.set(title=name, xlabel="x, m", ylabel="y, m", aspect="equal")
    axes.grid(alpha=0.3)
    axes.legend(fontsize=7, loc=(0.32, 0.2) if name == "eight" else "best")
