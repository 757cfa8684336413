"""What there is to know of the cart-pole before it is made."""

from hasrl_jax.config.files import CONFIG_FOLDER
from hasrl_jax.config.tasks import TaskSpec
from hasrl_jax.envs.cartpole.task import make

SPEC = TaskSpec(name="cartpole", make=make, recipe=CONFIG_FOLDER / "cartpole.yaml")
