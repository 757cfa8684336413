"""The Gaussian against numerical integration and sample averages."""

import jax
import jax.numpy as jnp
import numpy as np

from hasrl_jax.learn import distributions

MEAN, LOG_STD = jnp.asarray([0.3, -0.5]), jnp.asarray([-0.2, 0.4])


def test_density_integrates_to_one_and_gives_entropy() -> None:
    axis = np.linspace(-12.0, 12.0, 601)
    points = jnp.asarray(np.stack(np.meshgrid(axis, axis, indexing="ij"), -1), jnp.float32)
    log_p = np.asarray(distributions.log_prob(points, MEAN, LOG_STD), np.float64)
    cell = (axis[1] - axis[0]) ** 2
    p = np.exp(log_p) * cell
    np.testing.assert_allclose(p.sum(), 1.0, rtol=1e-4)
    np.testing.assert_allclose((p[..., None] * points).sum(axis=(0, 1)), MEAN, rtol=1e-3)
    np.testing.assert_allclose(distributions.entropy(LOG_STD), -(p * log_p).sum(), rtol=1e-4)


def test_samples_have_the_mean_and_deviation() -> None:
    draws = distributions.sample(jax.random.PRNGKey(0), jnp.tile(MEAN, (20000, 1)), LOG_STD)
    np.testing.assert_allclose(draws.mean(0), MEAN, atol=0.05)
    np.testing.assert_allclose(draws.std(0), np.exp(LOG_STD), rtol=0.03)
