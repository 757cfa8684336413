"""Rejects configurations that cannot work, before anything compiles or starts."""

import dataclasses
from typing import Any

from hasrl_jax.config import Config, ConfigError


def check(config: Config) -> None:
    """Rejects values that cannot work.

    Raises:
      ConfigError: names the field, the value seen and what would work.
    """
    collect, ppo, physics, cassie = config.collect, config.ppo, config.physics, config.cassie
    at_least_one = {
        "total_env_steps": config.total_env_steps,
        "physics.steps_per_env_step": physics.steps_per_env_step,
        "physics.solver_iterations": physics.solver_iterations,
        "physics.line_search_iterations": physics.line_search_iterations,
        "network.hidden_size": config.network.hidden_size,
        "collect.num_workers": collect.num_workers,
        "collect.envs_per_worker": collect.envs_per_worker,
        "collect.env_steps_per_iteration": collect.env_steps_per_iteration,
        "collect.unroll_length": collect.unroll_length,
        "collect.max_episode_steps": collect.max_episode_steps,
        "mjx.num_envs": config.mjx.num_envs,
        "mjx.contacts_per_env": config.mjx.contacts_per_env,
        "mjx.constraints_per_env": config.mjx.constraints_per_env,
        "ppo.epochs": ppo.epochs,
        "ppo.minibatch_trajectories": ppo.minibatch_trajectories,
        "evaluate.episodes": config.evaluate.episodes,
        "checkpoint.keep": config.checkpoint.keep,
    }
    for name, count in at_least_one.items():
        _require(count >= 1, name, count, "at least 1")
    positive = {
        "collect.worker_start_timeout_s": collect.worker_start_timeout_s,
        "collect.worker_timeout_s": collect.worker_timeout_s,
        "ppo.policy_learning_rate": ppo.policy_learning_rate,
        "ppo.value_learning_rate": ppo.value_learning_rate,
        "ppo.adam_epsilon": ppo.adam_epsilon,
        "ppo.max_gradient_norm": ppo.max_gradient_norm,
        "ppo.value_coefficient": ppo.value_coefficient,
        "cassie.clock.cycle_s": cassie.clock.cycle_s,
    }
    for name, value in positive.items():
        _require(value > 0, name, value, "a number above 0")
    not_negative = {
        "seed": config.seed,
        "ppo.max_kl": ppo.max_kl,
        "ppo.entropy_coefficient": ppo.entropy_coefficient,
        "evaluate.every_iterations": config.evaluate.every_iterations,
        "checkpoint.every_iterations": config.checkpoint.every_iterations,
        "cassie.randomize.encoder_offset_rad": cassie.randomize.encoder_offset_rad,
    }
    for name, value in not_negative.items():
        _require(value >= 0, name, value, "0 or more")
    _require(1e-5 <= physics.timestep_s <= 0.01, "physics.timestep_s", physics.timestep_s, "between 1e-5 and 0.01 s")
    _require(0 < ppo.clip < 1, "ppo.clip", ppo.clip, "between 0 and 1")
    _require(0 <= ppo.discount <= 1, "ppo.discount", ppo.discount, "from 0 to 1")
    _require(0 <= ppo.gae_lambda <= 1, "ppo.gae_lambda", ppo.gae_lambda, "from 0 to 1")
    for name in ("stand_probability", "start_moving"):
        share = getattr(cassie.command, name)
        _require(0 <= share <= 1, f"cassie.command.{name}", share, "from 0 to 1")
    for group in ("command", "randomize"):
        settings = getattr(cassie, group)
        for f in dataclasses.fields(settings):
            value = getattr(settings, f.name)
            if isinstance(value, tuple):
                _require(value[0] <= value[1], f"cassie.{group}.{f.name}", value, "low <= high")
    fastest = max(abs(speed) for speed in cassie.command.forward_m_s)
    cycle = cassie.clock.cycle_s + cassie.clock.cycle_per_speed_s * fastest
    _require(
        cycle > 0.1,
        "cassie.clock.cycle_per_speed_s",
        cassie.clock.cycle_per_speed_s,
        f"a gait cycle above 0.1 s at {fastest:g} m/s",
    )
    limits = cassie.termination
    _require(
        limits.min_height_m < limits.max_height_m,
        "cassie.termination.min_height_m",
        limits.min_height_m,
        "less than max_height_m",
    )


def _require(condition: bool, name: str, value: Any, expected: str) -> None:
    if not condition:
        raise ConfigError(f"{name}: got {value!r}; expected {expected}")
