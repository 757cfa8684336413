"""What a file says of its policy is what the task does."""

import dataclasses

import mujoco
import numpy as np
import pytest

from hasrl_jax.config.convert import from_dict
from hasrl_jax.config.files import shipped
from hasrl_jax.deploy import metadata, model_file
from hasrl_jax.envs.model import load_model
from hasrl_jax.envs.registry import make_task
from hasrl_jax.errors import ConfigError
from hasrl_jax.policy import loading


@pytest.fixture(scope="module")
def of_released():
    """The descriptions of the two policies that walk on level ground."""
    policies = {name: loading.load_policy_parameters(None, name)[0] for name in ("released", "released-steer")}
    return {name: metadata.describe(config, "") for name, config in policies.items()}


def test_the_tables_give_every_number_a_place_and_a_name(of_released):
    for name, size in (("released", 50), ("released-steer", 52)):
        table = of_released[name]["observation"]
        assert [row["start"] for row in table] == [0, *np.cumsum([row["size"] for row in table])[:-1]]
        assert sum(row["size"] for row in table) == size
        for row in table:
            assert len(row["parts"]) == (row["size"] if row["size"] > 1 else 0), row
    rows = {row["name"]: row for row in of_released["released-steer"]["observation"]}
    assert (rows["motor_velocities"]["start"], rows["motor_velocities"]["unit"]) == (21, "rad/s")
    assert rows["motor_velocities"]["parts"][6] == "right-hip-yaw"
    assert rows["height_command"]["start"] == 51
    (action,) = of_released["released"]["action"]
    assert action["parts"][:5] == ["left-hip-roll", "left-hip-yaw", "left-hip-pitch", "left-knee", "left-foot"]


def test_gains_limits_rates_and_commands_are_those_of_the_paper_and_the_task(of_released):
    about = of_released["released"]
    gains = {row["joint"]: (row["gain"], -row["bias"][2], row["force_range"][1]) for row in about["actuators"]}
    assert gains["left-hip-roll"] == gains["right-hip-yaw"] == (100.0, 10.0, 112.5)
    assert gains["left-hip-pitch"] == (88.0, 8.0, 195.2)
    assert gains["right-knee"] == (96.0, 9.6, 195.2)
    assert gains["right-foot"] == (50.0, 5.0, 45.0)
    assert all(row["bias"][1] == -row["gain"] for row in about["actuators"])
    assert about["policy_rate_hz"] == pytest.approx(40.0)
    assert 1 / about["physics"]["reference"]["timestep_s"] == pytest.approx(2000.0)
    assert [command["name"] for command in about["commands"]] == ["forward", "lateral"]
    (push,) = metadata.describe(shipped("cartpole"), "")["actuators"]
    assert (push["joint"], push["gear"], push["control_range"]) == ("slider", 10.0, [-1.0, 1.0])
    assert push["force_range"] is None
    steer = of_released["released-steer"]
    assert {c["name"]: c["default"] for c in steer["commands"]}["height"] == 0.9
    assert steer["constants"]["command_frame"] == "heading"
    assert steer["constants"]["clock"]["stand_below_m_s"] == 0.5


@pytest.mark.parametrize("recipe", ["cassie_walk", "cassie_steer", "paper", "cartpole"])
def test_the_formula_of_the_control_is_what_the_task_applies(recipe):
    config = shipped(recipe)
    about, task = metadata.describe(config, "")["control"], make_task(config)
    still = {"cassie": {"randomize": {"enabled": False}}} if config.section else {}
    nominal = make_task(from_dict(still, config))
    state = nominal.reset(np.full(nominal.reset_uniforms, 0.3), np).state
    action = np.random.default_rng(0).uniform(-2, 2, task.action_size)
    expected = task.control(state, action, np)
    given = np.array(about["offset"]) + np.array(about["scale"]) * np.clip(action, *about["clip"])
    np.testing.assert_allclose(given, expected)
    assert np.abs(given).max() > 0.5


