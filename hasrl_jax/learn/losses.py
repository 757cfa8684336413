"""The two PPO losses, averaged over valid steps (paper II.E)."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from hasrl_jax.config.schema import PPOConfig
from hasrl_jax.learn import distributions, networks, returns
from hasrl_jax.learn.networks import Parameters, Policy, Value
from hasrl_jax.types import SEGMENT_FIELDS, Trajectory

Metrics = dict[str, jax.Array]

_MAX_LOG_RATIO = 20.0  # exp stays finite in float32


class Batch(NamedTuple):
    """What the losses read; leading axis B (an iteration) or a minibatch of it."""

    trajectory: Trajectory
    advantage: jax.Array  # [B, T]
    target: jax.Array  # [B, T]
    weight: jax.Array  # [B, T] bool, steps that the losses average over
    proximal_log_prob: jax.Array  # [B, T] log-probability that ratios are taken against: the behaviour's, or corrected
    importance: jax.Array | None = None  # [B, T] weights of the surrogate; None: all 1


def prepare_batch(trajectory: Trajectory, ppo: PPOConfig) -> tuple[Batch, Metrics]:
    """Blanks masked steps and adds advantages and targets, from the behaviour values, once per iteration.

    Args:
      trajectory: [B, T, ...]; fields may hold anything, even NaN, where the mask is False.
      ppo: reads the advantage settings and `mask_padding`.

    Returns:
      (batch [B, T, ...], {"explained_variance"} of the behaviour values).

    Source: paper II.E Eq. 2 and 3, III.A.
    """
    mask = trajectory.mask

    def blank(field: jax.Array) -> jax.Array:
        valid = mask.reshape(mask.shape + (1,) * (field.ndim - 2))
        return jnp.where(valid, field, jnp.zeros_like(field))

    per_step = {name: blank(field) for name, field in trajectory._asdict().items() if name not in SEGMENT_FIELDS}
    steps = trajectory._replace(**per_step)
    advantage, target = returns.advantage_and_target(
        steps.reward,
        steps.value,
        steps.terminated,
        steps.truncated,
        steps.bootstrap_value,
        mask,
        ppo.discount,
        ppo.gae_lambda,
        ppo.advantage,
    )
    unexplained = returns.masked_variance(target - steps.value, mask)
    explained_variance = 1.0 - unexplained / jnp.maximum(returns.masked_variance(target, mask), 1e-8)
    if ppo.standardize_advantages:
        advantage = returns.masked_standardize(advantage, mask)
    weight = mask if ppo.mask_padding else jnp.ones_like(mask)
    batch = Batch(steps, advantage, jnp.where(mask, target, 0.0), weight, steps.log_prob)
    return batch, {"explained_variance": explained_variance}


def correct_for_lag(
    batch: Batch,
    params: Parameters,
    policy: Policy,
    mean: jax.Array | None,
    std: jax.Array | None,
    version: jax.Array,
    max_importance: float,
) -> tuple[Batch, Metrics]:
    """Separates the policy that ratios are taken against from the older ones that acted, once per iteration.

        proximal log-prob = log pi_now(a_t | s_t), with the parameters before the update
        importance_t = min(pi_now(a_t | s_t) / behaviour probability, max_importance)

    Clipping then limits how far this update moves the policy, and the weights account for how far it had moved since
    the data was collected. Trajectories of the present version keep the recorded log-probabilities and the weight 1,
    so that fresh data gives exactly the ordinary loss.

    Args:
      batch: from `prepare_batch`, [B, T, ...].
      params: policy parameters before the update.
      policy: the network.
      mean: [O] mean of the observation statistics before the update.
      std: [O] their standard deviation.
      version: [] int32, of `params`.
      max_importance: where the weights are cut off.

    Returns:
      (batch, {"importance_mean"} over valid steps).

    Source: Hilton, Cobbe and Schulman (2021), Batch size-invariance for policy optimization, the decoupled clipped
    objective. Differs: the proximal policy is the newest, and the weights are truncated.
    """
    steps = batch.trajectory
    recomputed = _log_prob(params, policy, steps, mean, std)
    stale = steps.mask & (steps.policy_version != version)[:, None]
    log_weight = jnp.clip(recomputed - steps.log_prob, -_MAX_LOG_RATIO, jnp.log(max_importance))
    importance = jnp.where(stale, jnp.exp(log_weight), 1.0)
    proximal_log_prob = jnp.where(stale, recomputed, steps.log_prob)
    metrics = {"importance_mean": returns.masked_mean(importance, steps.mask)}
    return batch._replace(proximal_log_prob=proximal_log_prob, importance=importance), metrics


def policy_lag(trajectory: Trajectory, version: jax.Array) -> Metrics:
    """How many versions older than `version` the parameters were that acted, over trajectories with a valid step.

    Args:
      trajectory: [B, T, ...].
      version: [] int32, of the learner's parameters.

    Returns:
      {"policy_lag" (the mean), "policy_lag_min", "policy_lag_max"}.
    """
    valid = jnp.any(trajectory.mask, axis=1)
    lag = version - trajectory.policy_version
    return {
        "policy_lag": returns.masked_mean(lag, valid),
        "policy_lag_min": jnp.min(lag, where=valid, initial=2**31 - 1).astype(jnp.float32),
        "policy_lag_max": jnp.max(lag, where=valid, initial=-1).astype(jnp.float32),
    }


def _log_prob(
    params: Parameters, policy: Policy, steps: Trajectory, mean: jax.Array | None, std: jax.Array | None
) -> jax.Array:
    """Log-probability of the actions taken, [B, T]."""
    action_mean, _ = policy.apply({"params": params}, steps.observation, steps.initial_carry, steps.is_first, mean, std)
    return distributions.log_prob(steps.action, action_mean, networks.log_std(policy, params))


def policy_loss(
    params: Parameters, policy: Policy, batch: Batch, mean: jax.Array | None, std: jax.Array | None, ppo: PPOConfig
) -> tuple[jax.Array, Metrics]:
    """Clipped surrogate and entropy bonus.

        ratio_t = exp(log pi(a_t | s_t) - proximal log-prob)
        loss = -E_t[importance_t min(ratio_t A_t, clip(ratio_t, 1 - clip, 1 + clip) A_t)] - c1 H

    The proximal log-prob is the behaviour's and the importance 1, unless `correct_for_lag` made them otherwise.
    E_t averages over `batch.weight`; the approximate KL, E[(ratio - 1) - log ratio], and the clip fraction always
    average over valid steps only.

    Args:
      params: policy parameters.
      policy: the network.
      batch: a minibatch.
      mean: [O] mean of the observation statistics the collectors used.
      std: [O] their standard deviation.
      ppo: coefficients.

    Returns:
      (loss, scalar metrics).

    Source: paper II.E (actor loss); Schulman et al. (2017).
    """
    steps = batch.trajectory
    log_ratio = _log_prob(params, policy, steps, mean, std) - batch.proximal_log_prob
    log_ratio = jnp.clip(log_ratio, -_MAX_LOG_RATIO, _MAX_LOG_RATIO)
    ratio = jnp.exp(log_ratio)
    clipped = jnp.clip(ratio, 1.0 - ppo.clip, 1.0 + ppo.clip)
    surrogate = jnp.minimum(ratio * batch.advantage, clipped * batch.advantage)
    if batch.importance is not None:
        surrogate = batch.importance * surrogate
    entropy = distributions.entropy(networks.log_std(policy, params))
    loss = -returns.masked_mean(surrogate, batch.weight) - ppo.entropy_coefficient * entropy
    return loss, {
        "actor_loss": loss,
        "entropy": entropy,
        "ratio_mean": returns.masked_mean(ratio, batch.weight),
        "approx_kl": returns.masked_mean((ratio - 1.0) - log_ratio, steps.mask),
        "clip_fraction": returns.masked_mean((jnp.abs(ratio - 1.0) > ppo.clip).astype(jnp.float32), steps.mask),
    }


def value_loss(
    params: Parameters, value: Value, batch: Batch, mean: jax.Array | None, std: jax.Array | None, ppo: PPOConfig
) -> jax.Array:
    """c2 E_t[(V(s_t) - R_t)^2] / 2; arguments as in `policy_loss`. Source: paper II.E (critic loss)."""
    prediction = networks.values(value, params, batch.trajectory.observation, mean, std)
    return ppo.value_coefficient * 0.5 * returns.masked_mean(jnp.square(prediction - batch.target), batch.weight)
