"""The policy and value forward pass in NumPy, for worker processes that never import JAX.

A test holds it equal to the Flax networks in `learn/networks.py`. Importing NumPy takes a tenth of
the time and memory of importing JAX, and a batch of a few dozen states needs no compiler.
"""

import numpy as np

from hasrl_jax.config.schema import NetworkConfig
from hasrl_jax.types import Mirror

LAYERS = 2
Parameters = dict[str, np.ndarray]


def parameter_shapes(observation_size: int, action_size: int, network: NetworkConfig) -> dict[str, tuple[int, ...]]:
    """Names and shapes of every array that a worker needs, in broadcast order."""
    hidden = network.hidden_size
    shapes: dict[str, tuple[int, ...]] = {}
    for layer, inputs in enumerate((observation_size, hidden)):
        if network.memory == "none":
            shapes[f"policy/dense_{layer}_kernel"] = (inputs, hidden)
            shapes[f"policy/dense_{layer}_bias"] = (hidden,)
            continue
        shapes[f"policy/lstm_{layer}_input"] = (inputs, 4 * hidden)
        shapes[f"policy/lstm_{layer}_recurrent"] = (hidden, 4 * hidden)
        shapes[f"policy/lstm_{layer}_bias"] = (4 * hidden,)
    shapes["policy/mean_kernel"] = (hidden, action_size)
    shapes["policy/mean_bias"] = (action_size,)
    shapes["policy/log_std"] = (action_size,)
    for layer, (inputs, outputs) in enumerate(((observation_size, hidden), (hidden, hidden), (hidden, 1))):
        shapes[f"value/dense_{layer}_kernel"] = (inputs, outputs)
        shapes[f"value/dense_{layer}_bias"] = (outputs,)
    if network.normalize_observations:
        shapes["normalizer/mean"] = shapes["normalizer/std"] = (observation_size,)
    return shapes


def streams(observation: np.ndarray, parameters: Parameters, mirror: Mirror | None) -> np.ndarray:
    """Normalised network inputs, [S, E, O]: the observation and, for a symmetric network, its mirror image."""
    inputs = [observation] if mirror is None else [observation, mirror.observation(observation)]
    stacked = np.stack(inputs)
    if "normalizer/mean" in parameters:
        stacked = np.clip((stacked - parameters["normalizer/mean"]) / parameters["normalizer/std"], -10, 10)
    return stacked.astype(np.float32)


def policy_step(
    parameters: Parameters, inputs: np.ndarray, carry: np.ndarray, is_first: np.ndarray, mirror: Mirror | None
) -> tuple[np.ndarray, np.ndarray]:
    """One step of the policy.

    Args:
      parameters: the arrays named by `parameter_shapes`.
      inputs: [S, E, O] from `streams`.
      carry: [E, L, 2 (h, c), S * H] before this step; L is 2, or 0 for a policy without memory.
      is_first: [E] bool, where the carry starts from zero.
      mirror: the symmetry of a symmetric network, else None.

    Returns:
      The action mean [E, A] in [-1, 1], and the next carry.
    """
    num_streams, num_envs, _ = inputs.shape
    x = inputs.reshape(num_streams * num_envs, -1)
    if has_memory(parameters):
        x, carry = _remember(parameters, x, carry, is_first)
    else:
        for layer in range(LAYERS):
            x = np.tanh(x @ parameters[f"policy/dense_{layer}_kernel"] + parameters[f"policy/dense_{layer}_bias"])
    head = (x @ parameters["policy/mean_kernel"] + parameters["policy/mean_bias"]).reshape(num_streams, num_envs, -1)
    mean = head[0] if mirror is None else 0.5 * (head[0] + mirror.action(head[1]))
    return np.tanh(mean, dtype=np.float32), carry


def has_memory(parameters: Parameters) -> bool:
    """Whether the policy is an LSTM."""
    return "policy/lstm_0_input" in parameters


def input_size(parameters: Parameters) -> int:
    """Numbers that the policy sees."""
    return len(parameters["policy/lstm_0_input" if has_memory(parameters) else "policy/dense_0_kernel"])


def _remember(
    parameters: Parameters, x: np.ndarray, carry: np.ndarray, is_first: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Both LSTM layers: inputs [S * E, O] and the carry of `policy_step` to features [S * E, H] and the next carry."""
    num_envs, num_streams = len(carry), len(x) // len(carry)
    carry = carry.copy()
    carry[is_first] = 0
    per_stream = carry.reshape(num_envs, LAYERS, 2, num_streams, -1).transpose(1, 2, 3, 0, 4)
    following = np.empty_like(per_stream)
    for layer in range(LAYERS):
        h, c = per_stream[layer].reshape(2, num_streams * num_envs, -1)
        gates = x @ parameters[f"policy/lstm_{layer}_input"]
        gates += h @ parameters[f"policy/lstm_{layer}_recurrent"]
        gates += parameters[f"policy/lstm_{layer}_bias"]
        width = h.shape[1]
        write, forget = _sigmoid(gates[:, :width]), _sigmoid(gates[:, width : 2 * width])
        candidate, read = np.tanh(gates[:, 2 * width : 3 * width]), _sigmoid(gates[:, 3 * width :])
        c = forget * c + write * candidate
        h = read * np.tanh(c)
        following[layer, 0] = h.reshape(num_streams, num_envs, width)
        following[layer, 1] = c.reshape(num_streams, num_envs, width)
        x = np.tanh(h)
    return x, following.transpose(3, 0, 1, 2, 4).reshape(carry.shape)


def value(parameters: Parameters, inputs: np.ndarray) -> np.ndarray:
    """V(s) of `streams` [S, E, O], averaged over the mirror images: [E]."""
    x = inputs
    for layer in range(2):
        x = np.tanh(x @ parameters[f"value/dense_{layer}_kernel"] + parameters[f"value/dense_{layer}_bias"])
    return (x @ parameters["value/dense_2_kernel"] + parameters["value/dense_2_bias"])[..., 0].mean(axis=0)


def log_std(parameters: Parameters, mirror: Mirror | None) -> np.ndarray:
    """Log standard deviation of each action, [A]; the same for both legs of a symmetric network."""
    own = parameters["policy/log_std"]
    return own if mirror is None else 0.5 * (own + own[mirror.action_index])


def log_prob(noise: np.ndarray, log_deviation: np.ndarray) -> np.ndarray:
    """Log-density of mean + std * noise under the diagonal Gaussian: [..., A] -> [...]."""
    return -np.sum(0.5 * noise * noise + log_deviation + np.float32(0.5 * np.log(2 * np.pi)), axis=-1)


def _sigmoid(x: np.ndarray) -> np.ndarray:
    return np.float32(0.5) * np.tanh(np.float32(0.5) * x) + np.float32(0.5)
