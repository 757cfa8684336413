"""Memory shared between the pool and its workers.

The block has no name: its file descriptor is inherited by the workers, so it vanishes with the last
process that holds it, however that process ends. Nothing can be left behind.
"""

import contextlib
import mmap
import os
import tempfile

import numpy as np
import psutil

from hasrl_jax.collect.plan import Plan
from hasrl_jax.config.schema import Config, NetworkConfig
from hasrl_jax.policy.numpy_networks import Parameters, parameter_shapes
from hasrl_jax.types import STEP_FIELDS

Specs = dict[str, tuple[tuple[int, ...], str]]  # name -> (shape, dtype)
ALIGNMENT = 64  # bytes, a cache line
# Episodes that ended, at the step where they did; zero elsewhere.
EPISODE_FIELDS = {"episode_return": "float32", "episode_length": "int32"}
NUM_BUFFERS = 2  # everything is double-buffered: one is written while the other is read


def create(size: int) -> int:
    """A file descriptor of `size` bytes of anonymous shared memory.

    Raises:
      OSError: the memory cannot be had; the message names the size.
    """
    remedy = "lower collect.env_steps_per_iteration, collect.envs_per_worker or collect.unroll_length, or free memory"
    available = psutil.virtual_memory().available
    # The learner needs as much again. Asking for it would not fail but let the kernel kill some process.
    if 2 * size > available:
        found = f"{available / 2**20:.0f} MiB are available, and training needs twice as much"
        raise OSError(f"cannot reserve {size / 2**20:.0f} MiB of shared memory for the workers ({found}); {remedy}")
    if hasattr(os, "memfd_create"):
        descriptor = os.memfd_create("hasrl_jax")
    else:  # not Linux: an unlinked temporary file serves the same purpose
        with tempfile.TemporaryFile() as file:
            descriptor = os.dup(file.fileno())
    try:
        if hasattr(os, "posix_fallocate"):
            os.posix_fallocate(descriptor, 0, size)  # fails here, and not as SIGBUS at the first write
        else:
            os.ftruncate(descriptor, size)
    except OSError as error:
        os.close(descriptor)
        raise OSError(
            error.errno,
            f"cannot reserve {size / 2**20:.0f} MiB of shared memory for the workers ({error.strerror}); {remedy}",
        ) from None
    return descriptor


def size_of(specs: Specs) -> int:
    """Bytes that `views` needs."""
    return sum(_padded(shape, dtype) for shape, dtype in specs.values())


def views(memory: mmap.mmap, specs: Specs, offset: int) -> dict[str, np.ndarray]:
    """Named arrays over `memory`, starting at `offset`."""
    arrays = {}
    for name, (shape, dtype) in specs.items():
        arrays[name] = np.ndarray(shape, dtype, memory, offset)
        offset += _padded(shape, dtype)
    return arrays


def _padded(shape: tuple[int, ...], dtype: str) -> int:
    size = int(np.prod(shape)) * np.dtype(dtype).itemsize
    return -(-size // ALIGNMENT) * ALIGNMENT


def slot_specs(
    num_steps: int, num_segments: int, observation_size: int, action_size: int, carry_shape: tuple[int, ...]
) -> Specs:
    """One worker's trajectory buffer: flat steps, and the start and end index of each trajectory in them."""
    sizes = {"": (), "O": (observation_size,), "A": (action_size,)}
    steps: Specs = {name: ((num_steps, *sizes[axes]), dtype) for name, (axes, dtype) in STEP_FIELDS.items()}
    episodes: Specs = {name: ((num_steps,), dtype) for name, dtype in EPISODE_FIELDS.items()}
    segments: Specs = {
        "initial_carry": ((num_segments, *carry_shape), "float32"),
        "start": ((num_segments,), "int32"),
        "end": ((num_segments,), "int32"),
        "num_segments": ((1,), "int32"),
    }
    return steps | segments | episodes


def worker_slot_specs(config: Config, plan: Plan, observation_size: int, action_size: int) -> Specs:
    """The trajectory buffer of a worker of this run."""
    unrolls = config.collect.mode == "unrolls"
    num_segments = plan.steps_per_worker // (plan.max_length if unrolls else 1)
    return slot_specs(plan.steps_per_worker, num_segments, observation_size, action_size, plan.carry_shape)


def parameter_specs(observation_size: int, action_size: int, network: NetworkConfig) -> Specs:
    """One copy of the parameters that the workers act with."""
    shapes = parameter_shapes(observation_size, action_size, network)
    return {name: (shape, "float32") for name, shape in shapes.items()}


class Block:
    """The whole shared block: heartbeats, copies of the parameters, and two trajectory slots per worker."""

    def __init__(self, descriptor: int, num_workers: int, num_copies: int, parameters: Specs, slot: Specs):
        beat: Specs = {"heartbeat": ((num_workers,), "float64")}
        self.size = size_of(beat) + num_copies * size_of(parameters) + NUM_BUFFERS * num_workers * size_of(slot)
        self.descriptor = create(self.size) if descriptor < 0 else descriptor
        self._memory = mmap.mmap(self.descriptor, self.size)
        self.heartbeat = views(self._memory, beat, 0)["heartbeat"]
        offset = size_of(beat)
        self.parameters: list[Parameters] = []
        for _ in range(num_copies):
            self.parameters.append(views(self._memory, parameters, offset))
            offset += size_of(parameters)
        self.slots: list[list[dict[str, np.ndarray]]] = []  # [buffer][worker]
        for _ in range(NUM_BUFFERS):
            row = []
            for _ in range(num_workers):
                row.append(views(self._memory, slot, offset))
                offset += size_of(slot)
            self.slots.append(row)

    def close(self) -> None:
        """Lets go of the memory; the arrays must not be used afterwards."""
        self.heartbeat, self.parameters, self.slots = np.empty(0), [], []
        with contextlib.suppress(BufferError):  # an exception under way may still hold an array; it goes with that
            self._memory.close()
        os.close(self.descriptor)


def open_block(config: Config, plan: Plan, observation_size: int, action_size: int, descriptor: int = -1) -> Block:
    """The block of a run: a new one, or the one behind an inherited `descriptor`."""
    slot = worker_slot_specs(config, plan, observation_size, action_size)
    parameters = parameter_specs(observation_size, action_size, config.network)
    # Workers that collect together share two copies; those that go their own way have one each.
    num_copies = plan.num_workers if config.schedule == "decoupled" else NUM_BUFFERS
    return Block(descriptor, plan.num_workers, num_copies, parameters, slot)
