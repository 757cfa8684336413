"""Collects with a pool of worker processes, or of Ray actors, that all work on the same iteration."""

import jax
import numpy as np

from hasrl_jax.collect.buffer import Collected, pad_segments
from hasrl_jax.collect.plan import Plan, make_plan
from hasrl_jax.collect.protocol import Experience, Parameters
from hasrl_jax.collect.ray.pool import RayPool
from hasrl_jax.collect.supervisor import CpuPool
from hasrl_jax.config.schema import Config
from hasrl_jax.envs.task import Task
from hasrl_jax.types import Record, Trajectory


class CpuCollector:
    """A `CpuPool` or `RayPool` whose buffers come out as padded trajectories."""

    def __init__(self, config: Config, task: Task):
        self.config, self.task, self.plan = config, task, make_plan(config)
        self.description = (
            f"{self.plan.num_workers} workers x {self.plan.envs_per_worker} environments, "
            f"{self.plan.env_steps} environment steps per iteration"
        )

    def __enter__(self) -> "CpuCollector":
        pool = RayPool if self.config.backend == "ray" else CpuPool
        self.pool: CpuPool | RayPool = pool(self.config, self.plan, self.task)
        return self

    def __exit__(self, *error: object) -> None:
        self.pool.close()

    @property
    def busy(self) -> bool:
        return self.pool.busy

    def start(self, parameters: Parameters, iteration: int, version: int) -> None:
        self.pool.start(fetch(parameters), iteration, version)

    def finish(self) -> Experience:
        collected = self.pool.finish()
        record = cpu_record(collected) | {"workers_lost": self.pool.workers_lost}
        return Experience(to_trajectory(collected, self.plan), len(collected.fields["mask"]), record)

    def configure(self, config: Config, task: Task) -> None:
        self.config, self.task = config, task
        self.pool.configure(config)

    def save(self) -> list[bytes]:
        return [] if self.pool.busy else self.pool.save()

    def load(self, states: list[bytes]) -> None:
        self.pool.load(states)


def fetch(parameters: Parameters) -> dict[str, np.ndarray]:
    """Parameters as float32 NumPy arrays that the caller owns."""
    return {name: np.array(array, np.float32) for name, array in jax.device_get(parameters).items()}


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
