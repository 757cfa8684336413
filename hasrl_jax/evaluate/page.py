"""The scorecard as a page: tables in Markdown and one picture."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from hasrl_jax.evaluate.palette import COLORS

Rows = list[dict[str, Any]]

# heading, key, how to write a value
Column = tuple[str, str, Callable[[Any], str]]


def percent(value: dict[str, Any]) -> str:
    """A share with its interval."""
    if value["mean"] is None:
        return "–"
    return f"{100 * value['mean']:.0f} % ({100 * value['low']:.0f}–{100 * value['high']:.0f})"


def number(digits: int) -> Callable[[dict[str, Any]], str]:
    """A mean with half the width of its interval."""

    def written(value: dict[str, Any]) -> str:
        if value["mean"] is None:
            return "–"
        return f"{value['mean']:.{digits}f} ± {value['high'] - value['mean']:.{digits}f}"

    return written


UP_20_S: Column = ("up 20 s", "share_up_20_s", percent)
UP: Column = ("up to the end", "share_up", percent)
LIMIT: Column = ("time limit", "cap_seconds", lambda value: f"{value:g} s")
SECONDS: Column = ("seconds upright", "seconds", number(1))
SPEED: Column = ("speed, m/s", "forward_speed", number(2))
SPEED_ERROR: Column = ("speed error, m/s", "forward_speed_error", number(3))
LATERAL_ERROR: Column = ("lateral error, m/s", "lateral_speed_error", number(3))
DRIFT: Column = ("heading drift, °", "heading_drift_deg", number(0))

ON_MODEL: tuple[Column, ...] = (UP, LIMIT, SECONDS, SPEED, SPEED_ERROR, LATERAL_ERROR)
SURVIVAL: tuple[Column, ...] = (UP_20_S, *ON_MODEL, DRIFT)
SHORT: tuple[Column, ...] = (SECONDS, UP_20_S, SPEED, SPEED_ERROR)
STEERING: tuple[Column, ...] = (
    UP_20_S,
    UP,
    LIMIT,
    SPEED_ERROR,
    LATERAL_ERROR,
    ("yaw rate, rad/s", "yaw_rate", number(2)),
    ("yaw rate error, rad/s", "yaw_rate_error", number(3)),
    ("height, m", "height", number(2)),
    ("height error, m", "height_error", number(3)),
)
GAIT: tuple[Column, ...] = (
    ("steps per second", "step_frequency_hz", number(2)),
    ("duty factor", "duty_factor", number(2)),
    ("difference of the feet", "duty_asymmetry", number(3)),
    ("right foot in the left's cycle", "phase_offset", number(2)),
    ("cost of transport", "cost_of_transport", number(2)),
    ("motor power, W", "motor_power", number(0)),
    ("on the toe, s a step", "trailing_toe_s", number(3)),
)


def table(rows: Rows, columns: tuple[Column, ...]) -> str:
    """A Markdown table with one line per row, empty without rows; columns that no row has are left out."""
    if not rows:
        return ""
    shown = [column for column in columns if any(column[1] in row for row in rows)]
    lines = ["| commanded | " + " | ".join(heading for heading, _, _ in shown) + " |", "|---" * (len(shown) + 1) + "|"]
    for row in rows:
        cells = (write(row[key]) if key in row else "–" for _, key, write in shown)
        lines.append(f"| {row['title']} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def select(rows: Rows, *kinds: str, randomized: bool = False) -> Rows:
    """The rows of some kinds."""
    return [row for row in rows if row["kind"] in kinds and row["randomized"] == randomized]


def write_page(report: dict[str, Any], directory: Path) -> None:
    """Writes scorecard.md and scorecard.png. `report`: as in scorecard.json."""
    (policy, rows), *others = report["policies"].items()
    cap_s = report["seconds"]
    survival = ("speed", "lateral", "changing")
    steering = ("steering", "turn", "sidestep", "height")
    steered = select(rows, *steering) + select(rows, *steering, randomized=True)
    sections = (
        ("The nominal robot", "", table(select(rows, *survival), SURVIVAL)),
        ("Dynamics randomisation, the paper's ranges", "", table(select(rows, *survival, randomized=True), SURVIVAL)),
        (
            "Gait of the nominal robot",
            "Contacts are seen once per environment step (25 ms), which makes the duty factor read up to 0.03 high; a "
            "step is a landing after 0.1 s or more in the air. The cost of transport is the mean sum of |torque × "
            "velocity| of the motors over weight × speed. A foot is on its toe while it bears more than 20 N with its "
            "heel 1.6 cm or more above it.\n",
            table(select(rows, "speed"), GAIT),
        ),
        (
            "Pushes",
            "A horizontal force on the pelvis for 0.2 s, in a random direction at a random moment of the gait, 6 to "
            "7 s after the start; survived when the robot is up 5 s later.\n",
            push_table(select(rows, "push")),
        ),
        (
            "Disturbances",
            "One at a time, the robot nominal in all else; no policy was trained for all of them.\n",
            table(select(rows, "disturbance"), SURVIVAL),
        ),
        (
            "Steering",
            "Commands of all dimensions change together every 2 to 6 s, or one is held. The rows of changing commands "
            "come first with the nominal robot; the last ones are randomised.\n",
            table(steered, STEERING),
        ),
    )
    parts = [
        f"# Scorecard: {policy}\n",
        f"C MuJoCo at {report['physics_hz']:.0f} Hz, mean action, {report['episodes']} episodes a row, seed "
        f"{report['seed']}, at most {cap_s:g} s each, from rest. A fall is a pelvis below 0.6 m or a tilt above 45°. "
        "Motors have a torque-speed curve. In brackets and after ±: 95 % intervals.\n",
        "A speed error is a time-weighted mean absolute error: that of the "
        "mean speed under a command, from 3 s after it was given, averaged over the commands by the time under each.\n",
        f"`{report['command']}`\n",
        "![Share that stays up, speed, pushes and gait](scorecard.png)\n",
    ]
    for heading, text, figures in sections:
        if figures:
            parts += [f"## {heading}\n", *filter(None, [text]), figures]
    if report.get("models"):
        parts += [
            "## On other models of the robot\n",
            "The nominal robot of other MJCF files with our PD loop and sensors put in; docs/deploy.md says how they "
            "differ.\n",
        ]
    for label, found in report.get("models", {}).items():
        walking = table(select(found["rows"], *survival), ON_MODEL)
        count = found["rows"][0]["episodes"]
        parts += [f"### {label}\n", f"{count} episodes a row: `{found['command']}`\n", walking]
        parts += [f"Pushed as above:\n\n{push_table(select(found['rows'], 'push'))}"]
    if others:
        parts += ["## The same for others\n", "The nominal robot; they are played under their own gait clock.\n"]
    for name, theirs in others:
        parts += [f"### {name}\n", table(select(theirs, "speed"), SHORT)]
    (directory / "scorecard.md").write_text("\n".join(parts), encoding="utf-8")
    plot(policy, report["policies"], directory / "scorecard.png")


def push_table(rows: Rows) -> str:
    """Share that survives, by force and speed; empty without rows."""
    if not rows:
        return ""
    forces, speeds = sorted({row["push_n"] for row in rows}), sorted({row["forward_m_s"][0] for row in rows})
    lines = ["| commanded | " + " | ".join(f"{force:g} N" for force in forces) + " |", "|---" * (len(forces) + 1) + "|"]
    share = {(row["forward_m_s"][0], row["push_n"]): percent(row["share_up"]) for row in rows}
    lines += [f"| {v:g} m/s | " + " | ".join(share.get((v, force), "–") for force in forces) + " |" for v in speeds]
    return "\n".join(lines) + "\n"


def plot(policy: str, policies: dict[str, Rows], path: Path) -> None:
    """Four panels: survival by speed, speed by command, survival by push, gait by speed."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    rows = policies[policy]
    walking = select(rows, "speed")
    commanded = [row["forward_m_s"][0] for row in walking]
    figure, axes = plt.subplots(1, 4, figsize=(13, 3.2), layout="constrained")
    for color, randomized in zip(COLORS, (False, True), strict=False):
        chosen = select(rows, "speed", randomized=randomized)
        label = "randomised" if randomized else "nominal"
        _curve(axes[0], chosen, "share_up", label, color, scale=100)
        _curve(axes[1], chosen, "forward_speed", label, color)
    for color, (name, theirs) in zip(COLORS[2:] * 9, list(policies.items())[1:], strict=False):
        _curve(axes[0], select(theirs, "speed"), "share_up", name, color, scale=100)
    axes[1].plot(commanded, commanded, color="grey", linewidth=0.8, linestyle="--", label="as commanded")
    pushes = select(rows, "push")
    for color, speed in zip(COLORS, sorted({row["forward_m_s"][0] for row in pushes}), strict=False):
        chosen = [row for row in pushes if row["forward_m_s"][0] == speed]
        _curve(axes[2], chosen, "share_up", f"{speed:g} m/s", color, scale=100)
    _curve(axes[3], walking, "step_frequency_hz", "steps per second", COLORS[0])
    _curve(axes[3], walking, "duty_factor", "duty factor", COLORS[1])
    _curve(axes[3], walking, "cost_of_transport", "cost of transport", COLORS[2])
    titles = (
        (f"stays up {walking[0]['cap_seconds']:g} s, %" if walking else "stays up, %", "commanded, m/s"),
        ("speed, m/s", "commanded, m/s"),
        ("survives a push of 0.2 s, %", "force, N"),
        ("gait", "commanded, m/s"),
    )
    for axis, (title, x) in zip(axes, titles, strict=True):
        axis.set_title(title, fontsize=10)
        axis.set_xlabel(x)
        axis.grid(alpha=0.3)
        if axis.lines:
            axis.legend(fontsize=7)
    for axis in (axes[0], axes[2]):
        axis.set_ylim(-3, 103)
    axes[3].set_ylim(bottom=0)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _curve(axis: Any, rows: Rows, key: str, label: str, color: str, scale: float = 1.0) -> None:
    """A line with its 95 % intervals over the commanded speed or the push, through the rows that have a value."""
    points = [row for row in rows if row[key]["mean"] is not None]
    if not points:
        return
    x = [row["push_n"] if row["kind"] == "push" else row["forward_m_s"][0] for row in points]
    values = [row[key] for row in points]
    mean = [scale * v["mean"] for v in values]
    low = [max(0.0, scale * (v["mean"] - v["low"])) for v in values]
    high = [max(0.0, scale * (v["high"] - v["mean"])) for v in values]
    axis.errorbar(x, mean, yerr=(low, high), label=label, color=color, marker="o", markersize=3)
