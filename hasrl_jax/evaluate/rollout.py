"""Plays whole episodes: many side by side to measure a policy, or one after the other to watch it."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from hasrl_jax.config.schema import Config
from hasrl_jax.envs.cpu_engine import CpuEnvs, EnvState
from hasrl_jax.envs.gymnasium import TaskEnv
from hasrl_jax.envs.task import Task
from hasrl_jax.policy import actor, numpy_networks


class Episodes(NamedTuple):
    """One entry per episode, and one row per environment step while any of them lasted."""

    episode_return: np.ndarray  # [N] undiscounted
    episode_length: np.ndarray  # [N] environment steps
    reached_cap: np.ndarray  # [N] bool: ended by the time limit, not by a fall
    seconds: np.ndarray  # [N] simulated time upright
    diverged: np.ndarray  # [N] bool: ended by a failure of the simulation, whose step does not count
    reached_goal: np.ndarray  # [N] bool: ended where it was to arrive
    action_change: np.ndarray  # [N] root mean square over actions of the change from step to step; NaN of a single step
    measures: np.ndarray  # [T, N, M] the task's measures; NaN after an episode's end


def run_episodes(
    config: Config,
    task: Task,
    parameters: numpy_networks.Parameters,
    episodes: int,
    seed: int | list[int],
    mean_action: bool = True,
    seconds: float | None = None,
    told: np.ndarray | None = None,
    goal: Callable[[EnvState], np.ndarray] | None = None,
) -> Episodes:
    """Plays `episodes` episodes side by side in C MuJoCo, with the LSTM state carried through each.

    Args:
      config: reads the network, and `collect.max_episode_steps` as the time limit.
      task: the task to play.
      parameters: as `learn.ppo.export_parameters` returns them.
      episodes: N.
      seed: one number or several; the same seed gives the same episodes.
      mean_action: act without exploration noise.
      seconds: the time limit instead, in simulated seconds: a randomised robot has environment steps of its own length.
      told: [N, C] a command of each episode, held to its end; None leaves them to the task.
      goal: whether the environments are where an episode is over as well, [N] bool.
    """
    policy = actor.reset(config, task, parameters, episodes)
    no_limit = np.iinfo(np.int64).max
    envs = CpuEnvs(task, episodes, config.collect.max_episode_steps if seconds is None else no_limit)
    rng = np.random.Generator(np.random.Philox(seed))
    state = envs.reset(rng)
    if told is not None:
        assert task.with_command is not None
        task_state, observation = task.with_command(state.task, state.observation, told, np)
        state = state._replace(task=task_state, observation=observation)
    std = np.exp(numpy_networks.log_std(parameters, policy.mirror))
    env_step_s = state.model_fields.get("timestep", task.model.opt.timestep) * task.steps_per_env_step
    env_step_s = np.broadcast_to(env_step_s, episodes)
    limit = np.full(episodes, config.collect.max_episode_steps)
    if seconds is not None:
        limit = np.maximum(1, np.ceil(seconds / env_step_s - 1e-9)).astype(np.int64)
    total, length = np.zeros(episodes), np.zeros(episodes, np.int64)
    reached_cap, diverged, running = np.zeros(episodes, bool), np.zeros(episodes, bool), np.ones(episodes, bool)
    reached_goal = np.zeros(episodes, bool)
    squares, before = np.zeros(episodes), np.zeros((episodes, task.action_size))
    measures = []
    for step in range(1, int(limit.max()) + 1):
        action, policy = actor.act(policy, state.observation, state.is_first)
        if not mean_action:
            action = action + std * rng.standard_normal(action.shape, np.float32)
        state, result = envs.step(state, action, rng)
        valid = running & ~result.diverged
        squares += np.where(valid & (length > 0), np.mean((action - before) ** 2, axis=1), 0.0)
        before = action
        measures.append(np.where(valid[:, None], result.measures, np.nan))
        total += np.where(valid, result.reward, 0.0)
        length += valid
        standing = running & ~result.terminated & ~result.diverged  # the others are already somewhere else
        if goal is not None:
            reached_goal |= standing & goal(state)
        over = (step >= limit) & standing & ~reached_goal
        reached_cap |= over
        diverged |= running & result.diverged
        running = standing & ~over & ~reached_goal
        if not running.any():
            break
    change = np.where(length > 1, np.sqrt(squares / np.maximum(length - 1, 1)), np.nan)
    return Episodes(total, length, reached_cap, length * env_step_s, diverged, reached_goal, change, np.stack(measures))


class Outcome(NamedTuple):
    """What an environment step of a `Player` led to."""

    info: dict[str, Any]  # measures and reward terms, as `TaskEnv.step` returns them
    terminated: bool
    truncated: bool

    @property
    def ended(self) -> bool:
        """Whether the episode is over."""
        return self.terminated or self.truncated


class Player:
    """A policy that acts in one environment with its mean action, episode after episode.

    Args:
      env: of the policy's configuration.
      parameters: as `learn.ppo.export_parameters` returns them.
      seed: of the environment.
    """

    def __init__(self, env: TaskEnv, parameters: numpy_networks.Parameters, seed: int | None = None):
        self.env = env
        self._policy = actor.reset(env.config, env.task, parameters, 1)
        self.begin(seed)

    def begin(self, seed: int | None = None) -> None:
        """Begins another episode, in the environment and in the policy's memory."""
        self._observation, _ = self.env.reset(seed=seed)
        self.is_first = True

    def command(self, *told: float, **named: float) -> None:
        """Commands the robot from now to the end of the episode, see `TaskEnv.set_command`."""
        self._observation = self.env.set_command(*told, **named)

    def step(self) -> Outcome:
        """One environment step; when it ends the episode, `begin` must follow."""
        action, self._policy = actor.act(self._policy, self._observation[None], np.array([self.is_first]))
        self._observation, _, terminated, truncated, info = self.env.step(action[0])
        self.is_first = False
        return Outcome(info, terminated, truncated)
