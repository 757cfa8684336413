"""Returns and advantages against numbers worked out by hand."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hasrl_jax.learn import returns

# One trajectory, discount 0.5: an episode that terminates at step 1, one that is both terminated and truncated at
# step 2, one that is truncated at step 4, then padding full of garbage.
REWARD = [1.0, 2.0, 3.0, 4.0, 5.0, 99.0]
VALUE = [0.5, 1.0, 1.5, 2.0, 2.5, 77.0]
TERMINATED = [False, True, True, False, False, True]
TRUNCATED = [False, False, True, False, True, True]
BOOTSTRAP = [0.0, 0.0, 100.0, 0.0, 6.0, 55.0]
MASK = [True, True, True, True, True, False]


def _call(setting: str, gae_lambda: float = 0.5) -> tuple[np.ndarray, np.ndarray]:
    fields = [jnp.asarray([x]) for x in (REWARD, VALUE, TERMINATED, TRUNCATED, BOOTSTRAP, MASK)]
    advantage, target = returns.advantage_and_target(*fields, discount=0.5, gae_lambda=gae_lambda, setting=setting)
    return np.asarray(advantage[0]), np.asarray(target[0])


def test_return_setting_by_hand() -> None:
    # R4 = 5 + 0.5 * 6, R3 = 4 + 0.5 * R4, R2 = 3 (terminated wins), R1 = 2, R0 = 1 + 0.5 * R1.
    expected = np.array([2.0, 2.0, 3.0, 8.0, 8.0, 0.0])
    advantage, target = _call("return")
    np.testing.assert_allclose(target, expected, atol=1e-6)
    np.testing.assert_allclose(advantage[:5], expected[:5] - np.array(VALUE[:5]), atol=1e-6)
    assert advantage[5] == 0.0


def test_gae_setting_by_hand() -> None:
    # delta = [1 + 0.5*1 - 0.5, 2 - 1, 3 - 1.5, 4 + 0.5*2.5 - 2, 5 + 0.5*6 - 2.5]; decay 0.25 where nothing ended.
    expected = np.array([1.0 + 0.25 * 1.0, 1.0, 1.5, 3.25 + 0.25 * 5.5, 5.5, 0.0])
    advantage, target = _call("gae")
    np.testing.assert_allclose(advantage, expected, atol=1e-6)
    np.testing.assert_allclose(target[:5], expected[:5] + np.array(VALUE[:5]), atol=1e-6)


def test_a_cut_in_the_middle_of_a_row_lends_only_its_bootstrap_value() -> None:
    # Discount 0.5, lambda 0.5; the episode is cut at step 1, another fills steps 2 and 3 and is cut, too.
    no = jnp.zeros((1, 4), bool)
    reward, value = jnp.asarray([[1.0, 2.0, 3.0, 4.0]]), jnp.asarray([[0.0, 1.0, 10.0, 20.0]])
    truncated, bootstrap = jnp.asarray([[False, True, False, True]]), jnp.asarray([[9.0, 8.0, 9.0, 6.0]])
    arguments = reward, value, no, truncated, bootstrap, ~no, 0.5, 0.5
    # Deltas: 1 + 0.5 * 1, 2 + 0.5 * 8 - 1, 3 + 0.5 * 20 - 10, 4 + 0.5 * 6 - 20; decay 0.25 at steps 0 and 2 alone.
    advantage, target = returns.advantage_and_target(*arguments)
    np.testing.assert_allclose(advantage, [[1.5 + 0.25 * 5.0, 5.0, 3.0 - 0.25 * 13.0, -13.0]], atol=1e-6)
    np.testing.assert_allclose(target, [[2.75, 6.0, 9.75, 7.0]], atol=1e-6)
    # R3 = 4 + 0.5 * 6, R2 = 3 + 0.5 * R3, R1 = 2 + 0.5 * 8, R0 = 1 + 0.5 * R1.
    _, target = returns.advantage_and_target(*arguments, setting="return")
    np.testing.assert_allclose(target, [[4.0, 6.0, 6.5, 7.0]], atol=1e-6)


def test_masked_step_in_the_middle_cuts_the_recursion() -> None:
    ones = jnp.ones((1, 3))
    no = jnp.zeros((1, 3), bool)
    mask = jnp.asarray([[True, False, True]])
    _, target = returns.advantage_and_target(
        ones * jnp.asarray([[1.0, jnp.nan, 1.0]]),
        ones,
        no,
        no | jnp.asarray([[False, False, True]]),
        ones,
        mask,
        1.0,
        1.0,
    )
    np.testing.assert_allclose(target, [[1.0, 0.0, 2.0]], atol=1e-6)


def test_masked_statistics_against_numpy() -> None:
    values = np.random.default_rng(0).normal(3.0, 2.0, (4, 5)).astype(np.float32)
    mask = np.random.default_rng(1).random((4, 5)) < 0.6
    standardized = np.asarray(returns.masked_standardize(jnp.asarray(values), jnp.asarray(mask)))
    expected = (values[mask] - values[mask].mean()) / values[mask].std()
    np.testing.assert_allclose(standardized[mask], expected, atol=1e-5)
    assert not standardized[~mask].any()


def test_almost_equal_advantages_are_not_blown_up() -> None:
    # The standard deviation is 1e-8, and so is what is added to it: the rounding of equal numbers stays small.
    tiny = jnp.asarray([[1e-8, -1e-8]])
    np.testing.assert_allclose(returns.masked_standardize(tiny, jnp.ones((1, 2), bool)), [[0.5, -0.5]], rtol=1e-5)


@pytest.mark.parametrize("helper", [returns.masked_mean, returns.masked_variance])
def test_masked_statistics_of_nothing_are_zero(helper: Callable[[jax.Array, jax.Array], jax.Array]) -> None:
    assert float(helper(jnp.full((2, 2), 5.0), jnp.zeros((2, 2), bool))) == 0.0
    assert np.isfinite(jax.grad(lambda x: helper(x, jnp.zeros((2, 2), bool)))(jnp.ones((2, 2)))).all()
