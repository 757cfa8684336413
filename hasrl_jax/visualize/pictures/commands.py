"""How well held commands are followed, over a grid of two of them: heat maps."""

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from hasrl_jax.config import tasks
from hasrl_jax.config.schema import Config
from hasrl_jax.envs.cpu_engine import CpuEnvs
from hasrl_jax.envs.registry import make_task
from hasrl_jax.errors import ConfigError
from hasrl_jax.policy import actor
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
    steps, settled = round(SECONDS / task.env_step_s), round(SETTLED_S / task.env_step_s)
    envs = CpuEnvs(task, len(told), steps + 1)
    rng = np.random.Generator(np.random.Philox(seed))
    state = envs.reset(rng)
    task_state, observation = task.with_command(state.task, state.observation, told, np)
    state = state._replace(task=task_state, observation=observation)
    policy = actor.reset(config, task, parameters, len(told))
    up, sums = np.ones(len(told), bool), np.zeros((len(told), 2))
    counts = np.zeros(len(told))
    columns = [task.measures.index(task.commands[names.index(name)].measure) for name in ("forward", other)]
    for step in range(steps):
        action, policy = actor.act(policy, state.observation, state.is_first)
        state, result = envs.step(state, action, rng)
        up &= ~(result.terminated | result.diverged)
        if step >= settled:
            sums += np.where(up[:, None], result.measures[:, columns], 0.0)
            counts += up
    with np.errstate(invalid="ignore"):
        error = np.abs(sums / np.where(counts > 0, counts, np.nan)[:, None] - cells)
    shape = (len(values), len(FORWARD_M_S), EACH)
    means = [_mean(error[:, column].reshape(shape)) for column in (0, 1)]
    return Grid(up.reshape(shape).mean(axis=-1), *means)


def _mean(values: np.ndarray) -> np.ndarray:
    """Mean over the last axis of the numbers that are there; NaN without any."""
    there = np.isfinite(values)
    return np.where(
        there.any(axis=-1), np.where(there, values, 0.0).sum(axis=-1) / np.maximum(there.sum(axis=-1), 1), np.nan
    )
