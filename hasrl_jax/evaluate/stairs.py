"""How policies get along with ground that they cannot see: `python -m hasrl_jax.evaluate --policy P --stairs DIR`.

A trial begins at rest on level ground, a random distance from the first edge, and succeeds when the pelvis is on the
far landing, or a few meters on, before the time is over and without a fall. C MuJoCo at 2 kHz, mean action.
Source: Siekmann et al. 2021, success against approach speed, 150 trials a point; the ranges of the ground are ours.
"""

import logging
import time
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hasrl_jax.config.convert import from_dict
from hasrl_jax.config.schema import Config
from hasrl_jax.envs.cassie import terrain
from hasrl_jax.envs.cassie.settings import RandomizeConfig
from hasrl_jax.envs.cpu_engine import EnvState
from hasrl_jax.envs.registry import make_task
from hasrl_jax.evaluate import report as reports
from hasrl_jax.evaluate.page import percent
from hasrl_jax.evaluate.palette import COLORS
from hasrl_jax.evaluate.rollout import run_episodes
from hasrl_jax.evaluate.scorecard import BATCH, NOTHING_DRAWN, PAPER_DRAWS, in_processes
from hasrl_jax.evaluate.statistics import share_interval
from hasrl_jax.policy.numpy_networks import Parameters

log = logging.getLogger("hasrl_jax")
REVISION = 1  # of what a trial is; counts made under another are not kept
SPEEDS_M_S = (0.25, 0.5, 0.75, 1.0, 1.25, 1.5)
RISES_M = (0.05, 0.1, 0.125, 0.15, 0.175, 0.2)
AT_RISE_M, AT_SPEED_M_S = 0.15, 0.75  # of the rows in which the other one varies
STAIRS: dict[str, Any] = {
    "kind": "steps",
    "step_depth_m": [0.24, 0.4],
    "step_noise_m": 0.01,
    "steps": [1, 8],
    "landing_m": [3.0, 3.0],
}
# Ground on which a trial ends `WALK_M` behind the first edge.
OTHERS: dict[str, dict[str, Any]] = {
    "level": {"kind": "steps", "step_height_m": [0.0, 0.0]},
    "slopes": {"kind": "slopes", "step_depth_m": [2.0, 4.0], "slope_deg": [-10.0, 10.0]},
    "rough": {"kind": "rough", "step_depth_m": [0.2, 0.6], "step_height_m": [-0.05, 0.05]},
    "step down": {"kind": "steps", "steps": [1, 1], "step_height_m": [-0.15, -0.15], "landing_m": [4.0, 4.0]},
}
WALK_M, ON_LANDING_M = 4.0, 0.5
FLAT_START_M, APPROACH_M, HEADING_RAD = 1.0, 1.5, 0.1
START_S, SLOWEST_SHARE = 5.0, 0.67  # of the commanded speed, at which a trial just takes its time
FALL = {"min_height_m": 0.5, "max_height_m": 3.0, "max_tilt_deg": 45.0}


class Row(NamedTuple):
    """One kind of trial."""

    ground: str  # "up" or "down" stairs, or one of `OTHERS`
    speed_m_s: float = AT_SPEED_M_S
    rise_m: float = AT_RISE_M  # of stairs
    randomized: bool = False

    @property
    def title(self) -> str:
        steps = f"{self.ground}, steps of {100 * self.rise_m:g} cm" if self.ground in ("up", "down") else self.ground
        return f"{steps}, {self.speed_m_s:g} m/s" + (", randomised" if self.randomized else "")


def rows() -> list[Row]:
    """All rows, each once."""
    ways = "up", "down"
    found = [Row(way, speed_m_s=speed) for way in ways for speed in SPEEDS_M_S]
    found += [Row(way, rise_m=rise) for way in ways for rise in RISES_M]
    found += [Row(way, randomized=True) for way in ways] + [Row(ground) for ground in OTHERS]
    return list(dict.fromkeys(found))


