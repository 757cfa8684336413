"""Entry point of `python -m hasrl_jax.render`."""

import sys

from hasrl_jax.cli.render import main

if __name__ == "__main__":
    sys.exit(main())
