"""Running statistics against NumPy."""

import jax.numpy as jnp
import numpy as np

from hasrl_jax.learn import normalize


def test_merged_batches_equal_numpy_over_all_valid_rows() -> None:
    rng = np.random.default_rng(0)
    normalizer, kept = normalize.initial_normalizer(3), []
    for rows in (1, 7, 50):
        batch = (rng.normal(size=(rows, 4, 3)) * [1.0, 5.0, 0.1] + [1000.0, -3.0, 0.0]).astype(np.float32)
        mask = rng.random((rows, 4)) < 0.7
        kept.append(batch[mask])
        normalizer = normalize.update(
            normalizer, jnp.asarray(np.where(mask[..., None], batch, np.nan)), jnp.asarray(mask)
        )
    mean, std = normalize.mean_std(normalizer)
    everything = np.concatenate(kept).astype(np.float64)
    assert float(normalizer.count) == len(everything)
    np.testing.assert_allclose(mean, everything.mean(0), rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(std, everything.std(0), rtol=1e-4)


def test_without_data_or_disabled_it_changes_nothing() -> None:
    empty = normalize.initial_normalizer(2)
    still_empty = normalize.update(empty, jnp.full((3, 2), jnp.nan), jnp.zeros(3, bool))
    full = normalize.update(empty, jnp.asarray([[1.0, 2.0], [3.0, 6.0]]), jnp.ones(2, bool))
    mean, std = normalize.mean_std(still_empty)
    assert not np.asarray(mean).any()
    np.testing.assert_array_equal(std, [1.0, 1.0])
    assert normalize.mean_std(full, enabled=False) == (None, None)


def test_a_constant_observation_has_the_least_deviation() -> None:
    normalizer = normalize.update(normalize.initial_normalizer(1), jnp.full((5, 1), 4.0), jnp.ones(5, bool))
    assert float(normalize.mean_std(normalizer)[1][0]) == np.float32(normalize.MINIMUM_STD)
