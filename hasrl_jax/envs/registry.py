"""From a configuration to its task."""

import importlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from hasrl_jax.config import strict_yaml, tasks
from hasrl_jax.config.limits import require
from hasrl_jax.config.schema import Config
from hasrl_jax.envs.task import Task
from hasrl_jax.errors import ConfigError

MENAGERIE = Path("menagerie")  # instead of a file: the robot of MuJoCo Menagerie


def make_task(config: Config) -> Task:
    """The task that `config.task` names.

    Raises:
      ConfigError: there is no such task, or the network is to be symmetric and the task has no mirror.
    """
    task: Task = tasks.find(config.task).make(config)
    usable = task.mirror is not None or not config.network.symmetric
    require(usable, "network.symmetric", True, f"False with task {config.task}, which defines no mirror")
    return task


class Robot(NamedTuple):
    """Another MJCF file of a task's robot."""

    file: Path  # or MENAGERIE
    mapping: Path | None = None  # YAML file of the names that differ, {group: {our name: their name}}

    @property
    def label(self) -> str:
        """The file with its folder: most are called alike."""
        return "/".join(self.file.absolute().parts[-2:]) if self.file != MENAGERIE else "MuJoCo Menagerie"


def make_task_on(config: Config, robot: Robot) -> Task:
    """The task that `config.task` names, on another MJCF file of its robot.

    Args:
      config: what a policy is played under.
      robot: the file, and what things are called there.

    Raises:
      ConfigError: the task cannot, or a file cannot be read or lacks something.
    """
    spec = tasks.find(config.task)
    if spec.make_on is None:
        raise ConfigError(f"--model: got {robot.file}; a policy for task {config.task} is played on its own model only")
    file = _menagerie_file(spec) if robot.file == MENAGERIE else robot.file
    if not file.is_file():
        raise ConfigError(f"--model: got {file}; there is no such file")
    names: Any = {}
    if robot.mapping is not None:
        try:
            names = strict_yaml.parse(robot.mapping.read_text(encoding="utf-8")) or {}
        except (OSError, ValueError) as error:
            raise ConfigError(f"--mapping: {robot.mapping} cannot be read ({' '.join(str(error).split())})") from None
        if not isinstance(names, Mapping):
            raise ConfigError(f"--mapping: {robot.mapping} holds {type(names).__name__}; expected groups of names")
    task: Task = spec.make_on(config, file, names)
    return task


def _menagerie_file(spec: tasks.TaskSpec) -> Path:
    """The scene of MuJoCo Menagerie with the robot of a task; its package loads it over the network at first use.

    Raises:
      ConfigError: the package is missing, has no such robot, or cannot load it.
    """
    if not spec.menagerie:
        raise ConfigError(f"--model: got {MENAGERIE}; MuJoCo Menagerie has no robot of task {spec.name}")
    try:
        menagerie = importlib.import_module("mujoco_menagerie")
    except ImportError:
        raise ConfigError(f'--model {MENAGERIE}: needs pip install "hasrl_jax[menagerie]"') from None
    try:
        return Path(menagerie.get(spec.menagerie).xml())
    except (menagerie.MenagerieError, OSError) as error:
        reason = " ".join(str(error).split())
        raise ConfigError(f"--model {MENAGERIE}: {spec.menagerie} cannot be loaded ({reason}); give a file") from None
