"""What a policy can do, in one table: `python -m hasrl_jax.evaluate --policy released --scorecard DIR`.

C MuJoCo at 2 kHz, mean action, seeds that no training uses. Every row is a number of episodes of one kind; a fall is a
pelvis below 0.6 m or a tilt above 45 degrees, whatever the policy was trained with. Rows are shared among processes.
"""

import logging
import multiprocessing
import os
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hasrl_jax.config.convert import from_dict
from hasrl_jax.config.schema import Config, available_cores
from hasrl_jax.envs.cassie.settings import RandomizeConfig
from hasrl_jax.envs.registry import Robot, make_task, make_task_on
from hasrl_jax.errors import ConfigError
from hasrl_jax.evaluate import gait
from hasrl_jax.evaluate import report as reports
from hasrl_jax.evaluate.page import percent, write_page
from hasrl_jax.evaluate.rollout import run_episodes
from hasrl_jax.evaluate.statistics import columns, mean_interval, settled_errors, share_interval
from hasrl_jax.policy.blas import ONE_THREAD
from hasrl_jax.policy.numpy_networks import Parameters

log = logging.getLogger("hasrl_jax")
SPEEDS_M_S = (-1.0, -0.3, 0.0, 0.5, 1.0, 1.5, 2.0, 3.0, 4.0)
LATERAL_M_S = (-0.5, -0.1, 0.1, 0.5)
LATERAL_AT_M_S = 0.5  # forward speed of the rows with a lateral command
CHANGING_M_S = ((-0.3, 2.0), (-0.3, 4.0))  # ranges of the rows whose commands change
CHANGE_S = (2.0, 6.0)  # seconds between commands
TURNS_RAD_S = (-1.0, -0.5, 0.5, 1.0)
TURN_AT_M_S = (0.0, 1.0)
SIDESTEPS_M_S = (-0.5, 0.5)
HEIGHTS_M = (0.65, 0.8, 1.0)
HEIGHT_AT_M_S = 0.5
STEERED = {"lateral_m_s": [-0.5, 0.5], "yaw_rate_rad_s": [-1.0, 1.0], "height_m": [0.65, 1.0]}  # of changing commands
DISTURBED_AT_M_S = 1.0
# One kind of disturbance at a time; each is met by every episode at its worst or within its range.
DISTURBANCES: dict[str, dict[str, Any]] = {
    "control delay 10 ms": {"control_delay_s": [0.01, 0.01]},
    "control delay 20 ms": {"control_delay_s": [0.02, 0.02]},
    "torque 3 ms late": {"torque_lag_s": [0.003, 0.003]},
    "policy periods x 0.8 to 1.2": {"policy_period_scale": [0.8, 1.2]},
    "noisy observations": {"observation_noise": 1.0},
    "velocity off by up to 0.2 m/s": {"velocity_bias_m_s": 0.2},
    "velocity 0.1 s late": {"velocity_lag_s": [0.1, 0.1]},
    "velocity off by up to 0.2 m/s and 0.1 s late": {"velocity_bias_m_s": 0.2, "velocity_lag_s": [0.1, 0.1]},
    "heading drifts by up to 3 °/s": {"yaw_drift_rad_s": float(np.deg2rad(3.0))},
    "turned by 45° at the start": {"start_turned_rad": [float(np.pi / 4)] * 2},
    "turned by 90° at the start": {"start_turned_rad": [float(np.pi / 2)] * 2},
    "10 kg on the pelvis": {"payload_kg": [10.0, 10.0]},
    "pelvis 3 kg lighter": {"payload_kg": [-3.0, -3.0]},
    "center of mass off by up to 5 cm": {"center_of_mass_m": 0.05},
    "torque limits x 0.8": {"torque_scale": [0.8, 0.8]},
    "PD gains x 0.8": {"pd_gain_scale": [0.8, 0.8]},
    "PD gains x 1.2": {"pd_gain_scale": [1.2, 1.2]},
    "springs x 0.8 to 1.2": {"spring_scale": [0.8, 1.2]},
    "friction 0.4": {"sliding_friction": [0.4, 0.4]},
    "friction 0.2": {"sliding_friction": [0.2, 0.2]},
    "floor sloping by 5°": {"floor_slope_deg": [5.0, 5.0]},
    "floor sloping by 8°": {"floor_slope_deg": [8.0, 8.0]},
}
# Of the ground; blocks of 0.3 to 0.5 m, and steps so long that each is climbed alone.
GROUNDS: dict[str, dict[str, Any]] = {
    "ground uneven by ± 1 cm": {"kind": "rough", "step_height_m": [-0.01, 0.01], "step_depth_m": [0.3, 0.5]},
    "ground uneven by ± 2 cm": {"kind": "rough", "step_height_m": [-0.02, 0.02], "step_depth_m": [0.3, 0.5]},
    "a step up of 10 cm every 2 m": {"kind": "steps", "step_height_m": [0.1, 0.1], "step_depth_m": [2.0, 2.0]},
}
FAST_M_S = 3.0
DISTURBED_FAST = ("friction 0.4", "friction 0.2", "torque 3 ms late", "velocity 0.1 s late", "ground uneven by ± 2 cm")
# Draws that leave the nominal robot as it is.
NOTHING_DRAWN: dict[str, Any] = {
    **{key: [1.0, 1.0] for key in ("damping_scale", "mass_scale", "physics_rate_scale", "sliding_friction")},
    "torsional_friction": [0.005, 0.005],
    "rolling_friction": [1e-4, 1e-4],
    "encoder_offset_rad": 0.0,
    **{key: [1.0, 1.0] for key in ("pd_gain_scale", "torque_scale", "spring_scale")},
    "policy_period_scale": [1.0, 1.0],
    **{
        key: [0.0, 0.0]
        for key in (
            *("payload_kg", "control_delay_s", "torque_lag_s", "velocity_lag_s"),
            *("start_turned_rad", "floor_slope_deg"),
        )
    },
    **dict.fromkeys(("center_of_mass_m", "velocity_bias_m_s", "yaw_drift_rad_s", "observation_noise"), 0.0),
}
PAPER_DRAWS = (
    "damping_scale",
    "mass_scale",
    "sliding_friction",
    "torsional_friction",
    "rolling_friction",
    "encoder_offset_rad",
    "physics_rate_scale",
)
PUSHES_N = (50.0, 100.0, 150.0, 200.0, 250.0, 300.0)
PUSH_SPEEDS_M_S = (1.0, 0.0)
# Walk, a random moment within, duration, then survive; the walk is the longest, or a second push would come in time.
PUSH_AFTER_S, PUSH_PHASE_S, PUSH_S, SURVIVE_S = 6.0, 1.0, 0.2, 5.0
FALL = {"min_height_m": 0.6, "max_height_m": 3.0, "max_tilt_deg": 45.0}
SHORT_S = 20.0  # besides the cap, survival is also told for this long
# What every row sets itself, of `cassie`.
SETTINGS = ("command", "motor", "push", "terrain", "termination", "randomize")
REVISION = 5  # of what a row plays and what its figures mean; those of an earlier one are measured anew
MODEL_EPISODES = 20  # of each row on another model
BATCH = 25  # episodes that one job plays side by side


