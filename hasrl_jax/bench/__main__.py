"""Entry point of `python -m hasrl_jax.bench`."""

import sys

from hasrl_jax.cli.bench import main

if __name__ == "__main__":
    sys.exit(main())
