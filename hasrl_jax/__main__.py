"""Entry point of `python -m hasrl_jax PROGRAM`."""

import sys

from hasrl_jax.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
