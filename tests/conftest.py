"""Runs every test on the CPU with eight simulated devices; must act before JAX is imported. Shared fixtures."""

import os
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

_DEVICES = "--xla_force_host_platform_device_count=8"

os.environ["JAX_PLATFORMS"] = "cpu"
os.environ.setdefault("NPROC", "1")  # with more threads on few cores, the matrix factorisations of MJX can hang
if _DEVICES not in os.environ.get("XLA_FLAGS", ""):
    os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {_DEVICES}".strip()

from hasrl_jax.config.convert import from_dict  # noqa: E402
from hasrl_jax.config.schema import Config  # noqa: E402
from hasrl_jax.envs.registry import make_task  # noqa: E402
from hasrl_jax.policy.numpy_networks import parameter_shapes  # noqa: E402


@pytest.fixture
def make_config() -> Callable[..., Config]:
    """`make_config(task, symmetric, memory, **collect)`: a few environments, short episodes, narrow networks."""

    def make(task: str = "cartpole", symmetric: bool = False, memory: str = "lstm", **collect: Any) -> Config:
        sizes = {
            "num_workers": 1,
            "envs_per_worker": 4,
            "unroll_length": 8,
            "env_steps_per_iteration": 96,
            "max_episode_steps": 10,
            "worker_timeout_s": 20.0,
        }
        network = {"memory": memory, "hidden_size": 16, "symmetric": symmetric, "initial_log_std": -0.5}
        return from_dict({"task": task, "network": network, "collect": sizes | collect})

    return make


@pytest.fixture
def make_parameters() -> Callable[[Config], dict[str, np.ndarray]]:
    """Random parameters of a configuration, far enough from zero that a mistake anywhere shows."""

    def make(config: Config) -> dict[str, np.ndarray]:
        task = make_task(config)
        rng = np.random.default_rng(2)
        parameters = {}
        shapes = parameter_shapes(task.observation_size, task.action_size, config.network)
        for name, shape in shapes.items():
            spread = 0.3 if len(shape) == 1 else 1 / np.sqrt(shape[0])
            parameters[name] = spread * rng.standard_normal(shape, np.float32)
        parameters["normalizer/std"] = 0.5 + np.abs(parameters["normalizer/std"])
        return {name: array.astype(np.float32) for name, array in parameters.items()}

    return make
