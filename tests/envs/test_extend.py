"""Tasks made from others: terms and commands of one's own, with nothing edited."""

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

from hasrl_jax.config.convert import from_dict
from hasrl_jax.config.files import recipe
from hasrl_jax.config.schema import Config
from hasrl_jax.envs.cpu_engine import CpuEnvs
from hasrl_jax.envs.gymnasium import make
from hasrl_jax.envs.registry import make_task
from hasrl_jax.policy import loading
from hasrl_jax.runs import checkpoint
from hasrl_jax.runs.directory import load_run_config, write_config

MODULE = """
from dataclasses import dataclass
from typing import Annotated

from hasrl_jax.config.limits import Limits, Range
from hasrl_jax.envs.cassie.settings import CassieConfig
from hasrl_jax.envs.cassie.spec import SPEC as CASSIE
from hasrl_jax.envs.extend import AddedCommand, extended
from hasrl_jax.envs.layout import NEGATED


@dataclass(frozen=True)
class Settings(CassieConfig):
    calm: Annotated[float, Limits(-10, 10)] = 0.25
    lean: Annotated[Range, Limits(-1, 1)] = (-0.2, 0.3)


def calm(step, xp):
    return xp.exp(-xp.abs(step.reading.qvel[..., 3])) + step.command["lean"]


def roll(step, xp):
    return step.reading.qpos[..., 4]


SPEC = extended(
    CASSIE, Settings, terms={"calm": calm}, commands=[AddedCommand("lean", "rad", roll, 0.1, (-0.5, 0.5), NEGATED)]
)
"""
NAME = "tilting_cassie:SPEC"


@pytest.fixture(scope="module", autouse=True)
def module(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    folder = tmp_path_factory.mktemp("extension")
    (folder / "tilting_cassie.py").write_text(MODULE)
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(folder))
        yield
        sys.modules.pop("tilting_cassie", None)


def config(**cassie: Any) -> Config:
    calm = {"randomize": {"enabled": False}} | cassie
    return from_dict({"cassie": calm}, recipe(NAME))


def test_a_term_is_weighted_and_added_and_a_command_seen_told_and_measured() -> None:
    plain = from_dict({"cassie": {"randomize": {"enabled": False}}}, recipe("cassie"))
    ours, theirs = make(NAME, config()), make("cassie", plain)
    ours.reset(seed=0, options={"command": {"forward": 0.5, "lean": 0.3}})
    theirs.reset(seed=0, options={"command": {"forward": 0.5}})
    assert ours.task.reward_terms == (*theirs.task.reward_terms, "calm")
    assert [command.name for command in ours.task.commands] == ["forward", "lateral", "lean"]
    for action in np.random.default_rng(0).uniform(-0.2, 0.2, (5, 10)):
        a, b = ours.step(action), theirs.step(action)
        np.testing.assert_array_equal(ours.qpos, theirs.qpos)
        qpos, qvel = np.split(ours._state.physics[1:], [35])
        term = 0.25 * (np.exp(-abs(qvel[3])) + 0.3)
        assert a[4]["reward/calm"] == pytest.approx(term)
        assert a[1] == pytest.approx(b[1] + term)
        assert a[4]["lean_command"] == 0.3 and a[4]["lean_measured"] == qpos[4]
        assert a[0][-1] == np.float32(0.3)
        np.testing.assert_array_equal(a[0][:-1], b[0])
    assert ours.set_command(forward=0.2)[-1] == np.float32(0.1)  # what is not told takes its default


def test_episodes_draw_it_from_their_settings_and_a_mirror_negates_it() -> None:
    task = make_task(config(lean=[-0.1, 0.4]))
    state = CpuEnvs(task, 200, 100).reset(np.random.default_rng(0))
    drawn = state.observation[:, -1]
    assert -0.1 <= drawn.min() < -0.05 and 0.35 < drawn.max() < 0.4
    assert len(np.unique(drawn)) == 200
    assert task.mirror.observation(np.arange(51.0))[-1] == -50


def test_both_array_modules_agree() -> None:
    task = make_task(config())
    rng = np.random.default_rng(0)
    uniforms = rng.random((3, task.reset_uniforms))
    ours, theirs = task.reset(uniforms, np), task.reset(jnp.asarray(uniforms), jnp)
    np.testing.assert_allclose(theirs.observation, ours.observation, rtol=1e-5, atol=1e-6)
    envs = CpuEnvs(task, 3, 100)
    state = envs.reset(rng)
    action = rng.uniform(-0.1, 0.1, (3, 10))
    _, reading, _ = envs._simulate(state, task.control(state.task, action, np)[:, None])
    draws = rng.random((3, task.step_uniforms))
    a, b = task.step(state.task, action, reading, draws, np), task.step(state.task, action, reading, draws, jnp)
    for name in ("reward", "reward_terms", "measures", "observation"):
        np.testing.assert_allclose(getattr(b, name), getattr(a, name), rtol=2e-4, atol=2e-4)


def test_a_policy_of_the_task_without_the_command_goes_on_in_it() -> None:
    ours = loading.load_initial(config(), "released")
    _, theirs = loading.load_policy_parameters(None, "released")
    assert ours["policy/lstm_0_input"].shape[0] == theirs["policy/lstm_0_input"].shape[0] + 1
    np.testing.assert_array_equal(ours["policy/lstm_0_input"][-1], 0.0)


def test_a_run_and_a_policy_of_it_come_back_with_their_settings(tmp_path: Path) -> None:
    trained = config(calm=0.5, command={"frame": "heading"}, reward={"velocity": 0.9})
    assert trained.settings.command.frame == "heading"
    write_config(tmp_path, trained)
    assert load_run_config(tmp_path) == trained
    _, parameters = loading.load_baseline("random", trained)
    checkpoint.save_policy(tmp_path / "policy.npz", parameters, loading.policy_metadata(trained))
    assert loading.load_policy_parameters(None, tmp_path / "policy.npz")[0] == trained
