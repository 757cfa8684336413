"""Entry point of `python -m hasrl_jax.viewer`."""

import sys

from hasrl_jax.visualize.viewer.__main__ import main

if __name__ == "__main__":
    sys.exit(main())
