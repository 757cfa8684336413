"""The environments under the frameworks that people use them with: a few hundred steps each."""

import os
import subprocess
import sys
from pathlib import Path

import gymnasium
import numpy as np
import pytest

import hasrl_jax  # noqa: F401 (importing it registers the environments)
from hasrl_jax.config.convert import from_dict
from hasrl_jax.visualize import opengl

POLE = "hasrl_jax/CartpoleHiddenVelocity-v0"
SHORT = from_dict({"task": "cartpole", "collect": {"max_episode_steps": 50}})


@pytest.mark.parametrize("algorithm", ["PPO", "RecurrentPPO"])
def test_stable_baselines_trains_on_it(algorithm: str) -> None:
    package = pytest.importorskip("stable_baselines3" if algorithm == "PPO" else "sb3_contrib")
    from stable_baselines3.common.env_checker import check_env
    from stable_baselines3.common.env_util import make_vec_env

    check_env(gymnasium.make(POLE, config=SHORT), skip_render_check=True)
    envs = make_vec_env(POLE, 2, seed=0, env_kwargs={"config": SHORT})
    policy = "MlpPolicy" if algorithm == "PPO" else "MlpLstmPolicy"
    model = getattr(package, algorithm)(policy, envs, n_steps=64, batch_size=64, n_epochs=2, seed=0, device="cpu")
    before = [parameter.detach().clone() for parameter in model.policy.parameters()]
    model.learn(256)
    assert model.num_timesteps == 256
    assert len(model.ep_info_buffer) > 4 and all(0 <= info["l"] - info["r"] <= 1 for info in model.ep_info_buffer)
    changed = [not np.array_equal(b, a.detach()) for b, a in zip(before, model.policy.parameters(), strict=True)]
    assert any(changed)
    envs.close()


def test_a_loop_as_in_cleanrl_sees_every_transition_once() -> None:
    """Same-step autoreset: what follows the last step of an episode is its own last observation, not the next one's."""
    envs = gymnasium.make_vec(POLE, num_envs=4, config=SHORT, autoreset_mode="SameStep")
    envs = gymnasium.wrappers.vector.RecordEpisodeStatistics(envs)
    rng = np.random.default_rng(0)
    observation, _ = envs.reset(seed=0)
    returns, ends, total = [], 0, np.zeros(4)
    for _ in range(100):
        following, reward, terminated, truncated, info = envs.step(rng.uniform(-1, 1, (4, 1)).astype(np.float32))
        real = following.copy()
        for env in np.flatnonzero(terminated | truncated):
            real[env] = info["final_obs"][env]
        moved = np.abs(real - observation)
        assert (moved < 2.0).all()  # nobody jumps from one episode into another
        total += reward
        ended = terminated | truncated
        assert (terminated <= (np.abs(real[:, 1]) > 2.0) | (np.abs(real[:, 0]) > 1.0)).all()  # where the fall led
        returns += total[ended].tolist()
        ends += ended.sum()
        if "final_info" in info and "episode" in info["final_info"]:
            np.testing.assert_allclose(info["final_info"]["episode"]["r"][ended], total[ended])
        elif "episode" in info:
            np.testing.assert_allclose(info["episode"]["r"][ended], total[ended])
        total[ended] = 0
        observation = following
    assert ends > 10 and len(returns) == ends


FILM = """
import sys, gymnasium, numpy as np, hasrl_jax
from gymnasium.wrappers import RecordVideo
from gymnasium.wrappers.vector import RecordVideo as RecordVideos

size = {"render_mode": "rgb_array", "width": 64, "height": 48}
env = RecordVideo(gymnasium.make(sys.argv[1], **size), sys.argv[2], episode_trigger=lambda episode: True)
env.reset(seed=0)
ended = False
while not ended:
    *_, terminated, truncated, _ = env.step(np.ones(1, np.float32))
    ended = terminated or truncated
env.close()
envs = gymnasium.make_vec(sys.argv[1], num_envs=2, **size)
envs.reset(seed=0)
first = envs.render()
for _ in range(5):
    envs.step(np.array([[1.0], [-1.0]], np.float32))
left, right = envs.render()
assert left.shape == (48, 64, 3) and not np.array_equal(left, right) and not np.array_equal(first[0], left)
envs.close()
"""


def test_record_video_films_an_episode(tmp_path: Path) -> None:
    pytest.importorskip("moviepy")
    backend = opengl.choose()
    if backend is None:
        pytest.skip("no OpenGL here")
    command = [sys.executable, "-W", "ignore", "-c", FILM, POLE, str(tmp_path)]
    subprocess.run(command, env=os.environ | {"MUJOCO_GL": backend}, check=True, timeout=120)
    (film,) = tmp_path.glob("*.mp4")
    import imageio_ffmpeg

    frames, seconds = imageio_ffmpeg.count_frames_and_secs(str(film))
    assert frames > 5 and seconds == pytest.approx(frames / 40, abs=0.05)
