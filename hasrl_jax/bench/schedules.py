"""`bench schedules`: how fast each schedule learns, and how much of an iteration it hides behind the other half.

Learning curves are runs of the real training loop. The second table puts a sleep in place of the update: it leaves the
cores to the workers, as a learner on an accelerator does, so an iteration should take max(collect, update) instead of
their sum.
"""

import argparse
import contextlib
import io
import json
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from hasrl_jax.bench.report import claim_file, format_table
from hasrl_jax.config.checks import check
from hasrl_jax.config.convert import from_dict
from hasrl_jax.config.files import CONFIG_FOLDER, load_yaml
from hasrl_jax.config.schema import Config
from hasrl_jax.errors import ConfigError
from hasrl_jax.learn import ppo
from hasrl_jax.runs.directory import METRICS_FILE
from hasrl_jax.train.loop import train

SCHEDULES = ("sync", "overlap", "decoupled")
Curve = list[dict[str, Any]]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the schedules benchmark."""
    config = CONFIG_FOLDER / "cartpole.yaml"
    parser.add_argument("--config", type=Path, default=config, metavar="FILE", help="what is trained")
    parser.add_argument("--seeds", type=int, default=5, metavar="N", help="runs of each schedule")
    parser.add_argument("--total-env-steps", type=int, default=120_000, metavar="N", help="of a run")
    parser.add_argument("--env-steps-per-iteration", type=int, default=4096, metavar="N", help="small: more iterations")
    parser.add_argument("--unroll-length", type=int, default=32, metavar="T", help="environment steps per trajectory")
    parser.add_argument("--target", type=float, default=100.0, metavar="R", help="episode return to reach")
    parser.add_argument("--iterations", type=int, default=10, metavar="N", help="per row of the second table")
    parser.add_argument(
        "--update-shares", type=float, nargs="+", default=[0.5, 1.0, 2.0], metavar="X", help="sleeps / collections"
    )
    parser.add_argument("--plot", type=Path, metavar="FILE.png", help="where to draw the learning curves")


def measure(arguments: argparse.Namespace) -> dict:
    """The second table first, as it also starts every program; then the seeds, schedules in turn.

    Raises:
      ConfigError: an impossible argument.
    """
    for name, least in {"seeds": arguments.seeds, "iterations": arguments.iterations}.items():
        if least < 1:
            raise ConfigError(f"--{name}: got {least}; expected at least 1")
    if min(arguments.update_shares) < 0:
        raise ConfigError(f"--update-shares: got {min(arguments.update_shares)}; expected at least 0")
    config = make_config(arguments)
    if arguments.plot:
        claim_file(arguments.plot)
    programs = {schedule: Program() for schedule in SCHEDULES}
    hidden = measure_hiding(config, arguments.iterations, arguments.update_shares)
    for schedule in SCHEDULES:  # compiles
        run(config, programs[schedule], schedule=schedule, total_env_steps=1)
    runs = []
    for seed in range(arguments.seeds):
        for schedule in SCHEDULES:
            curve = run(config, programs[schedule], schedule=schedule, seed=seed)
            runs.append({"schedule": schedule, "seed": seed, **summary(curve, arguments.target), "curve": curve})
    figures = {"config": arguments.config.name, "target": arguments.target, "hiding": hidden, "runs": runs}
    if arguments.plot:
        plot(figures, arguments.plot)
    return figures


def make_config(arguments: argparse.Namespace) -> Config:
    """The configuration without evaluations and saves on the way."""
    config: Config = load_yaml(arguments.config)
    names = "env_steps_per_iteration", "unroll_length"
    changes = {
        "total_env_steps": arguments.total_env_steps,
        "collect": {name: getattr(arguments, name) for name in names},
        "evaluate": {"every_iterations": 0},
        "checkpoint": {"every_iterations": 0, "keep": 1},
    }
    config = from_dict(changes, config)
    check(config)
    return config


class Program:
    """Makes the update of the first run, and gives it to the others of the same sizes."""

    def __init__(self) -> None:
        self.update: ppo.Update | None = None

    def __call__(self, *arguments: Any) -> ppo.Update:
        self.update = self.update or ppo.make_update(*arguments)
        return self.update


class Sleep:
    """Takes the place of an update that needs no core of this machine."""

    def __init__(self, seconds: float):
        self.seconds = seconds

    def __call__(self, learner: ppo.LearnerState, *_: Any) -> tuple[ppo.LearnerState, dict[str, float]]:
        time.sleep(self.seconds)
        return learner, {"parameters_finite": 1.0}


def run(config: Config, make_update: Callable[..., Any], **changes: Any) -> Curve:
    """`read_run` with some settings changed.

    Raises:
      KeyboardInterrupt: the run was asked to stop.
    """
    config = from_dict(changes, config)
    records = read_run(config, make_update)
    if records[-1]["env_steps"] < config.total_env_steps:
        raise KeyboardInterrupt
    return records


def read_run(config: Config, make_update: Callable[..., Any]) -> Curve:
    """Trains in a directory that is thrown away; returns the records of its metrics file.

    Raises:
      KeyboardInterrupt: the run was asked to stop in its first iteration.
    """
    with tempfile.TemporaryDirectory() as directory:
        with contextlib.redirect_stdout(io.StringIO()):
            train(from_dict({"run_dir": directory}, config), make_update=make_update)
        lines = (Path(directory) / METRICS_FILE).read_text(encoding="utf-8").splitlines()
    if not lines:
        raise KeyboardInterrupt
    return [json.loads(line) for line in lines]


def measure_hiding(config: Config, iterations: int, update_shares: list[float]) -> list[dict]:
    """Seconds per iteration with an update that sleeps for so many times a collection; medians without a warm-up."""
    total = (iterations + 2) * config.collect.env_steps_per_iteration

    def seconds(schedule: str, update_seconds: float) -> float:
        records = run(config, lambda *_: Sleep(update_seconds), schedule=schedule, total_env_steps=total)
        return statistics.median(np.diff([record["train_seconds"] for record in records])[1:].tolist())

    cells = []
    for share in update_shares:
        collect = seconds("sync", 0.0)  # again each time, as other work on the machine comes and goes
        for schedule in SCHEDULES:
            update, found = share * collect, seconds(schedule, share * collect)
            ideal = collect + update if schedule == "sync" else max(collect, update)
            cell = {"schedule": schedule, "collect_seconds": collect, "update_seconds": update}
            cells.append(cell | {"iteration_seconds": found, "ideal_seconds": ideal, "excess": found / ideal - 1})
    return cells


def summary(curve: Curve, target: float) -> dict[str, float | None]:
    """When a run first reached the target, and how it ended; None for what never happened."""
    reached = next((record for record in curve if (record["episode_return_train"] or 0.0) >= target), None)
    return {
        "env_steps_to_target": reached["env_steps"] if reached else None,
        "seconds_to_target": reached["train_seconds"] if reached else None,
        "return_at_end": curve[-1]["eval_return"],
        "seconds": curve[-1]["train_seconds"],
        "policy_lag": statistics.mean(record["policy_lag"] for record in curve),
        "policy_lag_max": max(record["policy_lag_max"] for record in curve),
        "dropped_stale": sum(record.get("dropped_stale") or 0 for record in curve),
    }


def tables(figures: dict) -> str:
    """Learning by schedule, mean ± standard deviation over seeds; then what is hidden."""

    def spread(schedule: str, name: str) -> str:
        values = [run[name] for run in figures["runs"] if run["schedule"] == schedule and run[name] is not None]
        if not values:
            return "-"
        deviation = statistics.stdev(values) if len(values) > 1 else 0.0
        return f"{statistics.mean(values):,.4g} ± {deviation:,.2g}"

    target = f"return {figures['target']:g}"
    names = ["env_steps_to_target", "seconds_to_target", "return_at_end", "seconds", "policy_lag"]
    headers = [
        f"env steps to {target}",
        f"seconds to {target}",
        "evaluation return at the end",
        "seconds",
        "policy lag",
    ]
    rows = []
    for schedule in SCHEDULES:
        runs = [run for run in figures["runs"] if run["schedule"] == schedule]
        reached = sum(run["env_steps_to_target"] is not None for run in runs)
        rows.append([schedule, f"{reached} of {len(runs)}", *(spread(schedule, name) for name in names)])
    learning = format_table(["schedule", "reached", *headers], rows)
    columns = ["collect_seconds", "update_seconds", "ideal_seconds", "iteration_seconds", "excess"]
    hiding = format_table(
        ["schedule", "collect s", "update s (asleep)", "ideal s", "iteration s", "excess"],
        [[cell["schedule"], *(cell[column] for column in columns)] for cell in figures["hiding"]],
    )
    return f"{figures['config']}, mean ± standard deviation over seeds\n\n{learning}\n\n{hiding}"


def plot(figures: dict, out: Path) -> None:
    """Draws the learning curves over environment steps and over seconds: mean, and a band of one standard deviation.

    A run that has ended keeps its last return, so that slower ones can be drawn to their end.
    """
    from matplotlib.figure import Figure

    drawing = Figure(figsize=(9, 3.4), layout="constrained")
    axes = drawing.subplots(1, 2, sharey=True)
    for axis, name, label in zip(axes, ("env_steps", "train_seconds"), ("environment steps", "seconds"), strict=True):
        for schedule in SCHEDULES:
            curves = [run["curve"] for run in figures["runs"] if run["schedule"] == schedule]
            known = [[record for record in curve if record["episode_return_train"] is not None] for curve in curves]
            places = [[record[name] for record in curve] for curve in known]
            heights = [[record["episode_return_train"] for record in curve] for curve in known]
            grid = np.linspace(max(place[0] for place in places), max(place[-1] for place in places), 100)
            returns = [np.interp(grid, x, y) for x, y in zip(places, heights, strict=True)]
            mean, deviation = np.mean(returns, axis=0), np.std(returns, axis=0)
            axis.plot(grid, mean, label=schedule)
            axis.fill_between(grid, mean - deviation, mean + deviation, alpha=0.2)
        axis.set_xlabel(label)
        axis.grid(alpha=0.3)
    axes[0].set_ylabel("training episode return")
    axes[0].legend()
    drawing.savefig(out, format="png", dpi=80)
