"""The pool of worker processes: starts them, hands out parameters, gathers trajectories, replaces the dead.

Messages are short JSON texts over one connection per worker; parameters and trajectories never pass
through it but lie in shared memory, double-buffered by the parity of the iteration.
Source: paper section III.A and Figure 1.
"""

import contextlib
import json
import logging
import os
import signal
import subprocess
import sys
import time
from collections import deque
from collections.abc import Iterable, Mapping
from multiprocessing.connection import Connection, Pipe, wait
from typing import Any, NamedTuple, cast

import numpy as np

from hasrl_jax.collect import shared_memory
from hasrl_jax.collect.buffer import Collected, merge
from hasrl_jax.collect.plan import Plan
from hasrl_jax.config.convert import to_dict
from hasrl_jax.config.schema import Config
from hasrl_jax.envs.task import Task
from hasrl_jax.errors import WorkerError
from hasrl_jax.policy.blas import ONE_THREAD, blas_variables

log = logging.getLogger("hasrl_jax")
MAX_FAILURES = 3  # of one worker among its last ATTEMPTS requests
ATTEMPTS = 6
# Environment variables that workers are given, by how their names begin; keys and passwords of other programs are not.
GIVEN_VARIABLES = (
    *("PATH", "HOME", "TMPDIR", "LANG", "LC_", "TZ", "LD_", "DYLD_", "PYTHON", "VIRTUAL_ENV", "COVERAGE_"),
    *("OPENBLAS_", "OMP_", "MKL_", "MUJOCO_", "MJ_", "NPY_", "HASRL_"),
)
LONGEST_LOOK_S = 2.0  # time between two looks at the workers that counts; what is more was a pause of this process


def worker_environment(environment: Mapping[str, str]) -> dict[str, str]:
    """What of `environment` a worker is given; a task that needs more calls it HASRL_*."""
    given = {name: value for name, value in environment.items() if name.startswith(GIVEN_VARIABLES)}
    return blas_variables() | given | ONE_THREAD


def are_of_all_workers(states: list[bytes], num_workers: int) -> bool:
    """Whether there is a saved state for each worker; warns where there are states of another number of them."""
    if states and len(states) != num_workers:
        log.warning("%d workers saved, %d run: all episodes begin anew", len(states), num_workers)
    return len(states) == num_workers


def warn_unless_loaded(index: int, state: bytes, loaded: bool) -> None:
    """Says that a worker could not take over the state that it was given."""
    if state and not loaded:
        log.warning("worker %d: the saved environments have other sizes; its episodes begin anew", index)


class _Worker(NamedTuple):
    process: subprocess.Popen
    connection: Connection


class Silence(NamedTuple):
    """How long a worker has given no sign of life while this process was looking."""

    heartbeat: float = 0.0  # the last one that was seen
    seconds: float = 0.0  # looked at since


