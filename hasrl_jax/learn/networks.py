"""Policy and value networks.

The parameters are flat dictionaries with explicit names, so that a collector can rebuild the forward pass from
arrays alone, without this module.
"""

from typing import cast

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np

from hasrl_jax.config.schema import NetworkConfig
from hasrl_jax.learn.lstm import GATES, lstm_layer
from hasrl_jax.types import Mirror

Parameters = dict[str, jax.Array]
LSTM_LAYERS = 2
OBSERVATION_CLIP = 10.0  # bound of a normalised observation, in standard deviations


def check_mirror(mirror: Mirror, observation_size: int, action_size: int) -> None:
    """Checks that mirroring twice gives back the input, on which exact equivariance rests.

    Raises:
      ValueError: wrong sizes, or an operator that is not its own inverse.
    """
    for name, index, sign, size in (
        ("observation", mirror.observation_index, mirror.observation_sign, observation_size),
        ("action", mirror.action_index, mirror.action_sign, action_size),
    ):
        index, sign = np.asarray(index), np.asarray(sign)
        if index.shape != (size,) or sign.shape != (size,):
            raise ValueError(f"mirror.{name}: index {index.shape} and sign {sign.shape}; expected ({size},) for both")
        if not (np.array_equal(index[index], np.arange(size)) and np.array_equal(sign * sign[index], np.ones(size))):
            raise ValueError(f"mirror.{name}: applied twice it must be the identity")


def normalize_observation(observation: jax.Array, mean: jax.Array | None, std: jax.Array | None) -> jax.Array:
    """(observation - mean) / std, clipped to +-OBSERVATION_CLIP; None for both leaves the observation as it is."""
    if mean is None or std is None:
        return observation
    return jnp.clip((observation - mean) / std, -OBSERVATION_CLIP, OBSERVATION_CLIP)


def zero_carry(batch: int, hidden_size: int, symmetric: bool = False, memory: str = "lstm") -> np.ndarray:
    """The LSTM carry at the start of an episode: zeros [batch, L, 2 (h, c), W].

    L is 0 without memory. W is hidden_size, or twice that for a symmetric policy (first half: the stream of the
    observation itself, second half: the stream of its mirror image).
    """
    layers = LSTM_LAYERS if memory == "lstm" else 0
    return np.zeros((batch, layers, 2, hidden_size * (2 if symmetric else 1)), np.float32)


def _orthogonal_gates(key: jax.Array, shape: tuple[int, int]) -> jax.Array:
    """[H, 4H]: an orthogonal matrix for each gate."""
    size = shape[0]
    blocks = [nn.initializers.orthogonal()(k, (size, size)) for k in jax.random.split(key, GATES)]
    return jnp.concatenate(blocks, axis=1)


def _forget_bias_one(key: jax.Array, shape: tuple[int]) -> jax.Array:
    """[4H]: 1 for the forget gate, 0 elsewhere, so that memory survives the first updates."""
    del key
    return jnp.zeros(shape).reshape(GATES, -1).at[1].set(1.0).reshape(-1)


