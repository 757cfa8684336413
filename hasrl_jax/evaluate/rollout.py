"""Runs a policy for whole episodes and reports what it can do: `python -m hasrl_jax.evaluate`."""

import argparse
import json
import sys
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hasrl_jax.cli import parsing as cli
from hasrl_jax.cli.options import OneLineParser, add_policy_options, require_writable
from hasrl_jax.config.checks import limits_of
from hasrl_jax.config.convert import from_dict
from hasrl_jax.config.limits import check_number
from hasrl_jax.config.schema import Config, EvaluateConfig
from hasrl_jax.envs.cpu_engine import CpuEnvs
from hasrl_jax.envs.registry import make_task
from hasrl_jax.envs.task import Task
from hasrl_jax.errors import ConfigError
from hasrl_jax.policy import numpy_networks as numpy_policy
from hasrl_jax.policy.actor import act, start

SETTLE_S = 3.0  # the speed error counts from this long after an episode's start or a new command
MAX_SECONDS = 3600.0
MIN_SCORECARD_S = SETTLE_S + 1.0


class Episodes(NamedTuple):
    """One entry per episode, and one row per environment step while any of them lasted."""

    episode_return: np.ndarray  # [N] undiscounted
    episode_length: np.ndarray  # [N] environment steps
    reached_cap: np.ndarray  # [N] bool: ended by the time limit, not by a fall
    seconds: np.ndarray  # [N] simulated time upright
    diverged: np.ndarray  # [N] bool: ended by a failure of the simulation, whose step does not count
    measures: np.ndarray  # [T, N, M] the task's measures; NaN after an episode's end


def run_episodes(
    config: Config,
    task: Task,
    parameters: numpy_policy.Parameters,
    episodes: int,
    seed: int | list[int],
    mean_action: bool = True,
) -> Episodes:
    """Plays `episodes` episodes side by side in C MuJoCo, with the LSTM state carried through each.

    Args:
      config: reads the network, and `collect.max_episode_steps` as the cap.
      task: the task to play.
      parameters: as `learn.ppo.export_parameters` returns them.
      episodes: N.
      seed: one number or several; the same seed gives the same episodes.
      mean_action: act without exploration noise.
    """
    acting = start(config, task, parameters, episodes)
    cap = config.collect.max_episode_steps
    envs = CpuEnvs(task, episodes, cap)
    rng = np.random.Generator(np.random.Philox(seed))
    state = envs.reset(rng)
    std = np.exp(numpy_policy.log_std(parameters, acting.mirror))
    env_step_s = state.model_fields.get("timestep", task.model.opt.timestep) * task.steps_per_env_step
    total, length = np.zeros(episodes), np.zeros(episodes, np.int64)
    reached_cap, diverged, running = np.zeros(episodes, bool), np.zeros(episodes, bool), np.ones(episodes, bool)
    measures = []
    for _ in range(cap):
        action, acting = act(acting, state.observation, state.is_first)
        if not mean_action:
            action = action + std * rng.standard_normal(action.shape, np.float32)
        state, result = envs.step(state, action, rng)
        valid = running & ~result.diverged
        measures.append(np.where(valid[:, None], result.measures, np.nan))
        total += np.where(valid, result.reward, 0.0)
        length += valid
        reached_cap |= running & result.truncated
        diverged |= running & result.diverged
        running &= ~(result.terminated | result.truncated | result.diverged)
        if not running.any():
            break
    return Episodes(total, length, reached_cap, length * env_step_s, diverged, np.stack(measures))


def summarize(episodes: Episodes, task: Task) -> dict[str, Any]:
    """Means with 95 % confidence intervals, ready for JSON."""
    summary: dict[str, Any] = {
        "episodes": len(episodes.episode_return),
        "episode_return": mean_interval(episodes.episode_return),
        "episode_length": mean_interval(episodes.episode_length),
        "seconds_upright": mean_interval(episodes.seconds),
        "share_reaching_cap": share_interval(episodes.reached_cap),
        "diverged_episodes": int(episodes.diverged.sum()),
    }
    if "forward_speed" in task.measures:
        summary |= _speeds(episodes, task)
    return summary


