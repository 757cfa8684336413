"""The update as a whole. The batches are small so that the file runs in seconds."""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hasrl_jax.config.schema import Config, NetworkConfig, PPOConfig
from hasrl_jax.learn import distributions, losses, networks, normalize, ppo
from hasrl_jax.learn.networks import make_networks, zero_carry
from hasrl_jax.types import Mirror, Trajectory

OBSERVATION, ACTION, H, B, T = 5, 2, 8, 16, 6
NETWORK = NetworkConfig(hidden_size=H)
PPO = PPOConfig(epochs=2, minibatch_trajectories=8, entropy_coefficient=0.01)


def _config(network: dict[str, Any] | None = None, **changes: Any) -> Config:
    return Config(network=dataclasses.replace(NETWORK, **(network or {})), ppo=dataclasses.replace(PPO, **changes))


@functools.cache
def _compiled(config: Config, devices: int) -> tuple[ppo.LearnerState, ppo.Update]:
    """One program per configuration for the whole file: compiling is what takes the time here."""
    mesh = ppo.make_mesh(jax.devices()[:devices])
    state = ppo.init_learner(config, OBSERVATION, ACTION, None, jax.random.PRNGKey(0))
    return jax.device_get(state), ppo.make_update(config, OBSERVATION, ACTION, None, mesh)


def _learner(config: Config, devices: int = 1) -> tuple[ppo.LearnerState, ppo.Update]:
    state, update = _compiled(config, devices)
    return jax.tree.map(jnp.array, state), update  # a copy, since an update donates its state


@functools.cache
def _networks(config: NetworkConfig) -> tuple[Any, Any]:
    policy, value = make_networks(config, OBSERVATION, ACTION, None)
    apply_policy = jax.jit(lambda params, *args: policy.apply({"params": params}, *args)[0])
    return apply_policy, jax.jit(lambda params, *args: value.apply({"params": params}, *args))


def _fresh(state: ppo.LearnerState, lengths: np.ndarray, seed: int = 0) -> Trajectory:
    """Trajectories that the state's own policy produces: rows of the given lengths, padded with zeros."""
    rng = np.random.default_rng(seed)
    policy, value = _networks(NETWORK)
    observation = rng.normal(1.0, 2.0, (B, T, OBSERVATION)).astype(np.float32)
    is_first = np.zeros((B, T), bool)
    is_first[::3, 2] = True
    mean, std = normalize.mean_std(state.normalizer)
    action_mean = policy(state.policy_params, observation, None, is_first, mean, std)
    log_std = state.policy_params["log_std"]
    action = distributions.sample(jax.random.PRNGKey(seed), action_mean, log_std)
    mask = np.arange(T) < lengths[:, None]
    truncated = np.arange(T) == lengths[:, None] - 1
    truncated[1::3] = False
    terminated = (np.arange(T) == lengths[:, None] - 1) & ~truncated
    steps = Trajectory(
        observation=observation,
        action=action,
        log_prob=distributions.log_prob(action, action_mean, log_std),
        value=value(state.value_params, observation, mean, std),
        reward=rng.normal(size=(B, T)).astype(np.float32),
        is_first=is_first,
        terminated=terminated,
        truncated=truncated,
        bootstrap_value=truncated.astype(np.float32),
        mask=mask,
        initial_carry=np.zeros((B, T)),
        policy_version=np.zeros((B, T)),
    )
    steps = jax.tree.map(lambda x: np.where(mask.reshape(B, T, *(1,) * (np.ndim(x) - 2)), x, 0).astype(x.dtype), steps)
    return steps._replace(initial_carry=zero_carry(B, H), policy_version=np.zeros(B, np.int32))


LENGTHS = np.array([6, 3, 5, 1, 6, 6, 2, 4, 6, 0, 5, 6, 3, 6, 6, 2])


def _numbers(tree: Any) -> list[np.ndarray]:
    return [np.asarray(leaf) for leaf in jax.tree.leaves(tree)]


def test_fresh_batch_has_ratio_one_also_after_the_normalizer_has_moved() -> None:
    state, update = _learner(_config())
    for seed in range(2):
        state, metrics = update(state, _fresh(state, LENGTHS, seed))
        np.testing.assert_allclose(metrics["ratio_first"], 1.0, atol=1e-5)
        assert np.isfinite(_numbers(metrics)).all()
        assert all(m.dtype == jnp.float32 for m in metrics.values())
    assert float(metrics["policy_updates"]) > 0
    assert int(state.update_count) == 2
    assert int(state.env_steps) == 2 * LENGTHS.sum() == float(state.normalizer.count)


