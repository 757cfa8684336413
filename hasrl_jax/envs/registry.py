"""From a configuration to its task."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from hasrl_jax.config import strict_yaml, tasks
from hasrl_jax.config.limits import require
from hasrl_jax.config.schema import Config
from hasrl_jax.envs.task import Task
from hasrl_jax.errors import ConfigError


def make_task(config: Config) -> Task:
    """The task that `config.task` names.

    Raises:
      ConfigError: there is no such task, or the network is to be symmetric and the task has no mirror.
    """
    task: Task = tasks.find(config.task).make(config)
    usable = task.mirror is not None or not config.network.symmetric
    require(usable, "network.symmetric", True, f"False with task {config.task}, which defines no mirror")
    return task


def make_task_on(config: Config, file: Path, mapping: Path | None = None) -> Task:
    """The task that `config.task` names, on another MJCF file of its robot.

    Args:
      config: what a policy is played under.
      file: the MJCF file.
      mapping: a YAML file of the names that differ, {group: {our name: their name}}; None where none does.

    Raises:
      ConfigError: the task cannot, or a file cannot be read or lacks something.
    """
    make_on = tasks.find(config.task).make_on
    if make_on is None:
        raise ConfigError(f"--model: got {file}; a policy for task {config.task} is played on its own model only")
    if not file.is_file():
        raise ConfigError(f"--model: got {file}; there is no such file")
    names: Any = {}
    if mapping is not None:
        try:
            names = strict_yaml.parse(mapping.read_text(encoding="utf-8")) or {}
        except (OSError, ValueError) as error:
            raise ConfigError(f"--mapping: {mapping} cannot be read ({' '.join(str(error).split())})") from None
        if not isinstance(names, Mapping):
            raise ConfigError(f"--mapping: {mapping} holds {type(names).__name__}; expected groups of names")
    task: Task = make_on(config, file, names)
    return task
