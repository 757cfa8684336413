"""Entry point of `python -m hasrl_jax.pictures`."""

import sys

from hasrl_jax.visualize.pictures.__main__ import main

if __name__ == "__main__":
    sys.exit(main())
