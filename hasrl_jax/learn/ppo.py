"""The learner: one PPO iteration as one jitted program over a mesh of devices.

Separate losses, optimisers and gradient clips for policy and value (paper II.E); epochs and minibatches run inside
one scan. Parameters are replicated and trajectories split over the mesh axis `data`; one CPU runs the same program.
"""

import logging
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from hasrl_jax.config.schema import Config, PPOConfig
from hasrl_jax.errors import ConfigError
from hasrl_jax.learn import networks, normalize
from hasrl_jax.learn.batching import minibatch_indices
from hasrl_jax.learn.losses import (
    Batch,
    Metrics,
    correct_for_lag,
    policy_lag,
    policy_loss,
    prepare_batch,
    value_loss,
)
from hasrl_jax.learn.networks import Parameters, Policy, Value, make_networks
from hasrl_jax.types import Mirror, Trajectory

log = logging.getLogger("hasrl_jax")
Trained = tuple[Parameters, Any]  # parameters and their optimiser state
Statistics = tuple[jax.Array | None, jax.Array | None]  # mean and standard deviation of observations, [O] each

_LARGEST_INT32 = 2**31 - 1
_POLICY_METRICS = (
    "actor_loss",
    "entropy",
    "ratio_mean",
    "approx_kl",
    "clip_fraction",
    "policy_updates",
    "policy_gradient_norm",
)


class LearnerState(NamedTuple):
    """Everything the learner needs to continue; a pytree of plain arrays, all of it in a checkpoint."""

    policy_params: Parameters  # flat, see `Policy`
    value_params: Parameters  # flat, see `Value`
    policy_opt_state: Any
    value_opt_state: Any
    normalizer: normalize.Normalizer
    key: jax.Array  # [2] uint32
    update_count: jax.Array  # [] int32, iterations done; the version of the parameters
    env_steps: jax.Array  # [] int32, valid environment steps learnt from; stays at 2^31 - 1 once there


def make_mesh(devices: list[jax.Device] | None = None) -> Mesh:
    """A one-dimensional mesh `data` over the given devices (default: all)."""
    return Mesh(np.array(jax.devices() if devices is None else devices), ("data",))


def make_optimizer(ppo: PPOConfig) -> optax.GradientTransformation:
    """Global-norm clip and Adam; the learning rate is applied by the caller. Source: paper II.E."""
    return optax.chain(optax.clip_by_global_norm(ppo.max_gradient_norm), optax.scale_by_adam(eps=ppo.adam_epsilon))


def init_learner(
    config: Config, observation_size: int, action_size: int, mirror: Mirror | None, key: jax.Array
) -> LearnerState:
    """The state before the first iteration.

    Args:
      config: reads `network` and `ppo`.
      observation_size: O.
      action_size: A.
      mirror: the task's mirror; used only when `network.symmetric`.
      key: a PRNG key of either kind; the state keeps raw uint32 data, which checkpoints store as is.

    Raises:
      ValueError: a symmetric network without a (valid) mirror.
    """
    if jnp.issubdtype(key.dtype, jax.dtypes.prng_key):
        key = jax.random.key_data(key)
    policy, value = make_networks(config.network, observation_size, action_size, mirror)
    optimizer = make_optimizer(config.ppo)

    def create(key: jax.Array) -> LearnerState:
        policy_key, value_key, key = jax.random.split(key, 3)
        observation = jnp.zeros((1, observation_size))
        policy_params = dict(policy.init(policy_key, observation)["params"])
        value_params = dict(value.init(value_key, observation)["params"])
        return LearnerState(
            policy_params=policy_params,
            value_params=value_params,
            policy_opt_state=optimizer.init(policy_params),
            value_opt_state=optimizer.init(value_params),
            normalizer=normalize.initial_normalizer(observation_size),
            key=key,
            update_count=jnp.zeros((), jnp.int32),
            env_steps=jnp.zeros((), jnp.int32),
        )

    return jax.jit(create)(key)  # one program starts sooner than its operations one by one


def with_deviation(state: LearnerState, log_std: float) -> LearnerState:
    """`state` with a policy that explores with another standard deviation, one for all actions.

    Args:
      state: where `network.learn_std` is false, so no gradient moves the deviation.
      log_std: its logarithm.
    """
    before = state.policy_params["log_std"]
    after = jax.device_put(np.full(before.shape, log_std, before.dtype), before.sharding)
    return state._replace(policy_params={**state.policy_params, "log_std": after})


