"""The policy as a StableHLO program of `jax.export`, for JAX without this package and for compilers that read it.

The file is a zip archive: `policy.bin` is what `jax.export.deserialize` takes, `metadata.json` the description.
"""

import io
import json
import zipfile
from pathlib import Path
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax import export

from hasrl_jax.config.schema import NetworkConfig
from hasrl_jax.deploy.files import Step, write_whole
from hasrl_jax.learn.networks import make_networks
from hasrl_jax.policy import numpy_networks
from hasrl_jax.policy.numpy_networks import Parameters
from hasrl_jax.types import Mirror

PROGRAM, METADATA = "policy.bin", "metadata.json"
PLATFORMS = ("cpu", "cuda", "rocm", "tpu")


def write(
    path: Path, network: NetworkConfig, parameters: Parameters, mirror: Mirror | None, metadata: dict[str, Any]
) -> None:
    """Writes the file; the program takes and returns what the ONNX graph does, for any number of robots E.

    Args:
      path: replaced when it exists.
      network: what the parameters are of.
      parameters: as `learn.ppo.export_parameters` returns them.
      mirror: the symmetry of the task, else None.
      metadata: JSON-able values by name.

    Raises:
      CheckpointError: the file cannot be written.
    """
    observation_size, action_size = numpy_networks.input_size(parameters), parameters["policy/mean_bias"].shape[0]
    policy, _ = make_networks(network, observation_size, action_size, mirror)
    weights = {
        name.removeprefix("policy/"): jnp.asarray(array)
        for name, array in parameters.items()
        if name.startswith("policy/")
    }
    statistics = parameters.get("normalizer/mean"), parameters.get("normalizer/std")

    def act(observation: jax.Array, carry: jax.Array) -> tuple[jax.Array, jax.Array]:
        return cast(Any, policy.apply({"params": weights}, observation, carry, None, *statistics))

    (robots,) = export.symbolic_shape("E")
    shapes = (robots, observation_size), (robots, *network.carry_shape)
    arguments = [jax.ShapeDtypeStruct(shape, jnp.float32) for shape in shapes]
    program = export.export(jax.jit(act), platforms=PLATFORMS)(*arguments)
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(PROGRAM, bytes(program.serialize()))
        archive.writestr(METADATA, json.dumps(metadata))
    write_whole(path, buffer.getvalue())


def load(path: Path) -> Step:
    """The file as a function that XLA computes."""
    with zipfile.ZipFile(path) as archive:
        call = jax.jit(export.deserialize(bytearray(archive.read(PROGRAM))).call)

    def step(observation: np.ndarray, carry: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        action, following = call(observation, carry)
        return np.asarray(action), np.asarray(following)

    return step