def row_config(trained: Config, row: Row) -> Config:
    """`trained` with the ground, the command and the ends of a row; what it observes, and its clock, stay."""
    if row.ground in OTHERS:
        ground, farthest = OTHERS[row.ground], WALK_M
    else:
        rise = row.rise_m if row.ground == "up" else -row.rise_m
        ground, farthest = STAIRS | {"step_height_m": [rise, rise]}, 8 * 0.4 + ON_LANDING_M
    drawn = NOTHING_DRAWN
    if row.randomized:
        drawn = NOTHING_DRAWN | {name: getattr(RandomizeConfig(), name) for name in PAPER_DRAWS}
    seconds = START_S + (FLAT_START_M + APPROACH_M + farthest) / (SLOWEST_SHARE * row.speed_m_s)
    height = trained.settings.reward.height_m
    cassie = {
        "command": {
            "forward_m_s": [row.speed_m_s] * 2,
            "lateral_m_s": [0.0, 0.0],
            "yaw_rate_rad_s": [0.0, 0.0],
            "height_m": [height, height],
            "start_heading_rad": HEADING_RAD,
            **dict.fromkeys(("stand_probability", "straight_probability", "alone_probability"), 0.0),
            "start_moving": 0.0,
            "resample_s": [0.0, 0.0],
        },
        "motor": {"torque_speed_curve": True},
        "randomize": {"enabled": row.randomized, "share": 1.0, **drawn},
        "push": {"force_n": [0.0, 0.0]},
        "terrain": {
            "step_noise_m": 0.0,
            **ground,
            "flat_start_m": FLAT_START_M,
            "approach_m": [0.0, APPROACH_M],
            "level_share": 0.0,
            "average_m": 0.3,
        },
        "termination": FALL,
    }
    steps = round(seconds / trained.physics.env_step_s)
    return from_dict({"cassie": cassie, "collect": {"max_episode_steps": steps}}, trained)


def arrived(row: Row, state: EnvState) -> np.ndarray:
    """Whether the robots are where a trial of `row` succeeds, [N] bool."""
    starts = state.task.terrain[:, terrain.START]
    if row.ground in OTHERS:
        end = starts[:, 1] + WALK_M
    else:
        # The landing is the first block that is longer than its neighbors.
        landing = 1 + np.argmax(np.diff(starts[:, 1:], axis=1) > STAIRS["landing_m"][0], axis=1)
        end = starts[np.arange(len(starts)), landing] + ON_LANDING_M
    return np.asarray(state.physics[:, 1] >= end)


def play(job: tuple[Row, Config, Parameters, int, list[int]]) -> np.ndarray:
    """Which trials of a part of a row succeed, [N] bool."""
    row, config, parameters, trials, seed = job
    seconds = config.collect.max_episode_steps * config.physics.env_step_s
    done = run_episodes(
        config, make_task(config), parameters, trials, seed, seconds=seconds, goal=partial(arrived, row)
    )
    return done.reached_goal


def write(
    directory: Path, policies: dict[str, tuple[Config, Parameters]], trials: int, seed: int, command: str
) -> None:
    """Measures every policy in every row; writes stairs.json, .md and .png after each row.

    Trials that stairs.json already counts of the same policies and seed are not played again: more can be added.

    Args:
      directory: made if missing.
      policies: by name: configuration, with the physics to play under, and parameters; all of the walking task.
      trials: of every row.
      seed: all policies meet the same ground.
      command: what to type for the same numbers, for the page.

    Raises:
      ConfigError: a policy of another task; OSError: the directory cannot be written.
    """
    reports.refuse_other_tasks(policies, "--stairs", "policies that walk can climb")
    directory.mkdir(parents=True, exist_ok=True)
    path = directory / "stairs.json"
    earlier = reports.read(path)
    physics_hz = 1 / next(iter(policies.values()))[0].physics.timestep_s
    report: dict[str, Any] = {"trials": trials, "seed": seed, "command": command, "physics_hz": physics_hz}
    report["policies"] = {}
    same = earlier.get("seed") == seed
    for name, (config, parameters) in policies.items():
        digest = _digest(config, parameters)
        known = earlier.get("policies", {}).get(name, {}) if same else {}
        fresh = {"digest": digest, "observe": config.settings.observe, "rows": []}
        report["policies"][name] = known if known.get("digest") == digest else fresh
    for name, (config, parameters) in policies.items():
        measured, started = report["policies"][name]["rows"], time.monotonic()
        played = [_played(row, trials) for row in measured] + [0] * (len(rows()) - len(measured))
        jobs = [
            (row, row_config(config, row), parameters, min(BATCH, trials - done), [seed, index, done])
            for index, row in enumerate(rows())
            for done in range(played[index], trials, BATCH)
        ]
        parts = in_processes(play, jobs)
        for index, row in enumerate(rows()):
            if played[index] == trials:
                continue
            successes = round(played[index] * measured[index]["success"]["mean"]) if played[index] else 0
            successes += sum(int(next(parts).sum()) for _ in range(played[index], trials, BATCH))
            success = share_interval(np.arange(trials) < successes)
            measured[index : index + 1] = [row._asdict() | {"title": row.title, "trials": trials, "success": success}]
            reports.write(report, path)
            write_page(report, directory)
            log.info("%s, %s: %s, %.0f s so far", name, row.title, percent(success), time.monotonic() - started)
    write_page(report, directory)


