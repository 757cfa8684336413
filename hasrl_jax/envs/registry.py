"""The tasks by name. A new task is a module with `make(config) -> Task` and one line here."""

from collections.abc import Callable

from hasrl_jax.config.schema import Config
from hasrl_jax.envs.cartpole import task as cartpole
from hasrl_jax.envs.cassie import task as cassie
from hasrl_jax.envs.task import Task

TASKS: dict[str, Callable[[Config], Task]] = {"cassie": cassie.make, "cartpole": cartpole.make}
RECIPES = {"cassie": "cassie_walk", "cartpole": "cartpole"}  # the file in configs/ that trains each task


def make_task(config: Config) -> Task:
    """The task that `config.task` names."""
    return TASKS[config.task](config)