def test_padding_cannot_change_anything() -> None:
    results = []
    for garbage in (0.0, 37.0):
        state, update = _learner(_config())
        trajectory = _fresh(state, LENGTHS)
        names = [n for n in Trajectory._fields if n not in ("mask", "initial_carry", "policy_version")]
        padding = ~trajectory.mask
        filled = {n: getattr(trajectory, n).copy() for n in names}
        for array in filled.values():
            array[padding] = garbage
        results.append(_numbers(update(state, trajectory._replace(**filled))))
    for left, right in zip(*results, strict=True):
        np.testing.assert_array_equal(left, right)


def test_padding_cannot_change_the_gradients() -> None:
    config = _config()
    state, _ = _learner(config)
    policy, value = make_networks(config.network, OBSERVATION, ACTION, None)
    statistics = normalize.mean_std(state.normalizer)

    @jax.jit
    def gradients(trajectory: Trajectory) -> Any:
        batch, _ = ppo.prepare_batch(trajectory, config.ppo)
        batch = batch._replace(trajectory=trajectory)  # garbage back in: the masks of the losses alone must do
        actor = jax.grad(losses.policy_loss, has_aux=True)(state.policy_params, policy, batch, *statistics, config.ppo)
        return actor, jax.value_and_grad(losses.value_loss)(state.value_params, value, batch, *statistics, config.ppo)

    clean = _fresh(state, LENGTHS)
    dirty = clean._replace(observation=np.where(clean.mask[..., None], clean.observation, 5.0).astype(np.float32))
    for left, right in zip(_numbers(gradients(clean)), _numbers(gradients(dirty)), strict=True):
        np.testing.assert_array_equal(left, right)


def test_one_device_and_eight_give_the_same_update() -> None:
    """Sums over a batch are taken in another order on eight devices; Adam's first step, g / (|g| + 1e-5), magnifies
    that rounding for gradients near zero, hence a tolerance of 1e-5 on parameters that move by 3e-4 per step."""
    results = []
    for devices in (1, 8):
        state, update = _learner(_config(), devices)
        state, metrics = update(state, _fresh(state, LENGTHS))
        results.append((state, metrics))
    for left, right in zip(*map(_numbers, results), strict=True):
        np.testing.assert_allclose(left, right, rtol=1e-4, atol=1e-5)


def test_one_device_and_eight_give_the_same_update_of_a_symmetric_network_that_stops_on_the_way() -> None:
    """With lost steps in the middle of rows, GAE, stale rows and a KL limit that a later minibatch exceeds."""
    rng = np.random.default_rng(4)
    mirror = Mirror(np.array([1, 0, 2, 4, 3]), np.array([1, 1, -1, 1, 1]), np.array([1, 0]), np.array([1, 1]))
    config = _config(network={"symmetric": True}, max_kl=0.01, policy_learning_rate=0.05, gae_lambda=0.7, epochs=3)
    config = dataclasses.replace(config, schedule="decoupled")
    mask = (np.arange(T) < LENGTHS[:, None]) & (rng.random((B, T)) < 0.8)
    steps = _fresh(_learner(_config())[0], LENGTHS)
    carry = rng.normal(0, 0.3, zero_carry(B, H, symmetric=True).shape).astype(np.float32)
    version = rng.integers(0, 3, B).astype(np.int32)
    cut = rng.random((B, T)) < 0.2
    results = []
    for devices in (1, 8):
        sizes = OBSERVATION, ACTION, mirror
        state = ppo.init_learner(config, *sizes, jax.random.PRNGKey(0))._replace(update_count=jnp.int32(2))
        policy, _ = make_networks(config.network, *sizes)
        mean = policy.apply({"params": state.policy_params}, steps.observation, carry, steps.is_first)[0]
        log_prob = distributions.log_prob(steps.action, mean, networks.log_std(policy, state.policy_params))
        trajectory = steps._replace(
            mask=mask, initial_carry=carry, policy_version=version, truncated=steps.truncated | cut, log_prob=log_prob
        )
        update = ppo.make_update(config, *sizes, ppo.make_mesh(jax.devices()[:devices]))
        results.append(update(state, jax.tree.map(np.asarray, trajectory)))
    assert 0 < float(results[0][1]["policy_updates"]) < 6
    for left, right in zip(*map(_numbers, results), strict=True):
        np.testing.assert_allclose(left, right, rtol=1e-3, atol=2e-3 * 0.05)


