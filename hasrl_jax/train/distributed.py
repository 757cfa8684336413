"""One learner over several training processes, usually one per host.

Every process collects its own share with its own workers; the update is one program over the devices of all of them.
Process 0 alone writes the run directory. What the processes must agree on travels as JSON from each to all.
"""

import atexit
import base64
import json
import logging
import math
import os
import socket
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

import jax
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from hasrl_jax.collect.protocol import Collector, Experience, Parameters
from hasrl_jax.config.convert import to_dict
from hasrl_jax.config.limits import shown
from hasrl_jax.config.schema import Config, DistributedConfig
from hasrl_jax.envs.task import Task
from hasrl_jax.errors import ConfigError, WorkerError
from hasrl_jax.types import Record, Trajectory

log = logging.getLogger("hasrl_jax")
SUMS = ("diverged_envs", "workers_lost")
OWN_SETTINGS = {"run_dir", "distributed.process_id"}  # may differ between the processes
SHUTDOWN_TIMEOUT_S = 10  # how long a process that ends waits for the others
REPLY_TIMEOUT_S = 5.0
RETRY_S = 0.2
GO = b"go"


class OtherProcessError(WorkerError):
    """This process ends because another one did."""


def join(config: Config) -> None:
    """Makes the devices of all processes known to each; before JAX first touches a device. Alone, does nothing.

    Raises:
      ConfigError: the processes do not find each other, or their settings differ.
    """
    settings = config.distributed
    if settings.num_processes == 1:
        return
    jax.config.update("jax_cpu_collectives_implementation", "gloo")
    barrier(settings)
    jax.distributed.initialize(
        settings.coordinator,
        settings.num_processes,
        settings.process_id,
        initialization_timeout=math.ceil(settings.start_timeout_s),
        shutdown_timeout_seconds=SHUTDOWN_TIMEOUT_S,
        coordinator_bind_address=settings.coordinator,
    )
    if settings.process_id:
        log.setLevel(logging.WARNING)  # the first process says it all
    first, *others = ({name: value for name, value in _flat(settings)} for settings in exchange(to_dict(config)))
    for process_id, other in enumerate(others, 1):
        for name in first.keys() - OWN_SETTINGS:
            if first[name] != other[name]:
                found = f"{shown(other[name])} in process {process_id} and {shown(first[name])} in process 0"
                raise ConfigError(f"{name}: got {found}; expected the same in all")


def barrier(settings: DistributedConfig) -> None:
    """Waits until all processes are there; JAX would end the program with a stack trace when one stays away.

    Raises:
      ConfigError: not all came in time, or they do not fit together.
    """
    host, _, port = settings.coordinator.rpartition(":")
    deadline = time.monotonic() + settings.start_timeout_s
    here = f"distributed.coordinator: got {settings.coordinator}"
    limit = f"within distributed.start_timeout_s={settings.start_timeout_s:g} s"
    try:
        if settings.process_id == 0:
            _hold_barrier(settings, (host, int(port)), deadline)
        else:
            _reach_barrier(settings, (host, int(port)), deadline)
    except TimeoutError as error:
        raise ConfigError(f"{here}; {error or 'nobody replied'}; expected all processes {limit}") from None
    except OSError as error:
        raise ConfigError(
            f"{here}, which cannot be used ({error.strerror}); expected a free port of process 0"
        ) from None


def _hold_barrier(settings: DistributedConfig, address: tuple[str, int], deadline: float) -> None:
    """Process 0: lets the others go on when all have reached the barrier."""
    with socket.create_server(address) as server, ExitStack() as stack:
        present: dict[int, socket.socket] = {}
        while len(present) < settings.num_processes - 1:
            server.settimeout(max(0.01, deadline - time.monotonic()))
            try:
                connection = stack.enter_context(server.accept()[0])
            except TimeoutError:
                raise TimeoutError(f"only processes {sorted([0, *present])} came") from None
            connection.settimeout(REPLY_TIMEOUT_S)
            try:
                process_id, num_processes = map(int, connection.recv(64).split())
            except (OSError, ValueError):
                continue  # not one of our processes
            if num_processes != settings.num_processes:
                seen = f"got {num_processes} in process {process_id} and {settings.num_processes} in process 0"
                raise ConfigError(f"distributed.num_processes: {seen}; expected the same in all")
            if process_id in present:
                raise ConfigError(f"distributed.process_id: got {process_id} twice; expected another in each process")
            present[process_id] = connection
        for connection in present.values():
            connection.sendall(GO)


def _reach_barrier(settings: DistributedConfig, address: tuple[str, int], deadline: float) -> None:
    """The other processes: wait for process 0."""
    while True:
        left = max(0.01, deadline - time.monotonic())
        try:
            connection = socket.create_connection(address, timeout=left)
            break
        except ConnectionRefusedError:
            if left <= RETRY_S:
                raise TimeoutError("process 0 does not listen there") from None
            time.sleep(RETRY_S)
    with connection:
        connection.settimeout(left + REPLY_TIMEOUT_S)  # process 0 gives up first
        connection.sendall(f"{settings.process_id} {settings.num_processes}".encode())
        try:
            answer = connection.recv(len(GO))
        except ConnectionResetError:
            answer = b""
        if answer != GO:
            raise TimeoutError("process 0 has given up, and says why")


