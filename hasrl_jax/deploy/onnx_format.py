"""The policy as an ONNX graph: mirror, normalisation, two LSTM layers and the head, with the LSTM state in and out."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from hasrl_jax.deploy.files import Step, require_package, write_whole
from hasrl_jax.learn.networks import OBSERVATION_CLIP
from hasrl_jax.policy.numpy_networks import LAYERS, Parameters, has_memory, input_size
from hasrl_jax.types import Mirror

OPSET, IR_VERSION = 17, 8  # old enough for every runtime in use
_GATES = (0, 3, 1, 2)  # ONNX stands input, output, forget, candidate; the parameters input, forget, candidate, output


def write(path: Path, parameters: Parameters, mirror: Mirror | None, metadata: dict[str, Any]) -> None:
    """Writes the file; the graph is that of `graph`, each key of `metadata` a property with its value as JSON.

    Args:
      path: replaced when it exists.
      parameters: as `learn.ppo.export_parameters` returns them.
      mirror: the symmetry of a symmetric network, else None.
      metadata: JSON-able values by name.

    Raises:
      ConfigError: the package `onnx` is missing; CheckpointError: the file cannot be written.
    """
    onnx = require_package("onnx")
    model = onnx.helper.make_model(
        graph(parameters, mirror),
        opset_imports=[onnx.helper.make_opsetid("", OPSET)],
        ir_version=IR_VERSION,
        producer_name="hasrl_jax",
    )
    onnx.helper.set_model_props(model, {name: json.dumps(value) for name, value in metadata.items()})
    onnx.checker.check_model(model, full_check=True)
    write_whole(path, model.SerializeToString())


def graph(parameters: Parameters, mirror: Mirror | None) -> Any:
    """The computation for E robots: (observation [E, O], carry [E, L, 2, W]) -> (action [E, A], next_carry).

    The streams (S = 2 with a mirror, else 1) stand behind each other on the batch axis of the LSTM operator:

        x = clip((stack(o, M o) - mean) / std),   h_l, c_l = LSTM_l(x, h_l, c_l),   x = tanh(h_l),
        action = tanh((head(x of o) + M head(x of M o)) / 2)

    Args:
      parameters: as `learn.ppo.export_parameters` returns them.
      mirror: the symmetry of a symmetric network, else None.

    Returns:
      An `onnx.GraphProto`.
    """
    onnx = require_package("onnx")
    nodes: list[Any] = []
    constants: dict[str, np.ndarray] = {}

    def add(operator: str, inputs: list[str], outputs: str | list[str], **attributes: Any) -> Any:
        names = [outputs] if isinstance(outputs, str) else outputs
        nodes.append(onnx.helper.make_node(operator, inputs, names, **attributes))
        return outputs

    def constant(name: str, value: Any) -> str:
        value = np.asarray(value)
        constants[name] = value.astype(np.float32 if value.dtype.kind == "f" else np.int64)
        return name

    actions, streams = parameters["policy/mean_bias"].shape[0], 1 if mirror is None else 2
    size = input_size(parameters)
    x = _inputs(add, constant, parameters, mirror)
    if has_memory(parameters):
        x, width = _remember(add, constant, parameters, streams, x)
    else:
        x, width = _dense(add, constant, parameters, x)

    head = add("MatMul", [x, constant("mean_kernel", parameters["policy/mean_kernel"])], "head_product")
    head = add("Add", [head, constant("mean_bias", parameters["policy/mean_bias"])], "head")
    head = add("Reshape", [head, constant("head_by_stream", [streams, -1, actions])], "head_streams")
    if mirror is None:
        logits = add("Squeeze", [head, constant("first_axis", [0])], "logits")
    else:
        add("Split", [head, constant("one_per_stream", [1, 1])], ["head_own", "head_other"], axis=0)
        other = add("Gather", ["head_other", constant("action_index", mirror.action_index)], "head_swapped", axis=2)
        other = add("Mul", [other, constant("action_sign", mirror.action_sign.astype(np.float32))], "head_mirrored")
        total = add("Add", ["head_own", other], "head_sum")
        total = add("Mul", [total, constant("half", np.float32(0.5))], "head_mean")
        logits = add("Squeeze", [total, constant("first_axis", [0])], "logits")
    add("Tanh", [logits], "action")

    def tensor(name: str, *shape: int) -> Any:
        return onnx.helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, ["E", *shape])

    carry_shape = LAYERS if has_memory(parameters) else 0, 2, streams * width
    return onnx.helper.make_graph(
        nodes,
        "policy",
        [tensor("observation", size), tensor("carry", *carry_shape)],
        [tensor("action", actions), tensor("next_carry", *carry_shape)],
        [onnx.numpy_helper.from_array(value, name) for name, value in constants.items()],
    )


def _remember(
    add: Callable[..., Any], constant: Callable[[str, Any], str], parameters: Parameters, streams: int, x: str
) -> tuple[str, int]:
    """Adds the LSTM layers on the inputs `x` [S E, O] and what makes the next carry; features [1, S E, H] and H."""
    size, hidden = parameters["policy/lstm_0_input"].shape[0], parameters["policy/lstm_0_recurrent"].shape[0]
    per_stream = [-1, LAYERS, 2, streams, hidden]
    split = add("Reshape", ["carry", constant("carry_by_stream", per_stream)], "carry_streams")
    split = add("Transpose", [split], "carry_time_major", perm=[1, 2, 3, 0, 4])
    split = add("Reshape", [split, constant("carry_rows", [2 * LAYERS, -1, hidden])], "carry_stacked")
    states = [name for layer in range(LAYERS) for name in (f"hidden_{layer}", f"cell_{layer}")]
    add("Split", [split, constant("one_each", [1] * (2 * LAYERS))], states, axis=0)

    x = add("Reshape", [x, constant("one_step", [1, -1, size])], "lstm_0_x")
    following = []
    for layer in range(LAYERS):
        weights = {name: parameters[f"policy/lstm_{layer}_{name}"] for name in ("input", "recurrent", "bias")}
        bias = _reorder(weights["bias"])
        operands = [
            x,
            constant(f"lstm_{layer}_W", _reorder(weights["input"]).T[None]),
            constant(f"lstm_{layer}_R", _reorder(weights["recurrent"]).T[None]),
            constant(f"lstm_{layer}_B", np.concatenate([bias, np.zeros_like(bias)])[None]),
            "",  # every sequence is whole
            f"hidden_{layer}",
            f"cell_{layer}",
        ]
        after = [f"next_hidden_{layer}", f"next_cell_{layer}"]
        add("LSTM", operands, ["", *after], hidden_size=hidden)
        following += after
        x = add("Tanh", [after[0]], f"features_{layer}")

    packed = add("Concat", following, "next_stacked", axis=0)
    packed = add("Reshape", [packed, constant("by_stream", [LAYERS, 2, streams, -1, hidden])], "next_time_major")
    packed = add("Transpose", [packed], "next_streams", perm=[3, 0, 1, 2, 4])
    add("Reshape", [packed, constant("carry_shape", [-1, LAYERS, 2, streams * hidden])], "next_carry")
    return x, hidden


def _dense(
    add: Callable[..., Any], constant: Callable[[str, Any], str], parameters: Parameters, x: str
) -> tuple[str, int]:
    """Adds the layers of a policy without memory on the inputs `x` [S E, O]; features [S E, H] and H."""
    add("Identity", ["carry"], "next_carry")
    for layer in range(LAYERS):
        kernel, bias = (parameters[f"policy/dense_{layer}_{name}"] for name in ("kernel", "bias"))
        x = add("MatMul", [x, constant(f"dense_{layer}_kernel", kernel)], f"dense_{layer}_product")
        x = add("Add", [x, constant(f"dense_{layer}_bias", bias)], f"dense_{layer}_sum")
        x = add("Tanh", [x], f"features_{layer}")
    return x, kernel.shape[1]


def _inputs(
    add: Callable[..., Any], constant: Callable[[str, Any], str], parameters: Parameters, mirror: Mirror | None
) -> str:
    """Adds what turns the observation [E, O] into the normalised inputs of the streams, [S E, O]; returns its name."""
    x = "observation"
    if mirror is not None:
        index, sign = mirror.observation_index, mirror.observation_sign.astype(np.float32)
        swapped = add("Gather", [x, constant("observation_index", index)], "observation_swapped", axis=1)
        mirrored = add("Mul", [swapped, constant("observation_sign", sign)], "observation_mirrored")
        x = add("Concat", [x, mirrored], "observation_streams", axis=0)
    if "normalizer/mean" not in parameters:
        return x
    x = add("Sub", [x, constant("observation_mean", parameters["normalizer/mean"])], "observation_centered")
    x = add("Div", [x, constant("observation_std", parameters["normalizer/std"])], "observation_scaled")
    bounds = [constant("clip_low", np.float32(-OBSERVATION_CLIP)), constant("clip_high", np.float32(OBSERVATION_CLIP))]
    clipped: str = add("Clip", [x, *bounds], "observation_normalized")
    return clipped


def _reorder(array: np.ndarray) -> np.ndarray:
    """The gates along the last axis [..., 4H] in the order of ONNX."""
    gates = np.split(array, len(_GATES), axis=-1)
    return np.concatenate([gates[gate] for gate in _GATES], axis=-1)


def load(path: Path) -> Step:
    """The file as a function that ONNX Runtime computes, on one thread.

    Raises:
      ConfigError: the package `onnxruntime` is missing.
    """
    runtime = require_package("onnxruntime")
    options = runtime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    session = runtime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])

    def step(observation: np.ndarray, carry: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        action, following = session.run(["action", "next_carry"], {"observation": observation, "carry": carry})
        return action, following

    return step
