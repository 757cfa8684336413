"""Rejects configurations that cannot work, before anything compiles or starts."""

import dataclasses
import os
import typing
from collections.abc import Iterator
from typing import Annotated, Any

from hasrl_jax.config import tasks
from hasrl_jax.config.limits import Limits, check_number, require
from hasrl_jax.config.schema import Config

LONGEST_PATH = 4096  # bytes


def check(config: Config) -> None:
    """Rejects values that cannot work.

    Raises:
      ConfigError: names the field, the value seen and what would work.
    """
    for name, value, limits in numbers(config):
        check_number(name, value, limits)
    if config.backend != "cpu_pool":
        reason = ", where collecting and learning share the devices" if config.backend == "mjx" else ""
        works = f"'sync' or 'overlap' with backend {config.backend}{reason}; decoupled needs cpu_pool"
        require(config.schedule != "decoupled", "schedule", config.schedule, works)
    _check_machines(config)
    for name, value in (("video.width", config.video.width), ("video.height", config.video.height)):
        require(value % 2 == 0, name, value, "an even number")
    _check_path("run_dir", config.run_dir)
    further = tasks.find(config.task).check
    if further:
        further(config)


def numbers(settings: Any, prefix: str = "") -> Iterator[tuple[str, Any, Limits]]:
    """(dotted path, value, limits) of every numeric field of a configuration or a group of one."""
    hints = typing.get_type_hints(type(settings), include_extras=True)
    for field in dataclasses.fields(settings):
        name, value, hint = prefix + field.name, getattr(settings, field.name), hints[field.name]
        if dataclasses.is_dataclass(value):
            yield from numbers(value, f"{name}.")
        elif typing.get_origin(hint) is Annotated:
            yield from ((name, value, limits) for limits in hint.__metadata__ if isinstance(limits, Limits))
        elif field.name == "stages":
            for index, stage in enumerate(value):
                yield from numbers(stage, f"{name}[{index}].")


def limits_of(settings: type, field: str) -> Limits:
    """The limits of one numeric field of a group of settings."""
    hint = typing.get_type_hints(settings, include_extras=True)[field]
    return next(limits for limits in hint.__metadata__ if isinstance(limits, Limits))


def _check_path(name: str, path: str) -> None:
    """Refuses what no file system takes, before it is tried."""
    try:
        fits = len(os.fsencode(path)) < LONGEST_PATH and "\0" not in path
    except UnicodeEncodeError:
        fits = False
    require(fits, name, path, f"a path of less than {LONGEST_PATH} bytes that can be encoded, without a null character")


def _check_machines(config: Config) -> None:
    """What must fit together when more than one machine takes part."""
    address = config.ray.address
    require(config.backend == "ray" or not address, "ray.address", address, "--backend=ray")
    require(not address or _is_host_and_port(address), "ray.address", address, "HOST:PORT of a cluster's head, or none")
    distributed, minibatch = config.distributed, config.ppo.minibatch_trajectories
    coordinator, processes, process_id = distributed.coordinator, distributed.num_processes, distributed.process_id
    require(process_id < processes, "distributed.process_id", process_id, f"0 to {processes - 1}, or more processes")
    if processes == 1:
        require(not coordinator, "distributed.coordinator", coordinator, "distributed.num_processes above 1")
        return
    there = "HOST:PORT of process 0, the same in all processes"
    require(_is_host_and_port(coordinator), "distributed.coordinator", coordinator, there)
    shared = f"a multiple of the {processes} processes"
    require(minibatch % processes == 0, "ppo.minibatch_trajectories", minibatch, shared)
    require(config.schedule == "sync", "schedule", config.schedule, "sync with several processes")
    require(config.backend == "cpu_pool", "backend", config.backend, "cpu_pool with several processes")


def _is_host_and_port(address: str) -> bool:
    host, _, port = address.rpartition(":")
    return host != "" and port.isascii() and port.isdecimal() and 0 < int(port) < 65536
