"""Entry point of `python -m hasrl_jax.viewer`."""

import sys

from hasrl_jax.cli.viewer import main

if __name__ == "__main__":
    sys.exit(main())