def test_motors_with_a_curve_are_told_with_their_gains():
    config = from_dict({"cassie": {"motor": {"torque_speed_curve": True}}}, shipped("cassie_walk"))
    rows = metadata.describe(config, "")["actuators"]
    plain = metadata.describe(shipped("cassie_walk"), "")["actuators"]
    assert rows[2]["no_load_speed"] == pytest.approx(1300 / 60 * 2 * np.pi / 16)
    assert rows[2]["stall_torque"] == pytest.approx(2 * 195.2)
    assert {row["no_load_speed"] for row in plain} == {row["stall_torque"] for row in plain} == {None}
    for with_curve, without in zip(rows, plain, strict=True):
        for name in ("gain", "bias", "force_range"):
            assert with_curve[name] == pytest.approx(without[name])


def test_a_task_whose_control_is_no_such_formula_has_none(monkeypatch):
    config = shipped("cartpole")
    squared = dataclasses.replace(make_task(config), control=lambda state, action, xp: action**2)
    monkeypatch.setattr(metadata, "make_task", lambda _: squared)
    assert metadata.describe(config, "")["control"] is None


def test_the_hash_tells_trainings_apart_but_not_their_folders():
    config, parameters = loading.load_policy_parameters(None, "released")
    digest = metadata.training_digest(config, parameters)
    assert len(digest) == 64
    assert metadata.training_digest(from_dict({"run_dir": "elsewhere"}, config), parameters) == digest
    assert metadata.training_digest(from_dict({"seed": config.seed + 1}, config), parameters) != digest
    changed = parameters | {"policy/mean_bias": parameters["policy/mean_bias"] + 1e-6}
    assert metadata.training_digest(config, changed) != digest


@pytest.mark.parametrize("recipe", ["cassie_walk", "cartpole"])
def test_the_model_beside_a_policy_is_the_one_it_is_played_on(recipe, tmp_path):
    config = loading.under_reference_physics(shipped(recipe))
    task, path = make_task(config), tmp_path / "model.xml"
    model_file.write(path, task, config.physics)
    theirs, ours = mujoco.MjModel.from_xml_path(str(path)), load_model(task.asset, config.physics, visual=True)
    size = mujoco.mj_sizeModel(ours)
    assert mujoco.mj_sizeModel(theirs) == size
    images = []
    for model in (theirs, ours):
        buffer = np.empty(size, np.uint8)
        mujoco.mj_saveModel(model, None, buffer)
        images.append(buffer.tobytes())
    assert images[0] == images[1]


def test_the_model_beside_a_policy_has_its_motors(tmp_path):
    config = from_dict({"cassie": {"motor": {"torque_speed_curve": True}}}, shipped("cassie_steer"))
    task, path = make_task(config), tmp_path / "model.xml"
    model_file.write(path, task, config.physics)
    written = mujoco.MjModel.from_xml_path(str(path))
    for field in ("gainprm", "dynprm", "biasprm", "gaintype", "dyntype", "biastype", "ctrlspec", "forcerange"):
        ours = getattr(task.model, f"actuator_{field}")
        np.testing.assert_allclose(getattr(written, f"actuator_{field}"), ours, err_msg=field)


def test_a_model_of_several_files_is_refused(tmp_path):
    asset = tmp_path / "meshes.xml"
    asset.write_text('<mujoco><asset><mesh name="m" file="m.obj"/></asset></mujoco>')
    task = dataclasses.replace(make_task(shipped("cartpole")), asset=asset)
    with pytest.raises(ConfigError, match=r"meshes\.xml refers to m\.obj; expected a model in a single file"):
        model_file.write(tmp_path / "out.xml", task, shipped("cartpole").physics)


def test_a_blind_policy_says_how_it_estimates_and_others_do_not(of_released):
    blind = metadata.describe(from_dict({"cassie": {"observe": "blind"}}), "")
    assert blind["constants"]["blind"] == {"unloaded_rad": 0.03, "bend_rad": 0.03, "trust": 0.5}
    assert "blind" not in of_released["released"]["constants"]
    notes = {row["name"]: row["note"] for row in blind["observation"]}
    assert "blind" in notes["pelvis_height"] and "blind" in notes["pelvis_velocity"]
