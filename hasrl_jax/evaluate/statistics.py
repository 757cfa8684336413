"""What episodes amount to: means and shares with 95 % confidence intervals, and how well commands are followed."""

from typing import Any

import numpy as np

from hasrl_jax.envs.task import Command, Task
from hasrl_jax.evaluate.rollout import Episodes

POWER = "motor_power"  # a measure in W that tasks may have: mean over every whole episode
SETTLE_S = 3.0  # an error counts from this long after an episode's start or a new command


def summarize(episodes: Episodes, task: Task) -> dict[str, Any]:
    """Means with 95 % confidence intervals, ready for JSON."""
    summary: dict[str, Any] = {
        "episodes": len(episodes.episode_return),
        "episode_return": mean_interval(episodes.episode_return),
        "episode_length": mean_interval(episodes.episode_length),
        "seconds_upright": mean_interval(episodes.seconds),
        "share_reaching_cap": share_interval(episodes.reached_cap),
        "diverged_episodes": int(episodes.diverged.sum()),
        "action_change": mean_interval(episodes.action_change),
    }
    column = columns(episodes, task)
    if POWER in column:
        steps = np.maximum(episodes.episode_length, 1)
        summary[POWER] = mean_interval(np.nansum(column[POWER], axis=0) / steps)
    if task.commands:
        errors = settled_errors(column, task.commands, task.env_step_s)
        first = errors[task.commands[0].measure]
        summary["settled_episodes"] = int(np.isfinite(first).sum())
        summary |= {name: mean_interval(values) for name, values in errors.items()}
    return summary


def columns(episodes: Episodes, task: Task) -> dict[str, np.ndarray]:
    """The task's measures by name, [T, N] each."""
    return {name: episodes.measures[..., index] for index, name in enumerate(task.measures)}


def settled_errors(
    column: dict[str, np.ndarray], commands: tuple[Command, ...], env_step_s: float
) -> dict[str, np.ndarray]:
    """How each command is followed once it has settled; [T, N] -> [N], NaN for an episode in which none ever did.

    For each command with the measure m: m, the mean; `<name>_command`, the mean of what was asked for; `m_error`, the
    time-weighted mean absolute error: that of the mean of m under a command, averaged over the episode's commands by
    the time under each, so that too much under one does not make up for too little under another; and
    `m_error_instantaneous`, the mean absolute error of every environment step.

    Args:
      column: the task's measures by name, [T, N] each; NaN after an episode's end.
      commands: of the task.
      env_step_s: nominal duration of an environment step, s.
    """
    settle_steps = round(SETTLE_S / env_step_s)
    settled = np.ones(next(iter(column.values())).shape, bool)
    for command in commands:
        settled &= settled_steps(column[f"{command.name}_command"], settle_steps)
    values = {}
    for command in commands:
        measured, asked = column[command.measure], column[f"{command.name}_command"]
        values[command.measure] = settled_mean(measured, settled)
        values[f"{command.name}_command"] = settled_mean(asked, settled)
        values[f"{command.measure}_error"] = command_error(measured - asked, settled)
        values[f"{command.measure}_error_instantaneous"] = settled_mean(np.abs(measured - asked), settled)
    return values


def settled_mean(values: np.ndarray, settled: np.ndarray) -> np.ndarray:
    """Mean of each episode's `values` [T, N] where `settled` [T, N]: [N], NaN for an episode that never settled."""
    counts = settled.sum(axis=0)
    return np.where(counts > 0, np.where(settled, values, 0.0).sum(axis=0) / np.maximum(counts, 1), np.nan)


def command_error(error: np.ndarray, settled: np.ndarray) -> np.ndarray:
    """Mean of |mean `error`| under each `settled` command, weighted by its time; [T, N] -> [N], NaN without any."""
    number = np.cumsum(np.diff(settled.astype(np.int8), axis=0, prepend=0) > 0, axis=0)  # of the command, from 1
    steps = [settled & (number == command) for command in range(1, number.max(initial=0) + 1)]
    total = sum((np.abs(np.where(held, error, 0.0).sum(axis=0)) for held in steps), np.zeros(error.shape[1]))
    counts = settled.sum(axis=0)
    return np.where(counts > 0, total / np.maximum(counts, 1), np.nan)


def settled_steps(command: np.ndarray, settle_steps: int) -> np.ndarray:
    """Where a command [T, N] (NaN after the end) has held for more than `settle_steps`: [T, N] bool."""
    changed = np.ones(command.shape, bool)
    changed[1:] = command[1:] != command[:-1]
    steps = np.arange(len(command))[:, None]
    since = steps - np.maximum.accumulate(np.where(changed, steps, 0), axis=0)
    return (since >= settle_steps) & np.isfinite(command)


def mean_interval(values: np.ndarray) -> dict[str, float | None]:
    """Mean of the values that are numbers and its 95 % normal confidence interval; None without any."""
    values = values[np.isfinite(values)]
    if len(values) == 0:
        return {"mean": None, "low": None, "high": None}
    half = 1.96 * np.std(values, ddof=1) / np.sqrt(len(values)) if len(values) > 1 else 0.0
    mean = float(np.mean(values))
    return {"mean": mean, "low": mean - float(half), "high": mean + float(half)}


def share_interval(hits: np.ndarray) -> dict[str, float | None]:
    """Share of true values and its 95 % Wilson interval; None without values."""
    if len(hits) == 0:
        return {"mean": None, "low": None, "high": None}
    n, share, z = len(hits), float(np.mean(hits)), 1.96
    center = (share + z * z / (2 * n)) / (1 + z * z / n)
    half = z / (1 + z * z / n) * np.sqrt(share * (1 - share) / n + z * z / (4 * n * n))
    return {"mean": share, "low": max(0.0, float(center - half)), "high": min(1.0, float(center + half))}
