"""What the formats share: a file is written whole or not at all, and an absent package is said on one line."""

import contextlib
import importlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from hasrl_jax.errors import CheckpointError, ConfigError
from hasrl_jax.runs import durable

# (observation [E, O] float32, carry [E, L, 2, W] float32) -> (action [E, A], next carry)
Step = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]


def require_package(name: str) -> Any:
    """The package `name` of the extra `deploy`.

    Raises:
      ConfigError: it is not installed.
    """
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise ConfigError(
            f'--format onnx: {name} cannot be imported ({error}); pip install "hasrl_jax[deploy]"'
        ) from None


def write_whole(path: Path, content: bytes) -> None:
    """Writes a file beside its place and renames it when it is complete.

    Raises:
      CheckpointError: it cannot be written; a file that was there before is untouched.
    """
    partial = path.with_name(f"{path.name}.{os.getpid()}.partial")
    try:
        partial.write_bytes(content)
        durable.replace(partial, path)
    except OSError as error:
        with contextlib.suppress(OSError):
            partial.unlink(missing_ok=True)
        raise CheckpointError(f"{path}: cannot be written ({error.strerror})") from error
