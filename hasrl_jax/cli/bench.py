"""The command line of the benchmarks: runs one by name, prints its tables, writes its figures as JSON."""

import argparse
import importlib
import json
import logging
import os
import sys
from pathlib import Path
from typing import Protocol

from hasrl_jax.bench.documents import refresh
from hasrl_jax.bench.report import claim_file, describe_machine
from hasrl_jax.cli.options import OneLineParser
from hasrl_jax.cli.parsing import run as run_command

# name -> (module with the functions of `Bench`, one line for --help); modules load only when they are run
BENCHES = {
    "collector": ("hasrl_jax.bench.collector", "env steps/s of the CPU pool, and its share of the physics limit"),
    "scaling": ("hasrl_jax.bench.scaling", "env steps/s by number of workers, and what each worker costs"),
    "physics": ("hasrl_jax.bench.physics", "where the time of a physics step goes, and other ways to step"),
    "learner": ("hasrl_jax.bench.learner", "seconds per PPO update, compile time and recompiles"),
    "compare": ("hasrl_jax.bench.compare", "ours against stable-baselines3 and a torch PPO on gymnasium"),
    "mjx": ("hasrl_jax.bench.mjx", "physics and environment steps/s of MJX by number of environments"),
    "parity": ("hasrl_jax.bench.parity", "how closely MJX follows C MuJoCo: observations, rewards, terminations"),
    "walking": ("hasrl_jax.bench.walking", "seconds to walking by schedule, learner and workers on cores of their own"),
    "schedules": ("hasrl_jax.bench.schedules", "learning curves by schedule, and what each hides of an iteration"),
}


class Bench(Protocol):
    """What a benchmark module provides."""

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        """Declares its options."""
        ...

    def measure(self, arguments: argparse.Namespace) -> dict:
        """Runs, and returns figures that JSON can hold; their names carry their units.

        The first to touch JAX, so it can make settings that must come before.
        """
        ...

    def tables(self, figures: dict) -> str:
        """The figures as text."""
        ...


def main(argv: list[str] | None = None) -> int:
    """Runs the benchmark that the arguments name; returns the exit status."""
    argv = sys.argv[1:] if argv is None else argv
    logging.basicConfig(format="%(message)s", level=logging.WARNING)
    parser = OneLineParser(prog="python -m hasrl_jax.bench", description=__doc__)
    subparsers = parser.add_subparsers(dest="name", required=True, metavar="NAME")
    for name, (module, summary) in BENCHES.items():
        subparser = subparsers.add_parser(name, help=summary, description=summary)
        subparser.add_argument("--json", type=Path, default=None, metavar="FILE", help="where to write the figures")
        if name in argv[:1]:
            importlib.import_module(module).add_arguments(subparser)
    documents = "write the tables of docs/*.md anew from benchmarks/results/*.json"
    subparsers.add_parser("docs", help=documents, description=documents)
    arguments = parser.parse_args(argv)
    if arguments.name == "docs":
        return run_command(write_documents)
    return run_command(lambda: run(arguments, " ".join(["python -m hasrl_jax.bench", *argv])))


def write_documents() -> None:
    """`bench docs`, in the checkout that is the working directory."""
    for path in refresh(Path("docs"), Path("benchmarks/results")):
        print(f"{path}: tables written anew")


def run(arguments: argparse.Namespace, command: str) -> None:
    """Measures, prints and writes. `command`: what was typed, for the report."""
    bench: Bench = importlib.import_module(BENCHES[arguments.name][0])  # type: ignore[assignment]
    if arguments.json:
        claim_file(arguments.json)
    load_average = os.getloadavg()[0]  # tells whether the machine was busy with other work
    figures = bench.measure(arguments)
    machine = describe_machine() | {"load_average": load_average}
    print(bench.tables(figures))
    print(f"\n{machine['cores']} cores ({machine['cpu']}), load {machine['load_average']:.1f} at the start")
    print(f"JAX device: {machine['device']}")
    if arguments.json:
        report = {"bench": arguments.name, "command": command, **machine, "figures": figures}
        arguments.json.write_text(json.dumps(report, indent=2) + "\n", encoding="utf-8")
        print(f"written to {arguments.json}")
