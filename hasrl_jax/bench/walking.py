"""`bench walking`: how many seconds each schedule needs until the robot walks.

The learner runs on one core and the workers on the others, so that neither takes the other's time, and a real update
is what is hidden behind the collection. Runs take turns, schedule by schedule and seed by seed. Every few iterations a
copy of the policy is put aside; only when the run is over are the copies played, one after the other, until one walks:
as in the scorecard's rows of one speed, from rest, but at the physics rate of the training. Playing them in between
would give the workers of some schedules time to collect that the run does not count.
"""

import argparse
import contextlib
import os
import signal
import statistics
import sys
import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from hasrl_jax.bench.report import format_table
from hasrl_jax.bench.schedules import SCHEDULES, Curve, Program, read_run
from hasrl_jax.config.checks import check
from hasrl_jax.config.convert import from_dict
from hasrl_jax.config.files import load_yaml
from hasrl_jax.config.schema import Config, available_cores
from hasrl_jax.envs.cassie.settings import CassieConfig
from hasrl_jax.envs.registry import make_task
from hasrl_jax.errors import ConfigError
from hasrl_jax.evaluate.rollout import run_episodes
from hasrl_jax.evaluate.scorecard import Row, row_config
from hasrl_jax.evaluate.statistics import summarize
from hasrl_jax.learn import ppo
from hasrl_jax.policy.numpy_networks import Parameters

