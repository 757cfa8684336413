"""Entry point of `python -m hasrl_jax.train`."""

import sys

from hasrl_jax.cli.train import main

if __name__ == "__main__":
    sys.exit(main())
