"""The ways to collect behind one interface, so that the training loop cannot tell them apart."""

import io
import logging
import math
import os
import time
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from hasrl_jax.collect.buffer import Collected
from hasrl_jax.collect.decoupled import FreePool
from hasrl_jax.collect.mjx import ActingParameters, MjxCollector, Statistics, make_mjx_plan
from hasrl_jax.collect.plan import Plan, make_plan
from hasrl_jax.collect.ray.cluster import import_ray
from hasrl_jax.collect.ray.pool import RayPool
from hasrl_jax.collect.supervisor import CpuPool
from hasrl_jax.config.schema import Config
from hasrl_jax.envs.mjx_engine import make_engine
from hasrl_jax.envs.task import Task
from hasrl_jax.errors import DivergenceError
from hasrl_jax.learn import normalize, ppo
from hasrl_jax.learn.batching import pad_segments
from hasrl_jax.learn.networks import make_networks
from hasrl_jax.types import Record, Trajectory

log = logging.getLogger("hasrl_jax")


class Experience(NamedTuple):
    """What one iteration learns from."""

    trajectory: Trajectory  # [B, T, ...]
    env_steps: int  # collected since the last one
    record: Record  # metrics of the collection
    replayed: bool = False  # an earlier iteration learnt from the same trajectories


class Collector(Protocol):
    """What the training loop asks of a collector.

    Making one only checks the configuration; entering its context starts what collects, leaving it frees everything.
    """

    description: str  # one line for the start of a run

    @property
    def busy(self) -> bool:
        """Between `start` and `finish`."""

    def start(self, learner: ppo.LearnerState, iteration: int, version: int) -> None:
        """Asks for one iteration's experience with the learner's present parameters; returns at once."""

    def finish(self) -> Experience:
        """Waits for what `start` asked for."""

    def save(self) -> list[bytes]:
        """The state of the environments, for a checkpoint; empty while they are being stepped."""

    def load(self, states: list[bytes]) -> None:
        """Restores what `save` returned."""

    def __enter__(self) -> "Collector": ...

    def __exit__(self, *error: object) -> None: ...


def make_collector(config: Config, task: Task, mesh: Mesh) -> Collector:
    """The collector of `config.backend`.

    Raises:
      ConfigError: Ray is needed and missing.
    """
    if config.backend == "mjx":
        return MjxExperience(config, task, mesh)
    if config.backend == "ray":
        import_ray(config.ray)
    return FreeExperience(config, task) if config.schedule == "decoupled" else CpuExperience(config, task)


class CpuExperience:
    """A `CpuPool` or `RayPool` whose buffers come out as padded trajectories."""

    def __init__(self, config: Config, task: Task):
        self.config, self.task, self.plan = config, task, make_plan(config)
        self.normalizes = config.network.normalize_observations
        self.description = (
            f"{self.plan.num_workers} workers x {self.plan.envs_per_worker} environments, "
            f"{self.plan.env_steps} environment steps per iteration"
        )

    def __enter__(self) -> "CpuExperience":
        pool = RayPool if self.config.backend == "ray" else CpuPool
        self.pool: CpuPool | RayPool = pool(self.config, self.plan, self.task)
        return self

    def __exit__(self, *error: object) -> None:
        self.pool.close()

    @property
    def busy(self) -> bool:
        return self.pool.busy

    def start(self, learner: ppo.LearnerState, iteration: int, version: int) -> None:
        self.pool.start(ppo.export_parameters(learner, self.normalizes), iteration, version)

    def finish(self) -> Experience:
        collected = self.pool.finish()
        record = cpu_record(collected) | {"workers_lost": self.pool.workers_lost}
        return Experience(to_trajectory(collected, self.plan), len(collected.fields["mask"]), record)

    def save(self) -> list[bytes]:
        return [] if self.pool.busy else self.pool.save()

    def load(self, states: list[bytes]) -> None:
        self.pool.load(states)


class FreeExperience:
    """A `FreePool`: what was finished first, and the newest batch once more while there is no other."""

    busy = False  # its workers always are, and `start` only gives them newer parameters

    def __init__(self, config: Config, task: Task):
        self.config, self.task, self.plan = config, task, make_plan(config)
        self.normalizes = config.network.normalize_observations
        slots = f"{self.plan.steps_per_worker} environment steps at a time"
        envs = f"{self.plan.num_workers} free workers x {self.plan.envs_per_worker} environments"
        self.description = f"{envs}, {slots}, {self.plan.env_steps} for an iteration"
        self._version = self._batches = self._uses = self._uses_of_newest = 0
        self._newest: Experience | None = None

    def __enter__(self) -> "FreeExperience":
        self.pool = FreePool(self.config, self.plan, self.task)
        return self

    def __exit__(self, *error: object) -> None:
        self.pool.close()

    def start(self, learner: ppo.LearnerState, iteration: int, version: int) -> None:
        self.pool.publish(ppo.export_parameters(learner, self.normalizes), version)
        self._version = version

    def finish(self) -> Experience:
        replayable = self._replayable()
        collected = self.pool.take(self._version, wait=replayable is None)
        if collected is not None:
            self._batches, self._uses_of_newest = self._batches + 1, 0
            env_steps, record = len(collected.fields["mask"]), cpu_record(collected)
            experience = self._newest = Experience(to_trajectory(collected, self.plan), env_steps, record)
        elif replayable is not None:
            unknown: Record = dict.fromkeys(replayable.record)
            experience = replayable._replace(env_steps=0, record=unknown, replayed=True)
        self._uses, self._uses_of_newest = self._uses + 1, self._uses_of_newest + 1
        dropped = self.pool.pop_dropped()
        counts: Record = {
            "workers_lost": self.pool.workers_lost,
            "dropped_stale": dropped.trajectories,
            "replay_ratio": self._uses / self._batches,
        }
        env_steps = experience.env_steps + dropped.env_steps
        return experience._replace(env_steps=env_steps, record=experience.record | counts)

    def _replayable(self) -> Experience | None:
        """The newest batch, if it may be used once more."""
        settings, newest = self.config.decoupled, self._newest
        within_average = self._uses + 1 <= settings.replay_ratio * self._batches
        if newest is None or not within_average or self._uses_of_newest >= math.ceil(settings.replay_ratio):
            return None
        valid = newest.trajectory.mask.any(axis=1)
        fresh = self._version - newest.trajectory.policy_version[valid].min(initial=self._version) <= settings.max_lag
        return newest if fresh else None

    def save(self) -> list[bytes]:
        return []

    def load(self, states: list[bytes]) -> None:
        self.pool.load(states)