def test_same_seed_same_numbers_and_no_recompile() -> None:
    results = []
    for _ in range(2):
        state, update = _learner(_config())
        for seed in range(3):
            state, metrics = update(state, _fresh(state, LENGTHS, seed))
        assert update.trace_count == 1
        assert update._jitted._cache_size() == 1
        results.append(_numbers((state, metrics)))
    for left, right in zip(*results, strict=True):
        np.testing.assert_array_equal(left, right)


def test_mask_padding_false_dilutes_the_ratio_as_published() -> None:
    config = _config(mask_padding=False)
    state, _ = _learner(_config())
    policy, _ = make_networks(config.network, OBSERVATION, ACTION, None)
    batch, _ = ppo.prepare_batch(jax.tree.map(jnp.asarray, _fresh(state, LENGTHS)), config.ppo)
    statistics = normalize.mean_std(state.normalizer)
    _, metrics = jax.jit(lambda p: losses.policy_loss(p, policy, batch, *statistics, config.ppo))(state.policy_params)
    at_zero = np.exp(distributions.log_prob(jnp.zeros(ACTION), jnp.zeros(ACTION), state.policy_params["log_std"]))
    valid = LENGTHS.sum() / (B * T)
    # The initial mean action is within about 0.01 of zero, which is the "action" of a padded step.
    np.testing.assert_allclose(metrics["ratio_mean"], valid + (1 - valid) * at_zero, atol=1e-3)
    assert float(metrics["ratio_mean"]) < 0.8
    np.testing.assert_allclose(metrics["approx_kl"], 0.0, atol=1e-6)


def test_max_kl_linear_schedule_and_fixed_deviation() -> None:
    config = _config(
        network={"learn_std": False}, max_kl=1e-7, policy_learning_rate=0.05, learning_rate_schedule="linear"
    )
    state, update = _learner(config)
    value_before, rates, applied = _numbers(state.value_params), [], []
    for seed in range(3):
        state, metrics = update(state, _fresh(state, LENGTHS, seed), progress=seed / 2)
        rates.append(float(metrics["learning_rate"]) / config.ppo.policy_learning_rate)
        applied.append(float(metrics["policy_updates"]))
    np.testing.assert_allclose(rates, [1.0, 0.5, 0.0], atol=1e-6)
    assert not np.asarray(state.policy_params["log_std"]).any()
    # One step of 0.05 exceeds the limit at once; with a rate of zero nothing moves and all four minibatches count.
    assert applied == [1.0, 1.0, 4.0]
    assert int(state.policy_opt_state[1].count) == 6
    assert int(state.value_opt_state[1].count) == 12
    assert any((x != y).any() for x, y in zip(value_before, _numbers(state.value_params), strict=True))


def test_shapes_that_do_not_divide_are_refused() -> None:
    state, update = _learner(_config(minibatch_trajectories=6))
    with pytest.raises(ValueError, match="multiple of the minibatch"):
        update(state, _fresh(state, LENGTHS))


def test_export_names_and_types() -> None:
    state, _ = _learner(_config())
    exported = ppo.export_parameters(state)
    policy = [f"lstm_{layer}_{kind}" for layer in (0, 1) for kind in ("input", "recurrent", "bias")]
    policy += ["mean_kernel", "mean_bias", "log_std"]
    value = [f"dense_{layer}_{kind}" for layer in (0, 1, 2) for kind in ("kernel", "bias")]
    names = {f"policy/{n}" for n in policy} | {f"value/{n}" for n in value} | {"normalizer/mean", "normalizer/std"}
    assert set(exported) == names
    assert all(isinstance(x, np.ndarray) and x.dtype == np.float32 for x in exported.values())


