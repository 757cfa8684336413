"""Workers that wait neither for each other nor for the learner, until both of their slots are full.

A thread of the learner's process sends each worker its next request as soon as it has a free slot, with the newest
parameters of that moment, and queues the slots that are finished. The learner takes them oldest first and drops those
that are too old. Nothing grows: a worker has two slots and one copy of the parameters, all in shared memory.
Source: paper section V, future work.
"""

import math
import threading
from collections import deque
from typing import Any, NamedTuple

import numpy as np

from hasrl_jax.collect.buffer import Collected, merge
from hasrl_jax.collect.cpu import cpu_record, fetch, to_trajectory
from hasrl_jax.collect.plan import Plan, make_plan
from hasrl_jax.collect.protocol import Experience, Parameters
from hasrl_jax.collect.shared_memory import NUM_BUFFERS
from hasrl_jax.collect.supervisor import CpuPool
from hasrl_jax.config.schema import Config
from hasrl_jax.envs.task import Task
from hasrl_jax.types import Record

POLL_SECONDS = 0.01  # between looks for a slot that the learner has freed, or for the first parameters
REPLY_SECONDS = 0.1  # the longest wait for replies, and so for the end
STREAMS_APART = 2**20  # a run resumed an iteration later draws random numbers so many collections later


class Finished(NamedTuple):
    """A slot that a worker has filled."""

    worker: int
    slot: dict[str, np.ndarray]  # arrays of shared_memory.slot_specs
    version: int  # of the parameters that acted
    statistics: dict[str, Any]


class Dropped(NamedTuple):
    """What was collected in vain."""

    trajectories: int = 0
    env_steps: int = 0


