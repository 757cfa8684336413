"""Entry point of `python -m hasrl_jax.doctor`."""

import sys

from hasrl_jax.cli.doctor import main

if __name__ == "__main__":
    sys.exit(main())
