"""hasrl_jax: heterogeneous asynchronous reinforcement learning for bipedal robots."""

from hasrl_jax.envs.registration import register

__version__ = "0.2.0"

register()
