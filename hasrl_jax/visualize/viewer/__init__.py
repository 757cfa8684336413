"""Watches a policy walk and commands it: `python -m hasrl_jax.viewer`."""
