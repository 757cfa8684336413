"""docs/deploy.md is enough to play a policy: its code is run as it stands, and its table names every array."""

import re
from pathlib import Path

import numpy as np
import pytest

from hasrl_jax.config.convert import from_dict
from hasrl_jax.config.files import shipped
from hasrl_jax.deploy import export, metadata
from hasrl_jax.envs.cpu_engine import CpuEnvs
from hasrl_jax.envs.registry import make_task
from hasrl_jax.policy import actor, loading

TEXT = (Path(__file__).parents[2] / "docs" / "deploy.md").read_text(encoding="utf-8")


def code_of_the_document():
    names = {}
    for block in re.findall(r"```python\n(.*?)```", TEXT, flags=re.DOTALL):
        exec(block, names)
    return names


@pytest.mark.parametrize(
    ("task_name", "symmetric", "memory"),
    [("cassie", True, "lstm"), ("cassie", False, "lstm"), ("cartpole", True, "lstm"), ("cassie", True, "none")],
)
def test_its_numpy_plays_an_exported_file_as_the_policy_does(
    make_config, make_parameters, tmp_path, task_name, symmetric, memory
):
    config = make_config(task_name, symmetric, memory)
    task, parameters = make_task(config), make_parameters(config)
    export.write(tmp_path / "policy.npz", "npz", config, parameters, "", steps=2)
    document = code_of_the_document()
    arrays, about = document["load"](tmp_path / "policy.npz")
    carry = np.zeros(about["network"]["carry_shape"])
    rng, policy = np.random.default_rng(4), actor.reset(config, task, parameters, 1)
    for _ in range(30):
        observation = 3 * rng.standard_normal(task.observation_size)
        expected, policy = actor.act(policy, observation[None], np.zeros(1, bool))
        action, carry = document["act"](arrays, observation, carry)
        np.testing.assert_allclose(action, expected[0], atol=1e-5)


@pytest.mark.parametrize("frame", ["world", "heading"])
def test_its_reference_is_what_residual_actions_are_added_to(frame):
    changes = {"command": {"frame": frame, "height_m": [0.8, 0.95]}, "randomize": {"enabled": False}}
    config = from_dict({"cassie": changes}, shipped("cassie_imitate"))
    about, task = metadata.describe(config, ""), make_task(config)
    assert about["control"] is None
    constants, reference = about["constants"]["reference"], code_of_the_document()["reference"]
    fresh = task.reset(np.random.default_rng(0).random((20, task.reset_uniforms)), np)
    action = np.random.default_rng(1).uniform(-2, 2, (20, 10))
    targets = task.control(fresh.state, action, np)
    for robot, (command, phase) in enumerate(zip(fresh.state.command, fresh.state.phase, strict=True)):
        standing = bool(fresh.state.standing[robot])
        height = command[3] if frame == "heading" else constants["height_m_where_not_commanded"]
        after = phase if standing else (phase + 0.025 / about["constants"]["clock"]["cycle_s"]) % 1
        motors = reference(constants, command[0], command[1], height, after, standing)
        np.testing.assert_allclose(targets[robot], np.clip(action[robot], -1, 1) + motors, atol=2e-5)


@pytest.mark.parametrize("policy", ["released", "released-fast"])
def test_its_numpy_walks(tmp_path, policy):
    config, parameters = loading.load_policy_parameters(None, policy)
    command = {"forward_m_s": [1.0, 1.0], "lateral_m_s": [0.0, 0.0], "stand_probability": 0.0}
    config = from_dict({"cassie": {"command": command, "randomize": {"enabled": False}}}, config)
    export.write(tmp_path / "policy.npz", "npz", config, parameters, "", steps=2)
    document = code_of_the_document()
    arrays, about = document["load"](tmp_path / "policy.npz")
    envs, rng = CpuEnvs(make_task(config), 1, 200), np.random.default_rng(0)
    state, carry = envs.reset(rng), np.zeros(about["network"]["carry_shape"])
    speeds = []
    for _ in range(160):
        action, carry = document["act"](arrays, state.observation[0], carry)
        state, result = envs.step(state, action[None], rng)
        assert not result.terminated[0]
        speeds.append(result.measures[0, 0])
    assert np.mean(speeds[80:]) == pytest.approx(1.0, abs=0.15)


def test_it_names_every_array_and_every_key(tmp_path):
    config, parameters = loading.load_policy_parameters(None, "released-steer")
    export.write(tmp_path / "policy.npz", "npz", config, parameters, "", steps=2)
    with np.load(tmp_path / "policy.npz") as file:
        names = set(file)
    spelled_out = TEXT.replace("{0,1,2}", "0") + TEXT.replace("{0,1,2}", "1") + TEXT.replace("{0,1,2}", "2")
    assert {name for name in names if f"`{name}`" not in spelled_out} == set()
    about = metadata.describe(config, "")
    keys = {*about, *about["network"], *about["actuators"][0], *about["commands"][0], *about["observation"][0]}
    keys |= {*about["constants"]["clock"], *about["constants"]["heading"]}
    assert {key for key in keys if key not in TEXT} == set()
    entries = {entry["name"] for entry in about["observation"] if not entry["name"].endswith("_command")}
    assert {name for name in entries if f"`{name}`" not in TEXT} == set()
