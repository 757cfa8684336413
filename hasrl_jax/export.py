"""Entry point of `python -m hasrl_jax.export`."""

import sys

from hasrl_jax.cli.export import main

if __name__ == "__main__":
    sys.exit(main())
