"""Diagonal Gaussian over actions: mean [..., A] and log standard deviation [A] or [..., A].

Log-probabilities are those of the sample itself. Clipping to the actuator range belongs to the environment, so the
density stays the one that was sampled from.
Differs from the paper's published code, which takes the density of the clamped action.
"""

import math

import jax
import jax.numpy as jnp

_LOG_TWO_PI = math.log(2.0 * math.pi)


def sample(key: jax.Array, mean: jax.Array, log_std: jax.Array) -> jax.Array:
    """One action per mean, [..., A]."""
    return mean + jnp.exp(log_std) * jax.random.normal(key, mean.shape, mean.dtype)


def log_prob(action: jax.Array, mean: jax.Array, log_std: jax.Array) -> jax.Array:
    """log pi(action), [...]: -1/2 sum_a (((action - mean) / std)^2 + 2 log std + log 2 pi)."""
    standardized = (action - mean) * jnp.exp(-log_std)
    return -0.5 * jnp.sum(jnp.square(standardized) + 2.0 * log_std + _LOG_TWO_PI, axis=-1)


def entropy(log_std: jax.Array) -> jax.Array:
    """Differential entropy, [...]: sum_a (log std + (1 + log 2 pi) / 2). Source: H of paper II.E."""
    return jnp.sum(log_std + 0.5 * (1.0 + _LOG_TWO_PI), axis=-1)
