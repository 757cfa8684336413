"""Environments, policy and value on the accelerator: one iteration's experience is one jitted program.

Every device of the mesh steps its own share of the environments, with no communication until the statistics are summed,
and nothing crosses to the host. The trajectories are those of the CPU pool.
Source: the Anakin design of the Podracer paper (Hessel et al., 2021).
"""

import io
import logging
import math
import time
from functools import partial
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from hasrl_jax.collect.protocol import Experience, Networks, Parameters
from hasrl_jax.config.schema import Config
from hasrl_jax.envs.mjx_engine import MjxEngine, MjxEnvState, make_engine
from hasrl_jax.envs.task import Task
from hasrl_jax.errors import ConfigError, DivergenceError
from hasrl_jax.types import Array, Record, Trajectory

log = logging.getLogger("hasrl_jax")
_ENVIRONMENTS = 0x456E7673  # folded into the seed


class MjxPlan(NamedTuple):
    """Sizes that follow from the configuration and stay fixed for a run."""

    num_envs: int  # E, over all devices
    steps_per_env: int  # S, environment steps of each environment per iteration
    max_length: int  # T of the trajectories given to the learner
    carry_shape: tuple[int, int, int]  # (L, 2, W)

    @property
    def rows(self) -> int:
        """B of the trajectories given to the learner."""
        return self.num_envs * self.steps_per_env // self.max_length

    @property
    def env_steps(self) -> int:
        """Environment steps per iteration."""
        return self.num_envs * self.steps_per_env


class ActingParameters(NamedTuple):
    """What the environments act with; on the device, the same on every one."""

    policy: Any  # parameters of the policy network
    value: Any  # parameters of the value network
    observation_mean: (
        Array | None
    )  # [O] of the observation statistics; None for both where observations are not normalised
    observation_std: Array | None  # [O]


class CollectorState(NamedTuple):
    """What the environments carry from one iteration to the next; plain arrays, all of it in a checkpoint."""

    envs: MjxEnvState  # every array with a leading axis [E]
    carry: Array  # [E, L, 2, W] LSTM state before the next step
    key: Array  # [E, 2] uint32, each environment's stream of action noise


class Statistics(NamedTuple):
    """Sums over an iteration, on the device."""

    valid_steps: Array  # [] int32 environment steps that count
    diverged: Array  # [] int32 simulations that failed and were reset
    reward_terms: Array  # [R] sum of each weighted term over the valid steps
    episodes: Array  # [] int32 episodes that ended, by termination or by the time limit
    episode_return: Array  # [] sum over those episodes
    episode_length: Array  # [] int32, likewise, environment steps
    contact_overflow: Array  # [] int32 environment steps in which Warp dropped contacts
    constraint_overflow: Array  # [] int32 environment steps in which Warp dropped constraints


class _Step(NamedTuple):
    """One environment step as it is recorded; leading axes [E] when recorded, [E, S] in the end."""

    observation: Array
    action: Array
    log_prob: Array
    is_first: Array
    reward: Array
    terminated: Array
    truncated: Array  # by the time limit
    diverged: Array
    final_observation: Array
    reward_terms: Array
    episode_return: Array  # where an episode ended, else 0
    episode_length: Array  # likewise
    overflow: Array