class Row(NamedTuple):
    """One kind of episode."""

    kind: str  # "speed", "lateral", "changing", "push", "disturbance", "turn", "sidestep", "height" or "steering"
    forward_m_s: tuple[float, float]
    lateral_m_s: tuple[float, float] = (0.0, 0.0)
    randomized: bool = False
    push_n: float = 0.0
    disturbance: str = ""  # one of `DISTURBANCES` or `GROUNDS`
    yaw_rate_rad_s: float = 0.0  # heading frame
    height_m: float = 0.0  # heading frame; 0 is the usual one

    @property
    def title(self) -> str:
        low, high = self.forward_m_s
        speed = f"{low:g} m/s" if low == high else f"{low:g} to {high:g} m/s, changing"
        if self.kind == "steering":
            speed += ", turning, sideways and in height too"
        if self.kind in ("lateral", "sidestep"):
            speed += f", {self.lateral_m_s[0]:+g} m/s to the left"
        if self.kind == "turn":
            speed += f", {self.yaw_rate_rad_s:+g} rad/s to the left"
        if self.height_m:
            speed += f", {self.height_m:g} m high"
        if self.disturbance:
            speed += f", {self.disturbance}"
        return f"{speed}, {self.push_n:g} N push" if self.push_n else speed


def model_rows() -> list[Row]:
    """The rows that are played on another model of the robot: those that say most."""
    return [
        *(Row("speed", (v, v)) for v in (0.0, 1.0, 2.0, 3.0, 4.0)),
        Row("changing", CHANGING_M_S[0], (-0.1, 0.1)),
        Row("push", (1.0, 1.0), push_n=150.0),
    ]


