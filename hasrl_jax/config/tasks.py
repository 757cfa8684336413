"""The tasks by name: those of this package, those that installed packages offer, and any other by its place.

A package offers a task as an entry point of the group `hasrl_jax.tasks` whose value is a `TaskSpec`.
"""

import dataclasses
import functools
import importlib
import importlib.metadata
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hasrl_jax.config.limits import named, shown
from hasrl_jax.config.schema import Config, PhysicsConfig
from hasrl_jax.errors import ConfigError

ENTRY_POINTS = "hasrl_jax.tasks"
BUILT_IN = {"cassie": "hasrl_jax.envs.cassie.spec:SPEC", "cartpole": "hasrl_jax.envs.cartpole.spec:SPEC"}


@dataclass(frozen=True)
class TaskSpec:
    """What there is to know of a task before it is made."""

    name: str  # of the task, and of the group of its settings in a configuration
    make: Callable[[Config], Any]  # -> envs.task.Task
    # What trains it when no file is named: a YAML file, or the values themselves
    recipe: Path | dict[str, Any] = dataclasses.field(default_factory=dict)
    settings: type | None = None  # frozen dataclass of its own settings, with a default for every field
    check: Callable[[Config], None] | None = None  # raises ConfigError for settings that do not fit together
    # What a policy is played under: finer physics than that of the training; by default the same.
    reference_physics: Callable[[], PhysicsConfig] | None = None
    # A configuration without what only training has: ends of episodes that spur a learner.
    played: Callable[[Config], Config] = lambda config: config
    # The nominal robot from rest, disturbed by nobody but on request; and robots drawn at random, where there are any.
    undisturbed: Callable[[Config], Config] = lambda config: config
    randomized: Callable[[Config], Config] | None = None
    # The task on another MJCF file of its robot, with names of ours mapped to names there; None where it cannot be.
    make_on: Callable[[Config, Path, Mapping[str, Any]], Any] | None = None
    menagerie: str = ""  # name of that robot in MuJoCo Menagerie


def find(name: str) -> TaskSpec:
    """The task of this name.

    Raises:
      ConfigError: there is none; lists those that there are.
    """
    place = name if ":" in name else _places().get(name)
    if place is None:
        known = ", ".join(_places())
        raise ConfigError(f"task: got {shown(name)}; expected {known}, or MODULE:NAME of a TaskSpec")
    return _load(name, place)


@functools.cache
def config_class(task: str) -> type[Config]:
    """`Config` with the group of settings of this task.

    Raises:
      ConfigError: there is no such task.
    """
    spec = find(task)
    if spec.settings is None:
        return Config
    group = (spec.name, spec.settings, dataclasses.field(default_factory=spec.settings))
    namespace = {"section": spec.name, "__reduce__": _reduced}
    return dataclasses.make_dataclass("Config", [group], bases=(Config,), namespace=namespace, frozen=True)


def _reduced(config: Config) -> tuple[Any, ...]:
    """For pickle, which cannot find by name a class that was made for a task."""
    return _restored, (config.task, {field.name: getattr(config, field.name) for field in dataclasses.fields(config)})


def _restored(task: str, fields: dict[str, Any]) -> Config:
    return config_class(task)(**fields)


def offered() -> list[str]:
    """Names of the tasks of this package and of installed ones."""
    return list(_places())


@functools.cache
def _places() -> dict[str, str]:
    found = {point.name: point.value for point in importlib.metadata.entry_points(group=ENTRY_POINTS)}
    return BUILT_IN | {name: value for name, value in found.items() if name not in BUILT_IN}


@functools.cache
def _load(name: str, place: str) -> TaskSpec:
    module, _, attribute = place.partition(":")
    try:
        spec = getattr(importlib.import_module(module), attribute)
    except (ImportError, AttributeError, TypeError, ValueError) as error:
        reason = " ".join(str(error).split())[:200]
        raise ConfigError(
            f"task: got {shown(name)}, which cannot be loaded from {named(place)} ({reason}); "
            "expected a module in the working directory, on PYTHONPATH or installed"
        ) from None
    if not isinstance(spec, TaskSpec):
        raise ConfigError(f"task: got {shown(name)}; {place} is no TaskSpec but {shown(spec)}")
    taken = {field.name for field in dataclasses.fields(Config)}
    if not spec.name.isidentifier() or spec.name in taken:
        raise ConfigError(f"task: {place} has the name {shown(spec.name)}; expected an identifier that is no field")
    return spec