def _speeds(episodes: Episodes, task: Task) -> dict[str, Any]:
    """What `settled_speeds` gives, over all episodes."""
    values = settled_speeds(columns(episodes, task), task.env_step_s)
    settled_episodes = int(np.isfinite(values["forward_speed"]).sum())
    return {"settled_episodes": settled_episodes, **{name: mean_interval(x) for name, x in values.items()}}


def columns(episodes: Episodes, task: Task) -> dict[str, np.ndarray]:
    """The task's measures by name, [T, N] each."""
    return {name: episodes.measures[..., index] for index, name in enumerate(task.measures)}


def settled_speeds(column: dict[str, np.ndarray], env_step_s: float) -> dict[str, np.ndarray]:
    """Speed, command and their difference after settling, mean of each episode; [T, N] -> [N], NaN if it never was.

    An error is that of the mean speed under a command, without its sign, averaged over the time under each: too fast
    under one does not make up for too slow under another.
    """
    settle_steps = round(SETTLE_S / env_step_s)
    settled = settled_steps(column["forward_command"], settle_steps)
    settled &= settled_steps(column["lateral_command"], settle_steps)
    error = column["forward_speed"] - column["forward_command"]
    lateral_error = column["lateral_speed"] - column["lateral_command"]
    return {
        "forward_speed": settled_mean(column["forward_speed"], settled),
        "forward_command": settled_mean(column["forward_command"], settled),
        "forward_speed_error": command_error(error, settled),
        "lateral_speed_error": command_error(lateral_error, settled),
        "forward_speed_error_instantaneous": settled_mean(np.abs(error), settled),
    }


def settled_mean(values: np.ndarray, settled: np.ndarray) -> np.ndarray:
    """Mean of each episode's `values` [T, N] where `settled` [T, N]: [N], NaN for an episode that never settled."""
    counts = settled.sum(axis=0)
    return np.where(counts > 0, np.where(settled, values, 0.0).sum(axis=0) / np.maximum(counts, 1), np.nan)


def command_error(error: np.ndarray, settled: np.ndarray) -> np.ndarray:
    """|mean `error`| while each command was `settled`, weighted by its time; [T, N] -> [N], NaN without any."""
    number = np.cumsum(np.diff(settled.astype(np.int8), axis=0, prepend=0) > 0, axis=0)  # of the command, from 1
    steps = [settled & (number == command) for command in range(1, number.max(initial=0) + 1)]
    total = sum((np.abs(np.where(held, error, 0.0).sum(axis=0)) for held in steps), np.zeros(error.shape[1]))
    counts = settled.sum(axis=0)
    return np.where(counts > 0, total / np.maximum(counts, 1), np.nan)


def settled_steps(command: np.ndarray, settle_steps: int) -> np.ndarray:
    """Where a command [T, N] (NaN after the end) has held for more than `settle_steps`: [T, N] bool."""
    changed = np.ones(command.shape, bool)
    changed[1:] = command[1:] != command[:-1]
    steps = np.arange(len(command))[:, None]
    since = steps - np.maximum.accumulate(np.where(changed, steps, 0), axis=0)
    return (since >= settle_steps) & np.isfinite(command)


def mean_interval(values: np.ndarray) -> dict[str, float | None]:
    """Mean of the values that are numbers and its 95 % normal confidence interval; None without any."""
    values = values[np.isfinite(values)]
    if len(values) == 0:
        return {"mean": None, "low": None, "high": None}
    half = 1.96 * np.std(values, ddof=1) / np.sqrt(len(values)) if len(values) > 1 else 0.0
    mean = float(np.mean(values))
    return {"mean": mean, "low": mean - float(half), "high": mean + float(half)}


def share_interval(hits: np.ndarray) -> dict[str, float | None]:
    """Share of true values and its 95 % Wilson interval; None without values."""
    if len(hits) == 0:
        return {"mean": None, "low": None, "high": None}
    n, share, z = len(hits), float(np.mean(hits)), 1.96
    centre = (share + z * z / (2 * n)) / (1 + z * z / n)
    half = z / (1 + z * z / n) * np.sqrt(share * (1 - share) / n + z * z / (4 * n * n))
    return {"mean": share, "low": float(centre - half), "high": float(centre + half)}