class CpuPool:
    """Worker processes that collect in parallel; use as a context manager.

    Args:
      config: the run's configuration, sent to every worker.
      plan: sizes from `make_plan(config)`.
      task: for the sizes of observations and actions.

    Raises:
      OSError: too little memory for the shared block.
      WorkerError: the workers do not start; carries the first traceback or exit signal.
    """

    def __init__(self, config: Config, plan: Plan, task: Task):
        self.config, self.plan = config, plan
        self.workers_lost = 0
        # Whether each of the last requests to a worker failed; one that dies again and again must not go unnoticed.
        self._failures = [deque[bool](maxlen=ATTEMPTS) for _ in range(plan.num_workers)]
        self._looked_at = time.monotonic()
        self._silences = [Silence() for _ in range(plan.num_workers)]
        self._workers: list[_Worker] = []
        self._block = shared_memory.open_block(config, plan, task.observation_size, task.action_size)
        self._iteration, self._version = -1, -1
        self.busy = False  # between `start` and `finish`
        self._started = 0.0
        try:
            for index in range(plan.num_workers):
                self._workers.append(self._spawn(index))
            for index in range(plan.num_workers):
                self._await_ready(index)
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> "CpuPool":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def process_ids(self) -> list[int]:
        """Operating-system process of each worker, in worker order."""
        return [worker.process.pid for worker in self._workers]

    def start(self, parameters: dict[str, np.ndarray], iteration: int, version: int) -> None:
        """Asks every worker for one iteration of steps; returns at once.

        Args:
          parameters: copied to the workers.
          iteration: selects the random streams and, by its parity, the buffers.
          version: of the parameters.
        """
        buffer = iteration % shared_memory.NUM_BUFFERS
        self.write_parameters(buffer, parameters)
        self._iteration, self._version, self._started = iteration, version, time.monotonic()
        self.busy = True
        for index in range(self.plan.num_workers):
            self.request(index, iteration, buffer)

    def finish(self) -> Collected:
        """Waits for the iteration that `start` asked for and merges the workers' buffers.

        A worker that dies or falls silent is replaced; only its own part of this iteration is lost.

        Raises:
          WorkerError: one failed too many times.
        """
        pending = set(range(self.plan.num_workers))
        statistics: dict[int, dict[str, Any]] = {}
        cause: str | None = None
        while pending:
            for index, reply in self.replies(pending, timeout_s=1.0).items():
                pending.discard(index)
                if isinstance(reply, str):
                    cause = reply
                else:
                    statistics[index] = reply
            if not pending and not statistics:
                log.warning(
                    "every worker was lost in the same iteration, the last one %s; it is collected again", cause
                )
                pending = set(range(self.plan.num_workers))
                for index in sorted(pending):
                    self.request(index, self._iteration, self._iteration % shared_memory.NUM_BUFFERS)
        self.busy = False
        finished = sorted(statistics)
        slots = [self.slot(index, self._iteration) for index in finished]
        ordered = [statistics[index] for index in finished]
        return merge(slots, ordered, self._version, time.monotonic() - self._started)

    def write_parameters(self, copy: int, parameters: dict[str, np.ndarray]) -> None:
        """Fills one of the copies of the parameters in shared memory, which no worker may be using."""
        for name, array in self._block.parameters[copy].items():
            array[:] = parameters[name]

    def request(self, index: int, iteration: int, copy: int) -> None:
        """Asks one worker to fill its slot of an iteration with a copy of the parameters; returns at once."""
        self._block.heartbeat[index] = time.monotonic()
        slot = iteration % shared_memory.NUM_BUFFERS
        self._send(index, {"do": "collect", "iteration": iteration, "parameters": copy, "slot": slot})

    def slot(self, index: int, iteration: int) -> dict[str, np.ndarray]:
        """Where a worker writes in an iteration; it does so again two iterations later."""
        return self._block.slots[iteration % shared_memory.NUM_BUFFERS][index]

    def replies(self, indices: Iterable[int], timeout_s: float) -> dict[int, dict[str, Any] | str]:
        """Waits for any of the workers that were sent a request.

        Returns:
          By worker: the statistics of one that has finished; how it was lost of one that was, and was replaced.

        Raises:
          WorkerError: one failed too many times in a row.
        """
        found: dict[int, dict[str, Any] | str] = {}
        by_connection = {self._workers[index].connection: index for index in indices}
        for ready in wait(list(by_connection), timeout_s):
            index = by_connection[cast(Connection, ready)]
            reply, failure = self._receive(index)
            if failure is None:
                found[index] = json.loads(reply)
                self._failures[index].append(False)
            else:
                found[index] = failure
                self._replace(index, failure)
        for index in self._replace_silent(set(by_connection.values()) - found.keys()):
            found[index] = self._silence()
        return found

    def save(self) -> list[bytes]:
        """The state of every worker's environments; only between `finish` and `start`.

        A worker that is lost meanwhile is replaced and has an empty state, so its episodes begin anew.
        """
        states = []
        for index in range(self.plan.num_workers):
            self._send(index, {"do": "save"})
            state, failure = self._reply_to(index)
            states.append(state)
            if failure is not None:
                self._replace(index, failure)
        return states

    def load(self, states: list[bytes]) -> None:
        """Restores what `save` returned; environments that differ in number begin new episodes instead."""
        if not are_of_all_workers(states, self.plan.num_workers):
            return
        for index, state in enumerate(states):
            self._send(index, {"do": "load"})
            self._send(index, state)
            reply, failure = self._reply_to(index)
            if failure is not None:
                self._replace(index, failure)
            else:
                warn_unless_loaded(index, state, json.loads(reply)["loaded"])

    def configure(self, config: Config) -> None:
        """Changes the settings of the task in every worker; only between `finish` and `start`.

        Episodes go on where `worker.Actor.configured` lets them, and begin anew elsewhere.
        """
        self.config = config
        for index in range(self.plan.num_workers):
            self.configure_worker(index)

    def configure_worker(self, index: int) -> None:
        """Gives `config`, which has changed, to one worker; it must not be collecting."""
        self._send(index, {"do": "configure", "config": to_dict(self.config)})
        _, failure = self._reply_to(index)
        if failure is not None:
            self._replace(index, failure)

    def close(self) -> None:
        """Ends all workers and frees the shared memory."""
        for worker in self._workers:
            worker.connection.close()
            worker.process.kill()  # it holds nothing that needs tidying
            worker.process.wait()
        self._workers = []
        self._block.close()

    def _spawn(self, index: int) -> _Worker:
        """A new interpreter that inherits the connection and the shared block, and one thread."""
        ours, theirs = Pipe()
        descriptors = (theirs.fileno(), self._block.descriptor)
        process = subprocess.Popen(
            [sys.executable, "-m", "hasrl_jax.collect.worker", *map(str, descriptors)],
            pass_fds=descriptors,
            stdin=subprocess.DEVNULL,
            env=worker_environment(os.environ),
        )
        theirs.close()
        setup = {"config": to_dict(self.config), "index": index, "parent": os.getpid()}
        with contextlib.suppress(OSError):  # it died at once; waiting for it to be ready says how
            ours.send_bytes(json.dumps(setup).encode())
        return _Worker(process, ours)

    def _await_ready(self, index: int) -> None:
        timeout = self.config.collect.worker_start_timeout_s
        worker = self._workers[index]
        if not worker.connection.poll(timeout):
            raise WorkerError(f"worker {index} did not start within collect.worker_start_timeout_s={timeout:g} s")
        _, failure = self._receive(index)
        if failure is not None:
            raise WorkerError(f"worker {index} did not start: it {failure}")

    def _send(self, index: int, message: dict[str, Any] | bytes) -> None:
        data = message if isinstance(message, bytes) else json.dumps(message).encode()
        with contextlib.suppress(OSError):  # it died; its closed connection says so when the reply is awaited
            self._workers[index].connection.send_bytes(data)

    def _reply_to(self, index: int) -> tuple[bytes, str | None]:
        """As `_receive`, for a request that is answered at once: a worker that stays silent has failed."""
        connection = self._workers[index].connection
        # Asked once more: the time may have passed while this process, and the worker with it, was stopped.
        if not connection.poll(self.config.collect.worker_timeout_s) and not connection.poll(LONGEST_LOOK_S):
            return b"", self._silence()
        return self._receive(index)

    def _receive(self, index: int) -> tuple[bytes, str | None]:
        """The worker's message, empty if it failed, and how it failed if it did."""
        worker = self._workers[index]
        try:
            data = worker.connection.recv_bytes()
        except (EOFError, OSError):
            code = worker.process.wait()
            return b"", f"was killed by {signal_name(-code)}" if code < 0 else f"exited with status {code}"
        if data.startswith(b'{"error"'):
            error = json.loads(data)["error"].rstrip()
            log.warning("worker %d (process %d) failed:\n%s", index, worker.process.pid, error)
            return b"", f"raised {error.splitlines()[-1]}"
        return data, None

    def _silence(self) -> str:
        return f"was silent for collect.worker_timeout_s={self.config.collect.worker_timeout_s:g} s"

    def _replace_silent(self, pending: set[int]) -> set[int]:
        """Replaces workers without a heartbeat; returns their indices."""
        now = time.monotonic()
        looked_s = min(now - self._looked_at, LONGEST_LOOK_S)
        self._looked_at = now
        silent = set()
        for index in pending:
            before, heartbeat = self._silences[index], float(self._block.heartbeat[index])
            seconds = before.seconds + looked_s if heartbeat == before.heartbeat else 0.0
            self._silences[index] = Silence(heartbeat, seconds)
            # A reply that waits to be read says that it is alive.
            if seconds > self.config.collect.worker_timeout_s and not self._workers[index].connection.poll(0):
                silent.add(index)
        for index in silent:
            self._replace(index, self._silence())
        return silent

    def _replace(self, index: int, cause: str) -> None:
        """Starts another worker in place of a lost one, more than once if the new one does not start either."""
        while True:
            old = self._workers[index]
            lost = "its part of this iteration is lost, starting another"
            log.warning("worker %d (process %d) %s; %s", index, old.process.pid, cause, lost)
            old.connection.close()
            old.process.kill()
            old.process.wait()
            self.workers_lost += 1
            self._failures[index].append(True)
            if sum(self._failures[index]) >= MAX_FAILURES:
                tries = f"{MAX_FAILURES} times in {len(self._failures[index])} requests"
                raise WorkerError(f"worker {index} failed {tries}; the last one {cause}")
            self._workers[index] = self._spawn(index)
            try:
                self._await_ready(index)
                return
            except WorkerError as error:
                cause = f"was replaced in vain: {error}"


def signal_name(number: int) -> str:
    """SIGKILL for 9; real-time signals have no name of their own."""
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"
