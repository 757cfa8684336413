"""Figures of training runs on disk.

fig3   episode return in training and testing, mean ratio, entropy (paper Fig. 3)
fig4   mean ratio and episode return of several runs, named by what differs in them (paper Fig. 4)
curve  episode length and return against environment steps and against time
"""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hasrl_jax.config.convert import flat, to_dict
from hasrl_jax.config.schema import Config
from hasrl_jax.errors import RunError
from hasrl_jax.evaluate.palette import COLORS
from hasrl_jax.runs.directory import METRICS_FILE

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

RENAMED = {"episode_return_test": "eval_return", "episode_length_test": "eval_length"}  # since version 0.1
Series = dict[str, np.ndarray]
SMOOTHED = 9  # iterations in the moving mean that is drawn over the raw values of fig4


def read_metrics(run_dir: Path) -> Series:
    """Every metric of a run by name, [iterations]; NaN where an iteration has none.

    Raises:
      RunError: the file is missing, damaged or empty.
    """
    path = run_dir / METRICS_FILE
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
        records = [json.loads(line) for line in lines]
    except OSError as error:
        raise RunError(f"{path}: cannot be read ({error.strerror})") from None
    except ValueError as error:
        raise RunError(f"{path}: damaged ({error})") from None
    if not records:
        raise RunError(f"{path}: holds no iteration yet")
    records = [{RENAMED.get(name, name): value for name, value in record.items()} for record in records]
    names = {name for record in records for name, value in record.items() if isinstance(value, int | float | None)}
    return {name: np.array([_number(record.get(name)) for record in records]) for name in sorted(names)}


def _number(value: Any) -> float:
    return float("nan") if value is None else float(value)


def differences(configs: list[Config]) -> list[str]:
    """What tells runs apart, "policy_learning_rate 0.0006": one text per run, empty where nothing does."""
    leaves = [flat(to_dict(config)) for config in configs]
    ignored = ("run_dir", "total_env_steps", "evaluate.", "checkpoint.", "seed")
    names = [n for n in leaves[0] if not n.startswith(ignored) and len({repr(values[n]) for values in leaves}) > 1]
    return [", ".join(f"{name.rpartition('.')[2]} {values[name]}" for name in names) for values in leaves]


def fig3(runs: list[Series], names: list[str]) -> "Figure":
    """Paper Fig. 3 of one run."""
    figure, axes = _axes(3)
    run, x = runs[0], runs[0]["iteration"]
    axes[0].plot(x, run["episode_return_train"], color=COLORS[0], linewidth=0.8, label="training")
    if "eval_return" in run:
        evaluated = np.isfinite(run["eval_return"])
        axes[0].plot(x[evaluated], run["eval_return"][evaluated], color=COLORS[1], linewidth=1, label="evaluation")
    axes[0].legend(fontsize=7)
    _label(axes[0], "(a) episode return", "iteration")
    axes[1].plot(x, run["ratio_mean"], color=COLORS[0], linewidth=0.8)
    _label(axes[1], "(b) mean ratio", "iteration")
    axes[2].plot(x, run["entropy"], color=COLORS[0], linewidth=1)
    _label(axes[2], "(c) entropy", "iteration")
    return figure


def fig4(runs: list[Series], names: list[str]) -> "Figure":
    """Paper Fig. 4: one line per run."""
    figure, axes = _axes(2)
    for color, run, name in zip(COLORS, runs, names, strict=False):
        for axis, metric in zip(axes, ("ratio_mean", "episode_return_train"), strict=True):
            axis.plot(run["iteration"], run[metric], color=color, linewidth=0.4, alpha=0.4)
            axis.plot(run["iteration"], moving_mean(run[metric]), color=color, linewidth=1.2, label=name)
    axes[0].axhline(1.0, color="grey", linewidth=0.6)
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=2, fontsize=7)
    _label(axes[0], "(a) mean ratio", "iteration")
    _label(axes[1], "(b) episode return in training", "iteration")
    return figure


def curve(runs: list[Series], names: list[str]) -> "Figure":
    """Episode length and return of every run against environment steps and time."""
    figure, axes = _axes(4)
    for color, run, name in zip(COLORS, runs, names, strict=False):
        seconds = run.get("train_seconds", np.nancumsum(run["collect_seconds"] + run["update_seconds"]))
        xs = (run["env_steps"] / 1e6, seconds / 60)
        for axis, (metric, x) in zip(axes, ((m, x) for m in ("length", "return") for x in xs), strict=True):
            axis.plot(x, moving_mean(run[f"episode_{metric}_train"]), color=color, linewidth=1, label=name)
    for axis, unit in zip(axes, ("million environment steps", "minutes of training") * 2, strict=True):
        _label(axis, "episode length" if axis in axes[:2] else "episode return", unit)
    if any(names):
        axes[0].legend(fontsize=7)
    return figure


def moving_mean(values: np.ndarray, width: int = SMOOTHED) -> np.ndarray:
    """Mean of the last `width` values that are numbers, [N] -> [N]; NaN until there is one."""
    windows = np.lib.stride_tricks.sliding_window_view(np.pad(values, (width - 1, 0), constant_values=np.nan), width)
    counts = np.isfinite(windows).sum(axis=1)
    return np.where(counts > 0, np.nansum(windows, axis=1) / np.maximum(counts, 1), np.nan)


FIGURES = {"fig3": fig3, "fig4": fig4, "curve": curve}


def _axes(number: int) -> tuple["Figure", list["Axes"]]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(3.4 * number, 3.0), layout="constrained")
    return figure, list(figure.subplots(1, number, squeeze=False)[0])


def _label(axis: "Axes", title: str, x: str) -> None:
    axis.set_title(title, fontsize=10)
    axis.set_xlabel(x)
    axis.grid(alpha=0.3)
