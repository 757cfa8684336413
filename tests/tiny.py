"""The settings of a run that takes seconds, for every test that starts one."""

from typing import Any

import yaml

_SETTINGS: dict[str, Any] = {
    "task": "cartpole",
    "physics": {"timestep_s": 0.005, "steps_per_env_step": 5, "integrator": "Euler"},
    "network": {"hidden_size": 8, "initial_log_std": -1.0},
    "collect": {
        "num_workers": 2,
        "envs_per_worker": 2,
        "env_steps_per_iteration": 128,
        "unroll_length": 16,
        "max_episode_steps": 40,
    },
    "ppo": {"epochs": 1, "minibatch_trajectories": 8},
    "evaluate": {"every_iterations": 2, "episodes": 2},
    "checkpoint": {"every_iterations": 2},
    "total_env_steps": 512,
}


def tiny(**changes: Any) -> dict[str, Any]:
    """The settings, with those of `changes` in place of theirs, group by group."""
    settings = {name: dict(value) if isinstance(value, dict) else value for name, value in _SETTINGS.items()}
    for name, value in changes.items():
        settings[name] = settings.get(name, {}) | value if isinstance(value, dict) else value
    return settings


def tiny_yaml(**changes: Any) -> str:
    """The same as the text of a file."""
    return yaml.safe_dump(tiny(**changes))
