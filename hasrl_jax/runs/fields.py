"""What the fields of metrics.jsonl mean; a test compares this table with the records of real runs."""

from typing import NamedTuple


class Field(NamedTuple):
    """One field of a record."""

    unit: str  # "" without one
    meaning: str
    only: str = ""  # where not every record has it


PER_TERM = "reward/"  # what the names of the reward terms begin with: one field for each term of the task
_EVALUATION = "after every `evaluate.every_iterations` iterations, and at the end"
_CPU, _MJX, _DECOUPLED = "backends `cpu_pool` and `ray`", "backend `mjx`", "schedule `decoupled`"
FIELDS: dict[str, Field] = {
    "iteration": Field("", "iterations finished, from 1; also the version of the parameters"),
    "env_steps": Field("steps", "environment steps collected since the run began, those of dropped trajectories too"),
    "train_seconds": Field("s", "time spent in iterations since the run began; goes on when the run is resumed"),
    "stage": Field("", "stages of the curriculum that had begun"),
    "env_steps_per_second": Field("steps/s", "environment steps of the iteration over its duration"),
    "collect_seconds": Field("s", "from the request for data to its arrival"),
    "wait_seconds": Field("s", "how long the learner waited for data"),
    "update_seconds": Field("s", "duration of the update; the first one contains its compilation"),
    "eval_seconds": Field("s", "duration of the evaluation", _EVALUATION),
    "episode_return_train": Field(
        "", "mean return, not discounted, of the episodes that ended in the iteration; null without one"
    ),
    "episode_length_train": Field("steps", "their mean length; null without one"),
    "eval_return": Field("", "mean return of evaluation episodes: mean action, fixed seeds", _EVALUATION),
    "eval_length": Field("steps", "their mean length", _EVALUATION),
    "reward/TERM": Field("", "mean of a weighted reward term over the environment steps; the terms sum to the reward"),
    "ratio_mean": Field("", "mean probability ratio of the new to the old policy; 1 before the first update"),
    "ratio_first": Field("", "the same in the first minibatch, before any update: 1 unless something is wrong"),
    "approx_kl": Field("nat", "mean of (ratio - 1) - log ratio, an estimate of the KL divergence"),
    "clip_fraction": Field("", "share of steps whose ratio was clipped"),
    "entropy": Field("nat", "of the action distribution"),
    "std_mean": Field("", "mean standard deviation of the actions, in units of the action"),
    "actor_loss": Field("", "clipped surrogate loss and entropy bonus"),
    "critic_loss": Field("", "half the mean squared error of the value, times `ppo.value_coefficient`"),
    "explained_variance": Field("", "share of the variance of the returns that the value explains; 1 is perfect"),
    "policy_gradient_norm": Field("", "global norm of the policy's gradient before it is clipped"),
    "value_gradient_norm": Field("", "global norm of the value network's gradient before it is clipped"),
    "policy_updates": Field("", "minibatches that updated the policy; fewer than all where `ppo.max_kl` was exceeded"),
    "learning_rate": Field("", "step size of the policy's optimizer"),
    "policy_lag": Field("versions", "mean age of the parameters that acted, in updates of the learner"),
    "policy_lag_min": Field("versions", "age of the newest ones"),
    "policy_lag_max": Field("versions", "age of the oldest ones"),
    "importance_mean": Field("", "mean truncated importance weight of the steps; 1 on fresh data", _DECOUPLED),
    "dropped_stale": Field("", "trajectories dropped as older than `decoupled.max_lag`", _DECOUPLED),
    "replay_ratio": Field("", "updates a batch entered, on average since the run was started", _DECOUPLED),
    "diverged_envs": Field("", "simulations that failed in the iteration and were reset"),
    "workers_lost": Field("", "workers lost since the run was started", _CPU),
    "contact_overflow": Field("", "environment steps with more contacts than `mjx.contacts_per_env` allows", _MJX),
    "constraint_overflow": Field("", "environment steps with more rows than `mjx.constraints_per_env` allows", _MJX),
}


def name_of(metric: str) -> str:
    """The name under which `FIELDS` has a metric."""
    return "reward/TERM" if metric.startswith(PER_TERM) else metric