class FreePool:
    """A `CpuPool` whose workers collect all the time.

    Args:
      config: the run's configuration.
      plan: sizes from `make_plan(config)`.
      task: for the sizes of observations and actions.

    Raises:
      OSError, WorkerError: as `CpuPool`.
    """

    def __init__(self, config: Config, plan: Plan, task: Task):
        self._pool, self._plan, self._max_lag = CpuPool(config, plan, task), plan, config.decoupled.max_lag
        self._dropped = Dropped()
        self._changed = threading.Condition()
        # Everything below is touched with `_changed` held only.
        self._parameters: dict[str, np.ndarray] | None = None  # the newest
        self._version, self._first_stream = 0, 0
        self._at_work: dict[int, int] = {}  # worker -> version it collects with
        self._settings = 0  # how often the settings of the task have changed
        self._configured = [0] * plan.num_workers  # which of them each worker collects under
        self._filled = [0] * plan.num_workers  # slots that each worker has filled since the start
        self._taken = [0] * plan.num_workers  # of these, slots that the learner has taken or dropped
        self._finished: deque[Finished] = deque()  # oldest first
        self._closing = False
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._serve, name="free_pool", daemon=True)
        self._thread.start()

    @property
    def workers_lost(self) -> int:
        """Workers that were replaced so far."""
        return self._pool.workers_lost

    @property
    def process_ids(self) -> list[int]:
        """Operating-system process of each worker, in worker order."""
        return self._pool.process_ids

    def load(self, states: list[bytes]) -> None:
        """Restores what `CpuPool.save` returned; only before the first `publish`."""
        self._pool.load(states)

    def publish(self, parameters: dict[str, np.ndarray], version: int) -> None:
        """Gives the workers newer parameters from their next request on; the arrays must not change afterwards."""
        with self._changed:
            if self._parameters is None:
                self._first_stream = version * STREAMS_APART
            self._parameters, self._version = parameters, version

    def configure(self, config: Config) -> None:
        """Changes the settings of the task; each worker takes them over before its next slot."""
        with self._changed:
            self._pool.config = config
            self._settings += 1

    def take(self, version: int, wait: bool) -> Collected | None:
        """The oldest slots that are fresh enough, as many as there are workers, whichever workers filled them.

        Args:
          version: of the learner's parameters, to tell how old a slot is.
          wait: for enough slots; otherwise None stands for too few.

        Raises:
          WorkerError: a worker failed too many times in a row.
        """
        with self._changed:
            while True:
                if self._error is not None:
                    raise self._error
                self._drop_older_than(version - self._max_lag)
                if len(self._finished) >= self._plan.num_workers:
                    break
                if not wait:
                    return None
                self._changed.wait()
            taken = [self._finished.popleft() for _ in range(self._plan.num_workers)]
        _, slots, versions, statistics = map(list, zip(*taken, strict=True))
        collected = merge(slots, statistics, versions, float(np.mean([one["seconds"] for one in statistics])))
        with self._changed:
            for finished in taken:
                self._taken[finished.worker] += 1
        return collected

    def pop_dropped(self) -> Dropped:
        """What `take` has dropped since the last call."""
        dropped, self._dropped = self._dropped, Dropped()
        return dropped

    def close(self) -> None:
        """Ends the thread and all workers and frees the shared memory."""
        self._closing = True
        self._thread.join()
        self._pool.close()

    def _drop_older_than(self, oldest: int) -> None:
        """Frees the slots that hold data of older versions than `oldest`."""
        for finished in [finished for finished in self._finished if finished.version < oldest]:
            trajectories, env_steps = int(finished.slot["num_segments"][0]), len(finished.slot["mask"])
            self._dropped = Dropped(self._dropped.trajectories + trajectories, self._dropped.env_steps + env_steps)
            self._taken[finished.worker] += 1
        self._finished = deque(finished for finished in self._finished if finished.version >= oldest)

    def _serve(self) -> None:
        """The thread: requests and replies, until the end or an error, which `take` raises."""
        try:
            while not self._closing:
                self._send_requests()
                replies = self._pool.replies(list(self._at_work), self._patience())
                with self._changed:
                    for index, reply in replies.items():
                        version = self._at_work.pop(index)
                        if not isinstance(reply, str):  # else it was replaced and begins this slot anew
                            slot = self._pool.slot(index, self._stream(index))
                            self._finished.append(Finished(index, slot, version, reply))
                            self._filled[index] += 1
                    self._changed.notify_all()
        except BaseException as error:
            with self._changed:
                self._error = error
                self._changed.notify_all()

    def _send_requests(self) -> None:
        """Sends every worker that has a free slot on its way."""
        with self._changed:
            for index in range(self._plan.num_workers):
                full = self._filled[index] - self._taken[index] == NUM_BUFFERS
                if self._parameters is not None and index not in self._at_work and not full:
                    if self._configured[index] != self._settings:
                        self._pool.configure_worker(index)
                        self._configured[index] = self._settings
                    self._pool.write_parameters(index, self._parameters)
                    self._pool.request(index, self._stream(index), copy=index)
                    self._at_work[index] = self._version

    def _stream(self, index: int) -> int:
        """The number that selects random stream and slot: a worker's slots take turns, as they are taken in order."""
        return self._first_stream + self._filled[index]

    def _patience(self) -> float:
        return REPLY_SECONDS if len(self._at_work) == self._plan.num_workers else POLL_SECONDS


class DecoupledCollector:
    """A `FreePool`: what was finished first, and the newest batch once more while there is no other."""

    busy = False  # its workers always are, and `start` only gives them newer parameters

    def __init__(self, config: Config, task: Task):
        self.config, self.task, self.plan = config, task, make_plan(config)
        slots = f"{self.plan.steps_per_worker} environment steps at a time"
        envs = f"{self.plan.num_workers} free workers x {self.plan.envs_per_worker} environments"
        self.description = f"{envs}, {slots}, {self.plan.env_steps} for an iteration"
        self._version = self._batches = self._uses = self._uses_of_newest = 0
        self._newest: Experience | None = None

    def __enter__(self) -> "DecoupledCollector":
        self.pool = FreePool(self.config, self.plan, self.task)
        return self

    def __exit__(self, *error: object) -> None:
        self.pool.close()

    def start(self, parameters: Parameters, iteration: int, version: int) -> None:
        self.pool.publish(fetch(parameters), version)
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

    def configure(self, config: Config, task: Task) -> None:
        self.config, self.task = config, task
        self.pool.configure(config)

    def save(self) -> list[bytes]:
        return []

    def load(self, states: list[bytes]) -> None:
        self.pool.load(states)
