"""From a configuration to its task."""

from hasrl_jax.config import tasks
from hasrl_jax.config.limits import require
from hasrl_jax.config.schema import Config
from hasrl_jax.envs.task import Task


def make_task(config: Config) -> Task:
    """The task that `config.task` names.

    Raises:
      ConfigError: there is no such task, or the network is to be symmetric and the task has no mirror.
    """
    task: Task = tasks.find(config.task).make(config)
    usable = task.mirror is not None or not config.network.symmetric
    require(usable, "network.symmetric", True, f"False with task {config.task}, which defines no mirror")
    return task
