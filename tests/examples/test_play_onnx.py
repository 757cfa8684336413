"""The example that plays a policy without the package walks, sees what our environment sees, and imports none of us."""

import ast
import importlib.util
import subprocess
import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest

from hasrl_jax.cli import export as command_line
from hasrl_jax.config.convert import from_dict
from hasrl_jax.deploy import metadata
from hasrl_jax.envs.cpu_engine import CpuEnvs
from hasrl_jax.envs.registry import make_task
from hasrl_jax.policy import actor, loading

EXAMPLE = Path(__file__).parents[2] / "examples" / "deploy" / "play_onnx.py"
STEPS = 60


class Lowest:
    """A generator whose every number is zero: the first phase, no heading, the low end of every range."""

    @staticmethod
    def random(shape):
        return np.zeros(shape)


@pytest.fixture(scope="module")
def example():
    spec = importlib.util.spec_from_file_location("play_onnx", EXAMPLE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize(
    ("policy", "told"),
    [
        ("released", {"forward": 1.0, "lateral": 0.05}),
        ("released-steer", {"forward": 0.6, "lateral": 0.1, "yaw_rate": 0.6, "height": 0.8}),
        ("released-steer", {}),
        ("released-fast", {"forward": 2.5, "yaw_rate": 0.3}),
    ],
)
def test_it_sees_and_does_what_our_environment_does(tmp_path, example, policy, told):
    onnx, xml = tmp_path / "policy.onnx", tmp_path / "cassie.xml"
    arguments = ["--policy", policy, "--format", "onnx", "--out", str(onnx), "--model", str(xml)]
    assert command_line.main(arguments) == 0
    played = [(seen, done) for _, seen, done, _ in example.play(str(onnx), xml, STEPS / 40, told)]

    trained, parameters = loading.load_policy_parameters(None, policy)
    command = {"start_moving": 0.0, "stand_probability": 0.0, "resample_s": [0, 0]}
    config = from_dict({"cassie": {"command": command, "randomize": {"enabled": False}}}, trained)
    config = loading.under_reference_physics(config)
    task = make_task(config)
    values = np.array([[told.get(command.name, command.default) for command in task.commands]])
    envs, state_of_policy = CpuEnvs(task, 1, STEPS), actor.reset(config, task, parameters, 1)
    state = envs.reset(Lowest())
    of_task, observation = task.with_command(state.task, state.observation, values, np)
    state = state._replace(task=of_task, observation=observation)
    for seen, done in played:
        np.testing.assert_allclose(seen, state.observation[0], atol=2e-3)
        action, state_of_policy = actor.act(state_of_policy, state.observation, state.is_first)
        np.testing.assert_allclose(done, action[0], atol=2e-3)
        state, _ = envs.step(state, action, Lowest())
    assert len(played) == STEPS


def test_an_orientation_is_seen_with_one_sign_however_often_the_robot_has_turned(tmp_path, example):
    xml = tmp_path / "cassie.xml"
    assert command_line.main(["--policy", "released-steer", "--model", str(xml)]) == 0
    about = metadata.describe(loading.load_policy_parameters(None, "released-steer")[0], "")
    memory = {"phase": 0.0, "heading": 0.0, "command": {}, "standing": True}
    data = mujoco.MjData(mujoco.MjModel.from_xml_path(str(xml)))
    data.qpos[3:7] = (-1, 0, 0, 0)
    np.testing.assert_allclose(example.observe(data, about, memory, False)["pelvis_orientation"], (1, 0, 0, 0))


def test_it_imports_neither_the_package_nor_jax_and_tells_its_inference_time(tmp_path):
    names = set()
    for node in ast.walk(ast.parse(EXAMPLE.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            names.add(node.module)
    assert names - set(sys.stdlib_module_names) - {"pathlib"} == {"mujoco", "numpy", "onnxruntime"}
    onnx, xml = str(tmp_path / "policy.onnx"), str(tmp_path / "cassie.xml")
    assert command_line.main(["--policy", "released", "--format", "onnx", "--out", onnx, "--model", xml]) == 0
    run = [sys.executable, "-I", str(EXAMPLE), onnx, xml, "--seconds", "2"]
    done = subprocess.run([*run, "--command", "forward=1.0"], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert "2.00 s: x" in done.stdout and "inference: median" in done.stdout
    for wrong, line in (
        (["--command", "sideways=1"], "error: --command: got sideways; expected forward, lateral"),
        (["--command", "forward"], "play_onnx.py: error: argument --command: invalid setting value: 'forward'"),
        (["--seconds", "0"], "error: --seconds: got 0; expected one step of the policy or more"),
    ):
        refused = subprocess.run([*run, *wrong], capture_output=True, text=True, timeout=120)
        assert refused.returncode != 0 and refused.stderr.splitlines()[-1] == line
    run[3] = "nowhere.onnx"
    refused = subprocess.run(run, capture_output=True, text=True, timeout=120)
    assert refused.stderr == "error: got nowhere.onnx; there is no such file\n"