SEED = 2_000_003  # of the episodes that are judged; apart from every training stream


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the walking benchmark."""
    parser.add_argument("--config", default="cassie_walk", metavar="FILE", help="what is trained")
    parser.add_argument("--schedules", nargs="+", choices=SCHEDULES, default=list(SCHEDULES))
    parser.add_argument("--seeds", type=int, default=3, metavar="N", help="runs of each schedule")
    parser.add_argument("--total-env-steps", type=int, metavar="N", help="of a run; default: the config's")
    parser.add_argument("--seconds", type=float, default=3600.0, metavar="S", help="a run ends after so many, too")
    parser.add_argument("--hidden-size", type=int, metavar="H", help="width of the networks; default: the config's")
    parser.add_argument("--epochs", type=int, metavar="N", help="default: the config's; more make updates longer")
    parser.add_argument("--shared", action="store_true", help="learner and workers share all cores")
    parser.add_argument("--every", type=int, default=10, metavar="N", help="iterations between copies of the policy")
    parser.add_argument("--speeds", type=float, nargs="+", default=[0.5, 1.0], metavar="V", help="commanded, m/s")
    parser.add_argument("--episodes", type=int, default=20, metavar="N", help="at each speed, 10 s each")
    parser.add_argument("--least-up", type=float, default=0.9, metavar="X", help="share that must stay up")
    parser.add_argument("--most-error", type=float, default=0.2, metavar="V", help="settled speed error, m/s")


def measure(arguments: argparse.Namespace) -> dict:
    """Trains and judges every run; prints a line for each on the way. Where it is interrupted, what it has until then.

    Raises:
      ConfigError: an impossible argument, or a single core; KeyboardInterrupt: before the first run was over.
    """
    for name in ("seeds", "every", "episodes"):
        if getattr(arguments, name) < 1:
            raise ConfigError(f"--{name}: got {getattr(arguments, name)}; expected at least 1")
    cores = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []
    if not arguments.shared and len(cores) < 2:
        raise ConfigError("--shared: not given, but the learner needs a core of its own, and the workers another")
    config = make_config(arguments, available_cores() if arguments.shared else len(cores) - 1)
    runs: list[dict[str, Any]] = []
    if not arguments.shared:
        pin(os.getpid(), cores[:1])
    try:
        for run in take_turns(config, arguments, [] if arguments.shared else cores[1:]):
            runs.append(run)
    except KeyboardInterrupt:  # hours are not lost to the last run
        if not runs:
            raise
    finally:
        if not arguments.shared:
            pin(os.getpid(), cores)
    names = "speeds", "episodes", "least_up", "most_error", "shared"
    stated = {name: getattr(arguments, name) for name in names}
    return {"config": Path(arguments.config).name, **stated, "num_workers": config.collect.num_workers, "runs": runs}


def take_turns(config: Config, arguments: argparse.Namespace, cores: list[int]) -> Iterator[dict[str, Any]]:
    """The runs of all schedules and seeds, the workers on `cores`; prints a line for each."""
    programs = {schedule: Program() for schedule in arguments.schedules}
    for schedule in arguments.schedules:  # compiles
        short = from_dict({"schedule": schedule, "total_env_steps": 1}, config)
        train_watched(short, programs[schedule], arguments, cores)
    for seed in range(arguments.seeds):
        for schedule in arguments.schedules:
            changed = from_dict({"schedule": schedule, "seed": seed}, config)
            curve, policies = train_watched(changed, programs[schedule], arguments, cores)
            looks = judge(changed, curve, policies, arguments)
            found = {"schedule": schedule, "seed": seed, **summary(curve, looks), "looks": looks}
            shown = {name: value for name, value in found.items() if name not in ("schedule", "seed", "looks")}
            print(f"{schedule}, seed {seed}: {shown}", file=sys.stderr, flush=True)
            yield found


def make_config(arguments: argparse.Namespace, num_workers: int) -> Config:
    """The configuration without evaluations and saves on the way."""
    config = load_yaml(arguments.config)
    changes: dict[str, Any] = {
        "collect": {"num_workers": num_workers},
        "evaluate": {"every_iterations": 0},
        "checkpoint": {"every_iterations": 0, "keep": 1},
    }
    if arguments.total_env_steps is not None:
        changes["total_env_steps"] = arguments.total_env_steps
    if arguments.hidden_size is not None:
        changes["network"] = {"hidden_size": arguments.hidden_size}
    if arguments.epochs is not None:
        changes["ppo"] = {"epochs": arguments.epochs}
    config = from_dict(changes, config)
    check(config)
    if not isinstance(config.settings, CassieConfig):
        raise ConfigError(f"--config: {arguments.config} trains task {config.task}; expected one that walks")
    return config


def pin(process: int, cores: list[int]) -> None:
    """Keeps every thread of a process, and those it starts later, on some cores."""
    for thread in os.listdir(f"/proc/{process}/task"):
        with contextlib.suppress(ProcessLookupError):  # it has ended meanwhile
            os.sched_setaffinity(int(thread), cores)


class Watched:
    """An update that puts copies of the policy aside and keeps the workers off the learner's core.

    Args:
      update: the program.
      every: iterations between copies.
      seconds: after these it asks the run to end.
      cores: for the workers; empty leaves them where they are.
      normalized: whether the policy's observations are.
    """

    def __init__(self, update: ppo.Update, every: int, seconds: float, cores: list[int], normalized: bool):
        self.update, self.every, self.seconds, self.cores, self.normalized = update, every, seconds, cores, normalized
        self.policies: dict[int, Parameters] = {}  # by iteration
        self.ended = False  # by its seconds
        self._calls, self._began = 0, time.monotonic()
        self._pinned: set[int] = set()

    def __call__(self, *arguments: Any) -> tuple[ppo.LearnerState, dict[str, Any]]:
        if self.cores:
            self._pin_workers()
        learner, metrics = self.update(*arguments)
        self._calls += 1
        if self._calls % self.every == 0:
            self.policies[self._calls] = ppo.export_parameters(learner, self.normalized)
        if time.monotonic() - self._began > self.seconds and not self.ended:
            self.ended = True
            os.kill(os.getpid(), signal.SIGTERM)
        return learner, metrics

    def _pin_workers(self) -> None:
        """They inherit the learner's cores; one that took the place of another does so again."""
        for child in psutil.Process().children():
            if child.pid not in self._pinned:
                self._pinned.add(child.pid)
                pin(child.pid, self.cores)


def train_watched(
    config: Config, program: Program, arguments: argparse.Namespace, cores: list[int]
) -> tuple[Curve, dict[int, Parameters]]:
    """A run, and the copies of its policy by iteration.

    Raises:
      ConfigError: its stages change the update; KeyboardInterrupt: it was asked to stop.
    """
    made: list[Watched] = []

    def make_update(part: Config, *sizes: Any) -> Watched:
        if part.ppo != config.ppo:
            raise ConfigError("stages: got one that changes ppo; expected one update for the whole run")
        normalized = config.network.normalize_observations
        made[:] = made or [Watched(program(part, *sizes), arguments.every, arguments.seconds, cores, normalized)]
        return made[0]

    curve = read_run(config, make_update)
    if curve[-1]["env_steps"] < config.total_env_steps and not made[0].ended:
        raise KeyboardInterrupt
    return curve, made[0].policies