def rows(trained: Config) -> list[Row]:
    """All rows of a scorecard of the policy of `trained`, in the order in which they are measured."""
    lateral = (LATERAL_AT_M_S, LATERAL_AT_M_S)
    return [
        *(Row("speed", (v, v)) for v in SPEEDS_M_S),
        *(Row("changing", limits, (-0.1, 0.1), drawn) for limits in CHANGING_M_S for drawn in (False, True)),
        *(Row("push", (v, v), push_n=force) for v in PUSH_SPEEDS_M_S for force in PUSHES_N),
        *(Row("lateral", lateral, (v, v), drawn) for drawn in (False, True) for v in LATERAL_M_S),
        *(Row("speed", (v, v), randomized=True) for v in SPEEDS_M_S),
        *(Row("disturbance", (DISTURBED_AT_M_S,) * 2, disturbance=name) for name in (*DISTURBANCES, *GROUNDS)),
        *(Row("disturbance", (FAST_M_S,) * 2, disturbance=name) for name in DISTURBED_FAST),
        *(_steered_rows() if trained.settings.command.frame == "heading" else ()),
    ]


def _steered_rows() -> list[Row]:
    """What only a policy that is commanded in the heading frame can be told."""
    still = (0.0, 0.0)
    return [
        *(Row("steering", limits, randomized=drawn) for limits in CHANGING_M_S for drawn in (False, True)),
        *(Row("turn", (v, v), yaw_rate_rad_s=rate) for v in TURN_AT_M_S for rate in TURNS_RAD_S),
        *(Row("sidestep", still, (v, v)) for v in SIDESTEPS_M_S),
        *(Row("height", (HEIGHT_AT_M_S,) * 2, height_m=height) for height in HEIGHTS_M),
    ]


def row_config(trained: Config, row: Row, seconds: float) -> Config:
    """`trained` with the commands, disturbances and ends of a row; its clock and networks stay as trained.

    Episodes last `seconds`, those with a lateral command 20 s at most, and pushed ones until 5 s after the push.
    """
    if row.kind == "push":
        seconds = PUSH_AFTER_S + PUSH_PHASE_S + PUSH_S + SURVIVE_S
    elif row.kind not in ("speed", "changing", "steering"):
        seconds = min(seconds, SHORT_S)
    height = row.height_m or trained.settings.reward.height_m
    told: dict[str, Any] = {
        "lateral_m_s": list(row.lateral_m_s),
        "yaw_rate_rad_s": [row.yaw_rate_rad_s] * 2,
        "height_m": [height, height],
    }
    drawn = NOTHING_DRAWN
    if row.randomized:
        drawn = NOTHING_DRAWN | {name: getattr(RandomizeConfig(), name) for name in PAPER_DRAWS}
    changing = row.kind in ("changing", "steering")
    cassie = {
        "command": {
            "forward_m_s": list(row.forward_m_s),
            **(told if row.kind != "steering" else STEERED | {"turn_m_s2": 2.0, "height_fade_m_s": [1.5, 3.0]}),
            "height_probability": 1.0,
            "start_heading_rad": 0.0,
            **dict.fromkeys(("stand_probability", "straight_probability", "alone_probability"), 0.0),
            "start_moving": 0.0,
            "resample_s": list(CHANGE_S) if changing else [0.0, 0.0],
        },
        "motor": {"torque_speed_curve": True},
        "randomize": {
            "enabled": row.randomized or bool(row.disturbance),
            "share": 1.0,
            **drawn,
            **DISTURBANCES.get(row.disturbance, {}),
        },
        "push": {
            "force_n": [row.push_n, row.push_n],
            "interval_s": [PUSH_AFTER_S, PUSH_AFTER_S + PUSH_PHASE_S],
            "duration_s": PUSH_S,
        },
        "terrain": GROUNDS.get(row.disturbance, {"kind": "flat"}),
        "termination": FALL,
    }
    return from_dict(
        {"cassie": cassie, "collect": {"max_episode_steps": round(seconds / trained.physics.env_step_s)}}, trained
    )