def any_process(config: Config, condition: bool) -> bool:
    """Whether the condition holds in any process; all must ask."""
    return any(exchange(condition)) if config.distributed.num_processes > 1 else condition


def first_process(config: Config, condition: bool) -> bool:
    """Whether the condition holds in the first process; all must ask."""
    return exchange(condition)[0] if config.distributed.num_processes > 1 else condition


def exchange(value: Any) -> list[Any]:
    """What each process calls this with, in their order; anything that JSON can hold. All must call it.

    Raises:
      WorkerError: another process has failed, or is gone.
    """
    messages = _exchange({"value": value})
    for process_id, message in enumerate(messages):
        if "failure" in message:
            raise OtherProcessError(f"process {process_id} failed: {message['failure']}")
    return [message["value"] for message in messages]


def _leave() -> None:
    """Ends this process without JAX's farewell, which would wait for the process that is gone and then abort."""
    sys.stdout.flush()
    os._exit(1)


@contextmanager
def ending_together(config: Config) -> Iterator[None]:
    """When one process fails, all others fail at their next `exchange`, rather than wait for it in vain."""
    try:
        yield
    except Exception as error:
        if config.distributed.num_processes > 1 and not isinstance(error, OtherProcessError):
            _exchange({"failure": f"{type(error).__name__}: {error}"})
        raise


def _exchange(message: dict[str, Any]) -> list[dict[str, Any]]:
    """The message of every process."""
    data = np.frombuffer(json.dumps(message).encode(), np.uint8)
    try:
        sizes = multihost_utils.process_allgather(np.array([len(data)]))[:, 0]
        padded = np.zeros(1 << int(sizes.max() - 1).bit_length(), np.uint8)  # few shapes, since each is compiled
        padded[: len(data)] = data
        rows = multihost_utils.process_allgather(padded)
    except (jax.errors.JaxRuntimeError, ValueError) as error:  # JAX raises either, as the call returns early or late
        atexit.register(_leave)
        reason = " ".join(str(error).split())[:200]
        raise OtherProcessError(f"another training process is gone ({reason}); use --resume") from None
    return [json.loads(row[:size].tobytes()) for row, size in zip(rows, sizes, strict=True)]


class SharedExperience:
    """What all processes collect, as one: the rows of process 0, then those of process 1, and so on."""

    def __init__(self, config: Config, own: Collector, mesh: Mesh):
        self.own, self.settings, self.mesh = own, config.distributed, mesh
        self.description = f"{self.settings.num_processes} processes, each {own.description}"

    def __enter__(self) -> "SharedExperience":
        self.own.__enter__()
        return self

    def __exit__(self, *error: object) -> None:
        self.own.__exit__(*error)

    @property
    def busy(self) -> bool:
        return self.own.busy

    def start(self, parameters: Parameters, iteration: int, version: int) -> None:
        self.own.start(parameters, iteration, version)

    def finish(self) -> Experience:
        """Waits for the workers of all processes."""
        own = self.own.finish()
        rows, env_steps, records = zip(*exchange([len(own.trajectory.mask), own.env_steps, own.record]), strict=True)
        trajectory = to_global(own.trajectory, max(rows), self.mesh)
        return Experience(trajectory, sum(env_steps), merge_records(list(records)))

    def configure(self, config: Config, task: Task) -> None:
        self.own.configure(config, task)

    def save(self) -> list[bytes]:
        own = [base64.b64encode(state).decode() for state in self.own.save()]
        return [base64.b64decode(state) for states in exchange(own) for state in states]

    def load(self, states: list[bytes]) -> None:
        workers = len(states) // self.settings.num_processes
        begin = self.settings.process_id * workers
        self.own.load(states[begin : begin + workers])


def to_global(trajectory: Trajectory, rows: int, mesh: Mesh) -> Trajectory:
    """This process's trajectories [B, T, ...] as its part of a global batch [processes * rows, T, ...].

    Args:
      trajectory: NumPy arrays.
      rows: the same in all processes, at least B; further rows are padding.
      mesh: over the devices of all processes, which have the same number each.
    """
    split = NamedSharding(mesh, PartitionSpec("data"))

    def place(array: np.ndarray) -> jax.Array:
        padded = np.zeros((rows, *array.shape[1:]), array.dtype)
        padded[: len(array)] = array
        return jax.make_array_from_process_local_data(split, padded)

    return Trajectory(*map(place, trajectory))


def merge_records(records: list[Record]) -> Record:
    """Counts are added, the slowest collection counts, and the rest is averaged over the processes that have it."""
    merged: Record = {}
    for name in records[0]:
        values = [value for record in records if (value := record[name]) is not None]
        total = sum(values) if name in SUMS else max(values) if name == "collect_seconds" and values else None
        merged[name] = total if total is not None else sum(values) / len(values) if values else None
    return merged


def _flat(settings: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """(dotted path, value) of every setting."""
    for name, value in settings.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{prefix}{name}.")
        else:
            yield prefix + name, value
