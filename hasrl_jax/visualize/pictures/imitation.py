"""How a policy moves against the reference motion, by the phase of the gait clock."""

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from hasrl_jax.config import tasks
from hasrl_jax.config.convert import from_dict
from hasrl_jax.config.schema import Config
from hasrl_jax.envs.cassie import clock, gaits
from hasrl_jax.envs.cassie.ids import MOTORS, cassie_ids
from hasrl_jax.envs.gymnasium import TaskEnv
from hasrl_jax.evaluate.rollout import Player
from hasrl_jax.policy.numpy_networks import Parameters
from hasrl_jax.visualize.pictures.gaits import library_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SPEEDS_M_S = (0.0, 0.5, 1.0)
SETTLE_S, SHOWN_S = 4.0, 3.0
WALKED, ASKED = "#1f6f8b", "#d97706"


class Strides(NamedTuple):
    """T settled environment steps at one speed; none where the robot fell before."""

    phase: np.ndarray  # [T] at the end of each
    motors: np.ndarray  # [T, 10] joint positions, rad
    reference: np.ndarray  # [T, 10]
    speed: np.ndarray  # [T] m/s


def draw(config: Config, parameters: Parameters, seed: int) -> "Figure":
    """One row per speed, one column per motor of the left leg: reference and motion against phase.

    Raises:
      ConfigError: a policy of another task.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 6.6), layout="constrained")
    grid = figure.subplots(len(SPEEDS_M_S), len(MOTORS), sharex=True, sharey="col")
    for row, speed in zip(grid, SPEEDS_M_S, strict=True):
        strides = walk(config, parameters, speed, seed)
        order = np.argsort(strides.phase)
        for index, axes in enumerate(row):
            axes.plot(strides.phase, strides.motors[:, index], ".", color=WALKED, markersize=3, label="policy")
            axes.plot(strides.phase[order], strides.reference[order, index], color=ASKED, label="reference")
            error = np.sqrt(((strides.motors - strides.reference)[:, index] ** 2).mean()) if len(order) else np.nan
            axes.set_title(f"{MOTORS[index]}: off by {error:.3f} rad", fontsize=9, loc="left")
            axes.grid(alpha=0.3)
        walked = f"walks {strides.speed.mean():.2f}" if len(order) else "fell"
        row[0].set_ylabel(f"{speed:g} m/s, {walked}", fontsize=9)
    for axes in grid[-1]:
        axes.set_xlabel("phase")
    grid[0, 0].legend(fontsize=7)
    return figure


def walk(config: Config, parameters: Parameters, speed: float, seed: int) -> Strides:
    """The nominal robot at a held forward speed, the last SHOWN_S of it.

    Raises:
      ConfigError: a policy of another task.
    """
    library = library_of(config)
    steps = round((SETTLE_S + SHOWN_S) / config.physics.env_step_s)
    env = TaskEnv(tasks.find(config.task).undisturbed(from_dict({"collect": {"max_episode_steps": steps}}, config)))
    ids, player, rows = cassie_ids(env.task.model), Player(env, parameters, seed), []
    player.command(forward=speed)
    height_m = config.settings.reward.height_m
    for step in range(steps):
        outcome = player.step()
        if step * env.task.env_step_s >= SETTLE_S:
            rows.append((outcome.info["phase"], env.qpos[ids.motor_qpos].copy(), outcome.info["forward_speed"]))
        if outcome.ended:
            break
    if not rows or outcome.terminated:
        return Strides(np.zeros(0), np.zeros((0, len(ids.motor_qpos))), np.zeros((0, len(ids.motor_qpos))), np.zeros(0))
    phase, motors, walked = (np.array(column) for column in zip(*rows, strict=True))
    # A measure's phase is that of the step's beginning; the joints are those of its end.
    cycle_s = clock.cycle_seconds(np.array(speed), config.settings.clock, np)
    phase = np.mod(phase + env.task.env_step_s / cycle_s, 1.0)
    told = np.full(len(phase), speed), np.zeros(len(phase)), np.full(len(phase), height_m)
    reference = gaits.motion(library, told, phase, np.zeros(len(phase), bool), np)["motor_positions"]
    return Strides(phase, motors, reference, walked)
