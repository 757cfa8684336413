"""What a policy can do, in figures: `python -m hasrl_jax.evaluate`."""
