"""Writes the policy of a run to one file: `python -m hasrl_jax.export --run-dir DIR --out FILE.npz`."""

import argparse
import sys
from pathlib import Path

from hasrl_jax import checkpoint, cli, config, policies


def export(arguments: list[str]) -> None:
    """The command: the newest whole checkpoint's parameters with their configuration, hashed, without pickle."""
    parser = argparse.ArgumentParser(prog="python -m hasrl_jax.export", description=export.__doc__, allow_abbrev=False)
    parser.add_argument("--run-dir", type=Path, required=True, help="a run directory")
    parser.add_argument("--out", type=Path, required=True, help="the file to write, .npz")
    known = parser.parse_args(arguments)
    settings, parameters = policies.load_policy_parameters(known.run_dir, None)
    settings = config.from_dict({"run_dir": ""}, settings)  # where it was trained is nobody's business
    checkpoint.save_policy(known.out, parameters, policies.policy_metadata(settings))
    print(f"{known.out}: {known.out.stat().st_size / 1000:.0f} kB")


def main(argv: list[str] | None = None) -> int:
    """The command line; returns the exit status."""
    cli.log_to_terminal()
    return cli.run(lambda: export(sys.argv[1:] if argv is None else argv))


if __name__ == "__main__":
    sys.exit(main())
