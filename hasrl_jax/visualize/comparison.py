"""Several runs side by side as one HTML page: curves, what differs in their configurations, their scorecards."""

import base64
import html
import io
import json
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hasrl_jax.config.convert import flat, to_dict
from hasrl_jax.config.schema import Config
from hasrl_jax.errors import RunError
from hasrl_jax.evaluate.palette import COLORS
from hasrl_jax.runs.directory import load_run_config
from hasrl_jax.visualize import curves

SCORECARD = Path("scorecard", "scorecard.json")  # inside a run directory
PANELS = (  # metric, title
    ("episode_return_train", "episode return"),
    ("episode_length_train", "episode length, steps"),
    ("eval_return", "return of evaluation episodes"),
    ("entropy", "entropy"),
    ("approx_kl", "KL of the update"),
    ("env_steps_per_second", "environment steps per second"),
)
LAST = (*(metric for metric, _ in PANELS), "env_steps", "train_seconds")  # shown as numbers, too
SCORES = (("share_up", "up to the end, %", 100.0), ("forward_speed_error", "speed error, m/s", 1.0))
STYLE = (
    ":root{color-scheme:light dark}body{font:14px/1.4 sans-serif;margin:2em auto;padding:0 1em;max-width:80em}"
    "table{display:block;overflow-x:auto;border-collapse:collapse;margin:.5em 0 1.5em}"
    "td,th{padding:.2em .7em;border-bottom:1px solid #8886;text-align:right}th:first-child,td:first-child"
    "{text-align:left}img{max-width:100%}code{background:#8883}"
)
MISSING = "–"


class RunData(NamedTuple):
    """What is compared of a run."""

    path: Path
    config: Config
    metrics: curves.Series
    scores: dict[str, dict[str, Any]]  # row's title -> row of its scorecard; empty without one


def load(path: Path) -> RunData:
    """One run.

    Raises:
      RunError: not a run, or one of its files is damaged.
    """
    return RunData(path, load_run_config(path), curves.read_metrics(path), load_scores(path))


def load_scores(path: Path) -> dict[str, dict[str, Any]]:
    """The rows of the scorecard of a run's policy by title, those of the randomised robot marked.

    Raises:
      RunError: the file is damaged.
    """
    file = path / SCORECARD
    if not file.is_file():
        return {}
    try:
        rows = next(iter(json.loads(file.read_text(encoding="utf-8"))["policies"].values()))
        return {row["title"] + (", randomised" if row["randomized"] else ""): row for row in rows}
    except (OSError, ValueError, KeyError, TypeError, AttributeError, StopIteration) as error:
        raise RunError(f"{file}: damaged ({error})") from None


def page(runs: list[RunData]) -> str:
    """The page as HTML with nothing outside it."""
    names = [str(run.path) for run in runs]
    sections = [
        ("Curves", f'<img alt="curves" src="data:image/png;base64,{_encoded(runs)}">'),
        ("Last values", table(["", *names], last_values(runs))),
        ("What differs", table(["setting", *names], setting_rows(runs)) or "<p>Nothing.</p>"),
    ]
    scores = score_rows(runs)
    if scores:
        sections.append(("Scorecards", table(["commanded", *names], scores)))
    else:
        hint = f"hasrl evaluate --run-dir {names[0]} --scorecard {names[0]}/{SCORECARD.parent}"
        sections.append(("Scorecards", f"<p>None yet: <code>{html.escape(hint)}</code></p>"))
    body = "".join(f"<h2>{title}</h2>{content}" for title, content in sections)
    title = html.escape(" · ".join(path.name for path in (run.path for run in runs)))
    return document(title, f"<h1>{title}</h1>{body}")


def document(title: str, body: str) -> str:
    """A page of HTML that needs nothing outside it, for narrow windows too."""
    head = '<meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">'
    return f'<!doctype html><html lang="en">{head}<title>{title}</title><style>{STYLE}</style>{body}</html>\n'


def table(heading: list[str], rows: list[list[str]]) -> str:
    """An HTML table; empty without rows."""
    if not rows:
        return ""

    def line(cells: list[str], tag: str) -> str:
        return "<tr>" + "".join(f"<{tag}>{html.escape(cell)}</{tag}>" for cell in cells) + "</tr>"

    return "<table>" + line(heading, "th") + "".join(line(row, "td") for row in rows) + "</table>"


def last_values(runs: list[RunData]) -> list[list[str]]:
    """The newest value that each run has of each of LAST."""
    rows = []
    for metric in LAST:
        finite = [run.metrics.get(metric, np.empty(0)) for run in runs]
        finite = [values[np.isfinite(values)] for values in finite]
        if any(len(values) for values in finite):
            rows.append([metric, *(f"{values[-1]:,.4g}" if len(values) else MISSING for values in finite)])
    return rows


def setting_rows(runs: list[RunData]) -> list[list[str]]:
    """Every setting that not all runs have alike."""
    leaves = [flat(to_dict(run.config)) for run in runs]
    names = dict.fromkeys(name for values in leaves for name in values)
    differs = [n for n in names if n != "run_dir" and len({repr(values.get(n, MISSING)) for values in leaves}) > 1]
    return [[name, *(str(values.get(name, MISSING)) for values in leaves)] for name in differs]


def score_rows(runs: list[RunData]) -> list[list[str]]:
    """Each row of the scorecards: one line for each of SCORES."""
    rows = []
    for title in dict.fromkeys(title for run in runs for title in run.scores):
        for key, label, scale in SCORES:
            values = [(run.scores.get(title, {}).get(key) or {}).get("mean") for run in runs]
            if any(value is not None for value in values):
                shown = [MISSING if value is None else f"{scale * value:.3g}" for value in values]
                rows.append([f"{title}: {label}", *shown])
    return rows


def _encoded(runs: list[RunData]) -> str:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13, 6.5), layout="constrained")
    for axis, (metric, title) in zip(figure.subplots(2, 3).ravel(), PANELS, strict=True):
        for color, run in zip(COLORS, runs, strict=False):
            values, x = run.metrics.get(metric, np.full(1, np.nan)), run.metrics["env_steps"] / 1e6
            known = np.isfinite(values)
            if not known.any():
                continue
            axis.plot(x[known], values[known], color=color, linewidth=0.5, alpha=0.4)
            axis.plot(x[known], curves.moving_mean(values[known]), color=color, linewidth=1.4, label=run.path.name)
        axis.set_title(title, fontsize=10)
        axis.set_xlabel("million environment steps", fontsize=8)
        axis.grid(alpha=0.3)
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=4)
    drawn = io.BytesIO()
    figure.savefig(drawn, format="png", dpi=110)
    return base64.b64encode(drawn.getvalue()).decode()
