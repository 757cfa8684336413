"""Pictures of how a policy walks: `python -m hasrl_jax.pictures NAME`."""