def acting_parameters(state: LearnerState, normalize_observations: bool = True) -> dict[str, jax.Array]:
    """What a collector needs to act, where the learner keeps it.

    Names: "policy/<name>" and "value/<name>" with the parameter names of `Policy` and `Value`, and, when observations
    are normalised, "normalizer/mean" and "normalizer/std" [O].
    """
    if jax.process_count() > 1:  # this process's copy
        state = jax.tree.map(lambda leaf: leaf.addressable_data(0), state)
    mean, std = normalize.mean_std(state.normalizer, normalize_observations)
    flat = {f"policy/{name}": array for name, array in state.policy_params.items()}
    flat |= {f"value/{name}": array for name, array in state.value_params.items()}
    if mean is not None and std is not None:
        flat |= {"normalizer/mean": mean, "normalizer/std": std}
    return flat


def export_parameters(state: LearnerState, normalize_observations: bool = True) -> dict[str, np.ndarray]:
    """`acting_parameters` as float32 NumPy arrays that the caller owns."""
    parameters = jax.device_get(acting_parameters(state, normalize_observations))
    return {name: np.array(array, np.float32) for name, array in parameters.items()}


class Update:
    """`update(state, trajectory) -> (state, metrics)`: one iteration of PPO.

    The state is donated: do not use the argument afterwards. The trajectory's arrays must stay unchanged until the
    metrics are read, since the call returns before the work is done.

    Metrics are float32 scalars. Policy metrics average over the minibatches that updated the policy (the first one
    alone when none did), `critic_loss` over all; `ratio_first` is the mean ratio of the very first minibatch.
    """

    def __init__(self, config: Config, policy: Policy, value: Value, mesh: Mesh) -> None:
        self.config = config
        self.policy = policy
        self.value = value
        self.mesh = mesh
        self.optimizer = make_optimizer(config.ppo)
        self.trace_count = 0  # how often the program was traced; stays at 1 while shapes do not change
        self._replicated = NamedSharding(mesh, PartitionSpec())
        self._split = NamedSharding(mesh, PartitionSpec("data"))
        self._jitted = jax.jit(
            self._iteration,
            in_shardings=(self._replicated, self._split, self._replicated, self._replicated),
            out_shardings=(self._replicated, self._replicated),
            donate_argnums=0,
        )

    def __call__(
        self, state: LearnerState, trajectory: Trajectory, replayed: bool = False, progress: float = 0.0
    ) -> tuple[LearnerState, Metrics]:
        """Runs the program.

        Args:
          state: the learner; donated.
          trajectory: [B, T, ...], see `Trajectory`.
          replayed: it was learnt from before, so steps and observation statistics do not count it again.
          progress: share of the run's environment steps that were collected before; a linear learning rate counts it.

        Raises:
          ValueError: B, the minibatch size and the number of devices do not divide each other.
        """
        rows, minibatch, devices = len(trajectory.reward), self.config.ppo.minibatch_trajectories, self.mesh.size
        if rows == 0 or rows % minibatch or minibatch % devices:
            raise ValueError(
                f"{rows} trajectories, ppo.minibatch_trajectories {minibatch}, {devices} devices: the trajectories "
                "must be a multiple of the minibatch, and the minibatch a multiple of the devices"
            )
        # Placed here rather than by jit, so that the first call and all later ones share one compiled program.
        state = jax.device_put(state, self._replicated)
        numbers = np.asarray(not replayed), np.float32(progress)
        return self._jitted(state, jax.device_put(trajectory, self._split), *numbers)

    def _iteration(
        self, state: LearnerState, trajectory: Trajectory, counts: jax.Array, progress: jax.Array
    ) -> tuple[LearnerState, Metrics]:
        """Advantages once, then all epochs and minibatches, then the observation statistics."""
        self.trace_count += 1
        log.info("compiling the update for %d trajectories of %d steps", *trajectory.reward.shape)
        config, ppo = self.config, self.config.ppo
        batch, metrics = prepare_batch(trajectory, ppo)
        statistics = normalize.mean_std(state.normalizer, config.network.normalize_observations)
        metrics |= policy_lag(trajectory, state.update_count)
        if config.schedule == "decoupled":
            acted = state.policy_params, self.policy, *statistics, state.update_count
            batch, importance = correct_for_lag(batch, *acted, config.decoupled.max_importance)
            metrics |= importance
        scale = jnp.ones(())
        if ppo.learning_rate_schedule == "linear":
            scale = jnp.maximum(0.0, 1.0 - progress)
        key, *epoch_keys = jax.random.split(state.key, 1 + ppo.epochs)
        rows, size = batch.target.shape[0], ppo.minibatch_trajectories
        indices = jnp.concatenate([minibatch_indices(epoch_key, rows, size) for epoch_key in epoch_keys])

        def minibatch_step(carry: Any, index: jax.Array) -> tuple[Any, tuple[Metrics, Metrics]]:
            policy, value, active = carry
            rows = jax.tree.map(lambda x: jax.lax.with_sharding_constraint(x[index], self._split), batch)
            policy, active, policy_metrics = jax.lax.cond(
                active, self._update_policy, _skip_policy, policy, rows, statistics, scale
            )
            value, value_metrics = self._update_value(value, rows, statistics, scale)
            return (policy, value, active), (policy_metrics, value_metrics)

        policy = (state.policy_params, state.policy_opt_state)
        value = (state.value_params, state.value_opt_state)
        (policy, value, _), history = jax.lax.scan(minibatch_step, (policy, value, jnp.asarray(True)), indices)
        log_std = networks.log_std(self.policy, policy[0])
        metrics |= _summarize(*history)
        steps = batch.trajectory
        normalizer = state.normalizer
        if config.network.normalize_observations:
            normalizer = normalize.update(normalizer, steps.observation, steps.mask & counts)
        finite = [jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves((policy, value, normalizer))]
        metrics["parameters_finite"] = jnp.all(jnp.stack(finite)).astype(jnp.float32)
        metrics |= {"learning_rate": scale * ppo.policy_learning_rate, "std_mean": jnp.mean(jnp.exp(log_std))}
        added = jnp.sum(steps.mask & counts, dtype=jnp.int32)
        new_state = LearnerState(
            policy_params=policy[0],
            value_params=value[0],
            policy_opt_state=policy[1],
            value_opt_state=value[1],
            normalizer=normalizer,
            key=key,
            update_count=state.update_count + 1,
            env_steps=jnp.minimum(state.env_steps, _LARGEST_INT32 - added) + added,
        )
        return new_state, metrics

    def _update_policy(
        self, policy: Trained, batch: Batch, statistics: Statistics, scale: jax.Array
    ) -> tuple[Trained, jax.Array, Metrics]:
        """One policy step, undone when the policy has already moved too far: (policy, still active, metrics)."""
        ppo = self.config.ppo
        gradient, metrics = jax.grad(policy_loss, has_aux=True)(policy[0], self.policy, batch, *statistics, ppo)
        updated = self._step(policy, gradient, scale * ppo.policy_learning_rate)
        # Written so that a KL that is not a number stops the policy too.
        active = metrics["approx_kl"] <= ppo.max_kl if ppo.max_kl > 0 else jnp.asarray(True)
        policy = jax.tree.map(lambda new, old: jnp.where(active, new, old), updated, policy)
        metrics |= {"policy_updates": active.astype(jnp.float32), "policy_gradient_norm": optax.tree.norm(gradient)}
        return policy, active, metrics

    def _update_value(
        self, value: Trained, batch: Batch, statistics: Statistics, scale: jax.Array
    ) -> tuple[Trained, Metrics]:
        ppo = self.config.ppo
        loss, gradient = jax.value_and_grad(value_loss)(value[0], self.value, batch, *statistics, ppo)
        updated = self._step(value, gradient, scale * ppo.value_learning_rate)
        return updated, {"critic_loss": loss, "value_gradient_norm": optax.tree.norm(gradient)}

    def _step(self, trained: Trained, gradient: Parameters, learning_rate: jax.Array) -> Trained:
        params, opt_state = trained
        direction, opt_state = self.optimizer.update(gradient, opt_state, params)
        return jax.tree.map(lambda p, d: p - learning_rate * d, params, direction), opt_state