class Policy(nn.Module):
    """Two-layer LSTM, tanh after each layer, tanh mean in [-1, 1] and a state-independent log standard deviation.

    Parameters (gate order along 4H: i, f, g, o), for layers l = 0 and 1:
        lstm_{l}_input [O or H, 4H], lstm_{l}_recurrent [H, 4H], lstm_{l}_bias [4H],
        mean_kernel [H, A], mean_bias [A], log_std [A].

    Without memory each layer is x = tanh(x W + b) with dense_{l}_kernel [O or H, H] and dense_{l}_bias [H], and the
    carry is empty.

    With a mirror M the same weights run on the observation and on its mirror image,
        mean(o) = tanh((head(h(o)) + M head(h(M o))) / 2),
    so that mean(M o) = M mean(o) for any parameters and any observation statistics.

    Source: paper II.E (policy representation). Differs from the paper: observation normalisation, the mirror and the
    choice of no memory.
    """

    observation_size: int
    action_size: int
    hidden_size: int
    initial_log_std: float = 0.0
    learn_std: bool = True
    mirror: Mirror | None = None
    memory: str = "lstm"

    def setup(self) -> None:
        hidden = self.hidden_size
        layers: list[tuple[jax.Array, ...]] = []
        for layer, width in ((0, self.observation_size), (1, hidden)):
            if self.memory == "none":
                kernel = self.param(f"dense_{layer}_kernel", nn.initializers.orthogonal(2.0**0.5), (width, hidden))
                layers.append((kernel, self.param(f"dense_{layer}_bias", nn.initializers.zeros, (hidden,))))
                continue
            layers.append(
                (
                    self.param(f"lstm_{layer}_input", nn.initializers.lecun_uniform(), (width, GATES * hidden)),
                    self.param(f"lstm_{layer}_recurrent", _orthogonal_gates, (hidden, GATES * hidden)),
                    self.param(f"lstm_{layer}_bias", _forget_bias_one, (GATES * hidden,)),
                )
            )
        self.layers = layers
        # A small head: the first policy acts near zero, the neutral posture, and its deviation alone explores.
        self.head = (
            self.param("mean_kernel", nn.initializers.orthogonal(0.01), (hidden, self.action_size)),
            self.param("mean_bias", nn.initializers.zeros, (self.action_size,)),
        )
        self.raw_log_std = self.param("log_std", nn.initializers.constant(self.initial_log_std), (self.action_size,))

    def log_std(self) -> jax.Array:
        """Log standard deviation [A] as used: without gradient when it is fixed, mirror-symmetric with a mirror."""
        log_std = self.raw_log_std if self.learn_std else jax.lax.stop_gradient(self.raw_log_std)
        return log_std if self.mirror is None else 0.5 * (log_std + log_std[np.asarray(self.mirror.action_index)])

    def __call__(
        self,
        observation: jax.Array,
        carry: jax.Array | None = None,
        is_first: jax.Array | None = None,
        observation_mean: jax.Array | None = None,
        observation_std: jax.Array | None = None,
    ) -> tuple[jax.Array, jax.Array]:
        """The mean action for single states or whole sequences.

        Args:
          observation: [N, O] single states, or [B, T, O] sequences; raw.
          carry: [N or B, L, 2, W] state before the first step (see `zero_carry`); None for zeros.
          is_first: [N] or [B, T] bool, the carry is zeroed before these steps; None for no resets.
          observation_mean: [O] mean of the observation statistics; None does not normalise.
          observation_std: [O] their standard deviation; None does not normalise.

        Returns:
          (mean action [N, A] or [B, T, A], carry after the last step, shaped as `carry`).

        Source: paper II.E (the output shape follows the input shape).
        """
        single = observation.ndim == 2
        if single:
            observation = observation[:, None]
            is_first = None if is_first is None else is_first[:, None]
        batch, steps = observation.shape[:2]
        if carry is None:
            carry = jnp.asarray(zero_carry(batch, self.hidden_size, self.mirror is not None, self.memory))
        streams = [observation] if self.mirror is None else [observation, self.mirror.observation(observation)]
        count = len(streams)
        # Streams stand side by side on the batch axis, so a batch split over devices stays where it is.
        inputs = normalize_observation(jnp.stack(streams, axis=1), observation_mean, observation_std)
        inputs = jnp.swapaxes(inputs.reshape(batch * count, steps, -1), 0, 1)  # time-major for the scan
        if self.memory == "none":
            for kernel, bias in self.layers:
                inputs = jnp.tanh(inputs @ kernel + bias)
            new_carry = carry
        else:
            inputs, new_carry = self._remember(inputs, carry, is_first)
        mean = jnp.swapaxes(self._mean(inputs.reshape(steps, batch, count, -1)), 0, 1)
        return (mean[:, 0] if single else mean), new_carry

    def _remember(self, inputs: jax.Array, carry: jax.Array, is_first: jax.Array | None) -> tuple[jax.Array, jax.Array]:
        """Both LSTM layers: inputs [T, B * streams, O] and the carry of `__call__` to features and the next carry."""
        batch, steps = carry.shape[0], inputs.shape[0]
        count = inputs.shape[1] // batch
        state = jnp.moveaxis(jnp.reshape(carry, (batch, LSTM_LAYERS, 2, count, -1)), 3, 1)
        state = state.reshape(batch * count, LSTM_LAYERS, 2, -1)
        keep = jnp.ones((batch, steps)) if is_first is None else 1.0 - is_first.astype(jnp.float32)
        keep = jnp.repeat(keep, count, axis=0).T[..., None]
        new_state = []
        for layer, weights in enumerate(self.layers):
            outputs, hidden, cell = lstm_layer(inputs, keep, state[:, layer, 0], state[:, layer, 1], *weights)
            new_state.append(jnp.stack([hidden, cell], axis=1))
            inputs = jnp.tanh(outputs)
        new_carry = jnp.stack(new_state, axis=1).reshape(batch, count, LSTM_LAYERS, 2, -1)
        return inputs, jnp.moveaxis(new_carry, 1, 3).reshape(carry.shape)

    def _mean(self, features: jax.Array) -> jax.Array:
        """Features [T, B, streams, H] to the mean action [T, B, A]."""
        kernel, bias = self.head
        head = features @ kernel + bias
        own = head[..., 0, :]
        logits = own if self.mirror is None else 0.5 * (own + self.mirror.action(head[..., 1, :]))
        return jnp.tanh(logits)


