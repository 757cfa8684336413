"""The update against PPO written a second time: NumPy in double precision, gradients by central differences.

The oracle below shares no line with `hasrl_jax/learn`: it follows the paper's equations step by step, with loops.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hasrl_jax.config.convert import from_dict
from hasrl_jax.config.schema import Config, PPOConfig
from hasrl_jax.learn import normalize, ppo
from hasrl_jax.learn.batching import minibatch_indices
from hasrl_jax.types import Trajectory

OBSERVATION, ACTION, H, B, T = 3, 2, 2, 6, 5
NOW = 4  # version of the learner's parameters
PROGRESS = 0.25  # of the run
Numbers = dict[str, np.ndarray]
PPO = {
    **{"epochs": 2, "minibatch_trajectories": 3, "policy_learning_rate": 0.03, "value_learning_rate": 0.05},
    **{"adam_epsilon": 0.01, "max_gradient_norm": 0.3, "clip": 0.2, "entropy_coefficient": 0.07},
    **{"value_coefficient": 0.6, "discount": 0.9, "gae_lambda": 0.8, "max_kl": 0.0},
}


def _config(**changes: Any) -> Config:
    ppo_changes = {name: value for name, value in changes.items() if name in PPOConfig.__dataclass_fields__}
    rest = {name: value for name, value in changes.items() if name not in ppo_changes}
    return from_dict({"network": {"hidden_size": H}, "ppo": PPO | ppo_changes} | rest)


def _learner(config: Config) -> ppo.LearnerState:
    """A learner with parameters far from zero, statistics of 50 observations, and version NOW."""
    rng = np.random.default_rng(5)
    state = ppo.init_learner(config, OBSERVATION, ACTION, None, jax.random.PRNGKey(3))

    def spread(leaf: jax.Array) -> jax.Array:
        return jnp.asarray(rng.normal(0, 0.5, leaf.shape), jnp.float32)

    policy, value = jax.tree.map(spread, (state.policy_params, state.value_params))
    mean, std = np.array([0.5, -1.0, 0.0]), np.array([2.0, 0.5, 1.0])
    statistics = normalize.Normalizer(*(jnp.asarray(x, jnp.float32) for x in (50.0, mean, 50 * std**2)))
    return state._replace(policy_params=policy, value_params=value, normalizer=statistics, update_count=jnp.int32(NOW))


def _trajectory(state: ppo.LearnerState) -> Trajectory:
    """Rows with ends of each kind in the middle, a lost step and padding; its log-probabilities are off on purpose."""
    rng = np.random.default_rng(1)
    mask = np.arange(T) < np.array([5, 3, 5, 0, 4, 5])[:, None]
    mask[2, 2] = False  # of a simulation that diverged
    terminated, truncated, is_first = (np.zeros((B, T), bool) for _ in range(3))
    terminated[0, 1] = truncated[0, 4] = True
    truncated[1, 0] = truncated[1, 2] = True  # cut in the middle, valid steps follow
    truncated[2, 1] = truncated[2, 4] = True
    terminated[4, 3] = truncated[4, 3] = True  # both: the end of the task counts
    truncated[5, 2] = terminated[5, 4] = True
    is_first[0, 2] = is_first[1, 1] = is_first[2, 3] = is_first[5, 0] = is_first[5, 3] = True
    steps = Trajectory(
        observation=rng.normal(0, 1.5, (B, T, OBSERVATION)),
        action=rng.normal(0, 0.8, (B, T, ACTION)),
        log_prob=np.zeros((B, T)),
        value=rng.normal(0, 1, (B, T)),
        reward=rng.normal(0, 1, (B, T)),
        is_first=is_first,
        terminated=terminated,
        truncated=truncated,
        bootstrap_value=rng.normal(0, 2, (B, T)),
        mask=mask,
        initial_carry=rng.normal(0, 0.5, (B, 2, 2, H)),
        policy_version=np.array([NOW, NOW - 1, NOW, NOW, NOW - 3, NOW], np.int32),
    )
    log_prob = _log_prob(_double(state.policy_params), steps, *_mean_std(state))
    steps = steps._replace(log_prob=log_prob + rng.uniform(-0.5, 0.5, (B, T)))
    steps = jax.tree.map(lambda x: x.astype(np.float32) if x.dtype == np.float64 else x, steps)
    for name, field in steps._asdict().items():
        if name not in ("mask", "initial_carry", "policy_version"):
            field[~mask] = True if field.dtype == bool else np.nan
    return steps


# The oracle.


def _double(tree: Any) -> Any:
    return jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), tree)


def _mean_std(state: ppo.LearnerState) -> tuple[np.ndarray, np.ndarray]:
    count, mean, m2 = _double(tuple(state.normalizer))
    return mean, np.sqrt(m2 / count)


def _sigmoid(x: np.ndarray) -> np.ndarray:
    return 1 / (1 + np.exp(-x))


def _log_prob(p: Numbers, steps: Trajectory, mean: np.ndarray, std: np.ndarray) -> np.ndarray:
    """log pi(a | s), [B, T], with the memory of both layers zeroed where an episode begins."""
    hidden, cell = (np.array(steps.initial_carry[:, :, part], np.float64) for part in (0, 1))
    columns = []
    for t in range(steps.observation.shape[1]):
        x = np.clip((steps.observation[:, t] - mean) / std, -10, 10)
        for layer in (0, 1):
            hidden[steps.is_first[:, t], layer] = cell[steps.is_first[:, t], layer] = 0
            gates = x @ p[f"lstm_{layer}_input"] + hidden[:, layer] @ p[f"lstm_{layer}_recurrent"]
            write, forget, new, read = np.split(gates + p[f"lstm_{layer}_bias"], 4, axis=1)
            cell[:, layer] = _sigmoid(forget) * cell[:, layer] + _sigmoid(write) * np.tanh(new)
            hidden[:, layer] = _sigmoid(read) * np.tanh(cell[:, layer])
            x = np.tanh(hidden[:, layer])
        center, deviation = np.tanh(x @ p["mean_kernel"] + p["mean_bias"]), np.exp(p["log_std"])
        density = np.exp(-0.5 * ((steps.action[:, t] - center) / deviation) ** 2) / (deviation * np.sqrt(2 * np.pi))
        columns.append(np.log(density).sum(axis=1))
    return np.stack(columns, axis=1)


def _values(p: Numbers, observation: np.ndarray, mean: np.ndarray, std: np.ndarray) -> np.ndarray:
    x = np.clip((observation - mean) / std, -10, 10)
    x = np.tanh(x @ p["dense_0_kernel"] + p["dense_0_bias"])
    x = np.tanh(x @ p["dense_1_kernel"] + p["dense_1_bias"])
    return (x @ p["dense_2_kernel"] + p["dense_2_bias"])[..., 0]


def _advantages(steps: Trajectory, discount: float, decay: float) -> np.ndarray:
    """[B, T], backwards from every end; 0 where there is no step."""
    advantage = np.zeros((B, T))
    for row in range(B):
        for t in reversed(range(T)):
            if not steps.mask[row, t]:
                continue
            ended = steps.terminated[row, t] or steps.truncated[row, t]
            following, later = 0.0, 0.0
            if not ended and t + 1 < T and steps.mask[row, t + 1]:
                following, later = steps.value[row, t + 1], advantage[row, t + 1]
            elif steps.truncated[row, t] and not steps.terminated[row, t]:
                following = steps.bootstrap_value[row, t]
            error = steps.reward[row, t] + discount * following - steps.value[row, t]
            advantage[row, t] = error + discount * decay * later
    return advantage


class Batch(NamedTuple):
    steps: Trajectory
    advantage: np.ndarray
    target: np.ndarray
    weight: np.ndarray  # of each step in the means of the losses
    proximal: np.ndarray
    importance: np.ndarray


def _policy_loss(p: Numbers, batch: Batch, config: Config, statistics: Any) -> tuple[float, dict[str, float]]:
    clip, valid = config.ppo.clip, batch.steps.mask
    difference = _log_prob(p, batch.steps, *statistics) - batch.proximal
    ratio = np.exp(difference)
    # The smaller of the two terms, case by case (Schulman et al. 2017, figure 1).
    bounded = np.where(batch.advantage >= 0, np.minimum(ratio, 1 + clip), np.maximum(ratio, 1 - clip))
    entropy = sum(0.5 * np.log(2 * np.pi * np.e * np.exp(2 * deviation)) for deviation in p["log_std"])
    objective = (batch.weight * batch.importance * bounded * batch.advantage).sum() / batch.weight.sum()
    loss = -objective - config.ppo.entropy_coefficient * entropy
    return loss, {
        "actor_loss": loss,
        "entropy": entropy,
        "ratio_mean": (batch.weight * ratio).sum() / batch.weight.sum(),
        "approx_kl": np.mean(ratio[valid] - 1 - difference[valid]),
        "clip_fraction": np.mean((ratio[valid] < 1 - clip) | (ratio[valid] > 1 + clip)),
    }


def _value_loss(p: Numbers, batch: Batch, config: Config, statistics: Any) -> tuple[float, dict[str, float]]:
    error = _values(p, batch.steps.observation, *statistics) - batch.target
    loss = config.ppo.value_coefficient * (batch.weight * error**2).sum() / (2 * batch.weight.sum())
    return loss, {"critic_loss": loss}


class Adam:
    """Kingma and Ba (2015), algorithm 1, after a clip of the gradient's norm."""

    def __init__(self, p: Numbers, epsilon: float, largest_norm: float):
        self.p, self.epsilon, self.largest_norm, self.t = dict(p), epsilon, largest_norm, 0
        self.first, self.second = ({name: np.zeros_like(x) for name, x in p.items()} for _ in range(2))

    def step(self, gradient: Numbers, rate: float) -> float:
        """Returns the gradient's norm before the clip."""
        norm = np.sqrt(sum((g**2).sum() for g in gradient.values()))
        self.t += 1
        for name, g in gradient.items():
            if norm > self.largest_norm:
                g = g * self.largest_norm / norm
            self.first[name] = 0.9 * self.first[name] + 0.1 * g
            self.second[name] = 0.999 * self.second[name] + 0.001 * g**2
            m, v = self.first[name] / (1 - 0.9**self.t), self.second[name] / (1 - 0.999**self.t)
            self.p[name] = self.p[name] - rate * m / (np.sqrt(v) + self.epsilon)
        return norm


