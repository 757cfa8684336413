"""Command lines: a YAML file, then dotted overrides of any config field, then the checks."""

import argparse
import logging
import sys
from collections.abc import Callable
from pathlib import Path

import tyro

from hasrl_jax import config as config_module
from hasrl_jax import config_checks
from hasrl_jax.collect.cpu_pool import WorkerError
from hasrl_jax.config import Config, ConfigError

SHORTHAND = {"--num-workers": "--collect.num-workers"}


def parse_train(arguments: list[str]) -> tuple[Config, bool]:
    """The configuration of a run, and whether it continues one.

    `--config FILE` reads a YAML file (default: configs/cassie_walk.yaml), `--resume DIR` the configuration of that
    run; everything else overrides single fields, `--ppo.clip 0.1`.

    Raises:
      ConfigError: an impossible value; RunError: `--resume` names no run.
    """
    from hasrl_jax.run_directory import load_run_config

    parser = argparse.ArgumentParser(prog="python -m hasrl_jax.train", add_help=False, allow_abbrev=False)
    parser.add_argument("--config", type=Path, default=None, metavar="FILE")
    parser.add_argument("--resume", type=Path, default=None, metavar="DIR")
    known, rest = parser.parse_known_args(arguments)
    if known.config and known.resume:
        raise ConfigError("--config and --resume: give one of them; a resumed run brings its own configuration")
    base = (
        load_run_config(known.resume)
        if known.resume
        else config_module.load_yaml(known.config or config_module.DEFAULT_CONFIG)
    )
    config = override(base, rest, "train")
    if known.resume:
        config = config_module.from_dict({"run_dir": str(known.resume)}, config)
    return config, known.resume is not None


def override(base: Config, arguments: list[str], program: str) -> Config:
    """`base` with the fields that the arguments name replaced, and checked."""
    arguments = [_expand(argument) for argument in arguments]
    config = tyro.cli(
        Config,
        default=base,
        args=arguments,
        prog=f"python -m hasrl_jax.{program}",
        description="Train a policy. Also: --config FILE, --resume DIR, --num-workers N.",
        config=(tyro.conf.FlagConversionOff,),
    )
    config_checks.check(config)
    return config


def run(job: Callable[[], None]) -> int:
    """Runs a command; expected errors become one line on stderr and exit status 1 (2 for a bad configuration)."""
    from hasrl_jax.checkpoint import CheckpointError
    from hasrl_jax.run_directory import RunError

    try:
        job()
    except ConfigError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except (RunError, CheckpointError, WorkerError, FloatingPointError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130
    return 0


def log_to_terminal() -> None:
    """Shows the program's own messages, and nobody else's, as plain lines on stderr."""
    logger = logging.getLogger("hasrl_jax")
    logger.setLevel(logging.INFO)
    logger.propagate = False
    if not logger.handlers:
        logger.addHandler(logging.StreamHandler())


def _expand(argument: str) -> str:
    name, equals, value = argument.partition("=")
    return SHORTHAND.get(name, name) + equals + value
