"""Every format acts as the policy it was written from."""

import json
import zipfile

import numpy as np
import onnxruntime
import pytest

from hasrl_jax.cli import export as command_line
from hasrl_jax.config.convert import from_dict
from hasrl_jax.deploy import export, files, metadata, npz_format, onnx_format, stablehlo_format
from hasrl_jax.envs.registry import make_task
from hasrl_jax.errors import CheckpointError, ConfigError
from hasrl_jax.policy import loading


def policy_by_hand(parameters, mirror, observations):
    """The actions [T, E, A] of a policy for [T, E, O], in float64, gate by gate, without any of the package's code."""
    p = {name: array.astype(np.float64) for name, array in parameters.items()}

    def sigmoid(x):
        return np.exp(-np.logaddexp(0, -x))

    def heads(sequence):
        hidden = p["policy/mean_kernel"].shape[0]
        h, c = np.zeros((2, sequence.shape[1], hidden)), np.zeros((2, sequence.shape[1], hidden))
        result = []
        for x in sequence:
            if "normalizer/mean" in p:
                x = np.clip((x - p["normalizer/mean"]) / p["normalizer/std"], -10, 10)
            for layer in range(2):
                if "policy/dense_0_kernel" in p:
                    x = np.tanh(x @ p[f"policy/dense_{layer}_kernel"] + p[f"policy/dense_{layer}_bias"])
                    continue
                names = [f"policy/lstm_{layer}_{kind}" for kind in ("input", "recurrent", "bias")]
                gates = x @ p[names[0]] + h[layer] @ p[names[1]] + p[names[2]]
                i, f, g, o = (gates[:, n * hidden : (n + 1) * hidden] for n in range(4))
                c[layer] = sigmoid(f) * c[layer] + sigmoid(i) * np.tanh(g)
                h[layer] = sigmoid(o) * np.tanh(c[layer])
                x = np.tanh(h[layer])
            result.append(x @ p["policy/mean_kernel"] + p["policy/mean_bias"])
        return np.array(result)

    own = heads(observations)
    if mirror is None:
        return np.tanh(own)
    other = heads(observations[..., mirror.observation_index] * mirror.observation_sign)
    return np.tanh((own + other[..., mirror.action_index] * mirror.action_sign) / 2)


def write_and_load(form, path, config, parameters, mirror):
    """The step function of a file of one format."""
    if form == "onnx":
        onnx_format.write(path, parameters, mirror, {})
        return onnx_format.load(path)
    if form == "jax":
        stablehlo_format.write(path, config.network, parameters, mirror, {})
        return stablehlo_format.load(path)
    npz_format.write(path, parameters, mirror, {})
    return npz_format.load(path)


@pytest.mark.parametrize("form", ["npz", "onnx", "jax"])
@pytest.mark.parametrize(
    ("task_name", "symmetric", "normalized", "memory"),
    [
        ("cassie", True, True, "lstm"),
        ("cassie", False, True, "lstm"),
        ("cartpole", True, False, "lstm"),
        ("cartpole", False, False, "lstm"),
        ("cassie", True, True, "none"),
        ("cartpole", False, False, "none"),
    ],
)
def test_a_file_acts_as_the_equations_say(
    make_config, make_parameters, tmp_path, form, task_name, symmetric, normalized, memory
):
    config = make_config(task_name, symmetric, memory)
    task, parameters = make_task(config), make_parameters(config)
    if not normalized:
        config = from_dict({"network": {"normalize_observations": False}}, config)
        parameters = {name: array for name, array in parameters.items() if not name.startswith("normalizer/")}
    mirror = task.mirror if symmetric else None
    step = write_and_load(form, tmp_path / "file", config, parameters, mirror)
    rng = np.random.default_rng(1)
    for robots in (1, 3):
        observations = 2 * rng.standard_normal((20, robots, task.observation_size)).astype(np.float32)
        observations[3] *= 1e4  # beyond the clip of normalised observations
        expected = policy_by_hand(parameters, mirror, observations.astype(np.float64))
        carry = np.zeros((robots, *config.network.carry_shape), np.float32)
        for observation, wanted in zip(observations, expected, strict=True):
            action, carry = step(observation, carry)
            assert (action.shape, action.dtype) == ((robots, task.action_size), np.float32)
            np.testing.assert_allclose(action, wanted, atol=1e-5)


