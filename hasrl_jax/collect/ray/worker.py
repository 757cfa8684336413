"""A worker of `ray_pool.py`: what `worker.py` does for a pipe and shared memory, for Ray's messages."""

import os
import time
from typing import Any

import numpy as np

from hasrl_jax.collect import shared_memory
from hasrl_jax.collect.plan import make_plan
from hasrl_jax.collect.worker import Actor
from hasrl_jax.config.convert import from_dict


class RayWorker:
    """A worker and its trajectory buffer, in a process that Ray starts."""

    def __init__(self, settings: dict[str, Any], index: int):
        config = from_dict(settings)
        plan = make_plan(config)
        self.actor = Actor(config, plan, index)
        sizes = self.actor.task.observation_size, self.actor.task.action_size
        specs = shared_memory.worker_slot_specs(config, plan, *sizes)
        self.slot = {name: np.zeros(shape, dtype) for name, (shape, dtype) in specs.items()}
        self.last_beat = time.monotonic()

    def place(self) -> tuple[str, int]:
        """The Ray node and the process it runs in; the reply says that it is ready."""
        import ray

        return ray.get_runtime_context().get_node_id(), os.getpid()

    def collect(
        self, parameters: dict[str, np.ndarray], iteration: int
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """One iteration: (buffer, statistics)."""

        def beat() -> None:
            self.last_beat = time.monotonic()

        beat()
        return self.slot, self.actor.collect(parameters, self.slot, iteration, beat)

    def silent_s(self) -> float:
        """Seconds since the last environment step."""
        return time.monotonic() - self.last_beat

    def configure(self, settings: dict[str, Any]) -> bool:
        """Changes the settings of the task; whether the episodes go on."""
        self.actor, goes_on = self.actor.configured(from_dict(settings))
        return goes_on

    def save(self) -> bytes:
        return self.actor.save()

    def load(self, state: bytes) -> bool:
        return self.actor.load(state)
