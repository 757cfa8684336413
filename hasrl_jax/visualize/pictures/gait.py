"""When each foot bears weight, against what the gait clock asks for, at several speeds."""

from typing import TYPE_CHECKING

import numpy as np

from hasrl_jax.config.schema import Config
from hasrl_jax.envs.cassie import clock
from hasrl_jax.evaluate.gait import contacts
from hasrl_jax.policy.numpy_networks import Parameters
from hasrl_jax.visualize.pictures.record import Recording, record

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SPEEDS_M_S = (0.0, 0.5, 1.0, 1.5, 2.0)
SETTLE_S = 4.0  # before the part that is shown
SHOWN_S = 2.0
SWING = -0.5  # the clock asks a foot to swing where its force clock is below
LEFT, RIGHT, CLOCK = "#1f6f8b", "#d97706", "#e5e0d5"


def draw(config: Config, parameters: Parameters, seed: int) -> "Figure":
    """One row per speed: contact bars of both feet over the clock's swing phases, and the ground forces."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.5, 6.8), layout="constrained")
    rows = figure.subplots(2 * len(SPEEDS_M_S), 1, sharex=True, height_ratios=[0.8, 1.0] * len(SPEEDS_M_S))
    for index, speed in enumerate(SPEEDS_M_S):
        recording = record(config, parameters, [speed], SETTLE_S + SHOWN_S + 1.0, seed)
        shown = window(recording)
        draw_contacts(rows[2 * index], recording, shown, config)
        draw_forces(rows[2 * index + 1], recording, shown)
        rows[2 * index].set_title(title(speed, recording, shown), loc="left", fontsize=9)
    highest = max(line.get_ydata().max(initial=0.0) for axes in rows[1::2] for line in axes.lines)
    for axes in rows[1::2]:
        axes.set(ylim=(0, 1.05 * highest), yticks=[0, 200, 400])
    rows[-1].set(xlabel="time, s", xlim=(0, SHOWN_S))
    legend(figure)
    return figure


def window(recording: Recording) -> slice:
    """The environment steps that are shown: SHOWN_S from the first start of a gait cycle after SETTLE_S."""
    phase, time_s = recording.measures["phase"], recording.time_s
    starts = np.flatnonzero((np.diff(phase, prepend=phase[:1]) < 0) & (time_s > SETTLE_S))
    if not len(starts):
        return slice(0, 0)
    first = int(starts[0])
    return slice(first, first + int(np.searchsorted(time_s - time_s[0], SHOWN_S)))


def stretches(contact: np.ndarray) -> list[tuple[int, int]]:
    """First and past-the-last index of every stretch in which a foot stands. `contact`: [T] bool."""
    on = np.concatenate([[False], contact, [False]])
    edges = np.flatnonzero(on[1:] != on[:-1]).tolist()
    return list(zip(edges[::2], edges[1::2], strict=True))


def draw_contacts(axes: "Axes", recording: Recording, shown: slice, config: Config) -> None:
    """Bars where a foot bears weight; behind them, shaded, where the clock asks it to swing."""
    measures = {name: values[shown] for name, values in recording.measures.items()}
    axes.set(yticks=[0, 1], yticklabels=["right", "left"], ylim=(-0.5, 1.5))
    axes.tick_params(labelsize=8, length=0)
    axes.spines[["top", "right", "bottom"]].set_visible(False)
    if not len(measures["phase"]):
        return
    step_s = recording.time_s[0]
    speed = measures["forward_command"][0]
    time_s = np.linspace(0, SHOWN_S, 2000)
    phase = np.mod(measures["phase"][0] + time_s / clock.cycle_seconds(speed, config.settings.clock, np), 1.0)
    asked = clock.force_clocks(phase, clock.swing_fraction(speed, config.settings.clock, np), np)
    for foot, (name, color, lane) in enumerate((("left_force", LEFT, 1), ("right_force", RIGHT, 0))):
        swings = asked[:, foot] < SWING
        axes.fill_between(time_s, lane - 0.5, lane + 0.5, where=swings.tolist(), color=CLOCK, linewidth=0)
        bars = [(start * step_s, (end - start) * step_s) for start, end in stretches(contacts(measures[name]))]
        axes.broken_barh(bars, (lane - 0.25, 0.5), color=color)


def draw_forces(axes: "Axes", recording: Recording, shown: slice) -> None:
    """The ground force of each foot."""
    force_n = [recording.measures[name][shown] for name in ("left_force", "right_force")]
    time_s = recording.time_s[0] * (np.arange(len(force_n[0])) + 0.5)  # a mean belongs to the middle of its step
    for values, color in zip(force_n, (LEFT, RIGHT), strict=True):
        axes.plot(time_s, values, color=color, linewidth=1.4)
    axes.tick_params(labelsize=8)
    axes.set_ylabel("N", fontsize=8)
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(axis="y", alpha=0.3)


def title(speed: float, recording: Recording, shown: slice) -> str:
    """Commanded and measured speed, and how much of the time both feet, or none, are on the ground."""
    if not len(recording.time_s[shown]):
        return f"commanded {speed:g} m/s: fell after {recording.time_s[-1]:.1f} s"
    measured = recording.measures["forward_speed"][shown].mean()
    left, right = (contacts(recording.measures[name][shown]) for name in ("left_force", "right_force"))
    both, none = 100 * (left & right).mean(), 100 * (~left & ~right).mean()
    return f"commanded {speed:g} m/s, walks {measured:.2f} m/s; both feet down {both:.0f} %, none {none:.0f} %"


def legend(figure: "Figure") -> None:
    """What the colours mean, above the rows."""
    from matplotlib.patches import Patch

    patches = [
        Patch(color=LEFT, label="left foot on the ground"),
        Patch(color=RIGHT, label="right foot on the ground"),
        Patch(color=CLOCK, label="the clock asks the foot to swing"),
    ]
    figure.legend(handles=patches, loc="outside upper center", ncols=3, fontsize=9, frameon=False)