@pytest.mark.parametrize("policy", loading.RELEASED)
@pytest.mark.parametrize("form", ["npz", "onnx", "jax"])
def test_a_released_policy_is_exported_and_agrees_for_a_thousand_steps(tmp_path, capsys, policy, form):
    out = tmp_path / f"policy{export.SUFFIXES[form]}"
    assert command_line.main(["--policy", policy, "--format", form, "--out", str(out)]) == 0
    assert "1000 steps beside the policy: largest difference" in capsys.readouterr().out
    assert [path.name for path in tmp_path.iterdir()] == [out.name]  # nothing unfinished is left beside it


def test_a_file_that_acts_otherwise_is_not_left_behind(monkeypatch, tmp_path):
    config, parameters = loading.load_policy_parameters(None, "released")
    monkeypatch.setattr(onnx_format, "_GATES", (0, 1, 2, 3))  # as if ONNX had our order
    out = tmp_path / "policy.onnx"
    out.write_text("an earlier file")
    with pytest.raises(CheckpointError, match=r"policy\.onnx: not written: its actions differ .* at most 1e-05$"):
        export.write(out, "onnx", config, parameters, "", steps=20)
    assert [path.name for path in tmp_path.iterdir()] == ["policy.onnx"]
    assert out.read_text() == "an earlier file"


def test_the_three_files_say_the_same_and_an_exported_policy_loads(tmp_path):
    config, parameters = loading.load_policy_parameters(None, "released-steer")
    digest = metadata.training_digest(config, parameters)
    for form, suffix in export.SUFFIXES.items():
        export.write(tmp_path / f"policy{suffix}", form, config, parameters, digest, steps=5)
    session = onnxruntime.InferenceSession(str(tmp_path / "policy.onnx"))
    in_onnx = {name: json.loads(text) for name, text in session.get_modelmeta().custom_metadata_map.items()}
    with zipfile.ZipFile(tmp_path / "policy.zip") as archive:
        in_zip = json.loads(archive.read("metadata.json"))
    with np.load(tmp_path / "policy.npz") as arrays:
        in_npz = json.loads(str(arrays["__metadata__"]))
        assert {"mirror/observation_index", "mirror/action_sign"} <= set(arrays)
    assert in_onnx == in_zip == in_npz
    assert in_onnx["training_sha256"] == digest
    loaded_config, loaded = loading.load_policy_parameters(None, tmp_path / "policy.npz")
    assert loaded_config == config
    assert loaded.keys() == parameters.keys()
    for name, array in loaded.items():
        np.testing.assert_array_equal(array, parameters[name])
    assert loading.training_digest_of(tmp_path / "policy.npz") == digest
    assert loading.training_digest_of("released") is None


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["--policy", "released", "--out", "x.txt"], "--out: got x.txt; expected a name that ends in .npz"),
        (["--policy", "released", "--format", "onnx", "--out", "x.npz"], "--out: got x.npz; .* ends in .onnx"),
        (["--policy", "released", "--out", "."], r"--out: got \., a folder; expected a file, NAME\.npz"),
        (["--policy", "released"], "--out: missing; expected the file to write, or --model"),
        (["--out", "x.npz"], "--run-dir: missing; expected a run directory, or --policy"),
        (["--policy", "released", "--model", "x.mjb"], "--model: got x.mjb; expected a name that ends in .xml"),
    ],
)
def test_impossible_arguments_are_refused(arguments, complaint):
    with pytest.raises(ConfigError, match=complaint):
        command_line.export(arguments)


def test_a_missing_package_is_named_with_its_remedy(monkeypatch, tmp_path):
    monkeypatch.setitem(__import__("sys").modules, "onnx", None)
    with pytest.raises(ConfigError, match=r'--format onnx: onnx cannot be imported .*; pip install "hasrl_jax\[deploy'):
        onnx_format.write(tmp_path / "x.onnx", {}, None, {})


def test_a_file_that_cannot_be_written_leaves_nothing(tmp_path):
    with pytest.raises(CheckpointError, match="cannot be written"):
        files.write_whole(tmp_path / "missing" / "policy.onnx", b"")
