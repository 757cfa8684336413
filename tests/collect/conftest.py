"""Small configurations and parameters that the collector tests share."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from hasrl_jax import config as config_module
from hasrl_jax.collect.numpy_policy import parameter_shapes
from hasrl_jax.config import Config
from hasrl_jax.envs.registry import make_task


@pytest.fixture
def make_config() -> Callable[..., Config]:
    """`make_config(task, symmetric, **collect)`: a few environments, short episodes, narrow networks."""

    def make(task: str = "cartpole", symmetric: bool = False, **collect: Any) -> Config:
        sizes = {
            "num_workers": 1,
            "envs_per_worker": 4,
            "unroll_length": 8,
            "env_steps_per_iteration": 96,
            "max_episode_steps": 10,
            "worker_timeout_s": 20.0,
        }
        network = {"hidden_size": 16, "symmetric": symmetric, "initial_log_std": -0.5}
        return config_module.from_dict({"task": task, "network": network, "collect": sizes | collect})

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