def test_learns_a_bandit_whose_best_action_depends_on_the_observation() -> None:
    """Reward -|a - 0.5 sign(o)|^2, one step per episode; the best mean action is +-0.5."""
    config = _config(
        network={"initial_log_std": -0.7}, epochs=5, minibatch_trajectories=B, policy_learning_rate=5e-3, max_kl=0.0
    )
    state, update = _learner(config)
    policy, _ = _networks(NETWORK)
    rng = np.random.default_rng(0)

    def play(state: ppo.LearnerState) -> tuple[Trajectory, float]:
        rows, ones = B, np.ones((B, 1), bool)
        observation = rng.choice([-1.0, 1.0], (rows, 1, OBSERVATION)).astype(np.float32)
        mean = np.asarray(policy(state.policy_params, observation, None, None, *normalize.mean_std(state.normalizer)))
        log_std = state.policy_params["log_std"]
        action = mean + np.exp(np.asarray(log_std)) * rng.normal(size=mean.shape).astype(np.float32)
        best = 0.5 * observation[..., :ACTION]
        nothing = np.zeros((rows, 1), np.float32)
        trajectory = Trajectory(
            observation=observation,
            action=action,
            log_prob=distributions.log_prob(action, mean, log_std),
            value=nothing,
            reward=-np.sum((action - best) ** 2, -1),
            is_first=ones,
            terminated=ones,
            truncated=~ones,
            bootstrap_value=nothing,
            mask=ones,
            initial_carry=zero_carry(rows, H),
            policy_version=np.zeros(rows, np.int32),
        )
        return trajectory, float(np.mean(np.sum((mean - best) ** 2, -1)))

    trajectory, first_error = play(state)
    for _ in range(30):
        state, _ = update(state, trajectory)
        trajectory, error = play(state)
    assert error < 0.25 * first_error


@functools.cache
def _correct() -> Any:
    """`(state, trajectory) -> (batch, corrected batch)`."""
    policy, _ = make_networks(NETWORK, OBSERVATION, ACTION, None)

    def compute(state: ppo.LearnerState, trajectory: Trajectory) -> tuple[losses.Batch, losses.Batch]:
        batch, _ = losses.prepare_batch(trajectory, PPO)
        acted = state.policy_params, policy, *normalize.mean_std(state.normalizer), state.update_count
        return batch, losses.correct_for_lag(batch, *acted, 2.0)[0]

    return jax.jit(compute)


def _loss(params: Any, state: ppo.LearnerState, batch: losses.Batch) -> tuple[jax.Array, losses.Metrics]:
    """Operation by operation: a compiler would round the two losses differently where it fuses them."""
    policy, _ = make_networks(NETWORK, OBSERVATION, ACTION, None)
    return losses.policy_loss(params, policy, batch, *normalize.mean_std(state.normalizer), PPO)


def _moved(state: ppo.LearnerState, by: float) -> Any:
    return jax.tree.map(
        lambda leaf: leaf + by * jnp.cos(jnp.arange(leaf.size)).reshape(leaf.shape), state.policy_params
    )


def test_fresh_data_gives_exactly_the_ordinary_loss() -> None:
    state, _ = _learner(_config())
    trajectory = _fresh(state, LENGTHS)
    plain, corrected = _correct()(state, trajectory)
    np.testing.assert_array_equal(corrected.proximal_log_prob, trajectory.log_prob)
    np.testing.assert_array_equal(corrected.importance, 1.0)
    params, mask = _moved(state, 0.2), trajectory.mask
    loss, metrics = _loss(params, state, corrected)
    inputs = trajectory.observation, trajectory.initial_carry, trajectory.is_first
    mean = np.asarray(_networks(NETWORK)[0](params, *inputs, *normalize.mean_std(state.normalizer)), np.float64)
    log_std = np.asarray(params["log_std"], np.float64)
    density = np.exp(-0.5 * ((trajectory.action - mean) / np.exp(log_std)) ** 2 - log_std) / np.sqrt(2 * np.pi)
    ratio = density.prod(axis=-1)[mask] / np.exp(trajectory.log_prob[mask])
    assert ratio.min() < 0.8 and ratio.max() > 1.2
    advantage = np.asarray(plain.advantage, np.float64)[mask]
    bounded = np.where(advantage > 0, np.minimum(ratio, 1.2), np.maximum(ratio, 0.8))
    entropy = (log_std + 0.5 * np.log(2 * np.pi * np.e)).sum()
    np.testing.assert_allclose(loss, -(bounded * advantage).mean() - 0.01 * entropy, rtol=1e-4)
    np.testing.assert_allclose(metrics["clip_fraction"], np.mean((ratio < 0.8) | (ratio > 1.2)), rtol=1e-5)


