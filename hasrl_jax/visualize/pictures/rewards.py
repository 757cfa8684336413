"""What an episode earns: every weighted reward term over time, while the commanded speed changes."""

from typing import TYPE_CHECKING, Any

import numpy as np

from hasrl_jax.config.schema import Config
from hasrl_jax.envs.cassie import clock
from hasrl_jax.envs.cassie.rewards import SCORES, TERMS
from hasrl_jax.policy.numpy_networks import Parameters
from hasrl_jax.visualize.pictures.record import record

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SPEEDS_M_S = (0.0, 1.0, 0.5)
SECONDS_EACH = 4.0
LINE, FAINT, COMMAND = "#1f6f8b", "#a9c9d6", "#333333"


def draw(config: Config, parameters: Parameters, seed: int) -> "Figure":
    """Commanded and measured speed above, its terms in small panels below; thick lines average a gait cycle."""
    from matplotlib.figure import Figure

    recording = record(config, parameters, list(SPEEDS_M_S), SECONDS_EACH, seed)
    time_s, measures = recording.time_s, recording.measures
    cycle_s = clock.cycle_seconds(np.mean(SPEEDS_M_S), config.settings.clock, np)
    span = max(1, round(cycle_s / time_s[0]))
    shown = [name for name in TERMS if getattr(config.settings.reward, name)]
    rows: list[Any] = [list(shown[first : first + 2]) for first in range(0, len(shown), 2)]
    rows[-1] += ["."] * (2 - len(rows[-1]))  # an empty place beside the last of an odd number
    figure = Figure(figsize=(8.5, 1.6 + 1.2 * len(rows)), layout="constrained")
    panels = figure.subplot_mosaic([["speed", "speed"], *rows], sharex=True)
    speed = panels["speed"]
    speed.plot(time_s, measures["forward_command"], "--", color=COMMAND, linewidth=1.2, label="commanded")
    speed.plot(time_s, measures["forward_speed"], color=FAINT, linewidth=0.8, label="measured")
    speed.plot(time_s, smooth(measures["forward_speed"], span), color=LINE, label="mean over a gait cycle")
    speed.set_title("forward speed, m/s", loc="left", fontsize=9)
    speed.set_xlim(0, SECONDS_EACH * len(SPEEDS_M_S))
    speed.legend(fontsize=8, ncols=3, frameon=False, loc="lower right")
    for name in shown:
        panel, values = panels[name], recording.reward_terms[name]
        weight = config.settings.reward.scale * getattr(config.settings.reward, name)
        panel.plot(time_s, values, color=FAINT, linewidth=0.8)
        panel.plot(time_s, smooth(values, span), color=LINE)
        panel.axhline(weight, color=COMMAND, linewidth=0.8, linestyle=":")
        if name not in SCORES:  # these are not bounded by their weight
            panel.set_ylim(0, 1.1 * weight)
        panel.set_title(f"{name.replace('_', ' ')}: {values.mean():.3f}", loc="left", fontsize=9)
    for panel in panels.values():
        panel.tick_params(labelsize=8)
        panel.grid(alpha=0.3)
        panel.spines[["top", "right"]].set_visible(False)
        for change in SECONDS_EACH * np.arange(1, len(SPEEDS_M_S)):
            panel.axvline(change, color=COMMAND, linewidth=0.6, alpha=0.4)
    for name in shown[-2:]:
        panels[name].set_xlabel("time, s", fontsize=9)
    total = sum(values.mean() for values in recording.reward_terms.values())
    ending = f"; fell after {time_s[-1]:.1f} s" if recording.fell else ""
    note = f"weighted reward terms, their means (sum {total:.3f} per environment step) and weights (dotted)"
    figure.suptitle(note + ending, fontsize=10)
    return figure


def smooth(values: np.ndarray, span: int) -> np.ndarray:
    """Centred means over `span` steps; NaN where fewer are left, at both ends. [T] -> [T]"""
    means = np.full(len(values), np.nan)
    if len(values) >= span:
        first = (span - 1) // 2
        means[first : first + len(values) - span + 1] = np.convolve(values, np.ones(span) / span, "valid")
    return means
