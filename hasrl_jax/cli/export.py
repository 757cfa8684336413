"""Writes the policy of a run to one file: `python -m hasrl_jax.export --run-dir DIR --out FILE.npz`."""

import sys
from pathlib import Path

from hasrl_jax.cli import parsing as cli
from hasrl_jax.cli.options import OneLineParser, require_writable
from hasrl_jax.config.convert import from_dict
from hasrl_jax.policy import loading as policies
from hasrl_jax.runs import checkpoint


def export(arguments: list[str]) -> None:
    """The command: the newest whole checkpoint's parameters with their configuration, hashed, without pickle."""
    parser = OneLineParser(
        prog="python -m hasrl_jax.export",
        description="Write a policy to one file. Physics and cassie settings that differ from the training's, and that "
        "whoever plays the file then starts from, can be given: --cassie.randomize.enabled False",
        allow_abbrev=False,
    )
    parser.add_argument("--run-dir", type=Path, required=True, help="a run directory")
    parser.add_argument("--out", type=Path, required=True, help="the file to write, .npz")
    known, rest = parser.parse_known_args(arguments)
    require_writable("--out", known.out, ".npz")
    settings, parameters = policies.load_policy_parameters(known.run_dir, None)
    # Where it was trained is nobody's business, and its curriculum is over.
    settings = cli.override_for_policy(from_dict({"run_dir": "", "stages": []}, settings), rest, "export")
    checkpoint.save_policy(known.out, parameters, policies.policy_metadata(settings))
    print(f"{known.out}: {known.out.stat().st_size / 1000:.0f} kB")


def main(argv: list[str] | None = None) -> int:
    """The command line; returns the exit status."""
    cli.log_to_terminal()
    return cli.run(lambda: export(sys.argv[1:] if argv is None else argv))


if __name__ == "__main__":
    sys.exit(main())
