"""One LSTM layer over a sequence, with resets inside the scan and a hand-written gradient.

The time loop holds only what must be sequential: one product with the recurrent matrix per environment step.
The input projection, and in the gradient every weight gradient, are single large products over all steps.
Automatic differentiation would instead add to the [H, 4H] gradient at every step, which costs about half as much
again on a CPU and, with a batch split over devices, one all-reduce per step.
"""

from typing import Any

import jax
import jax.numpy as jnp

GATES = 4  # input i, forget f, candidate g, output o: the order along the last axis of every 4H array

Pair = tuple[jax.Array, jax.Array]


def lstm_layer(
    inputs: jax.Array,
    keep: jax.Array,
    hidden: jax.Array,
    cell: jax.Array,
    input_kernel: jax.Array,
    recurrent_kernel: jax.Array,
    bias: jax.Array,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Runs a layer over a time-major sequence.

    With k_t = keep[t] and gates in the order i, f, g, o:
        i, f, g, o = split(x_t W + (k_t h_{t-1}) U + b)
        c_t = sigmoid(f) k_t c_{t-1} + sigmoid(i) tanh(g),    h_t = sigmoid(o) tanh(c_t)

    Args:
      inputs: [T, B, I].
      keep: [T, B, 1], 0 where the state before step t is zeroed and 1 elsewhere.
      hidden: [B, H] h before step 0.
      cell: [B, H] c before step 0.
      input_kernel: [I, 4H] W.
      recurrent_kernel: [H, 4H] U.
      bias: [4H] b.

    Returns:
      (h of every step [T, B, H], h after the last step [B, H], c after the last step [B, H]).

    Source: paper II.E (two-layer LSTM policy).
    """
    projected = jnp.dot(inputs, input_kernel) + bias
    return _recurrence(projected, recurrent_kernel, hidden, cell, keep)


def _cell(
    gates: jax.Array, cell: jax.Array
) -> tuple[jax.Array, jax.Array, tuple[jax.Array, jax.Array, jax.Array, jax.Array]]:
    """(h, c, activated gates), each [B, H], from gates [B, 4H] before activation and the cell before the step."""
    i, f, g, o = jnp.split(gates, GATES, axis=-1)
    i, f, g, o = jax.nn.sigmoid(i), jax.nn.sigmoid(f), jnp.tanh(g), jax.nn.sigmoid(o)
    cell = f * cell + i * g
    return o * jnp.tanh(cell), cell, (i, f, g, o)


@jax.custom_vjp
def _recurrence(
    projected: jax.Array, recurrent_kernel: jax.Array, hidden: jax.Array, cell: jax.Array, keep: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """The sequential part: projected [T, B, 4H] to (h [T, B, H], last h [B, H], last c [B, H])."""

    def step(carry: Pair, inputs: Pair) -> tuple[Pair, jax.Array]:
        (h, c), (x, k) = carry, inputs
        h, c, _ = _cell(x + (h * k) @ recurrent_kernel, c * k)
        return (h, c), h

    (last_h, last_c), outputs = jax.lax.scan(step, (hidden, cell), (projected, keep))
    return outputs, last_h, last_c


def _recurrence_forward(
    projected: jax.Array, recurrent_kernel: jax.Array, hidden: jax.Array, cell: jax.Array, keep: jax.Array
) -> tuple[tuple[jax.Array, jax.Array, jax.Array], tuple[Any, ...]]:
    """As `_recurrence`, and keeps for the gradient the state before each step and the activated gates."""

    def step(carry: Pair, inputs: Pair) -> tuple[Pair, tuple[Any, ...]]:
        (h, c), (x, k) = carry, inputs
        h_before, c_before = h * k, c * k
        h, c, activated = _cell(x + h_before @ recurrent_kernel, c_before)
        return (h, c), (h, h_before, c_before, activated)

    (last_h, last_c), (outputs, *saved) = jax.lax.scan(step, (hidden, cell), (projected, keep))
    return (outputs, last_h, last_c), (recurrent_kernel, keep, *saved)


def _recurrence_backward(residuals: tuple[Any, ...], cotangents: tuple[jax.Array, ...]) -> tuple[Any, ...]:
    """Back-propagation through time: the gradient of every gate, then one product for the recurrent matrix."""
    recurrent_kernel, keep, h_before, c_before, activated = residuals
    d_outputs, d_last_h, d_last_c = cotangents
    transposed_kernel = recurrent_kernel.T

    def step(carry: Pair, inputs: tuple[Any, ...]) -> tuple[Pair, jax.Array]:
        d_h, d_c = carry
        d_output, k, c_prev, (i, f, g, o) = inputs
        tanh_c = jnp.tanh(f * c_prev + i * g)
        d_h = d_h + d_output
        d_c = d_c + d_h * o * (1 - tanh_c * tanh_c)
        d_gates = jnp.concatenate(
            [d_c * g * i * (1 - i), d_c * c_prev * f * (1 - f), d_c * i * (1 - g * g), d_h * tanh_c * o * (1 - o)], -1
        )
        return ((d_gates @ transposed_kernel) * k, d_c * f * k), d_gates

    (d_hidden, d_cell), d_gates = jax.lax.scan(
        step, (d_last_h, d_last_c), (d_outputs, keep, c_before, activated), reverse=True
    )
    d_recurrent = jnp.einsum("tbh,tbg->hg", h_before, d_gates)
    return d_gates, d_recurrent, d_hidden, d_cell, jnp.zeros_like(keep)  # keep is data: no gradient


_recurrence.defvjp(_recurrence_forward, _recurrence_backward)
