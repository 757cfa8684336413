"""From trajectories to minibatches."""

import jax


def minibatch_indices(key: jax.Array, num_rows: int, minibatch_rows: int) -> jax.Array:
    """A random partition of the rows of one epoch: [num_minibatches, minibatch_rows] int, each row exactly once.

    Raises:
      ValueError: `num_rows` is not a multiple of `minibatch_rows`.

    Source: paper III.B (random batch sampler). Differs from the paper's published code, which drops the last partial
    minibatch: here none is left over.
    """
    if num_rows % minibatch_rows:
        raise ValueError(
            f"ppo.minibatch_trajectories: {minibatch_rows} does not divide the {num_rows} trajectories of an iteration"
        )
    return jax.random.permutation(key, num_rows).reshape(-1, minibatch_rows)
