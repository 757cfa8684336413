"""`hasrl evaluate`: plays fixed-seed episodes of a policy and reports what it can do, or a whole scorecard."""

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from hasrl_jax.cli.options import (
    OneLineParser,
    add_force_option,
    add_model_options,
    add_policy_options,
    require_writable,
)
from hasrl_jax.cli.parsing import (
    log_to_terminal,
    refuse_untrained,
    robot_of,
    run,
    to_play,
    trained_commands,
)
from hasrl_jax.config.checks import limits_of
from hasrl_jax.config.limits import check_number
from hasrl_jax.config.schema import Config, EvaluateConfig
from hasrl_jax.envs.registry import make_task, make_task_on
from hasrl_jax.errors import ConfigError
from hasrl_jax.evaluate import scorecard, stairs
from hasrl_jax.evaluate.rollout import run_episodes
from hasrl_jax.evaluate.statistics import SETTLE_S, summarize
from hasrl_jax.policy.loading import load_baseline, load_policy_parameters
from hasrl_jax.policy.numpy_networks import Parameters
from hasrl_jax.runs.trackers import Trackers

MAX_SECONDS = 3600.0
MIN_SCORECARD_S = SETTLE_S + 1.0


def evaluate(arguments: list[str]) -> None:
    """Loads a policy, plays, prints and writes the summary, or a whole scorecard.

    Raises:
      ConfigError: an impossible argument; RunError, CheckpointError: no policy.
    """
    known, rest = _parse(arguments)
    if known.scorecard:
        _write_scorecard(known, rest, arguments)
        return
    if known.stairs:
        scorecard.refuse_settings(rest, "the page about stairs")
        played = _side_by_side(known, rest)
        stairs.write(known.stairs, played, known.episodes, known.seed, _command(arguments))
        return
    trained, parameters = load_policy_parameters(known.run_dir, known.policy)
    config = to_play(trained, known.physics, rest, "evaluate")
    robot = robot_of(known)
    task = make_task_on(config, robot) if robot else make_task(config)
    told = trained_commands(trained)
    for command in task.commands:
        refuse_untrained(command.name, command.drawn, told, known.force)
    episodes = run_episodes(
        config, task, parameters, known.episodes, known.seed, not known.stochastic, seconds=known.seconds
    )
    summary = {"physics_hz": 1 / config.physics.timestep_s, "cap_seconds": known.seconds, "seed": known.seed}
    summary |= summarize(episodes, task)
    for name, value in summary.items():
        print(f"{name:36s} {_readable(value)}")
    if known.json:
        known.json.write_text(json.dumps(summary, indent=2) + "\n", encoding="utf-8")


def _command(arguments: list[str]) -> str:
    return " ".join(["python -m hasrl_jax.evaluate", *arguments])


def _side_by_side(known: argparse.Namespace, rest: list[str]) -> dict[str, tuple[Config, Parameters]]:
    """The policy that is asked for and those beside it by name: how each is played, and its parameters."""
    trained, parameters = load_policy_parameters(known.run_dir, known.policy)
    source = known.run_dir or known.policy or "released"
    name = "the released policy" if source == "released" else Path(source).name
    policies = {name: (trained, parameters)} | {other: load_baseline(other, trained) for other in known.against}
    return {
        policy: (to_play(config, known.physics, rest, "evaluate"), weights)
        for policy, (config, weights) in policies.items()
    }


def _write_scorecard(known: argparse.Namespace, rest: list[str], arguments: list[str]) -> None:
    scorecard.refuse_settings(rest)
    command = _command(arguments)
    robot = robot_of(known)
    if robot:
        trained, parameters = load_policy_parameters(known.run_dir, known.policy)
        config = to_play(trained, known.physics, rest, "evaluate")
        scorecard.write_on_model(known.scorecard, robot, config, parameters, known.seed, command)
        return
    played = _side_by_side(known, rest)
    scorecard.write(known.scorecard, played, known.episodes, known.seconds, known.seed, command)
    if known.run_dir:
        with Trackers(next(iter(played.values()))[0], known.run_dir) as trackers:  # those that the run was told to
            for path in sorted(known.scorecard.glob("scorecard.*")):
                trackers.attach("scorecard", path)


def _parse(arguments: list[str]) -> tuple[argparse.Namespace, list[str]]:
    """The command line, checked as far as it can be without the policy."""
    parser = OneLineParser(
        prog="python -m hasrl_jax.evaluate",
        description="Play fixed-seed episodes. Physics and the task's settings can be overridden: "
        "--cassie.randomize.enabled False",
        allow_abbrev=False,
    )
    add_policy_options(parser)
    parser.add_argument("--episodes", type=int, help="of every figure; default 100, with --stairs 150")
    parser.add_argument("--seconds", type=float, help="time limit of an episode; default 20, of a scorecard 60")
    parser.add_argument("--stochastic", action="store_true", help="sample actions instead of taking the mean")
    parser.add_argument("--json", type=Path, help="write the statistics here")
    parser.add_argument(
        "--scorecard", type=Path, metavar="DIR", help="speeds, randomisation, pushes and gait, as a page"
    )
    parser.add_argument(
        "--stairs",
        type=Path,
        metavar="DIR",
        help="success on stairs by speed and height, and on other ground, as a page",
    )
    parser.add_argument(
        "--against",
        nargs="*",
        default=[],
        help='more policies for either page: "zero", "random", run directories, files',
    )
    add_model_options(parser)
    add_force_option(parser)
    known, rest = parser.parse_known_args(arguments)
    if known.episodes is None:
        known.episodes = 150 if known.stairs else 100
    check_number("--episodes", known.episodes, limits_of(EvaluateConfig, "episodes"))
    check_number("--seed", known.seed, limits_of(Config, "seed"))
    page = "--scorecard" if known.scorecard else "--stairs" if known.stairs else ""
    for option in ("json", "stochastic"):
        if page and getattr(known, option):
            raise ConfigError(f"{page}: writes its own files of the mean action; leave out --{option}")
    for option in ("scorecard", "model", "seconds"):
        if known.stairs and getattr(known, option):
            raise ConfigError(f"--stairs: plays trials of its own; leave out --{option}")
    if known.seconds is None:
        known.seconds = 60.0 if known.scorecard else 20.0
    if not 0 < known.seconds <= MAX_SECONDS:
        raise ConfigError(f"--seconds: got {known.seconds:g}; expected more than 0 and at most {MAX_SECONDS:g}")
    if known.json:
        require_writable("--json", known.json)
    if known.scorecard and known.seconds < MIN_SCORECARD_S:
        raise ConfigError(f"--seconds: got {known.seconds:g}; expected at least {MIN_SCORECARD_S:g} for a --scorecard")
    if known.against and known.model:
        raise ConfigError("--against: a scorecard compares policies on their own model; leave out --model")
    if known.against and not page:
        raise ConfigError("--against: only a --scorecard or --stairs compares policies")
    return known, rest


def _readable(value: Any) -> str:
    if isinstance(value, dict):
        return (
            "none"
            if value["mean"] is None
            else f"{value['mean']:.3f}  (95 % {value['low']:.3f} to {value['high']:.3f})"
        )
    return f"{value:g}"


def main(argv: list[str] | None = None) -> int:
    """The command line; returns the exit status."""
    log_to_terminal()
    return run(lambda: evaluate(sys.argv[1:] if argv is None else argv))