def _gradient(loss: Callable[[Numbers], float], p: Numbers, by: float = 1e-6) -> Numbers:
    """Central differences, one number after the other."""
    gradient = {name: np.zeros_like(x) for name, x in p.items()}
    for name, x in p.items():
        for index in np.ndindex(x.shape):
            ends = []
            for side in (by, -by):
                moved = x.copy()
                moved[index] += side
                ends.append(loss(p | {name: moved}))
            gradient[name][index] = (ends[0] - ends[1]) / (2 * by)
    return gradient


def _prepare(state: ppo.LearnerState, trajectory: Trajectory, config: Config) -> Batch:
    """Zeros where there is no step, advantages, and the policy that ratios are taken against."""
    mask, settings = trajectory.mask, config.ppo
    wide = jax.tree.map(np.array, trajectory)
    for name, field in wide._asdict().items():
        if name not in ("mask", "initial_carry", "policy_version"):
            field[~mask] = 0
    advantage = _advantages(wide, settings.discount, 1.0 if settings.advantage == "return" else settings.gae_lambda)
    target = advantage + wide.value
    if settings.standardize_advantages:
        advantage = np.where(mask, (advantage - advantage[mask].mean()) / advantage[mask].std(), 0)
    weight = mask.astype(float) if settings.mask_padding else np.ones((B, T))
    proximal, importance = wide.log_prob.astype(np.float64), np.ones((B, T))
    if config.schedule == "decoupled":
        stale = mask & (trajectory.policy_version != NOW)[:, None]
        now = _log_prob(_double(state.policy_params), wide, *_mean_std(state))
        importance[stale] = np.minimum(np.exp(now - proximal), config.decoupled.max_importance)[stale]
        proximal[stale] = now[stale]
    return Batch(wide, advantage, target, weight, proximal, importance)


