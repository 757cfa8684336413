"""Plays one episode of the nominal robot under given commands and keeps what pictures need."""

from typing import NamedTuple

import numpy as np

from hasrl_jax.config import tasks
from hasrl_jax.config.convert import from_dict
from hasrl_jax.config.schema import Config
from hasrl_jax.envs.cassie.settings import CassieConfig
from hasrl_jax.envs.gymnasium import TaskEnv
from hasrl_jax.errors import ConfigError
from hasrl_jax.evaluate.rollout import Player
from hasrl_jax.policy.numpy_networks import Parameters


class Recording(NamedTuple):
    """T environment steps of one episode; shorter than asked for where the robot fell."""

    time_s: np.ndarray  # [T] at the end of each environment step
    measures: dict[str, np.ndarray]  # each of the task's measures, [T]
    reward_terms: dict[str, np.ndarray]  # each weighted reward term, [T]
    fell: bool


def record(config: Config, parameters: Parameters, speeds: list[float], seconds: float, seed: int = 0) -> Recording:
    """Plays an episode.

    Args:
      config: of the policy; its task must be "cassie".
      parameters: as `learn.ppo.export_parameters` returns them.
      speeds: commanded forward speeds, m/s, one after the other; the last one holds to the end.
      seconds: how long each speed is commanded.
      seed: of the environment.

    Raises:
      ConfigError: another task, or an impossible speed.
    """
    if not isinstance(config.settings, CassieConfig):
        raise ConfigError(f"task: the pictures show Cassie's gait, and the policy is of {config.task!r}")
    steps_each = max(1, round(seconds / config.physics.env_step_s))
    steps = steps_each * len(speeds)
    env = TaskEnv(tasks.find(config.task).undisturbed(from_dict({"collect": {"max_episode_steps": steps}}, config)))
    player = Player(env, parameters, seed)
    rows, terminated = [], False
    for step in range(steps):
        if step % steps_each == 0:
            player.command(speeds[step // steps_each])
        outcome = player.step()
        rows.append(outcome.info)
        terminated = outcome.terminated
        if outcome.ended:
            break

    def columns(prefix: str, names: tuple[str, ...]) -> dict[str, np.ndarray]:
        return {name: np.array([row[prefix + name] for row in rows]) for name in names}

    time_s = env.task.env_step_s * np.arange(1, len(rows) + 1)
    measures, terms = columns("", env.task.measures), columns("reward/", env.task.reward_terms)
    return Recording(time_s, measures, terms, terminated)
