"""`hasrl figures`: figures of training runs on disk."""

import argparse
import sys
from pathlib import Path

from hasrl_jax.cli.options import OneLineParser, require_writable
from hasrl_jax.cli.parsing import log_to_terminal, run
from hasrl_jax.errors import ConfigError
from hasrl_jax.evaluate.palette import COLORS
from hasrl_jax.runs.directory import load_run_config
from hasrl_jax.visualize import curves

DPI = 110


def draw(arguments: list[str]) -> None:
    """The command.

    Raises:
      ConfigError: an impossible argument; RunError: a run that cannot be read.
    """
    parser = OneLineParser(
        prog="python -m hasrl_jax.figures",
        description=curves.__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.add_argument("name", choices=tuple(curves.FIGURES))
    parser.add_argument("--run-dir", type=Path, nargs="+", required=True, help="run directories; fig3 takes one")
    parser.add_argument("--labels", nargs="+", help="a name for each run; default: the settings that differ")
    parser.add_argument("--out", type=Path, help="the PNG; default: NAME.png")
    known = parser.parse_args(arguments)
    out = known.out or Path(f"{known.name}.png")
    if known.name == "fig3" and len(known.run_dir) > 1:
        raise ConfigError(f"--run-dir: got {len(known.run_dir)} runs; fig3 shows one")
    if len(known.run_dir) > len(COLORS):
        raise ConfigError(f"--run-dir: got {len(known.run_dir)} runs; expected at most {len(COLORS)}")
    if known.labels and len(known.labels) != len(known.run_dir):
        raise ConfigError(f"--labels: got {len(known.labels)}; expected one for each of {len(known.run_dir)} runs")
    require_writable("--out", out, ".png")
    names = known.labels or curves.differences([load_run_config(run_dir) for run_dir in known.run_dir])
    curves.FIGURES[known.name]([curves.read_metrics(run_dir) for run_dir in known.run_dir], names).savefig(out, dpi=DPI)
    print(f"{out}: {known.name} of {', '.join(map(str, known.run_dir))}")


def main(argv: list[str] | None = None) -> int:
    """Entry point; returns the exit status."""
    log_to_terminal()
    return run(lambda: draw(sys.argv[1:] if argv is None else argv))