def write(
    directory: Path,
    policies: dict[str, tuple[Config, Parameters]],
    episodes: int,
    seconds: float,
    seed: int,
    command: str,
) -> None:
    """Measures every policy, the first being the one that the card is about; writes scorecard.json, .md and .png.

    Rows that scorecard.json already holds of the same policies and settings are not measured again. The card's own
    policy comes last, it stays up longest; the files are brought up to date after each of its rows.

    Args:
      directory: made if missing.
      policies: by name: configuration, with the physics to play under, and parameters; all of the walking task.
      episodes: as in `measure`.
      seconds: as in `measure`.
      seed: as in `measure`.
      command: what to type for the same numbers, for the page.

    Raises:
      ConfigError: a policy of another task; OSError: the directory cannot be written.
    """
    reports.refuse_other_tasks(policies, "--scorecard", "policies that walk have one")
    directory.mkdir(parents=True, exist_ok=True)
    path = directory / "scorecard.json"
    report: dict[str, Any] = {"episodes": episodes, "seconds": seconds, "seed": seed, "command": command}
    report |= {"date": time.strftime("%Y-%m-%d"), "digests": {}, "policies": {}}
    report["physics_hz"] = 1 / next(iter(policies.values()))[0].physics.timestep_s
    earlier = reports.read(path)
    own_digest = _digest(*next(iter(policies.values())), seconds)
    report["models"] = {
        label: found for label, found in earlier.get("models", {}).items() if found["policy_digest"] == own_digest
    }
    same = all(earlier.get(name) == report[name] for name in ("episodes", "seconds", "seed"))
    for name, (config, parameters) in policies.items():
        digest = report["digests"][name] = _digest(config, parameters, seconds)
        known = same and earlier.get("digests", {}).get(name) == digest
        report["policies"][name] = earlier["policies"].get(name, []) if known else []
    own = next(iter(policies))
    for name, (config, parameters) in reversed(policies.items()):
        measured, started = report["policies"][name], time.monotonic()
        for row in measure(config, parameters, episodes, seconds, seed, len(measured)):
            measured.append(row)
            reports.write(report, path)
            if name == own and len(measured) < len(rows(config)):  # the last one is written below
                write_page(report, directory)
            robot = "randomised" if row["randomized"] else "nominal"
            share, spent = percent(row["share_up"]), time.monotonic() - started
            log.info("%s, %s, %s: %s up, %.0f s so far", name, row["title"], robot, share, spent)
    reports.write(report, path)
    write_page(report, directory)


def write_on_model(
    directory: Path, robot: Robot, config: Config, parameters: Parameters, seed: int, command: str
) -> None:
    """Adds to a scorecard how its policy does on another model of the robot; the rest of the card stays.

    Args:
      directory: holds the scorecard.
      robot: the other model.
      config: of the card's policy, with the physics to play under.
      parameters: of the card's policy.
      seed: as in `measure`.
      command: what to type for the same numbers, for the page.

    Raises:
      ConfigError: there is no scorecard, or the model cannot be played on; OSError: it cannot be written.
    """
    path = directory / "scorecard.json"
    report = reports.read(path)
    if not report.get("policies"):
        raise ConfigError(f"--scorecard: {path} holds no scorecard; expected one made without --model")
    make_task_on(row_config(config, model_rows()[0], SHORT_S), robot)  # complains before the work
    entry: dict[str, Any] = {
        "policy_digest": _digest(config, parameters, report["seconds"]),
        "command": command,
        "rows": [],
    }
    for row in measure(config, parameters, MODEL_EPISODES, SHORT_S, seed, chosen=model_rows(), robot=robot):
        entry["rows"].append(row)
        log.info("%s, %s: %s up", robot.label, row["title"], percent(row["share_up"]))
    report.setdefault("models", {})[robot.label] = entry
    reports.write(report, path)
    write_page(report, directory)


def refuse_settings(arguments: list[str], what: str = "a scorecard") -> None:
    """Refuses overrides of what the rows set themselves.

    Raises:
      ConfigError: there is one.
    """
    for argument in arguments:
        option = argument.partition("=")[0].replace("_", "-")
        if option.startswith(tuple(f"--cassie.{setting}" for setting in SETTINGS)):
            raise ConfigError(f"{option}: {what} sets it for each of its rows; leave it out")


def _digest(config: Config, parameters: Parameters, seconds: float) -> str:
    """Tells policies apart, and what they are played under."""
    return reports.digest((row_config(config, row, seconds) for row in rows(config)), REVISION, parameters)


