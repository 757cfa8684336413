"""The policy as arrays, with all that plain NumPy needs to play them; docs/deploy.md names every one."""

from pathlib import Path
from typing import Any

import numpy as np

from hasrl_jax.deploy.files import Step
from hasrl_jax.policy import numpy_networks
from hasrl_jax.policy.numpy_networks import Parameters
from hasrl_jax.runs import checkpoint
from hasrl_jax.types import Mirror

_MIRROR = "mirror/"


def write(path: Path, parameters: Parameters, mirror: Mirror | None, metadata: dict[str, Any]) -> None:
    """Writes the file, which the programs also take as --policy.

    Args:
      path: replaced when it exists.
      parameters: as `learn.ppo.export_parameters` returns them.
      mirror: the symmetry of a symmetric network, else None.
      metadata: JSON-able values by name, with the configuration under `config`.

    Raises:
      CheckpointError: the file cannot be written.
    """
    symmetry = {} if mirror is None else {_MIRROR + name: array for name, array in mirror._asdict().items()}
    checkpoint.save_policy(path, parameters | symmetry, metadata)


def load(path: Path) -> Step:
    """The file as a function that NumPy computes, from nothing but its arrays."""
    arrays, _ = checkpoint.load_policy(path)
    symmetry = {name.removeprefix(_MIRROR): array for name, array in arrays.items() if name.startswith(_MIRROR)}
    mirror = Mirror(**symmetry) if symmetry else None

    def step(observation: np.ndarray, carry: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        inputs = numpy_networks.streams(observation, arrays, mirror)
        return numpy_networks.policy_step(arrays, inputs, carry, np.zeros(len(carry), bool), mirror)

    return step
