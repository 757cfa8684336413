"""How well held commands are followed, over a grid of two of them: heat maps."""

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from hasrl_jax.config import tasks
from hasrl_jax.config.schema import Config
from hasrl_jax.envs.registry import make_task
from hasrl_jax.errors import ConfigError
from hasrl_jax.evaluate.rollout import run_episodes
from hasrl_jax.evaluate.statistics import columns, settled_mean
from hasrl_jax.policy.numpy_networks import Parameters

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SECONDS, SETTLED_S = 10.0, 4.0  # of an episode, and when its means begin
EACH = 4  # episodes of a cell
FORWARD_M_S = (-1.0, -0.5, 0.0, 0.5, 1.0, 2.0, 3.0, 4.0)
GRIDS = {
    "yaw_rate": (-1.0, -0.5, -0.25, 0.0, 0.25, 0.5, 1.0),
    "lateral": (-0.5, -0.3, -0.15, 0.0, 0.15, 0.3, 0.5),
}


class Grid(NamedTuple):
    """Figures of the cells: rows are the values of the second command, columns the forward speeds."""

    up: np.ndarray  # [R, C] share of episodes that end upright
    forward_error: np.ndarray  # [R, C] |mean speed - command|, m/s; NaN where every episode fell before it settled
    other_error: np.ndarray  # [R, C] that of the second command


def draw(config: Config, parameters: Parameters, seed: int) -> "Figure":
    """Share upright, forward error and the other command's error, for turning and for walking sideways.

    Raises:
      ConfigError: the policy has no such commands.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 6.2), layout="constrained")
    for axes, (other, values) in zip(figure.subplots(2, 3), GRIDS.items(), strict=True):
        grid = measure(config, parameters, other, values, seed)
        unit = "rad/s" if other == "yaw_rate" else "m/s"
        titles = ("upright after 10 s, %", "forward error, m/s", f"{other.replace('_', ' ')} error, {unit}")
        pictures = (100 * grid.up, grid.forward_error, grid.other_error)
        for axis, title, cells, worst in zip(axes, titles, pictures, (100, 0.3, 0.3), strict=True):
            good = worst == 100
            axis.imshow(cells, vmin=0, vmax=worst, cmap="RdYlGn" if good else "RdYlGn_r", aspect="auto", origin="lower")
            axis.set_xticks(range(len(FORWARD_M_S)), [f"{v:g}" for v in FORWARD_M_S])
            axis.set_yticks(range(len(values)), [f"{v:g}" for v in values])
            axis.set(title=title, xlabel="forward, m/s", ylabel=f"{other.replace('_', ' ')}, {unit}")
            for (row, column), value in np.ndenumerate(cells):
                text = "" if np.isnan(value) else f"{value:.0f}" if good else f"{value:.2f}"
                axis.text(column, row, text, ha="center", va="center", fontsize=7)
    return figure


def measure(config: Config, parameters: Parameters, other: str, values: tuple[float, ...], seed: int) -> Grid:
    """Plays every cell of forward speed and a second command, all side by side, with the nominal robot.

    Raises:
      ConfigError: the task has no command of this name.
    """
    config = tasks.find(config.task).undisturbed(config)
    task = make_task(config)
    names = [command.name for command in task.commands]
    if other not in names or "forward" not in names or task.with_command is None:
        raise ConfigError(f"task: the grid needs the commands forward and {other}; try --policy released-steer")
    told = np.array([[command.default for command in task.commands]] * (len(values) * len(FORWARD_M_S) * EACH))
    cells = np.array([(speed, value) for value in values for speed in FORWARD_M_S for _ in range(EACH)])
    told[:, [names.index("forward"), names.index(other)]] = cells
    episodes = run_episodes(config, task, parameters, len(told), seed, seconds=SECONDS, told=told)
    shape, column = (len(values), len(FORWARD_M_S), EACH), columns(episodes, task)
    errors = []
    for which, name in enumerate(("forward", other)):
        measured = column[task.commands[names.index(name)].measure]
        settled = np.isfinite(measured)
        settled[: round(SETTLED_S / task.env_step_s)] = False
        errors.append(_mean(np.abs(settled_mean(measured, settled) - cells[:, which]).reshape(shape)))
    return Grid(episodes.reached_cap.reshape(shape).mean(axis=-1), *errors)


def _mean(values: np.ndarray) -> np.ndarray:
    """Mean over the last axis of the numbers that are there; NaN without any."""
    there = np.isfinite(values)
    return np.where(
        there.any(axis=-1), np.where(there, values, 0.0).sum(axis=-1) / np.maximum(there.sum(axis=-1), 1), np.nan
    )
