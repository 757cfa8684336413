"""Entry point of `python -m hasrl_jax.pictures`."""

import sys

from hasrl_jax.cli.pictures import main

if __name__ == "__main__":
    sys.exit(main())
