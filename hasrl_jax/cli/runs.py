"""`hasrl runs`: lists run directories, newest last."""

import sys
import time
from pathlib import Path

from rich.console import Console
from rich.table import Table

from hasrl_jax.cli.options import OneLineParser
from hasrl_jax.cli.parsing import log_to_terminal, run
from hasrl_jax.errors import RunError
from hasrl_jax.runs import overview

COLUMNS = ("run", "task", "state", "env steps", "of", "train return", "length", "hours", "last written")


def list_runs(arguments: list[str]) -> None:
    """The command.

    Raises:
      RunError: there is no such folder.
    """
    parser = OneLineParser(prog="hasrl runs", description=__doc__, allow_abbrev=False)
    parser.add_argument(
        "folders", type=Path, nargs="*", default=[Path("runs")], help="of runs, or runs; default: runs/"
    )
    known = parser.parse_args(arguments)
    table = Table(box=None, header_style="bold")
    for index, name in enumerate(COLUMNS):
        table.add_column(name, justify="right" if 3 <= index <= 7 else "left", no_wrap=True)
    runs, damaged = [], []
    for path in overview.find_runs(known.folders):
        try:
            runs.append(overview.read_run(path))
        except RunError as error:
            damaged.append(str(error))
    for one in sorted(runs, key=lambda one: one.changed_s):
        table.add_row(*_cells(one))
    console = Console(file=sys.stdout, width=None if sys.stdout.isatty() else 400, highlight=False)
    if runs:
        console.print(table)
    else:
        print(f"no runs in {', '.join(map(str, known.folders))}")
    for text in damaged:
        print(f"unreadable: {text}")


def _cells(one: overview.Run) -> tuple[str, ...]:
    def number(name: str, form: str, scale: float = 1.0) -> str:
        value = one.last.get(name)
        return "-" if value is None else format(value * scale, form)

    return (
        str(one.path),
        one.config.task,
        one.state,
        number("env_steps", ",.0f"),
        f"{one.config.total_env_steps:,}",
        number("episode_return_train", ".1f"),
        number("episode_length_train", ".0f"),
        number("train_seconds", ".1f", 1 / 3600),
        time.strftime("%Y-%m-%d %H:%M", time.localtime(one.changed_s)),
    )


def main(argv: list[str] | None = None) -> int:
    """Entry point; returns the exit status."""
    log_to_terminal()
    return run(lambda: list_runs(sys.argv[1:] if argv is None else argv))