def make_mjx_plan(config: Config, num_envs: int, num_devices: int) -> MjxPlan:
    """Rounds the budget up so that every environment fills whole trajectories, and they whole minibatches.

    Args:
      config: reads `collect`, `network` and `ppo`.
      num_envs: environments over all devices.
      num_devices: devices of the mesh.

    Raises:
      ConfigError: settings that cannot work together; the message names values that do.
    """
    collect = config.collect
    if collect.mode != "unrolls":
        raise ConfigError(f"collect.mode: the mjx backend collects no {collect.mode!r}; set it to unrolls")
    if num_envs < num_devices or num_envs % num_devices:
        works = max(1, num_envs // num_devices) * num_devices
        raise ConfigError(f"mjx.num_envs: {num_envs} is not a multiple of the {num_devices} devices; {works} is")
    pieces = -(-collect.env_steps_per_iteration // (num_envs * collect.unroll_length))
    minibatch = config.ppo.minibatch_trajectories
    multiple = minibatch // math.gcd(num_envs, minibatch)
    pieces = -(-pieces // multiple) * multiple
    return MjxPlan(num_envs, pieces * collect.unroll_length, collect.unroll_length, config.network.carry_shape)


def environment_keys(seed: int, num_envs: int) -> Array:
    """A key for each environment, [num_envs, 2] uint32; apart from those that the learner splits from the same seed."""
    return jax.random.split(jax.random.fold_in(jax.random.PRNGKey(seed), _ENVIRONMENTS), num_envs)


class MjxRollout:
    """`collect(parameters, state, version) -> (state, trajectory, statistics)`: one iteration's experience.

    Args:
      plan: from `make_mjx_plan`.
      engine: the task on MJX; its environments per device must be `plan.num_envs / mesh.size`.
      policy: a network with `__call__(observation, carry, is_first, mean, std) -> (mean action, carry)` and
        `log_std() -> [A]`.
      value: a network with `__call__(observation, mean, std) -> value`.
      mesh: environments are split over its axis `data`, like the learner's trajectories.
    """

    def __init__(self, plan: MjxPlan, engine: MjxEngine, policy: nn.Module, value: nn.Module, mesh: Mesh):
        self.plan, self.engine, self.policy, self.value = plan, engine, policy, value
        self.trace_count = 0  # how often the program was traced; stays at 1 after the first iteration
        split, everywhere = PartitionSpec("data"), PartitionSpec()
        self._split, self._everywhere = NamedSharding(mesh, split), NamedSharding(mesh, everywhere)
        # Each device runs the same program on its own rows. Left to itself, the partitioner would gather all
        # environments for every matrix factorisation, which it cannot split.
        on_each_device = jax.shard_map(
            self._collect,
            mesh=mesh,
            in_specs=(everywhere, split, everywhere),
            out_specs=(split, split, everywhere),
            check_vma=False,
        )
        self._jitted = jax.jit(
            on_each_device, in_shardings=(self._everywhere, self._split, self._everywhere), donate_argnums=1
        )

    def init(self, seed: int) -> CollectorState:
        """Fresh episodes in all environments; the same for every number of devices."""

        def begin(key: Array) -> CollectorState:
            env_key, noise_key = jax.random.split(key)
            state = CollectorState(self.engine.reset(env_key), jnp.zeros(self.plan.carry_shape), noise_key)
            # Types as a collection returns them, none of them weak: the second call would be compiled anew.
            return jax.tree.map(lambda array: jnp.asarray(array, array.dtype), state)

        return jax.jit(jax.vmap(begin), out_shardings=self._split)(environment_keys(seed, self.plan.num_envs))

    def __call__(
        self, parameters: ActingParameters, state: CollectorState, version: Array | int
    ) -> tuple[CollectorState, Trajectory, Statistics]:
        """Steps every environment `plan.steps_per_env` times.

        Args:
          parameters: of version `version`.
          state: from `init`, or returned by the previous call; donated, so do not use it afterwards.
          version: of the parameters, written to the trajectories.

        Returns:
          The next state, trajectories [B, T, ...] split over the devices (row = environment * unrolls + unroll), and
          the statistics. All of it is on the devices and may still be under way.

        Raises:
          MemoryError: the devices cannot hold that many environments.
        """
        if not self.trace_count:
            log.info("compiling the collection of %d MJX environments; expect about a minute", self.plan.num_envs)
        # Placed here rather than by jit, so that the first call and all later ones share one compiled program.
        parameters = jax.device_put(parameters, self._everywhere)
        state = jax.device_put(state, self._split)
        version = jax.device_put(version if isinstance(version, jax.Array) else np.int32(version), self._everywhere)
        try:
            return self._jitted(parameters, state, version)
        except jax.errors.JaxRuntimeError as error:
            if "RESOURCE_EXHAUSTED" not in str(error):
                raise
            raise MemoryError(
                f"mjx.num_envs: {self.plan.num_envs} environments of {self.plan.steps_per_env} steps do not fit into "
                f"the devices' memory; try {self.plan.num_envs // 2}"
            ) from error

    def _collect(
        self, parameters: ActingParameters, state: CollectorState, version: Array
    ) -> tuple[CollectorState, Trajectory, Statistics]:
        """The program of one device; [E] is its share of the environments."""
        self.trace_count += 1
        env_step = partial(self._env_step, parameters)

        def unroll(state: CollectorState, _: None) -> tuple[CollectorState, tuple[Array, _Step]]:
            keep = ~state.envs.is_first[:, None, None, None]
            next_state, steps = jax.lax.scan(env_step, state, None, length=self.plan.max_length)
            return next_state, (jnp.where(keep, state.carry, 0.0), steps)

        pieces = self.plan.steps_per_env // self.plan.max_length
        state, (carries, steps) = jax.lax.scan(unroll, state, None, length=pieces)
        steps = jax.tree.map(lambda x: jnp.moveaxis(x, 2, 0).reshape(x.shape[2], -1, *x.shape[3:]), steps)
        trajectory = self._trajectory(parameters, steps, jnp.moveaxis(carries, 1, 0), version)
        return state, trajectory, _statistics(steps)

    def _env_step(self, parameters: ActingParameters, state: CollectorState, _: None) -> tuple[CollectorState, _Step]:
        """One environment step of every environment."""
        envs = state.envs
        variables = {"params": parameters.policy}
        normalizer = (parameters.observation_mean, parameters.observation_std)
        mean, carry = self.policy.apply(variables, envs.observation, state.carry, envs.is_first, *normalizer)
        log_std: Array = self.policy.apply(variables, method="log_std")
        keys = jax.vmap(jax.random.split)(state.key)
        noise = jax.vmap(lambda key: jax.random.normal(key, mean.shape[1:]))(keys[:, 1])
        action = mean + jnp.exp(log_std) * noise
        next_envs, result = jax.vmap(self.engine.step)(envs, action)
        ended = result.terminated | result.truncated
        step = _Step(
            observation=envs.observation,
            action=action,
            log_prob=-0.5 * jnp.sum(jnp.square(noise) + 2.0 * log_std + math.log(2.0 * math.pi), axis=-1),
            is_first=envs.is_first,
            reward=result.reward,
            terminated=result.terminated,
            truncated=result.truncated,
            diverged=result.diverged,
            final_observation=result.final_observation,
            reward_terms=result.reward_terms,
            episode_return=jnp.where(ended, envs.episode_return + result.reward, 0.0),
            episode_length=jnp.where(ended, envs.episode_step + 1, 0),
            overflow=next_envs.overflow,
        )
        return CollectorState(next_envs, carry, keys[:, 0]), step

    def _trajectory(self, parameters: ActingParameters, steps: _Step, carries: Array, version: Array) -> Trajectory:
        """Adds values and cuts to the steps [E, S, ...] and folds them to [B, T, ...]; `carries`: [E, S / T, L, 2, W].

        The last step of every trajectory is cut, and so is the step before a lost one, which leads to a known state.
        """
        normalizer = (parameters.observation_mean, parameters.observation_std)
        value = partial(self.value.apply, {"params": parameters.value})
        mask = ~steps.diverged
        next_is_lost = jnp.pad(steps.diverged[:, 1:] & ~steps.is_first[:, 1:], ((0, 0), (0, 1)))
        is_last = jnp.arange(1, self.plan.steps_per_env + 1) % self.plan.max_length == 0
        truncated = steps.truncated | ((next_is_lost | is_last) & mask & ~steps.terminated)
        following: Array = value(steps.final_observation, *normalizer)

        def fold(field: Array) -> Array:
            return field.reshape(-1, self.plan.max_length, *field.shape[2:])

        initial_carry = carries.reshape(-1, *carries.shape[2:])
        return Trajectory(
            observation=fold(steps.observation),
            action=fold(steps.action),
            log_prob=fold(steps.log_prob),
            value=fold(value(steps.observation, *normalizer)),
            reward=fold(steps.reward),
            is_first=fold(steps.is_first),
            terminated=fold(steps.terminated),
            truncated=fold(truncated),
            bootstrap_value=fold(jnp.where(truncated, following, 0.0)),
            mask=fold(mask),
            initial_carry=initial_carry,
            policy_version=jnp.full(len(initial_carry), version, jnp.int32),
        )


def _statistics(steps: _Step) -> Statistics:
    """Sums over the steps [E, S] of all devices."""
    ended = steps.terminated | steps.truncated
    count = partial(jnp.sum, dtype=jnp.int32)
    sums = Statistics(
        valid_steps=count(~steps.diverged),
        diverged=count(steps.diverged),
        reward_terms=jnp.sum(steps.reward_terms, axis=(0, 1)),
        episodes=count(ended),
        episode_return=jnp.sum(steps.episode_return),
        episode_length=count(steps.episode_length),
        contact_overflow=count(steps.overflow[..., 0]),
        constraint_overflow=count(steps.overflow[..., 1]),
    )
    return jax.lax.psum(sums, "data")


class MjxCollector:
    """MJX environments on the learner's devices; the trajectories never leave them."""

    def __init__(self, config: Config, task: Task, mesh: Mesh, networks: Networks):
        self.plan = make_mjx_plan(config, config.mjx.num_envs, mesh.size)
        self._mesh, self._networks, self._physics = mesh, networks, config.physics
        self.rollout, self.reward_terms = self._make_rollout(config, task), task.reward_terms
        self.seed = config.seed
        self.busy, self._started = False, 0.0
        self._pending: Any = None  # between `start` and `finish`
        steps = f"{self.plan.env_steps} environment steps per iteration"
        self.description = f"{self.plan.num_envs} MJX environments ({config.mjx.impl}), {steps}"

    def _make_rollout(self, config: Config, task: Task) -> MjxRollout:
        """The program; the settings of the task are constants in it."""
        settings = config.mjx
        limits = settings.contacts_per_env, settings.constraints_per_env
        cap = config.collect.max_episode_steps
        engine = make_engine(task, settings.impl, cap, settings.num_envs // self._mesh.size, *limits)
        return MjxRollout(self.plan, engine, *self._networks, self._mesh)

    def __enter__(self) -> "MjxCollector":
        self.state = self.rollout.init(self.seed)
        return self

    def __exit__(self, *error: object) -> None:
        pass  # arrays are freed with the object

    def start(self, parameters: Parameters, iteration: int, version: int) -> None:
        del iteration  # the environments' own keys move on with them
        # Copied, because the update donates the learner's arrays while this program may still read them.
        acting = acting_parameters(jax.tree.map(jnp.copy, parameters))
        self._pending = self.rollout(acting, self.state, version)
        self.busy, self._started = True, time.monotonic()

    def finish(self) -> Experience:
        self.state, trajectory, sums = self._pending
        statistics: Statistics = jax.device_get(sums)  # waits for the collection
        self.busy, self._pending = False, None
        if not statistics.valid_steps:
            raise DivergenceError("every MJX environment diverged; the policy's actions are probably not finite")
        record = mjx_record(statistics, self.reward_terms) | {"collect_seconds": time.monotonic() - self._started}
        return Experience(trajectory, self.plan.env_steps, record)

    def configure(self, config: Config, task: Task) -> None:
        saved = self.save() if config.physics == self._physics else []  # as `worker.Actor.configured`
        self._physics = config.physics
        self.rollout = self._make_rollout(config, task)
        self.state = self.rollout.init(self.seed)
        self.load(saved)

    def save(self) -> list[bytes]:
        if self.busy:
            return []
        buffer = io.BytesIO()
        np.savez(buffer, *(np.asarray(leaf) for leaf in jax.tree.leaves(self.state)))
        return [buffer.getvalue()]

    def load(self, states: list[bytes]) -> None:
        leaves, structure = jax.tree.flatten(self.state)
        saved: list[Any] = []
        if len(states) == 1:
            with np.load(io.BytesIO(states[0]), allow_pickle=False) as file:
                saved = [file[name] for name in file.files]
        if [array.shape for array in saved] == [leaf.shape for leaf in leaves]:
            self.state = jax.tree.unflatten(structure, saved)
        elif states:
            log.warning("the saved environments are of another number or backend: all episodes begin anew")


def acting_parameters(parameters: Parameters) -> ActingParameters:
    """The learner's parameters by network; a policy whose observations are not normalised has no statistics."""

    def group(name: str) -> Parameters:
        return {key.removeprefix(name): array for key, array in parameters.items() if key.startswith(name)}

    mean, std = (parameters.get(f"normalizer/{name}") for name in ("mean", "std"))
    return ActingParameters(group("policy/"), group("value/"), mean, std)


def mjx_record(statistics: Statistics, reward_terms: tuple[str, ...]) -> Record:
    """As `cpu_record`; also counts the steps in which Warp ran out of room."""
    episodes = int(statistics.episodes)
    means = statistics.reward_terms / statistics.valid_steps
    return {
        "episode_return_train": float(statistics.episode_return) / episodes if episodes else None,
        "episode_length_train": float(statistics.episode_length) / episodes if episodes else None,
        "diverged_envs": int(statistics.diverged),
        "contact_overflow": int(statistics.contact_overflow),
        "constraint_overflow": int(statistics.constraint_overflow),
        **{f"reward/{name}": float(mean) for name, mean in zip(reward_terms, means, strict=True)},
    }