def _expected(
    state: ppo.LearnerState, trajectory: Trajectory, config: Config
) -> tuple[Numbers, Numbers, dict[str, float]]:
    """Policy and value parameters after the update, and its metrics."""
    batch, statistics, settings = _prepare(state, trajectory, config), _mean_std(state), config.ppo
    limits = settings.adam_epsilon, settings.max_gradient_norm
    policy, value = Adam(_double(state.policy_params), *limits), Adam(_double(state.value_params), *limits)
    scale = 1.0
    if settings.learning_rate_schedule == "linear":
        scale = 1 - PROGRESS
    active, policy_history, value_history = True, [], []
    _, *keys = jax.random.split(state.key, 1 + settings.epochs)
    for key in keys:
        for rows in np.asarray(minibatch_indices(key, B, settings.minibatch_trajectories)):
            part = Batch(Trajectory(*(x[rows] for x in batch.steps)), *(x[rows] for x in batch[1:]))
            _, metrics = _value_loss(value.p, part, config, statistics)
            gradient = _gradient(lambda p, part=part: _value_loss(p, part, config, statistics)[0], value.p)
            metrics["value_gradient_norm"] = value.step(gradient, scale * settings.value_learning_rate)
            value_history.append(metrics)
            _, metrics = _policy_loss(policy.p, part, config, statistics)
            active = active and (not settings.max_kl or metrics["approx_kl"] <= settings.max_kl)
            gradient = _gradient(lambda p, part=part: _policy_loss(p, part, config, statistics)[0], policy.p)
            if active:
                metrics["policy_gradient_norm"] = policy.step(gradient, scale * settings.policy_learning_rate)
                policy_history.append(metrics)
    averaged = {name: np.mean([m[name] for m in policy_history]) for name in policy_history[0]}
    averaged |= {name: np.mean([m[name] for m in value_history]) for name in value_history[0]}
    averaged |= {"policy_updates": len(policy_history), "ratio_first": policy_history[0]["ratio_mean"]}
    mask = trajectory.mask
    unexplained = batch.target[mask] - batch.steps.value[mask]
    averaged["explained_variance"] = 1 - unexplained.var() / batch.target[mask].var()
    averaged |= {"learning_rate": scale * settings.policy_learning_rate, "parameters_finite": 1.0}
    averaged["std_mean"] = np.exp(policy.p["log_std"]).mean()
    if config.schedule == "decoupled":
        averaged["importance_mean"] = batch.importance[mask].mean()
    return policy.p, value.p, averaged


