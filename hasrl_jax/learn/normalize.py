"""Running mean and variance of observations.

The statistics that collectors acted with are those an update must use, or the ratio of a fresh batch would not be 1.
The learner therefore adds a batch only after it has trained on it; the result takes effect with the next version.
Differs from the paper: its observations are not normalised (`network.normalize_observations: false`).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

# Statistics from elsewhere count as so many: sixty default iterations move them half way to those of a new task.
GIVEN_OBSERVATIONS = 1e6
MINIMUM_STD = 1e-2  # an almost constant observation must not become large noise


class Normalizer(NamedTuple):
    """Sufficient statistics of all observations seen; part of a checkpoint."""

    count: jax.Array  # type: ignore[assignment]  # [] float32, observations counted
    mean: jax.Array  # [O] float32
    m2: jax.Array  # [O] float32, sum of squared distances from the mean


def initial_normalizer(observation_size: int) -> Normalizer:
    """No observation seen yet."""
    return Normalizer(jnp.zeros(()), jnp.zeros((observation_size,)), jnp.zeros((observation_size,)))


def from_mean_std(mean: jax.Array, std: jax.Array) -> Normalizer:
    """Statistics known only by their mean and standard deviation, [O] each; they count as GIVEN_OBSERVATIONS."""
    return Normalizer(jnp.asarray(GIVEN_OBSERVATIONS, jnp.float32), mean, GIVEN_OBSERVATIONS * jnp.square(std))


def update(normalizer: Normalizer, observation: jax.Array, mask: jax.Array) -> Normalizer:
    """Adds a batch, by the pairwise formula that does not cancel when the mean is far from zero.

        d = mean_B - mean_A,   mean = mean_A + d n_B / n,   m2 = m2_A + m2_B + d^2 n_A n_B / n

    Args:
      normalizer: statistics so far.
      observation: [..., O] raw; anything, even NaN, where the mask is False.
      mask: [...] bool, which observations count.

    Returns:
      The merged statistics.

    Source: Chan, Golub and LeVeque (1979), pairwise merge of sample moments.
    """
    weight = mask[..., None].astype(jnp.float32)
    observation = jnp.where(mask[..., None], observation, 0.0)
    axes = tuple(range(observation.ndim - 1))
    batch_count = jnp.sum(weight)
    batch_mean = jnp.sum(observation, axes) / jnp.maximum(batch_count, 1.0)
    batch_m2 = jnp.sum(weight * jnp.square(observation - batch_mean), axes)
    count = normalizer.count + batch_count
    batch_share = batch_count / jnp.maximum(count, 1.0)
    difference = batch_mean - normalizer.mean
    return Normalizer(
        count=count,
        mean=normalizer.mean + difference * batch_share,
        m2=normalizer.m2 + batch_m2 + jnp.square(difference) * normalizer.count * batch_share,
    )


def mean_std(normalizer: Normalizer, enabled: bool = True) -> tuple[jax.Array | None, jax.Array | None]:
    """(mean [O], standard deviation [O]); 0 and 1 before any observation, None for both when disabled."""
    if not enabled:
        return None, None
    zeros, ones = jnp.zeros_like(normalizer.mean), jnp.ones_like(normalizer.mean)
    std = jnp.maximum(jnp.sqrt(normalizer.m2 / jnp.maximum(normalizer.count, 1.0)), MINIMUM_STD)
    seen = normalizer.count > 0
    return jnp.where(seen, normalizer.mean, zeros), jnp.where(seen, std, ones)