def measure(
    trained: Config,
    parameters: Parameters,
    episodes: int,
    seconds: float,
    seed: int,
    skip: int = 0,
    chosen: list[Row] | None = None,
    robot: Robot | None = None,
) -> Iterator[dict[str, Any]]:
    """Plays the rows and yields each one's results, ready for JSON, in their order.

    Args:
      trained: the policy's configuration, with the physics to play under.
      parameters: as `learn.ppo.export_parameters` returns them.
      episodes: per row.
      seconds: time limit of the longest episodes, see `row_config`.
      seed: the same seed gives the same numbers, whatever the number of cores.
      skip: rows to leave out at the beginning.
      chosen: the rows; by default all, `rows`.
      robot: another model to play on.
    """
    jobs = [
        (row, row_config(trained, row, seconds), parameters, min(BATCH, episodes - done), [seed, number, done], robot)
        for number, row in enumerate(rows(trained) if chosen is None else chosen)
        if number >= skip
        for done in range(0, episodes, BATCH)
    ]
    parts: list[dict[str, np.ndarray]] = []
    for job, part in zip(jobs, in_processes(_play, jobs), strict=True):
        parts.append(part)
        if sum(len(p["seconds"]) for p in parts) == episodes:
            yield summarize_row(job[0], job[1], parts)
            parts = []


def in_processes(play: Callable[[Any], Any], jobs: Sequence[Any]) -> Iterator[Any]:
    """What `play` makes of each job, in their order, by a process per core."""
    os.environ.update(ONE_THREAD)  # the processes inherit it before they load NumPy
    # Fresh interpreters: forking a process that has started JAX can hang.
    with ProcessPoolExecutor(available_cores(), multiprocessing.get_context("spawn")) as pool:
        yield from pool.map(play, jobs)


def _play(job: tuple[Row, Config, Parameters, int, list[int], Robot | None]) -> dict[str, np.ndarray]:
    """Per-episode figures of a part of a row, each [N]."""
    _, config, parameters, episodes, seed, robot = job
    task = make_task(config) if robot is None else make_task_on(config, robot)
    cap_s = config.collect.max_episode_steps * config.physics.env_step_s
    played = run_episodes(config, task, parameters, episodes, seed, seconds=cap_s)
    column = columns(played, task)
    mass = float(task.model.body_mass.sum())
    figures = gait.describe(
        column["left_force"],
        column["right_force"],
        column["motor_power"],
        column["forward_speed"],
        mass,
        task.env_step_s,
    )
    figures["trailing_toe_s"] = gait.trailing(
        column["left_toe_force"], column["right_toe_force"], task.env_step_s, figures["step_frequency_hz"]
    )
    last = np.maximum(played.episode_length - 1, 0)
    heading = np.unwrap(np.nan_to_num(column["heading"]), axis=0)[last, np.arange(episodes)]
    speeds = settled_errors(column, task.commands, task.env_step_s)
    return {
        "seconds": played.seconds,
        "reached_cap": played.reached_cap,
        "diverged": played.diverged,
        **{name: values for name, values in speeds.items() if not name.endswith(("_command", "_instantaneous"))},
        "motor_power": np.nanmean(column["motor_power"], axis=0),
        "heading_drift_deg": np.abs(np.rad2deg(heading)),
        **figures,
    }


def summarize_row(row: Row, config: Config, parts: list[dict[str, np.ndarray]]) -> dict[str, Any]:
    """One row's figures with 95 % intervals."""
    values = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    cap_s = config.collect.max_episode_steps * config.physics.env_step_s
    result: dict[str, Any] = row._asdict() | {"title": row.title, "cap_seconds": cap_s}
    result |= {"episodes": len(values["seconds"]), "diverged": int(values.pop("diverged").sum())}
    reached = values.pop("reached_cap")
    if row.kind == "push":  # of those that were up until the first moment of a push
        reached = reached[values["seconds"] > PUSH_AFTER_S]
        result["pushed_episodes"] = len(reached)
    result["share_up"] = share_interval(reached)
    if row.kind != "push":
        result["share_up_20_s"] = share_interval(values["seconds"] >= min(SHORT_S, cap_s) - 1e-9)
    # An episode that fell before the command had settled has no speed error, and one that stands no gait.
    return result | {name: mean_interval(x) for name, x in values.items()}
