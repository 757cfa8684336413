"""The ways to collect behind one interface, so that the training loop cannot tell them apart."""

from typing import NamedTuple, Protocol

import numpy as np

from hasrl_jax.collect.cpu_pool import Collected, CpuPool
from hasrl_jax.collect.plan import Plan
from hasrl_jax.config import Config
from hasrl_jax.envs.task import Task
from hasrl_jax.learn import ppo
from hasrl_jax.learn.batching import pad_segments
from hasrl_jax.metrics import Record
from hasrl_jax.types import Trajectory


class Experience(NamedTuple):
    """What one iteration collected."""

    trajectory: Trajectory  # [B, T, ...]
    env_steps: int
    version: int  # of the parameters that acted
    record: Record  # metrics of the collection


class Collector(Protocol):
    """What the training loop asks of a collector; a context manager that frees everything on exit."""

    busy: bool  # between `start` and `finish`

    def start(self, learner: ppo.LearnerState, iteration: int, version: int) -> None:
        """Asks for one iteration's experience with the learner's present parameters; returns at once."""

    def finish(self) -> Experience:
        """Waits for what `start` asked for."""

    def save(self) -> list[bytes]:
        """The state of the environments, for a checkpoint; only while not busy."""

    def load(self, states: list[bytes]) -> None:
        """Restores what `save` returned."""

    def __enter__(self) -> "Collector": ...

    def __exit__(self, *error: object) -> None: ...


class CpuCollector:
    """A `CpuPool` whose buffers come out as padded trajectories."""

    def __init__(self, config: Config, plan: Plan, task: Task):
        self.plan = plan
        self.pool = CpuPool(config, plan, task)
        self.save, self.load = self.pool.save, self.pool.load

    def __enter__(self) -> "CpuCollector":
        return self

    def __exit__(self, *error: object) -> None:
        self.pool.close()

    @property
    def busy(self) -> bool:
        return self.pool.busy

    def start(self, learner: ppo.LearnerState, iteration: int, version: int) -> None:
        self.pool.start(ppo.export_parameters(learner), iteration, version)

    def finish(self) -> Experience:
        collected = self.pool.finish()
        record = collection_record(collected) | {"workers_lost": self.pool.workers_lost}
        return Experience(to_trajectory(collected, self.plan), len(collected.fields["mask"]), collected.version, record)


def to_trajectory(collected: Collected, plan: Plan) -> Trajectory:
    """The centralised buffer as trajectories padded on the right, in whole minibatches (paper III.B)."""
    rows = plan.rows * -(-len(collected.start) // plan.rows)
    version = np.full(len(collected.start), collected.version, np.int32)
    fields = collected.fields | {"initial_carry": collected.initial_carry, "policy_version": version}
    return pad_segments(fields, collected.start, collected.end, plan.max_length, rows)


def collection_record(collected: Collected) -> Record:
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
