"""Shapes, resets, gradients and symmetry of the networks."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hasrl_jax.config.schema import NetworkConfig
from hasrl_jax.learn import lstm
from hasrl_jax.learn.networks import Mirror, Policy, make_networks, zero_carry

OBSERVATION, ACTION, H, B, T = 6, 4, 8, 3, 7
MIRROR = Mirror(np.array([1, 0, 2, 3, 5, 4]), np.array([1, 1, -1, 1, -1, -1]), np.array([2, 3, 0, 1]), np.ones(4))


@functools.cache
def _networks(symmetric: bool = False) -> tuple[Any, Any, Any, Any]:
    """(compiled policy, its parameters, compiled value, its parameters)."""
    policy, value = make_networks(NetworkConfig(hidden_size=H, symmetric=symmetric), OBSERVATION, ACTION, MIRROR)
    params = jax.jit(policy.init)(jax.random.PRNGKey(0), jnp.zeros((1, OBSERVATION)))
    # The initial head is almost zero; a larger one makes the tests sensitive.
    params = {"params": params["params"] | {"mean_kernel": jax.random.normal(jax.random.PRNGKey(1), (H, ACTION))}}
    value_params = jax.jit(value.init)(jax.random.PRNGKey(2), jnp.zeros((1, OBSERVATION)))
    return jax.jit(policy.apply), params, jax.jit(value.apply), value_params


def _data(symmetric: bool = False) -> tuple[jax.Array, jax.Array, jax.Array]:
    rng = np.random.default_rng(0)
    carry = rng.normal(size=zero_carry(B, H, symmetric).shape) * 0.5
    is_first = np.zeros((B, T), bool)
    is_first[0, 0] = is_first[0, 3] = is_first[1, 5] = True
    return (
        jnp.asarray(rng.normal(size=(B, T, OBSERVATION)), jnp.float32),
        jnp.asarray(carry, jnp.float32),
        jnp.asarray(is_first),
    )


@pytest.mark.parametrize("symmetric", [False, True])
def test_scan_equals_stepping_with_resets_in_the_middle(symmetric: bool) -> None:
    policy, params, value, value_params = _networks(symmetric)
    observation, carry, is_first = _data(symmetric)
    mean, std = jnp.full(OBSERVATION, 0.2), jnp.full(OBSERVATION, 0.7)
    whole, last = policy(params, observation, carry, is_first, mean, std)
    assert whole.shape == (B, T, ACTION)
    for t in range(T):
        step, carry = policy(params, observation[:, t], carry, is_first[:, t], mean, std)
        np.testing.assert_allclose(step, whole[:, t], atol=1e-6)
    np.testing.assert_allclose(carry, last, atol=1e-6)
    values = value(value_params, observation, mean, std)
    assert values.shape == (B, T)
    np.testing.assert_allclose(value(value_params, observation[:, 2], mean, std), values[:, 2], atol=1e-6)


def test_the_named_parameters_rebuild_the_policy_in_numpy() -> None:
    policy, params, _, _ = _networks()
    observation, carry, _ = _data()
    p = {name: np.asarray(array) for name, array in params["params"].items()}
    expected, expected_carry = policy(
        params, observation[:, 0] * 20, carry, None, jnp.full(OBSERVATION, 0.5), jnp.full(OBSERVATION, 2.0)
    )
    x = np.clip((np.asarray(observation[:, 0]) * 20 - 0.5) / 2.0, -10, 10)
    for layer in (0, 1):
        h, c = np.asarray(carry[:, layer, 0]), np.asarray(carry[:, layer, 1])
        gates = x @ p[f"lstm_{layer}_input"] + h @ p[f"lstm_{layer}_recurrent"] + p[f"lstm_{layer}_bias"]
        i, f, g, o = np.split(gates, 4, axis=-1)
        c = c / (1 + np.exp(-f)) + np.tanh(g) / (1 + np.exp(-i))
        h = np.tanh(c) / (1 + np.exp(-o))
        np.testing.assert_allclose(expected_carry[:, layer], np.stack([h, c], 1), atol=1e-6)
        x = np.tanh(h)
    np.testing.assert_allclose(expected, np.tanh(x @ p["mean_kernel"] + p["mean_bias"]), atol=1e-6)


def test_without_memory_every_step_stands_for_itself() -> None:
    network = NetworkConfig(hidden_size=H, memory="none")
    policy, _ = make_networks(network, OBSERVATION, ACTION, None)
    params = jax.jit(policy.init)(jax.random.PRNGKey(0), jnp.zeros((1, OBSERVATION)))
    rng = np.random.default_rng(1)
    p = {name: rng.normal(size=array.shape).astype(np.float32) for name, array in params["params"].items()}
    assert {name: array.shape for name, array in p.items()} == {
        "dense_0_kernel": (OBSERVATION, H),
        "dense_0_bias": (H,),
        "dense_1_kernel": (H, H),
        "dense_1_bias": (H,),
        "mean_kernel": (H, ACTION),
        "mean_bias": (ACTION,),
        "log_std": (ACTION,),
    }
    observation, _, is_first = _data()
    carry = jnp.zeros((B, *network.carry_shape))
    assert carry.size == 0
    mean, following = policy.apply({"params": p}, observation, carry, is_first, jnp.full(OBSERVATION, 0.2), jnp.ones(1))
    x = np.tanh((np.asarray(observation) - 0.2) @ p["dense_0_kernel"] + p["dense_0_bias"])
    x = np.tanh(x @ p["dense_1_kernel"] + p["dense_1_bias"])
    np.testing.assert_allclose(mean, np.tanh(x @ p["mean_kernel"] + p["mean_bias"]), atol=1e-5)
    assert following.shape == carry.shape


def test_the_hand_written_gradient_equals_automatic_differentiation() -> None:
    rng = np.random.default_rng(0)
    shapes = {"projected": (T, B, 4 * H), "recurrent": (H, 4 * H), "hidden": (B, H), "cell": (B, H)}
    args = [jnp.asarray(rng.normal(size=shape), jnp.float32) for shape in shapes.values()]
    keep = jnp.asarray(rng.random((T, B, 1)) < 0.7, jnp.float32)
    weights = [jnp.asarray(rng.normal(size=shape), jnp.float32) for shape in ((T, B, H), (B, H), (B, H))]

    def loss(recurrence: Any, *args: jax.Array) -> jax.Array:
        return sum(jnp.sum(w * out) for w, out in zip(weights, recurrence(*args, keep), strict=True))

    ours = jax.jit(jax.grad(functools.partial(loss, lstm._recurrence), (0, 1, 2, 3)))(*args)
    automatic = jax.jit(jax.grad(functools.partial(loss, lstm._recurrence.fun), (0, 1, 2, 3)))(*args)
    for name, left, right in zip(shapes, ours, automatic, strict=True):
        np.testing.assert_allclose(left, right, rtol=2e-4, atol=2e-5, err_msg=name)


def test_symmetric_policy_is_equivariant_and_value_invariant() -> None:
    policy, params, value, value_params = _networks(symmetric=True)
    observation, _, is_first = _data(symmetric=True)
    mean, std = jnp.arange(OBSERVATION) * 0.1, 1.0 + jnp.arange(OBSERVATION) * 0.3  # not symmetric themselves
    mirrored = MIRROR.observation(observation)
    action, _ = policy(params, observation, None, is_first, mean, std)
    mirrored_action, _ = policy(params, mirrored, None, is_first, mean, std)
    np.testing.assert_allclose(mirrored_action, MIRROR.action(action), atol=1e-6)
    assert np.abs(np.asarray(mirrored_action - action)).max() > 0.01
    values, mirrored_values = (value(value_params, x, mean, std) for x in (observation, mirrored))
    np.testing.assert_allclose(values, mirrored_values, atol=1e-6)
    uneven = {"params": params["params"] | {"log_std": jnp.arange(4.0)}}
    network, _ = make_networks(NetworkConfig(hidden_size=H, symmetric=True), OBSERVATION, ACTION, MIRROR)
    np.testing.assert_allclose(network.apply(uneven, method=Policy.log_std), [1.0, 2.0, 1.0, 2.0])


def test_initial_policy_acts_near_zero_with_the_configured_deviation() -> None:
    policy, _ = make_networks(NetworkConfig(hidden_size=H, initial_log_std=-1.5), OBSERVATION, ACTION, None)
    params = jax.jit(policy.init)(jax.random.PRNGKey(0), jnp.zeros((1, OBSERVATION)))
    mean, _ = jax.jit(policy.apply)(params, _data()[0])
    assert np.abs(np.asarray(mean)).max() < 0.05
    np.testing.assert_allclose(policy.apply(params, method=Policy.log_std), -1.5)


def test_symmetric_without_a_usable_mirror_is_refused() -> None:
    with pytest.raises(ValueError, match="no mirror"):
        make_networks(NetworkConfig(symmetric=True), OBSERVATION, ACTION, None)
    with pytest.raises(ValueError, match="identity"):
        make_networks(
            NetworkConfig(symmetric=True), OBSERVATION, ACTION, MIRROR._replace(action_index=np.array([1, 2, 3, 0]))
        )