def make_update(config: Config, observation_size: int, action_size: int, mirror: Mirror | None, mesh: Mesh) -> Update:
    """The update of a configuration; arguments as in `init_learner`, `mesh` from `make_mesh`.

    Raises:
      ConfigError: the devices cannot share a minibatch evenly.
      ValueError: a symmetric network without a (valid) mirror.
    """
    minibatch, devices = config.ppo.minibatch_trajectories, mesh.size
    if minibatch % devices:
        works = -(-minibatch // devices) * devices
        raise ConfigError(
            f"ppo.minibatch_trajectories: {minibatch} is not a multiple of the {devices} devices; {works} is"
        )
    return Update(config, *make_networks(config.network, observation_size, action_size, mirror), mesh)


def _skip_policy(policy: Trained, *_: Any) -> tuple[Trained, jax.Array, Metrics]:
    """Takes the place of a policy step once the policy has moved too far."""
    return policy, jnp.asarray(False), {name: jnp.zeros(()) for name in _POLICY_METRICS}


def _summarize(policy: Metrics, value: Metrics) -> Metrics:
    """Histories [minibatches] to scalars, as documented in `Update`."""
    applied = policy["policy_updates"]
    first = (jnp.arange(applied.shape[0]) == 0).astype(jnp.float32)
    weight = jnp.where(jnp.sum(applied) > 0, applied, first)
    metrics = {name: jnp.sum(weight * history) / jnp.sum(weight) for name, history in policy.items()}
    metrics |= {name: jnp.mean(history) for name, history in value.items()}
    return metrics | {"policy_updates": jnp.sum(applied), "ratio_first": policy["ratio_mean"][0]}
