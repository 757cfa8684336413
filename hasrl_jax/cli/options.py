"""Command-line arguments of the programs: complaints on one line, and outputs checked before the work."""

import argparse
import re
import tempfile
from pathlib import Path
from typing import NoReturn

from hasrl_jax.errors import ConfigError

KINDS = {"int": "a whole number", "float": "a number"}


class OneLineParser(argparse.ArgumentParser):
    """An argument parser whose complaint is one line on stderr, in our words and without the usage; exit status 2."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"error: {_in_our_words(message.removeprefix('argument '))}\n")


def _in_our_words(message: str) -> str:
    """A complaint of argparse as ours are: what was given, and what is expected instead."""
    number = re.fullmatch(r"(.*): invalid (int|float) value: (.*)", message, re.DOTALL)
    if number:
        return f"{number[1]}: got {number[3]}; expected {KINDS[number[2]]}"
    choice = re.fullmatch(r"(.*): invalid choice: (.*) \(choose from (.*)\)", message, re.DOTALL)
    if choice:
        return one_of(choice[1], choice[2], choice[3])
    return re.sub(r": expected (one|at least one) argument$", ": missing; expected a value", message)


def one_of(option: str, value: str, choices: str) -> str:
    """A complaint about a value that is none of the choices, which argparse and tyro may have quoted."""
    return f"{option}: got {value}; expected one of " + choices.replace("'", "")


def add_policy_options(parser: argparse.ArgumentParser) -> None:
    """The options of every program that plays a policy, see `policies.load_policy_parameters`."""
    parser.add_argument("--run-dir", type=Path, help="a run directory; its newest checkpoint is played")
    parser.add_argument(
        "--policy", help="a policy file (.npz), released (the default), released-steer, -fast, -stairs or -imitate"
    )
    parser.add_argument(
        "--physics", choices=("paper", "training"), default="paper", help="2 kHz (Cassie), or as trained"
    )
    parser.add_argument("--seed", type=int, default=0)


def add_model_options(parser: argparse.ArgumentParser) -> None:
    """The options of the programs that can play on another model of a robot, see `parsing.robot_of`."""
    parser.add_argument(
        "--model", type=Path, help="play on this MJCF file of the same robot, or on menagerie, see docs/deploy.md"
    )
    parser.add_argument("--mapping", type=Path, help="YAML file of the names that differ in --model")


def add_force_option(parser: argparse.ArgumentParser) -> None:
    """The option of the programs that `parsing.refuse_untrained` guards."""
    parser.add_argument("--force", action="store_true", help="command what the policy was not trained for, too")


def require_writable(option: str, path: Path, suffix: str = "") -> None:
    """Proves that the file can be written, and leaves it as it is.

    Raises:
      ConfigError: that is a folder, the name has not the `suffix`, its folder does not exist or cannot be written to.
    """
    if path.is_dir():
        raise ConfigError(f"{option}: got {path}, a folder; expected a file, {path / f'NAME{suffix}'}")
    if suffix and path.suffix.lower() != suffix:
        raise ConfigError(f"{option}: got {path}; expected a name that ends in {suffix}")
    if not path.parent.is_dir():
        raise ConfigError(f"{option}: got {path}; expected a file in a folder that exists, and {path.parent} does not")
    try:
        if path.exists():
            with open(path, "ab"):
                pass
        else:
            with tempfile.TemporaryFile(dir=path.parent):
                pass
    except OSError as error:
        raise ConfigError(f"{option}: {path} cannot be written ({error.strerror})") from None