def judge(
    config: Config, curve: Curve, policies: dict[int, Parameters], arguments: argparse.Namespace
) -> list[dict[str, Any]]:
    """Plays the copies in their order until one walks; what was seen of each."""
    looks: list[dict[str, Any]] = []
    for iteration, parameters in policies.items():
        record = curve[iteration - 1]
        rows = play(config, parameters, arguments.speeds, arguments.episodes)
        walks = is_walking(rows, arguments.least_up, arguments.most_error)
        place = {"iteration": iteration, "env_steps": record["env_steps"], "seconds": record["train_seconds"]}
        looks.append(place | {"rows": rows, "walks": walks})
        if walks:
            break
    return looks


def play(config: Config, parameters: Parameters, speeds: Iterable[float], episodes: int) -> list[dict[str, Any]]:
    """At each commanded speed: the share that stays up for 10 s, and the settled error, m/s (None: none settled)."""
    rows = []
    for speed in speeds:
        played = row_config(config, Row("speed", (speed, speed)), seconds=10.0)
        task = make_task(played)
        found = summarize(run_episodes(played, task, parameters, episodes, SEED), task)
        error = found["forward_speed_error"]["mean"]
        rows.append({"speed": speed, "share_up": found["share_reaching_cap"]["mean"], "error": error})
    return rows


def is_walking(rows: list[dict[str, Any]], least_up: float, most_error: float) -> bool:
    """Whether a policy stays up and follows the command at every speed; one that stands still does not."""
    errors = [row["error"] for row in rows]
    return all(row["share_up"] >= least_up for row in rows) and all(e is not None and e <= most_error for e in errors)


def summary(curve: Curve, looks: list[dict[str, Any]]) -> dict[str, float | None]:
    """When a run first walked, None for never, and what its iterations consisted of, medians without the first."""
    first = looks[-1] if looks and looks[-1]["walks"] else None
    later = curve[1:] or curve
    seconds = np.diff([record["train_seconds"] for record in curve]).tolist() or [curve[0]["train_seconds"]]
    return {
        "seconds_to_walking": first["seconds"] if first else None,
        "env_steps_to_walking": first["env_steps"] if first else None,
        "iteration_seconds": statistics.median(seconds),
        **{
            name: statistics.median(record[name] for record in later if record.get(name) is not None)
            for name in ("collect_seconds", "update_seconds", "wait_seconds")
        },
        "policy_lag": statistics.mean(record["policy_lag"] for record in later),
        "seconds": curve[-1]["train_seconds"],
        "env_steps": curve[-1]["env_steps"],
    }


def tables(figures: dict) -> str:
    """Seconds to walking by schedule, mean ± standard deviation over the seeds that walked."""

    def walked(runs: list[dict]) -> int:
        return sum(run["seconds_to_walking"] is not None for run in runs)

    def spread(runs: list[dict], name: str) -> str:
        values = [run[name] for run in runs if run[name] is not None]
        if not values:
            return "-"
        deviation = statistics.stdev(values) if len(values) > 1 else 0.0
        return f"{statistics.mean(values):,.4g} ± {deviation:,.2g}"

    columns = {
        "seconds to walking": "seconds_to_walking",
        "env steps to walking": "env_steps_to_walking",
        "iteration s": "iteration_seconds",
        "collect s": "collect_seconds",
        "update s": "update_seconds",
        "wait s": "wait_seconds",
        "policy lag": "policy_lag",
        "seconds in all": "seconds",
    }
    by_schedule: dict[str, list[dict]] = {}
    for run in figures["runs"]:
        by_schedule.setdefault(run["schedule"], []).append(run)
    rows = [
        [schedule, f"{walked(runs)} of {len(runs)}", *(spread(runs, name) for name in columns.values())]
        for schedule, runs in by_schedule.items()
    ]
    where = "all cores shared" if figures["shared"] else "the learner on a core of its own"
    stated = (
        f"{figures['config']}, {figures['num_workers']} workers, {where}. Walking: at "
        f"{' and '.join(format(speed, 'g') for speed in figures['speeds'])} m/s commanded, from rest, at least "
        f"{100 * figures['least_up']:g} % of {figures['episodes']} episodes stay up for 10 s, and the settled speed "
        f"error is at most {figures['most_error']:g} m/s. Means ± standard deviations over seeds."
    )
    return f"{stated}\n\n{format_table(['schedule', 'walked', *columns], rows)}"