def evaluate(arguments: list[str]) -> None:
    """The command: loads a policy, plays, prints and writes the summary, or a whole scorecard.

    Raises:
      ConfigError: an impossible argument; RunError, CheckpointError: no policy.
    """
    from hasrl_jax.policy.loading import load_baseline, load_policy_parameters

    known, rest = _parse(arguments)
    trained, parameters = load_policy_parameters(known.run_dir, known.policy)
    if known.scorecard:
        from hasrl_jax.evaluate import scorecard

        scorecard.refuse_settings(rest)
        source = known.run_dir or known.policy or "released"
        name = "the released policy" if source == "released" else Path(source).name
        policies = {name: (trained, parameters)} | {other: load_baseline(other, trained) for other in known.against}
        played = {name: (_to_play(config, known, rest), weights) for name, (config, weights) in policies.items()}
        command = " ".join(["python -m hasrl_jax.evaluate", *arguments])
        scorecard.write(known.scorecard, played, known.episodes, known.seconds, known.seed, command)
        return
    config = _to_play(trained, known, rest)
    steps = max(1, round(known.seconds / config.physics.env_step_s))
    config = from_dict({"collect": {"max_episode_steps": steps}}, config)
    task = make_task(config)
    episodes = run_episodes(config, task, parameters, known.episodes, known.seed, not known.stochastic)
    summary = {"physics_hz": 1 / config.physics.timestep_s, "cap_seconds": known.seconds, "seed": known.seed}
    summary |= summarize(episodes, task)
    for name, value in summary.items():
        print(f"{name:36s} {_readable(value)}")
    if known.json:
        known.json.write_text(json.dumps(summary, indent=2) + "\n", encoding="utf-8")


def _to_play(trained: Config, known: argparse.Namespace, rest: list[str]) -> Config:
    """The configuration of a policy with the physics to play under and the command line's overrides."""
    from hasrl_jax.policy.loading import with_physics

    return cli.override_for_policy(with_physics(trained, known.physics), rest, "evaluate")


def _parse(arguments: list[str]) -> tuple[argparse.Namespace, list[str]]:
    """The command line, checked as far as it can be without the policy."""
    parser = OneLineParser(
        prog="python -m hasrl_jax.evaluate",
        description="Play fixed-seed episodes. Physics and cassie settings can be overridden: "
        "--cassie.randomize.enabled False",
        allow_abbrev=False,
    )
    add_policy_options(parser)
    parser.add_argument("--episodes", type=int, default=100)
    parser.add_argument("--seconds", type=float, help="time limit of an episode; default 20, of a scorecard 60")
    parser.add_argument("--stochastic", action="store_true", help="sample actions instead of taking the mean")
    parser.add_argument("--json", type=Path, help="write the statistics here")
    parser.add_argument(
        "--scorecard", type=Path, metavar="DIR", help="speeds, randomisation, pushes and gait, as a page"
    )
    parser.add_argument(
        "--against", nargs="*", default=[], help='more policies for the scorecard: "zero", "random", run directories'
    )
    known, rest = parser.parse_known_args(arguments)
    check_number("--episodes", known.episodes, limits_of(EvaluateConfig, "episodes"))
    check_number("--seed", known.seed, limits_of(Config, "seed"))
    if known.seconds is None:
        known.seconds = 60.0 if known.scorecard else 20.0
    if not 0 < known.seconds <= MAX_SECONDS:
        raise ConfigError(f"--seconds: got {known.seconds:g}; expected more than 0 and at most {MAX_SECONDS:g}")
    if known.json:
        require_writable("--json", known.json)
    for option in ("json", "stochastic"):
        if known.scorecard and getattr(known, option):
            raise ConfigError(f"--scorecard: writes its own files of the mean action; leave out --{option}")
    if known.scorecard and known.seconds < MIN_SCORECARD_S:
        raise ConfigError(f"--seconds: got {known.seconds:g}; expected at least {MIN_SCORECARD_S:g} for a --scorecard")
    if known.against and not known.scorecard:
        raise ConfigError("--against: only a --scorecard compares policies")
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
    cli.log_to_terminal()
    return cli.run(lambda: evaluate(sys.argv[1:] if argv is None else argv))


if __name__ == "__main__":
    sys.exit(main())
