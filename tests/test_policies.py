"""The released policy loads from a fresh install and walks."""

from pathlib import Path

import numpy as np
import pytest

from hasrl_jax import evaluate, export, policies, train
from hasrl_jax.config import ConfigError, from_dict
from hasrl_jax.envs.registry import make_task


def test_the_released_policy_walks_at_the_commanded_speed() -> None:
    config, parameters = policies.load_policy_parameters(None, Path("released"))
    assert policies.RELEASED.stat().st_size < 5e6
    assert config.run_dir == ""
    command = {"forward_m_s": [1.0, 1.0], "lateral_m_s": [0.0, 0.0], "stand_probability": 0.0, "start_moving": 0.0}
    changes = {"cassie": {"command": command, "randomize": {"enabled": False}}, "collect": {"max_episode_steps": 240}}
    config = from_dict(changes, config)
    task = make_task(config)
    episodes = evaluate.run_episodes(config, task, parameters, episodes=2, seed=0)
    assert episodes.reached_cap.all()
    forward = episodes.measures[120:, :, task.measures.index("forward_speed")]
    np.testing.assert_allclose(forward.mean(axis=0), 1.0, atol=0.15)


def test_a_run_exports_the_policy_that_it_evaluates(tmp_path: Path) -> None:
    run, out = tmp_path / "run", tmp_path / "policy.npz"
    small = ["--collect.envs-per-worker", "2", "--collect.env-steps-per-iteration", "256", "--num-workers", "1"]
    config = Path(__file__).parents[1] / "configs" / "cartpole.yaml"
    arguments = ["--config", str(config), "--run-dir", str(run), "--total-env-steps", "256", *small]
    assert train.main([*arguments, "--ppo.minibatch-trajectories", "8", "--evaluate.episodes", "2"]) == 0
    assert export.main(["--run-dir", str(run), "--out", str(out)]) == 0
    exported, from_run = policies.load_policy_parameters(None, out)[1], policies.load_policy_parameters(run, None)[1]
    assert exported.keys() == from_run.keys()
    for name, array in exported.items():
        np.testing.assert_array_equal(array, from_run[name])


def test_exactly_one_source_is_named() -> None:
    with pytest.raises(ConfigError, match="exactly one"):
        policies.load_policy_parameters(None, None)