def _digest(config: Config, parameters: Parameters) -> str:
    """Tells policies apart, and what they are played under."""
    return reports.digest((row_config(config, row) for row in rows()), REVISION, parameters)


def _played(row: dict[str, Any], trials: int) -> int:
    """How many trials of a row need not be played again: all, or whole batches of fewer."""
    known: int = row["trials"]
    return known if known == trials or (known < trials and known % BATCH == 0) else 0


def write_page(report: dict[str, Any], directory: Path) -> None:
    """Writes stairs.md and stairs.png. `report`: as in stairs.json."""
    shares = {
        name: {
            Row(**{key: row[key] for key in Row._fields}): row["success"]
            for row in policy["rows"]
            if row["trials"] == report["trials"]
        }
        for name, policy in report["policies"].items()
    }
    lines = [
        "# Stairs\n",
        f"C MuJoCo at {report['physics_hz']:.0f} Hz, mean action, {report['trials']} trials a figure, seed "
        f"{report['seed']}. A trial starts at rest 1 to 2.5 m before the first edge, up to {HEADING_RAD:g} rad askew "
        "where the policy keeps a heading, and succeeds when the pelvis is 0.5 m beyond the last edge of one flight, "
        "or 4 m beyond the first edge of other ground, in time and without a fall: a pelvis below 0.5 m above the mean "
        "of the ground 0.3 m around it, or a tilt above 45°. Flights have 1 to 8 steps, 0.24 to 0.4 m deep, each off "
        "by up to 1 cm in height. Slopes are up to 10° steep, rough blocks up to 5 cm high or low, the step down is "
        "one of 15 cm. In brackets: 95 % Wilson intervals.\n",
        "Observations: "
        + ", ".join(f"{name}, {policy['observe']}" for name, policy in report["policies"].items())
        + ".\n",
        f"`{report['command']}`\n",
        "![Success by speed and by height of the steps](stairs.png)\n",
        "| trial | " + " | ".join(shares) + " |",
        "|---" * (len(shares) + 1) + "|",
    ]
    for row in rows():
        cells = [percent(found[row]) if row in found else "–" for found in shares.values()]
        lines.append(f"| {row.title} | " + " | ".join(cells) + " |")
    (directory / "stairs.md").write_text("\n".join(lines) + "\n", encoding="utf-8")
    plot(shares, directory / "stairs.png")


def plot(shares: dict[str, dict[Row, dict[str, Any]]], path: Path) -> None:
    """Four panels, success by speed and by height, up and down; a line with 95 % intervals for every policy."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 4, figsize=(13, 3.2), layout="constrained", sharey=True)
    panels = [(way, of_speed) for of_speed in (True, False) for way in ("up", "down")]
    for axis, (way, of_speed) in zip(axes, panels, strict=True):
        values = SPEEDS_M_S if of_speed else RISES_M
        for color, (name, found) in zip(COLORS * 9, shares.items(), strict=False):
            plain = Row(way)
            row_of = {v: plain._replace(speed_m_s=v) if of_speed else plain._replace(rise_m=v) for v in values}
            known = [(value, found[row]) for value, row in row_of.items() if row in found]
            mean = [100 * share["mean"] for _, share in known]
            low = [100 * (share["mean"] - share["low"]) for _, share in known]
            high = [100 * (share["high"] - share["mean"]) for _, share in known]
            scale = 1 if of_speed else 100
            x = [scale * value for value, _ in known]
            axis.errorbar(x, mean, yerr=(low, high), label=name, color=color, marker="o", markersize=3)
        fixed = f"steps of {100 * AT_RISE_M:g} cm" if of_speed else f"{AT_SPEED_M_S:g} m/s"
        axis.set_title(f"{way}, {fixed}", fontsize=10)
        axis.set_xlabel("commanded, m/s" if of_speed else "height of a step, cm")
        axis.set_ylim(-3, 103)
        axis.grid(alpha=0.3)
    axes[0].set_ylabel("success, %")
    axes[0].legend(fontsize=7)
    figure.savefig(path, dpi=110)
    plt.close(figure)
