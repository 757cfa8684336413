"""Entry point of `python -m hasrl_jax.figures`."""

import sys

from hasrl_jax.cli.figures import main

if __name__ == "__main__":
    sys.exit(main())
