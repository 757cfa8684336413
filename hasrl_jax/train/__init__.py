"""The training loop: `python -m hasrl_jax.train`."""
