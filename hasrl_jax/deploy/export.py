"""Writes a policy to a file of one of three formats, and proves that the file acts as the policy does."""

from collections.abc import Callable
from pathlib import Path

from hasrl_jax.config.convert import to_dict
from hasrl_jax.config.schema import Config
from hasrl_jax.deploy import npz_format, onnx_format, stablehlo_format, verify
from hasrl_jax.deploy.files import Step
from hasrl_jax.deploy.metadata import describe
from hasrl_jax.envs.registry import make_task
from hasrl_jax.errors import CheckpointError
from hasrl_jax.policy.numpy_networks import Parameters
from hasrl_jax.runs import durable

SUFFIXES = {"npz": ".npz", "onnx": ".onnx", "jax": ".zip"}  # of each format


def write(
    path: Path, form: str, config: Config, parameters: Parameters, training_sha256: str, steps: int = verify.STEPS
) -> verify.Comparison:
    """Writes the file and plays it beside the policy; a file that differs does not stay.

    Args:
      path: replaced when it exists.
      form: one of SUFFIXES.
      config: what the policy was trained with.
      parameters: as `learn.ppo.export_parameters` returns them.
      training_sha256: as `metadata.training_digest` returns it.
      steps: environment steps to compare over.

    Raises:
      CheckpointError: the file cannot be written, or acts differently; ConfigError: a package is missing.
    """
    task = make_task(config)
    mirror = task.mirror if config.network.symmetric else None
    metadata = describe(config, training_sha256) | {"config": to_dict(config)}
    partial = path.with_name(f".unproved-{path.name}")
    load: Callable[[Path], Step]
    try:
        if form == "onnx":
            onnx_format.write(partial, parameters, mirror, metadata)
            load = onnx_format.load
        elif form == "jax":
            stablehlo_format.write(partial, config.network, parameters, mirror, metadata)
            load = stablehlo_format.load
        else:
            npz_format.write(partial, parameters, mirror, metadata)
            load = npz_format.load
        found = verify.compare(config, task, parameters, load(partial), steps)
        if not found.difference <= verify.TOLERANCE:
            raise CheckpointError(
                f"{path}: not written: its actions differ from the policy's by {found.difference:.1e}; "
                f"expected at most {verify.TOLERANCE:g}"
            )
        durable.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)
    return found
