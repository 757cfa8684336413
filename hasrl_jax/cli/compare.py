"""`hasrl compare`: curves, differing settings and scorecards of several runs side by side, as one HTML page."""

import sys
from pathlib import Path

from hasrl_jax.cli.options import OneLineParser, require_writable
from hasrl_jax.cli.parsing import log_to_terminal, run
from hasrl_jax.errors import ConfigError
from hasrl_jax.evaluate.palette import COLORS
from hasrl_jax.visualize import comparison


def compare(arguments: list[str]) -> None:
    """The command.

    Raises:
      ConfigError: an impossible argument; RunError: a run that cannot be read.
    """
    parser = OneLineParser(prog="hasrl compare", description=__doc__, allow_abbrev=False)
    parser.add_argument("runs", type=Path, nargs="+", help="run directories")
    parser.add_argument("--out", type=Path, default=Path("comparison.html"), help="the page")
    known = parser.parse_args(arguments)
    if len(known.runs) > len(COLORS):
        raise ConfigError(f"runs: got {len(known.runs)}; expected at most {len(COLORS)}, one for each color")
    require_writable("--out", known.out, ".html")
    known.out.write_text(comparison.page([comparison.load(path) for path in known.runs]), encoding="utf-8")
    print(f"{known.out}: {', '.join(map(str, known.runs))}")


def main(argv: list[str] | None = None) -> int:
    """Entry point; returns the exit status."""
    log_to_terminal()
    return run(lambda: compare(sys.argv[1:] if argv is None else argv))
