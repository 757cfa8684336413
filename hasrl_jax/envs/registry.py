"""From a configuration to its task."""

from hasrl_jax.config import tasks
from hasrl_jax.config.schema import Config
from hasrl_jax.envs.task import Task


def make_task(config: Config) -> Task:
    """The task that `config.task` names.

    Raises:
      ConfigError: there is no such task.
    """
    task: Task = tasks.find(config.task).make(config)
    return task
