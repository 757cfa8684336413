"""The workers of `collect/supervisor.py` as Ray actors, on this machine or on the nodes of a Ray cluster.

Parameters go into Ray's object store once per iteration and trajectories come back through it: on the same node
without a copy. Ray's own restarts are not used, since a lost worker is counted, and begins new episodes.
"""

import atexit
import contextlib
import logging
import os
import re
import signal
import time
from collections.abc import Iterable
from typing import Any

import numpy as np

from hasrl_jax.collect import shared_memory
from hasrl_jax.collect.buffer import Collected, merge
from hasrl_jax.collect.plan import Plan
from hasrl_jax.collect.ray.cluster import connect, environment, find_raylet, has_ended, import_ray
from hasrl_jax.collect.ray.worker import RayWorker
from hasrl_jax.collect.supervisor import MAX_FAILURES, are_of_all_workers, warn_unless_loaded
from hasrl_jax.config.convert import to_dict
from hasrl_jax.config.schema import Config
from hasrl_jax.envs.task import Task
from hasrl_jax.errors import WorkerError

log = logging.getLogger("hasrl_jax")
HEARTBEAT = "heartbeat"  # a thread of its own in every worker, which replies while another collects
TICK_S = 1.0
RAISED = "raised "  # how the failure of a worker begins that is its own


