"""The arrays that cross between collectors and the learner.

Legend of shapes, used in every docstring:

    N   transitions in a flat buffer          B   trajectories in a batch
    T   environment steps in a trajectory     E   environments in one worker
    O   observation size (50 for Cassie)      A   action size (10 for Cassie)
    L   LSTM layers (2)                       H   hidden width

All arrays are float32 unless stated. NamedTuples are used instead of flax.struct so that worker
processes, which never import JAX, share these definitions; JAX treats both as pytrees.
"""

from typing import Any, NamedTuple

import numpy as np

Array = Any  # numpy.ndarray or jax.Array: the definition code runs on both
Record = dict[str, float | int | None]  # metrics by name; None where there is nothing to measure


class Trajectory(NamedTuple):
    """A batch of trajectories, padded on the right; every array is [B, T] unless stated.

    Step t holds s_t, a_t, r_t and what was known when a_t was chosen. Episodes may begin inside a
    trajectory: `is_first` marks those steps and the LSTM carry is reset there.

    The value that follows step t, needed for returns, is
        0                    where `terminated` (the MDP ended at t),
        bootstrap_value[t]   where `truncated` (cut from outside at t: time limit or end of the buffer),
        value[t + 1]         elsewhere.
    The last valid step of a trajectory is always terminated or truncated.
    """

    observation: Array  # [B, T, O] raw (not normalised)
    action: Array  # [B, T, A] as sampled, before any clipping inside the environment
    log_prob: Array  # behaviour log-probability of `action`
    value: Array  # V(s_t) of the behaviour version
    reward: Array
    is_first: Array  # bool: the first step of an episode
    terminated: Array  # bool: the MDP ended after this step
    truncated: Array  # bool: cut from outside after this step
    bootstrap_value: Array  # V(s_{t+1}) of the true next observation where `truncated`, else 0
    mask: Array  # bool: False on padding and on steps of a diverged simulation
    initial_carry: Array  # [B, L, 2, H] LSTM (h, c) before step 0
    policy_version: Array  # [B] int32, version of the parameters that acted


# The arrays of a trajectory, wherever they lie: axes behind those of the batch (see the legend), and type.
STEP_FIELDS: dict[str, tuple[str, str]] = {  # one entry for every environment step
    "observation": ("O", "float32"),
    "action": ("A", "float32"),
    "log_prob": ("", "float32"),
    "value": ("", "float32"),
    "reward": ("", "float32"),
    "is_first": ("", "bool"),
    "terminated": ("", "bool"),
    "truncated": ("", "bool"),
    "bootstrap_value": ("", "float32"),
    "mask": ("", "bool"),
}
SEGMENT_FIELDS = ("initial_carry", "policy_version")  # one entry for every trajectory


class Mirror(NamedTuple):
    """The left-right mirror image of observations and actions as signed permutations: M x = sign * x[index]."""

    observation_index: np.ndarray  # [O] int
    observation_sign: np.ndarray  # [O] +1 or -1
    action_index: np.ndarray  # [A] int
    action_sign: np.ndarray  # [A] +1 or -1

    def observation(self, observation: Array) -> Array:
        """The mirrored observation, [..., O]."""
        return observation[..., self.observation_index] * self.observation_sign

    def action(self, action: Array) -> Array:
        """The mirrored action, [..., A]."""
        return action[..., self.action_index] * self.action_sign
