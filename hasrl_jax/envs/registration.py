"""Makes the tasks known to gymnasium; importing `hasrl_jax` is enough."""

import gymnasium

ENVIRONMENTS = {"hasrl_jax/Cassie-v0": "cassie", "hasrl_jax/CartpoleHiddenVelocity-v0": "cartpole"}  # id -> task


def register() -> None:
    """Registers every environment with gymnasium; doing so again changes nothing."""
    for name, task in ENVIRONMENTS.items():
        if name not in gymnasium.registry:
            gymnasium.register(
                name,
                entry_point="hasrl_jax.envs.gymnasium:make",
                vector_entry_point="hasrl_jax.envs.vector:make",
                kwargs={"task": task},
            )
