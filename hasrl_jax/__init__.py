"""hasrl_jax: heterogeneous asynchronous reinforcement learning for bipedal robots."""

__version__ = "0.1.0"