@pytest.mark.parametrize(
    ("ratio", "advantage", "surrogate"),
    [
        (1.5, 2.0, 2.4),  # better and far enough: 1.2 * 2
        (1.5, -2.0, -3.0),  # worse and more likely: all of it counts
        (0.5, 2.0, 1.0),  # better and less likely: all of it counts
        (0.5, -2.0, -1.6),  # worse and far enough: 0.8 * -2
        (1.1, 2.0, 2.2),
        (0.9, -2.0, -1.8),
        (0.0, -1.0, -0.8),
        (np.inf, -1.0, -np.exp(20.0)),  # stays finite
    ],
)
def test_the_clipped_surrogate_by_hand(ratio: float, advantage: float, surrogate: float) -> None:
    state, _ = _learner(_config())
    batch, _ = losses.prepare_batch(jax.tree.map(jnp.asarray, _fresh(state, LENGTHS)), PPO)
    with np.errstate(divide="ignore"):
        proximal = batch.trajectory.log_prob - np.float32(np.log(ratio))
    full = jnp.full((B, T), advantage)
    policy, _ = make_networks(NETWORK, OBSERVATION, ACTION, None)
    arguments = batch._replace(proximal_log_prob=proximal, advantage=full), *normalize.mean_std(state.normalizer)
    ppo_config = dataclasses.replace(PPO, entropy_coefficient=0.0)
    loss, metrics = losses.policy_loss(state.policy_params, policy, *arguments, ppo_config)
    np.testing.assert_allclose(loss, -surrogate, rtol=1e-5)
    assert float(metrics["clip_fraction"]) == (not 0.8 < ratio < 1.2)


def test_stale_data_is_weighted_and_clipped_around_the_policy_before_the_update() -> None:
    state, _ = _learner(_config())
    trajectory = _fresh(state, LENGTHS)
    now = state._replace(policy_params=_moved(state, 0.15), update_count=jnp.int32(3))  # the data is of version 0
    batch, corrected = _correct()(now, trajectory)
    loss, metrics = _loss(now.policy_params, now, corrected)
    # Before it has moved, every ratio is 1 and the loss is the weighted advantage.
    np.testing.assert_allclose(metrics["ratio_mean"], 1.0, rtol=1e-6)
    np.testing.assert_allclose(metrics["approx_kl"], 0.0, atol=1e-6)
    policy, _ = _networks(NETWORK)
    statistics = normalize.mean_std(state.normalizer)
    carry = trajectory.initial_carry
    mean = policy(now.policy_params, trajectory.observation, carry, trajectory.is_first, *statistics)
    log_prob = np.asarray(distributions.log_prob(trajectory.action, mean, now.policy_params["log_std"]))
    weight = np.minimum(np.exp(log_prob - trajectory.log_prob), 2.0)[trajectory.mask]
    assert weight.max() == 2.0 and weight.min() < 0.8
    advantage = np.asarray(batch.advantage)[trajectory.mask]
    entropy = float(distributions.entropy(now.policy_params["log_std"]))
    np.testing.assert_allclose(loss, -(weight * advantage).mean() - PPO.entropy_coefficient * entropy, rtol=1e-4)


def test_lag_is_measured_on_the_trajectories_and_a_replay_counts_nothing() -> None:
    config = dataclasses.replace(_config(), schedule="decoupled")
    state, update = _learner(config)
    state = state._replace(update_count=jnp.int32(7))
    version = np.array([7, 5, 4, *[6] * (B - 3)], np.int32)
    version[LENGTHS == 0] = -99  # an empty row says nothing
    state, metrics = update(state, _fresh(state, LENGTHS)._replace(policy_version=version))
    lag = 7 - version[LENGTHS > 0]
    found = [float(metrics[name]) for name in ("policy_lag", "policy_lag_min", "policy_lag_max")]
    np.testing.assert_allclose(found, [lag.mean(), 0, 3], rtol=1e-6)
    before = jax.tree.map(np.asarray, (state.env_steps, state.normalizer))
    state, _ = update(state, _fresh(state, LENGTHS), replayed=True)
    for left, right in zip(_numbers(before), _numbers((state.env_steps, state.normalizer)), strict=True):
        np.testing.assert_array_equal(left, right)
    assert int(state.update_count) == 9
    assert update._jitted._cache_size() == 1
