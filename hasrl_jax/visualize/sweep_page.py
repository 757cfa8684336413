"""The result of a sweep as one HTML page."""

import base64
import html
import io
from typing import NamedTuple

from hasrl_jax.evaluate.palette import COLORS
from hasrl_jax.visualize.comparison import MISSING, document, table

PANELS_A_ROW = 4


class Trial(NamedTuple):
    """One trial of a sweep."""

    number: int
    state: str  # "complete", "pruned", "fail" or "running"
    value: float | None  # of the metric, at its end or where it was pruned
    settings: dict[str, float | int | str | bool]
    run: str  # its run directory


def page(metric: str, maximize: bool, trials: list[Trial]) -> str:
    """The page: the best trial, every setting against the metric, and all trials, best first."""
    finished = [trial for trial in trials if trial.state == "complete" and trial.value is not None]
    ranked = sorted(finished, key=lambda trial: trial.value or 0.0, reverse=maximize)
    others = [trial for trial in trials if trial not in ranked]
    names = list(dict.fromkeys(name for trial in trials for name in trial.settings))
    rows = [
        [
            str(trial.number),
            trial.state,
            MISSING if trial.value is None else f"{trial.value:.4g}",
            *(str(trial.settings.get(name, MISSING)) for name in names),
            trial.run,
        ]
        for trial in ranked + others
    ]
    parts = [f"<h1>Sweep for {'high' if maximize else 'low'} {html.escape(metric)}</h1>"]
    if ranked:
        best = ranked[0]
        options = " ".join(f"--{name.replace('_', '-')} {value}" for name, value in best.settings.items())
        parts.append(f"<p>Best of {len(finished)}: trial {best.number}, {best.value:.4g}: ")
        parts.append(f"<code>{html.escape(options)}</code></p>")
        parts.append(f'<img alt="settings" src="data:image/png;base64,{_picture(metric, names, finished)}">')
    parts.append(table(["trial", "state", metric, *names, "run"], rows))
    return document("Sweep", "".join(parts))


def _picture(metric: str, names: list[str], trials: list[Trial]) -> str:
    from matplotlib.figure import Figure

    columns = min(PANELS_A_ROW, len(names) + 1)
    rows = -(-(len(names) + 1) // columns)
    figure = Figure(figsize=(3.2 * columns, 2.8 * rows), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False).ravel()
    for axis, name in zip(axes, ["trial", *names], strict=False):
        shown = [trial for trial in trials if name == "trial" or name in trial.settings]
        values = [trial.number if name == "trial" else trial.settings[name] for trial in shown]
        numeric = all(isinstance(value, int | float) and not isinstance(value, bool) for value in values)
        axis.plot(
            values if numeric else [str(value) for value in values],
            [trial.value for trial in shown],
            "o",
            color=COLORS[0],
            markersize=4,
        )
        if numeric and name != "trial" and min(values) > 0 and max(values) > 20 * min(values):  # type: ignore[operator, type-var]
            axis.set_xscale("log")
        axis.set_xlabel(name, fontsize=8)
        axis.grid(alpha=0.3)
    axes[0].set_ylabel(metric, fontsize=8)
    for axis in axes[len(names) + 1 :]:
        axis.set_visible(False)
    drawn = io.BytesIO()
    figure.savefig(drawn, format="png", dpi=100)
    return base64.b64encode(drawn.getvalue()).decode()
