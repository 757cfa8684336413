"""Advantages and value targets over padded trajectories, and the masked averages that go with them."""

from typing import Literal

import jax
import jax.numpy as jnp


def advantage_and_target(
    reward: jax.Array,
    value: jax.Array,
    terminated: jax.Array,
    truncated: jax.Array,
    bootstrap_value: jax.Array,
    mask: jax.Array,
    discount: float,
    gae_lambda: float,
    setting: Literal["gae", "return"] = "gae",
) -> tuple[jax.Array, jax.Array]:
    """Advantage A_t and value target R_t of every step.

        V'_t = 0 where terminated, bootstrap_value[t] where truncated only, value[t + 1] elsewhere
        delta_t = r_t + discount V'_t - V(s_t)
        A_t = delta_t + discount lambda A_{t+1}      (the last term only where neither terminated nor truncated)
        R_t = A_t + V(s_t)

    "gae" takes `gae_lambda`. "return" takes lambda = 1, for which the deltas telescope: R_t is then the discounted
    return, bootstrapped where truncated, and A_t = R_t - V(s_t).
    A masked step gets 0 and lends nothing to the step before it, neither its advantage nor its value.

    Args:
      reward: [B, T], as in `Trajectory`, like the next five.
      value: [B, T].
      terminated: [B, T] bool.
      truncated: [B, T] bool.
      bootstrap_value: [B, T].
      mask: [B, T] bool.
      discount: gamma.
      gae_lambda: lambda; ignored by "return".
      setting: "gae" or "return".

    Returns:
      (advantage [B, T], target [B, T]).

    Source: paper II.E Eq. 2 and 3 ("return"); Schulman et al. (2016), generalised advantage estimation ("gae").
    Differs from the paper: Eq. 3 has no bootstrap; its published code bootstraps a truncated trajectory, as here.
    """
    decay = discount * (1.0 if setting == "return" else gae_lambda)
    reward, value = jnp.where(mask, reward, 0.0), jnp.where(mask, value, 0.0)
    following = jnp.pad(value[:, 1:], ((0, 0), (0, 1)))
    next_value = jnp.where(terminated, 0.0, jnp.where(truncated, bootstrap_value, following))
    delta = jnp.where(mask, reward + discount * next_value - value, 0.0)
    factor = jnp.where(mask & ~terminated & ~truncated, decay, 0.0)

    def step(later: jax.Array, inputs: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        delta_t, factor_t = inputs
        advantage = delta_t + factor_t * later
        return advantage, advantage

    _, advantage = jax.lax.scan(step, jnp.zeros_like(delta[:, 0]), (delta.T, factor.T), reverse=True)
    advantage = advantage.T
    return advantage, advantage + value


def masked_mean(values: jax.Array, mask: jax.Array) -> jax.Array:
    """Mean of `values` where `mask`, a scalar; 0 when nothing is valid."""
    return jnp.sum(jnp.where(mask, values, 0.0)) / jnp.maximum(jnp.sum(mask), 1)


def masked_variance(values: jax.Array, mask: jax.Array) -> jax.Array:
    """Population variance of `values` where `mask`, a scalar; 0 when nothing is valid."""
    return masked_mean(jnp.square(values - masked_mean(values, mask)), mask)


def masked_standardize(values: jax.Array, mask: jax.Array, epsilon: float = 1e-8) -> jax.Array:
    """(values - mean) / standard deviation over the valid steps; 0 elsewhere. Shapes as `values`."""
    centered = values - masked_mean(values, mask)
    return jnp.where(mask, centered / (jnp.sqrt(masked_variance(values, mask)) + epsilon), 0.0)
