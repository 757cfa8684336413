"""hasrl_jax: heterogeneous asynchronous reinforcement learning for bipedal robots."""

__version__ = "0.1.0"

from hasrl_jax.envs.registration import register_when_imported

register_when_imported()
