"""One of two processes that share a learner; started by test_distributed.py, which also imports its batch."""

import dataclasses
import sys

import jax
import numpy as np

from hasrl_jax.cli.train import main as train_main
from hasrl_jax.config.schema import Config, DistributedConfig, NetworkConfig, PPOConfig
from hasrl_jax.learn import ppo
from hasrl_jax.train import distributed
from hasrl_jax.train import loop as train
from hasrl_jax.types import Trajectory

OBSERVATION, ACTION, H, B, T = 5, 2, 8, 16, 6
CONFIG = Config(network=NetworkConfig(hidden_size=H), ppo=PPOConfig(epochs=1, minibatch_trajectories=8))


def batch() -> Trajectory:
    """Trajectories of several lengths, the same in every process."""
    rng = np.random.default_rng(0)
    length = 1 + np.arange(B)[:, None] % T
    mask, last = np.arange(T) < length, np.arange(T) == length - 1

    def normal(*shape: int) -> np.ndarray:
        return rng.standard_normal(shape, np.float32) * mask.reshape(B, T, *(1,) * (len(shape) - 2))

    return Trajectory(
        observation=normal(B, T, OBSERVATION),
        action=normal(B, T, ACTION),
        log_prob=normal(B, T) - 2,
        value=normal(B, T),
        reward=normal(B, T),
        is_first=np.arange(T) == np.zeros((B, 1)),
        terminated=last,
        truncated=np.zeros_like(last),
        bootstrap_value=np.zeros((B, T), np.float32),
        mask=mask,
        initial_carry=np.zeros((B, 2, 2, H), np.float32),
        policy_version=np.zeros(B, np.int32),
    )


def updated(config: Config, trajectory: Trajectory, mesh: jax.sharding.Mesh) -> dict[str, np.ndarray]:
    """The learner after two updates, by name."""
    state = ppo.init_learner(config, OBSERVATION, ACTION, None, jax.random.key(0))
    update = ppo.make_update(config, OBSERVATION, ACTION, None, mesh)
    for _ in range(2):
        state, _ = update(state, trajectory)
    return leaves(state)


def leaves(state: ppo.LearnerState) -> dict[str, np.ndarray]:
    paths = jax.tree_util.tree_flatten_with_path(jax.device_get(state))[0]
    return {jax.tree_util.keystr(path): np.asarray(leaf) for path, leaf in paths}


def update_half(process_id: str, coordinator: str, out: str) -> int:
    """Both halves of the batch make one update."""
    settings = DistributedConfig(coordinator=coordinator, num_processes=2, process_id=int(process_id))
    config = dataclasses.replace(CONFIG, distributed=settings)
    distributed.join(config)
    mesh = ppo.make_mesh()
    own = slice(B // 2 * settings.process_id, B // 2 * (settings.process_id + 1))
    half = Trajectory(*(array[own] for array in batch()))
    np.savez(out, **updated(config, distributed.to_global(half, B // 2, mesh), mesh))
    return 0


def run_command(out: str, *arguments: str) -> int:
    """The training command, which also leaves the learner of its last checkpoint in a file of this process."""
    save = train.save

    def save_here_too(config, directory, state) -> None:
        save(config, directory, state)
        np.savez(out, **leaves(state.learner))

    train.save = save_here_too
    return train_main(list(arguments))


if __name__ == "__main__":
    sys.exit({"update": update_half, "command": run_command}[sys.argv[1]](*sys.argv[2:]))
