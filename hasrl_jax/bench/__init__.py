"""Timed figures: `python -m hasrl_jax.bench NAME --json FILE`. A new benchmark is a module and a line in `__main__`."""
