"""The task definitions, written once for NumPy and JAX, and the physics engines that run them."""
