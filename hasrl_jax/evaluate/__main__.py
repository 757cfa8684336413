"""Entry point of `python -m hasrl_jax.evaluate`."""

import sys

from hasrl_jax.cli.evaluate import main

if __name__ == "__main__":
    sys.exit(main())