class Value(nn.Module):
    """MLP O -> H -> H -> 1 with tanh. Parameters: dense_{0,1,2}_kernel and dense_{0,1,2}_bias.

    With a mirror M, V(o) = (V'(o) + V'(M o)) / 2, so that V(M o) = V(o).

    Source: paper II.E (three-layer value network).
    """

    observation_size: int
    hidden_size: int
    mirror: Mirror | None = None

    def setup(self) -> None:
        sizes = (self.observation_size, self.hidden_size, self.hidden_size, 1)
        self.layers = [
            (
                self.param(
                    f"dense_{layer}_kernel", nn.initializers.orthogonal(scale), (sizes[layer], sizes[layer + 1])
                ),
                self.param(f"dense_{layer}_bias", nn.initializers.zeros, (sizes[layer + 1],)),
            )
            for layer, scale in enumerate((2.0**0.5, 2.0**0.5, 1.0))
        ]

    def __call__(
        self,
        observation: jax.Array,
        observation_mean: jax.Array | None = None,
        observation_std: jax.Array | None = None,
    ) -> jax.Array:
        """V(s) of raw observations: [N, O] to [N], [B, T, O] to [B, T]."""
        if self.mirror is not None:
            observation = jnp.stack([observation, self.mirror.observation(observation)])
        features = normalize_observation(observation, observation_mean, observation_std)
        (kernel_0, bias_0), (kernel_1, bias_1), (kernel_2, bias_2) = self.layers
        features = jnp.tanh(features @ kernel_0 + bias_0)
        features = jnp.tanh(features @ kernel_1 + bias_1)
        value = (features @ kernel_2 + bias_2)[..., 0]
        return value if self.mirror is None else 0.5 * (value[0] + value[1])


def log_std(policy: Policy, params: Parameters) -> jax.Array:
    """The log standard deviation that `policy` acts with, [A]."""
    return cast(jax.Array, policy.apply({"params": params}, method=Policy.log_std))


def values(
    value: Value, params: Parameters, observation: jax.Array, mean: jax.Array | None, std: jax.Array | None
) -> jax.Array:
    """V(s) of raw observations [..., O] under the observation statistics' mean and standard deviation [O]: [...]."""
    return cast(jax.Array, value.apply({"params": params}, observation, mean, std))


def make_networks(
    config: NetworkConfig, observation_size: int, action_size: int, mirror: Mirror | None
) -> tuple[Policy, Value]:
    """The two networks of a configuration; `mirror` is used, and required, only when `config.symmetric`.

    Raises:
      ValueError: a symmetric network without a mirror, or a mirror that is not its own inverse.
    """
    if config.symmetric:
        if mirror is None:
            raise ValueError("network.symmetric: this task defines no mirror; set network.symmetric to false")
        check_mirror(mirror, observation_size, action_size)
    else:
        mirror = None
    policy = Policy(
        observation_size,
        action_size,
        config.hidden_size,
        config.initial_log_std,
        config.learn_std,
        mirror,
        config.memory,
    )
    return policy, Value(observation_size, config.hidden_size, mirror)
