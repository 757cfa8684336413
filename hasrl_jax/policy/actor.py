"""A policy that acts step by step in one or many environments, with its LSTM state: `reset`, then `act`."""

from typing import NamedTuple

import numpy as np

from hasrl_jax.config.schema import Config
from hasrl_jax.envs.task import Task
from hasrl_jax.policy import numpy_networks
from hasrl_jax.types import Mirror


class Acting(NamedTuple):
    """A policy in the middle of E episodes; made by `reset`."""

    parameters: numpy_networks.Parameters
    mirror: Mirror | None  # the symmetry of a symmetric network
    carry: np.ndarray  # [E, *network.carry_shape] LSTM state before the next observation


def reset(config: Config, task: Task, parameters: numpy_networks.Parameters, num_envs: int) -> Acting:
    """A policy before its first observation, its LSTM state zero.

    Args:
      config: reads the network.
      task: what it was trained for.
      parameters: as `learn.ppo.export_parameters` returns them.
      num_envs: E.
    """
    mirror = task.mirror if config.network.symmetric else None
    return Acting(parameters, mirror, np.zeros((num_envs, *config.network.carry_shape), np.float32))


def act(acting: Acting, observation: np.ndarray, is_first: np.ndarray) -> tuple[np.ndarray, Acting]:
    """The mean action [E, A] for `observation` [E, O]; where `is_first` [E] the LSTM starts anew."""
    inputs = numpy_networks.streams(observation, acting.parameters, acting.mirror)
    action, carry = numpy_networks.policy_step(acting.parameters, inputs, acting.carry, is_first, acting.mirror)
    return action, acting._replace(carry=carry)
