"""Tasks of other packages: found by entry point or by place, with settings and a recipe, and nothing of ours edited."""

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from hasrl_jax.cli.train import main as train_main
from hasrl_jax.config import tasks
from hasrl_jax.config.convert import from_dict, to_dict
from hasrl_jax.config.tasks import find
from hasrl_jax.errors import ConfigError

# A mass on a rail that is to stand where the settings say.
MODULE = """
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np

from hasrl_jax.config.limits import Limits
from hasrl_jax.config.tasks import TaskSpec
from hasrl_jax.envs.layout import SAME, Entry
from hasrl_jax.envs.model import load_model
from hasrl_jax.envs.task import Reset, Task, Transition

HERE = Path(__file__).parent


@dataclass(frozen=True)
class Settings:
    goal_m: Annotated[float, Limits(-1, 1)] = 0.5  # where to stand, m


class State(NamedTuple):
    zero: object


def make(config):
    def step(state, action, reading, uniforms, xp):
        reward = xp.exp(-xp.abs(reading.qpos[..., 0] - config.settings.goal_m))
        fell = xp.abs(reading.qpos[..., 0]) > 2.0
        return Transition(state, reading.qpos, reward, fell, reward[..., None], reading.qpos)

    def reset(uniforms, xp):
        qpos = uniforms - 0.5
        return Reset(State(xp.zeros(uniforms.shape[:-1])), qpos, qpos, xp.zeros_like(qpos), {})

    return Task(
        name="slider",
        asset=HERE / "slider.xml",
        model=load_model(HERE / "slider.xml", config.physics),
        steps_per_env_step=config.physics.steps_per_env_step,
        observation=(Entry("position", "m", SAME),),
        action=(Entry("push", "", SAME),),
        reset_uniforms=1,
        reward_terms=("near",),
        measures=("position",),
        reset=reset,
        control=lambda state, action, xp: xp.clip(action, -1.0, 1.0),
        step=step,
    )


SPEC = TaskSpec(name="slider", make=make, recipe=HERE / "slider.yaml", settings=Settings)
"""
MODEL = """
<mujoco><worldbody><body><joint name="x" type="slide" axis="1 0 0" damping="1"/><geom size="0.1" mass="1"/></body>
</worldbody><actuator><motor joint="x" gear="5"/></actuator></mujoco>
"""
RECIPE = """
slider: {goal_m: 0.25}
network: {hidden_size: 8}
collect: {num_workers: 1, envs_per_worker: 4, env_steps_per_iteration: 128, unroll_length: 16, max_episode_steps: 32}
ppo: {epochs: 1, minibatch_trajectories: 8}
evaluate: {every_iterations: 1, episodes: 2}
total_env_steps: 256
"""
ENTRY_POINT = "[hasrl_jax.tasks]\nslider = my_robot.slider:SPEC\n"


@pytest.fixture(scope="module")
def elsewhere(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A folder with the installed package `my_robot`, which offers the task `slider`."""
    folder = tmp_path_factory.mktemp("elsewhere")
    package, info = folder / "my_robot", folder / "my_robot-0.1.dist-info"
    package.mkdir()
    info.mkdir()
    (package / "__init__.py").touch()
    (package / "slider.py").write_text(MODULE)
    (package / "slider.xml").write_text(MODEL)
    (package / "slider.yaml").write_text(RECIPE)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: my-robot\nVersion: 0.1\n")
    (info / "entry_points.txt").write_text(ENTRY_POINT)
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(folder))
        tasks._places.cache_clear()
        yield folder
    tasks._places.cache_clear()


@pytest.mark.parametrize("name", ["slider", "my_robot.slider:SPEC"])
def test_its_settings_are_a_group_under_its_name(elsewhere: Path, name: str) -> None:
    config = from_dict({"task": name, "slider": {"goal_m": -0.5}})
    assert config.settings.goal_m == -0.5
    assert from_dict(to_dict(config)) == config
    with pytest.raises(ConfigError, match=r"config.slider.goal: unknown field; known fields are goal_m"):
        from_dict({"task": name, "slider": {"goal": 1}})
    with pytest.raises(ConfigError, match=r"config.cassie: unknown field"):
        from_dict({"task": name, "cassie": {}})


def test_changing_the_task_keeps_what_both_have(elsewhere: Path) -> None:
    walking = from_dict({"seed": 7, "cassie": {"reward": {"scale": 3.0}}})
    slider = from_dict({"task": "slider"}, walking)
    assert slider.seed == 7 and slider.settings.goal_m == 0.5 and not hasattr(slider, "cassie")


def test_the_programs_train_and_evaluate_it_by_its_recipe(elsewhere: Path) -> None:
    environment = os.environ | {"PYTHONPATH": str(elsewhere)}

    def run(*arguments: str) -> str:
        command = [sys.executable, "-m", *arguments]
        done = subprocess.run(command, env=environment, cwd=elsewhere, capture_output=True, text=True, timeout=120)
        assert done.returncode == 0, done.stderr
        return done.stdout

    run("hasrl_jax.train", "--task", "slider", "--run-dir", "run", "--slider.goal-m", "0.3")
    assert "goal_m: 0.3" in (elsewhere / "run" / "config.yaml").read_text()
    records = [json.loads(line) for line in (elsewhere / "run" / "metrics.jsonl").read_text().splitlines()]
    assert records[-1]["env_steps"] == 256 and records[-1]["reward/near"] > 0
    assert "episode_return" in run("hasrl_jax.evaluate", "--run-dir", "run", "--episodes", "2", "--seconds", "0.5")


def test_a_symmetric_network_for_a_task_without_a_mirror_is_one_line(
    elsewhere: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run"
    assert train_main(["--task", "slider", "--network.symmetric", "True", "--run-dir", str(run)]) == 2
    expected = "error: network.symmetric: got True; expected False with task slider, which defines no mirror\n"
    assert capsys.readouterr().err.endswith(expected)
    assert not run.exists()


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("hopper", r"^task: got 'hopper'; expected cassie, cartpole.*, or MODULE:NAME of a TaskSpec$"),
        ("no_such_module:SPEC", r"^task: got 'no_such_module:SPEC', which cannot be loaded .*No module named"),
        ("json:SPEC", r"^task: got 'json:SPEC', which cannot be loaded .*has no attribute 'SPEC'"),
        ("json:loads", r"^task: got 'json:loads'; json:loads is no TaskSpec but <function"),
        (":", r"^task: got ':', which cannot be loaded"),
    ],
)
def test_what_cannot_be_found_is_refused_on_one_line(name: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        find(name)