class RayPool:
    """`CpuPool` with Ray actors for workers; use as a context manager.

    A replacement starts in the background and takes part from the first iteration that finds it ready. So a cluster
    that has lost a node goes on with the workers that are left until there is room for the others again.

    Args:
      config: the run's configuration, sent to every worker.
      plan: sizes from `make_plan(config)`.
      task: for the sizes of observations and actions.

    Raises:
      ConfigError: Ray is not installed.
      WorkerError: the cluster cannot be reached, or the workers do not start; carries the cause.
    """

    def __init__(self, config: Config, plan: Plan, task: Task):
        self.config, self.plan = config, plan
        self.workers_lost = 0
        self.busy = False  # between `start` and `finish`
        self.places: dict[int, tuple[str, int]] = {}  # Ray node and process of each worker that is ready
        self._failures = [0] * plan.num_workers
        self._actors: dict[int, Any] = {}
        self._starting: dict[Any, int] = {}  # the reply of `RayWorker.place` still to come -> worker
        self._requests: dict[Any, int] = {}  # the reply of `RayWorker.collect` still to come -> worker
        self._version, self._started = -1, 0.0
        specs = shared_memory.worker_slot_specs(config, plan, task.observation_size, task.action_size)
        self.ray = import_ray(config.ray)
        self._connected = connect(self.ray, config.ray, plan.num_workers, shared_memory.size_of(specs))
        self._raylet = find_raylet(self.ray)
        try:
            options = {"num_cpus": 1, "max_restarts": 0, "scheduling_strategy": "SPREAD"}
            options |= {"concurrency_groups": {HEARTBEAT: 1}, "runtime_env": environment(config.ray)}
            self._remote = self.ray.remote(**options)(RayWorker)
            for index in range(plan.num_workers):
                self._spawn(index)
            self._await_all()
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> "RayPool":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def start(self, parameters: dict[str, np.ndarray], iteration: int, version: int) -> None:
        """Asks every worker that is ready for one iteration of steps; returns at once.

        Args:
          parameters: shared with all workers.
          iteration: selects the random streams.
          version: of the parameters.

        Raises:
          WorkerError: no worker is ready, and none gets ready in time.
        """
        self._version, self._started = version, time.monotonic()
        self._join()
        self._require_raylet()
        shared = self.ray.put(parameters)
        self._requests = {self._actors[index].collect.remote(shared, iteration): index for index in sorted(self.places)}
        self.busy = True

    def finish(self) -> Collected:
        """Waits for the iteration that `start` asked for and merges the workers' buffers.

        A worker or node that dies or falls silent is replaced; only its own part of this iteration is lost.

        Raises:
          WorkerError: no worker finished, one failed too many times in a row, or Ray's process on this node died.
        """
        finished: dict[int, tuple[dict[str, np.ndarray], dict[str, Any]]] = {}
        cause: str | None = None
        heard = dict.fromkeys(self._requests.values(), time.monotonic())
        asked: dict[int, Any] = {}
        while self._requests:
            for request in self._wait(self._requests, TICK_S):
                index = self._requests.pop(request)
                reply, failure = self._receive(index, request)
                if failure is None:
                    finished[index] = reply
                    self._failures[index] = 0
                else:
                    self._replace(index, failure)
                    cause = failure
            silent = self._silent(self._requests.values(), heard, asked)
            for request in [request for request, index in self._requests.items() if index in silent]:
                cause = self._silence()
                self._replace(self._requests.pop(request), cause)
        self.busy = False
        if not finished:
            raise WorkerError(f"every worker was lost in the same iteration; the last one {cause}")
        slots, statistics = zip(*(finished[index] for index in sorted(finished)), strict=True)
        return merge(list(slots), list(statistics), self._version, time.monotonic() - self._started)

    def save(self) -> list[bytes]:
        """The state of every worker's environments; only between `finish` and `start`.

        A worker that is lost meanwhile, or has yet to start, has an empty state: its episodes begin anew.
        """
        requests = {index: self._actors[index].save.remote() for index in self.places}
        states = [b""] * self.plan.num_workers
        for index, request in requests.items():
            state, failure = self._receive(index, request)
            if failure is None:
                states[index] = state
            else:
                self._replace(index, failure)
        return states

    def load(self, states: list[bytes]) -> None:
        """Restores what `save` returned; environments that differ in number begin new episodes instead."""
        if not are_of_all_workers(states, self.plan.num_workers):
            return
        requests = {index: self._actors[index].load.remote(states[index]) for index in self.places}
        for index, request in requests.items():
            loaded, failure = self._receive(index, request)
            if failure is not None:
                self._replace(index, failure)
            else:
                warn_unless_loaded(index, states[index], loaded)

    def configure(self, config: Config) -> None:
        """Changes the settings of the task in every worker; only between `finish` and `start`."""
        self.config = config
        requests = {index: self._actors[index].configure.remote(to_dict(config)) for index in sorted(self.places)}
        # One that is still starting has the old settings: another takes its place.
        for index in set(range(self.plan.num_workers)) - self.places.keys():
            self._replace(index, "was starting under the settings of an earlier stage", counts=False)
        for index, request in requests.items():
            _, failure = self._receive(index, request)
            if failure is not None:
                self._replace(index, failure)

    def close(self) -> None:
        """Ends the workers, and Ray if it was started here; a cluster that was joined goes on without them."""
        if self._raylet is not None and has_ended(self._raylet):
            self._end_local_workers()
            return
        if self.ray.is_initialized():
            for actor in self._actors.values():
                with contextlib.suppress(self.ray.exceptions.RayError):
                    self.ray.kill(actor)
        self._actors, self._starting, self._requests, self.places = {}, {}, {}, {}
        if self._connected:
            self.ray.shutdown()
            self._connected = False

    def _spawn(self, index: int) -> None:
        self._actors[index] = self._remote.remote(to_dict(self.config), index)
        self._starting[self._actors[index].place.remote()] = index

    def _await_all(self) -> None:
        """Waits for the workers of a new pool."""
        timeout = self.config.collect.worker_start_timeout_s
        ready, late = self.ray.wait(list(self._starting), num_returns=len(self._starting), timeout=timeout)
        for request in ready:
            index = self._starting.pop(request)
            place, failure = self._receive(index, request)
            if failure is not None:
                raise WorkerError(f"worker {index} did not start: it {failure}")
            self.places[index] = place
        if late:
            cpus = f"the Ray cluster has {self.ray.cluster_resources().get('CPU', 0):g} CPUs"
            raise WorkerError(
                f"{len(late)} of {self.plan.num_workers} workers did not start within "
                f"collect.worker_start_timeout_s={timeout:g} s; each takes one CPU, and {cpus}"
            )
        nodes = len({node for node, _ in self.places.values()})
        log.info("Ray: %d workers on %d node%s", len(self.places), nodes, "s" if nodes > 1 else "")

    def _join(self) -> None:
        """Takes in the replacements that have started; waits for one only when there is no other worker."""
        deadline = time.monotonic() + self.config.collect.worker_start_timeout_s
        while self._starting:
            timeout = 0.0 if self.places else max(0.0, deadline - time.monotonic())
            ready = self._wait(self._starting, timeout)
            if not ready:
                break
            index = self._starting.pop(ready[0])
            place, failure = self._receive(index, ready[0])
            if failure is None:
                self.places[index] = place
            else:
                # A replacement that was to start on a node that is going down is not at fault.
                self._replace(index, f"was replaced in vain: it {failure}", counts=failure.startswith(RAISED))
        if not self.places:
            limit = f"collect.worker_start_timeout_s={self.config.collect.worker_start_timeout_s:g} s"
            raise WorkerError(f"every worker was lost, and no other started within {limit}")

    def _require_raylet(self) -> None:
        """Asked before Ray is: without its process on this node it ends this one, unsaved, at the next request.

        Raises:
          WorkerError: that process has died.
        """
        if self._raylet is not None and has_ended(self._raylet):
            raise WorkerError("Ray's process on this machine, the raylet, has died, and all workers with it")

    def _end_local_workers(self) -> None:
        """Without a word to Ray, which would end this process before it has said why, and repeat itself at its end."""
        atexit.unregister(self.ray.shutdown)
        own = self.ray.get_runtime_context().get_node_id()
        for node, process_id in self.places.values():
            if node == own:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(process_id, signal.SIGKILL)

    def _wait(self, requests: Iterable[Any], timeout: float) -> list[Any]:
        """Those that are answered; at most one, after `timeout` seconds none."""
        self._require_raylet()
        ready, _ = self.ray.wait(list(requests), timeout=timeout)
        self._require_raylet()
        return ready

    def _receive(self, index: int, request: Any) -> tuple[Any, str | None]:
        """A worker's reply, and how it failed if it did."""
        self._require_raylet()
        try:
            return self.ray.get(request, timeout=self.config.collect.worker_timeout_s), None
        except self.ray.exceptions.GetTimeoutError:
            return None, self._silence()
        except self.ray.exceptions.RayError as error:
            text = re.sub(r"\x1b\[[0-9;]*m", "", str(error)).rstrip()  # without colours
            last_line = text.splitlines()[-1].strip()
            if isinstance(error, self.ray.exceptions.RayTaskError) or getattr(error, "actor_init_failed", False):
                log.warning("worker %d failed:\n%s", index, text)
                return None, f"{RAISED}{last_line}"
            return None, f"was lost: {last_line.partition('. ')[0]}"  # with its process or its node

    def _silence(self) -> str:
        return f"was silent for collect.worker_timeout_s={self.config.collect.worker_timeout_s:g} s"

    def _silent(self, pending: Iterable[int], heard: dict[int, float], asked: dict[int, Any]) -> set[int]:
        """The pending workers without an environment step for too long.

        Args:
          pending: workers.
          heard: when each took its last known step; brought up to date.
          asked: each worker's reply still to come, of `RayWorker.silent_s`; brought up to date.
        """
        now, limit = time.monotonic(), self.config.collect.worker_timeout_s
        for index in pending:
            if index not in asked:
                asked[index] = self._actors[index].silent_s.options(concurrency_group=HEARTBEAT).remote()
            elif self.ray.wait([asked[index]], timeout=0)[0]:
                with contextlib.suppress(self.ray.exceptions.RayError):  # the reply to `collect` says so too
                    heard[index] = max(heard[index], now - self.ray.get(asked[index]))
                del asked[index]
        return {index for index in pending if now - heard[index] > limit}

    def _replace(self, index: int, cause: str, counts: bool = True) -> None:
        """Starts another worker in place of a lost one; it joins when it is ready."""
        log.warning("worker %d %s; its part of this iteration is lost, starting another", index, cause)
        self.workers_lost += counts
        self._failures[index] += counts
        self.places.pop(index, None)
        with contextlib.suppress(self.ray.exceptions.RayError):
            self.ray.kill(self._actors[index])
        if self._failures[index] >= MAX_FAILURES:
            raise WorkerError(f"worker {index} failed {MAX_FAILURES} times in a row; the last one {cause}")
        self._spawn(index)