class MjxExperience:
    """MJX environments on the learner's devices; the trajectories never leave them."""

    def __init__(self, config: Config, task: Task, mesh: Mesh):
        self.plan = make_mjx_plan(config, config.mjx.num_envs, mesh.size)
        settings = config.mjx
        limits = settings.contacts_per_env, settings.constraints_per_env
        cap = config.collect.max_episode_steps
        engine = make_engine(task, settings.impl, cap, settings.num_envs // mesh.size, *limits)
        networks = make_networks(config.network, task.observation_size, task.action_size, task.mirror)
        self.collector = MjxCollector(self.plan, engine, *networks, mesh)
        self.seed = config.seed
        self.normalizes, self.reward_terms = config.network.normalize_observations, task.reward_terms
        self.busy, self._started = False, 0.0
        self._pending: Any = None  # between `start` and `finish`
        steps = f"{self.plan.env_steps} environment steps per iteration"
        self.description = f"{self.plan.num_envs} MJX environments ({settings.impl}), {steps}"

    def __enter__(self) -> "MjxExperience":
        self.state = self.collector.init(self.seed)
        return self

    def __exit__(self, *error: object) -> None:
        pass  # arrays are freed with the object

    def start(self, learner: ppo.LearnerState, iteration: int, version: int) -> None:
        del iteration  # the environments' own keys move on with them
        statistics = normalize.mean_std(learner.normalizer, self.normalizes)
        # Copied, because the update donates the learner's arrays while this program may still read them.
        parameters = jax.tree.map(jnp.copy, ActingParameters(learner.policy_params, learner.value_params, *statistics))
        self._pending = self.collector(parameters, self.state, version)
        self.busy, self._started = True, time.monotonic()

    def finish(self) -> Experience:
        self.state, trajectory, sums = self._pending
        statistics: Statistics = jax.device_get(sums)  # waits for the collection
        self.busy, self._pending = False, None
        if not statistics.valid_steps:
            raise DivergenceError("every MJX environment diverged; the policy's actions are probably not finite")
        record = mjx_record(statistics, self.reward_terms) | {"collect_seconds": time.monotonic() - self._started}
        return Experience(trajectory, self.plan.env_steps, record)

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


def to_trajectory(collected: Collected, plan: Plan) -> Trajectory:
    """The centralised buffer as trajectories padded on the right, in whole minibatches (paper III.B)."""
    rows = plan.rows * -(-len(collected.start) // plan.rows)
    fields = collected.fields | {"initial_carry": collected.initial_carry, "policy_version": collected.version}
    return pad_segments(fields, collected.start, collected.end, plan.max_length, rows)


def cpu_record(collected: Collected) -> Record:
    """The metrics of a collection under the names of the metrics file; None without a finished episode."""
    ended = collected.fields["episode_length"] > 0
    terms = [statistics["reward_terms"] for statistics in collected.statistics]
    return {
        "episode_return_train": float(collected.fields["episode_return"][ended].mean()) if ended.any() else None,
        "episode_length_train": float(collected.fields["episode_length"][ended].mean()) if ended.any() else None,
        "collect_seconds": collected.seconds,
        "diverged_envs": sum(statistics["diverged"] for statistics in collected.statistics),
        **{f"reward/{name}": float(np.mean([term[name] for term in terms])) for name in terms[0]},
    }


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


def prepare_jax(config: Config) -> None:
    """Settings that must be made before JAX first touches a device."""
    if config.backend == "mjx":
        # XLA's thread pool on few CPU cores can wait for itself for ever in batched matrix factorisations.
        os.environ.setdefault("NPROC", "1")
    if config.compilation_cache:
        cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "hasrl_jax" / "compiled"
        try:
            cache.mkdir(parents=True, exist_ok=True)
            jax.config.update("jax_compilation_cache_dir", str(cache))
        except OSError as error:
            log.warning("%s: programs are compiled anew at every start (%s)", cache, error.strerror)
    if config.backend == "mjx" and jax.default_backend() == "cpu":
        log.warning(
            "the mjx backend has no accelerator here: one CPU core runs about 530 environment steps/s with MJX and "
            "about 4,000 with --backend=cpu_pool; NPROC=%s keeps XLA from hanging on few cores",
            os.environ["NPROC"],
        )