CASES = {  # few, since each is a program to compile
    "gradient clipped": {},
    "padding counted, returns": {
        **{"mask_padding": False, "advantage": "return", "standardize_advantages": False, "clip": 0.05},
        **{"max_gradient_norm": 1e6, "minibatch_trajectories": 6, "epochs": 3},
    },
    "stale rows, linear rate": {
        **{"schedule": "decoupled", "decoupled": {"max_importance": 1.2}},
        **{"learning_rate_schedule": "linear", "entropy_coefficient": 0.0},
    },
    "policy stops on the way": {"max_kl": 0.05, "epochs": 4},
}


@pytest.mark.parametrize("changes", CASES.values(), ids=CASES)
def test_an_update_equals_the_oracle(changes: dict[str, Any]) -> None:
    config = _config(**changes)
    state = _learner(config)
    trajectory = _trajectory(state)
    policy, value, metrics = _expected(state, trajectory, config)
    before = jax.tree.map(np.array, (state.policy_params, state.value_params))
    update = ppo.make_update(config, OBSERVATION, ACTION, None, ppo.make_mesh(jax.devices()[:1]))
    after, found = update(state, jax.tree.map(jnp.asarray, trajectory), progress=PROGRESS)
    for ours, old, expected in ((after.policy_params, before[0], policy), (after.value_params, before[1], value)):
        assert max(np.abs(expected[name] - old[name]).max() for name in old) > 0.01
        for name, array in ours.items():
            np.testing.assert_allclose(array, expected[name], rtol=0, atol=3e-5, err_msg=name)
    lag = {"policy_lag", "policy_lag_min", "policy_lag_max"}
    assert found.keys() - lag == metrics.keys()
    for name, expected in metrics.items():
        np.testing.assert_allclose(found[name], expected, rtol=2e-4, atol=2e-5, err_msg=name)
    # Rows with steps: versions NOW, NOW - 1, NOW, NOW - 3, NOW.
    np.testing.assert_allclose([found[name] for name in sorted(lag)], [4 / 5, 3, 0], rtol=1e-6)
