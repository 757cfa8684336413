"""Films: the files, the caption, and what is said where nothing can render."""

import functools
import os
import subprocess
import sys
from pathlib import Path

import imageio_ffmpeg
import jax
import numpy as np
import pytest
from PIL import Image

from hasrl_jax.cli import render as cli_render
from hasrl_jax.config.convert import from_dict
from hasrl_jax.envs.gymnasium import TaskEnv
from hasrl_jax.envs.registry import make_task
from hasrl_jax.errors import CheckpointError, ConfigError
from hasrl_jax.learn import ppo
from hasrl_jax.policy import loading as policies
from hasrl_jax.runs import checkpoint
from hasrl_jax.runs.directory import open_run
from hasrl_jax.visualize import opengl, render

CONFIG = from_dict({"network": {"hidden_size": 8, "symmetric": True}})


@functools.cache
def _backend() -> str | None:
    return opengl.choose()


@pytest.fixture(scope="module")
def policy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A policy file with random parameters."""
    task = make_task(CONFIG)
    learner = ppo.init_learner(CONFIG, task.observation_size, task.action_size, task.mirror, jax.random.key(0))
    path = tmp_path_factory.mktemp("policy") / "random.npz"
    checkpoint.save_policy(path, ppo.export_parameters(learner), policies.policy_metadata(CONFIG))
    return path


def _moment(**changes: object) -> render.Moment:
    measures = {"forward_speed": 0.5, "forward_command": 1.0, "lateral_speed": 0.0, "lateral_command": -0.1}
    return render.Moment(np.zeros((48, 64, 3), np.uint8), 1.25, measures, 0, False)._replace(**changes)


def test_writes_a_film_and_a_strip(policy: Path, tmp_path: Path) -> None:
    if _backend() is None:
        pytest.skip(opengl.MISSING)
    out = tmp_path / "random.mp4"
    arguments = ["--out", str(out), "--seconds", "0.25", "--width", "160", "--height", "120", "--forward", "0.5"]
    command = [sys.executable, "-m", "hasrl_jax.render", "--policy", str(policy), "--push", "100", "--push-at", "0"]
    done = subprocess.run([*command, *arguments], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    ffmpeg = imageio_ffmpeg.get_ffmpeg_exe()
    decode = [ffmpeg, "-i", str(out), "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    decoded = subprocess.run(decode, capture_output=True, check=True, timeout=60)
    assert b"40 fps" in decoded.stderr
    images = np.frombuffer(decoded.stdout, np.uint8).reshape(-1, 120, 160, 3)
    assert len(images) == 10
    assert images.std(axis=(1, 2, 3)).min() > 10  # a scene, not one colour
    strip = np.asarray(Image.open(out.with_suffix(".png")))
    assert strip.shape == (render.STRIP_HEIGHT_PX, render.STRIP_FRAMES * render.STRIP_HEIGHT_PX, 3)


def test_speeds_follow_each_other(policy: Path) -> None:
    config, parameters = policies.load_policy_parameters(None, policy)
    env = TaskEnv(from_dict({"cassie": {"command": {"resample_s": [0.1, 0.1]}}}, config), "rgb_array")
    env.render = lambda: np.zeros((2, 2, 3), np.uint8)
    frames, told = 12, [{"forward": speed, "lateral": 0.1} for speed in (0.5, 0.0, 1.5)]
    moments = list(render.play(env, parameters, frames, 0, render.Push(0.0, 0.0), told))
    commands = [(m.measures["forward_command"], m.measures["lateral_command"]) for m in moments[1:]]
    assert commands == [(speed, 0.1) for speed in [*[0.5] * 4, *[0.0] * 4, *[1.5] * 3]]


def test_rgb_array_follows_the_robot() -> None:
    if _backend() is None:
        pytest.skip(opengl.MISSING)
    code = """if True:
        import gymnasium, hasrl_jax, numpy as np
        from gymnasium.utils.env_checker import check_env
        env = gymnasium.make("hasrl_jax/Cassie-v0", render_mode="rgb_array", width=96, height=64)
        check_env(env.unwrapped)
        env.reset(seed=0)
        first = env.render()
        for _ in range(10):
            env.step(env.action_space.sample())
        assert first.shape == (64, 96, 3) and first.dtype == np.uint8
        assert (first != env.render()).mean() > 0.02
        env.close()
        env.close()
    """
    command = [sys.executable, "-c", code]
    environment = os.environ | {"MUJOCO_GL": _backend() or ""}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr


def test_without_opengl_one_line_says_what_to_install(
    policy: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(opengl, "works", lambda backend: False)
    assert cli_render.main(["--policy", str(policy), "--out", str(tmp_path / "film.mp4")]) == 1
    message = capsys.readouterr().err
    assert message.count("\n") == 1
    assert "libegl1" in message
    assert "libosmesa6" in message
    assert not list(tmp_path.iterdir())


def test_candidates_respect_the_setting(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("platform.system", lambda: "Linux")
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    assert opengl.candidates()[:2] == ["egl", "osmesa"]
    monkeypatch.setenv("MUJOCO_GL", "osmesa")
    assert opengl.candidates()[:2] == ["osmesa", "egl"]


def test_caption() -> None:
    commands = make_task(CONFIG).commands
    speeds = "forward +0.50 of +1.00 m/s    lateral +0.00 of -0.10 m/s"
    assert render.caption(_moment(), commands) == f" 1.25 s    {speeds}"
    assert render.caption(_moment(falls=2, pushed=True), commands).endswith("falls 2    PUSH")
    assert render.caption(_moment(measures={"angle": 0.1}), ()) == " 1.25 s    angle +0.10"
    text = render.caption(_moment(falls=12, pushed=True), commands)
    drawn = render.draw_text(np.zeros((480, 640, 3), np.uint8), text)
    assert drawn[:40].max() == 255
    assert drawn[40:].max() == 0
    assert drawn[:, -8:].max() == 0  # the text fits


@pytest.mark.parametrize(
    ("arguments", "field"),
    [
        (["--width", "63"], "--width"),
        (["--height", "99"], "--height"),
        (["--seconds", "0"], "--seconds"),
        (["--seconds", "nan"], "--seconds"),
        (["--push", "inf"], "--push"),
        (["--seed", "-1"], "--seed"),
        (["--out", "film.gif"], "--out"),
        (["--speeds", "0", "nan"], "--speeds"),
        (["--speeds", "0", "11", "--policy", "released"], "forward"),
        (
            ["--speeds", "0", "2.5", "--policy", "released"],
            "^--forward: got 2.5; .* for -0.3 to 2 m/s.*--force",
        ),
        (["--command", "height=0.6", "--policy", "released-steer"], "^--height: got 0.6; .* trained for 0.65 to 1 m"),
        (["--command", "forward", "--policy", "released"], "--command"),
        (["--command", "jump=1", "--policy", "released"], "jump"),
        (["--yaw-rate", "1", "--policy", "released"], "yaw_rate"),
        (["--speeds", "1", "--forward", "1"], "--forward"),
        (["--run-dir", "run", "--policy", "released"], "--run-dir"),
    ],
)
def test_bad_arguments_name_the_field(arguments: list[str], field: str) -> None:
    known, rest = cli_render._parse(arguments)
    with pytest.raises(ConfigError, match=field):
        cli_render.render(known, rest)


def test_a_policy_of_another_task_is_not_pushed(tmp_path: Path) -> None:
    config = from_dict({"task": "cartpole", "physics": {"timestep_s": 0.005, "steps_per_env_step": 5}}, CONFIG)
    config = from_dict({"network": {"symmetric": False}}, config)
    task = make_task(config)
    learner = ppo.init_learner(config, task.observation_size, task.action_size, task.mirror, jax.random.key(0))
    path = tmp_path / "cartpole.npz"
    checkpoint.save_policy(path, ppo.export_parameters(learner), policies.policy_metadata(config))
    known, rest = cli_render._parse(["--policy", str(path), "--push", "9", "--out", str(tmp_path / "film.mp4")])
    with pytest.raises(ConfigError, match="--push: the robot of task cartpole cannot be pushed"):
        cli_render.render(known, rest)


@pytest.mark.parametrize("at_s", [0.1, 0.7])
def test_a_push_lasts_as_long_whenever_it_begins(policy: Path, at_s: float, monkeypatch: pytest.MonkeyPatch) -> None:
    env = TaskEnv(CONFIG)
    monkeypatch.setattr(env, "render", lambda: np.zeros((48, 64, 3), np.uint8))
    parameters = policies.load_policy_parameters(None, policy)[1]
    moments = list(render.play(env, parameters, 40, 0, render.Push(1.0, at_s)))
    assert sum(moment.pushed for moment in moments) == 8
    assert moments[round(at_s / env.task.env_step_s)].pushed


def test_a_policy_file_brings_its_configuration(policy: Path, tmp_path: Path) -> None:
    config, parameters = policies.load_policy_parameters(None, policy)
    assert config == CONFIG
    assert parameters["policy/lstm_0_recurrent"].shape == (8, 32)
    other = tmp_path / "other.npz"
    metadata = policies.policy_metadata(from_dict({"network": {"hidden_size": 16}}))
    checkpoint.save_policy(other, parameters, metadata)
    with pytest.raises(CheckpointError, match=r"other\.npz.*lstm_0_input"):
        policies.load_policy_parameters(None, other)
    checkpoint.save_policy(other, parameters, {})
    with pytest.raises(CheckpointError, match="configuration"):
        policies.load_policy_parameters(None, other)
    with pytest.raises(ConfigError, match="only one"):
        policies.load_policy_parameters(tmp_path, policy)


def test_a_run_gives_its_newest_checkpoint(tmp_path: Path) -> None:
    config = from_dict({"run_dir": str(tmp_path / "run")}, CONFIG)
    task = make_task(config)
    sizes = (task.observation_size, task.action_size, task.mirror)
    with open_run(config, resume=False) as run:
        for step in (1, 2):
            learner = ppo.init_learner(config, *sizes, jax.random.key(step))
            checkpoint.save(run.checkpoints, step, learner, {}, [], keep=2)
    loaded_config, parameters = policies.load_policy_parameters(config.run_dir, None)
    assert loaded_config == config
    for name, values in ppo.export_parameters(learner).items():
        np.testing.assert_array_equal(parameters[name], values, err_msg=name)
