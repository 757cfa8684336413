"""Entry point of `python -m hasrl_jax.gaits`."""

import sys

from hasrl_jax.cli.main import start

if __name__ == "__main__":
    sys.exit(start("gaits"))
