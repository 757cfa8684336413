"""Command lines: a YAML file, then dotted overrides of any config field, then the checks."""

import contextlib
import difflib
import io
import itertools
import logging
import re
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import tyro

from hasrl_jax.cli.options import OneLineParser
from hasrl_jax.config import curriculum
from hasrl_jax.config import limits as config_checks
from hasrl_jax.config import schema as config_module
from hasrl_jax.config.schema import Config
from hasrl_jax.errors import ConfigError, HasrlError

SHORTHAND = {"--num-workers": "--collect.num-workers", "--ray-address": "--ray.address"}
OVERRIDABLE_FOR_A_POLICY = ("physics", "cassie")  # what can differ from the training of a policy that is played


def parse_train(arguments: list[str]) -> tuple[Config, bool, str | None]:
    """The configuration of a run, whether it continues one, and the policy that it starts from.

    `--config FILE` reads a YAML file (default: configs/cassie_walk.yaml), `--resume DIR` the configuration of that
    run; `--init-policy SOURCE` names a policy file, a run directory or "released"; everything else overrides single
    fields, `--ppo.clip 0.1`.

    Raises:
      ConfigError: an impossible value; RunError: `--resume` names no run.
    """
    from hasrl_jax.runs.directory import load_run_config

    parser = OneLineParser(prog="python -m hasrl_jax.train", add_help=False, allow_abbrev=False)
    parser.add_argument("--config", type=Path, default=None, metavar="FILE")
    parser.add_argument("--resume", type=Path, default=None, metavar="DIR")
    parser.add_argument("--init-policy", default=None, metavar="SOURCE")
    known, rest = parser.parse_known_args(arguments)
    if known.init_policy and known.resume:
        raise ConfigError("--init-policy and --resume: give one of them; a resumed run goes on with its own policy")
    if known.config and known.resume:
        raise ConfigError("--config and --resume: give one of them; a resumed run brings its own configuration")
    if known.resume and any(_option(argument) == "--run-dir" for argument in rest):
        raise ConfigError("--resume and --run-dir: give only --resume; a resumed run goes on in its own directory")
    base = (
        load_run_config(known.resume)
        if known.resume
        else config_module.load_yaml(known.config or config_module.DEFAULT_CONFIG)
    )
    config = override(base, rest, "train")
    curriculum.stages(config)  # refuses stages that cannot work
    if known.resume:
        config = config_module.from_dict({"run_dir": str(known.resume)}, config)
    return config, known.resume is not None, known.init_policy


def override(base: Config, arguments: list[str], program: str) -> Config:
    """`base` with the fields that the arguments name replaced, and checked.

    Raises:
      ConfigError: an unknown option or an impossible value, on one line.
    """
    arguments = [_expand(argument) for argument in arguments]
    _refuse_unknown_options(arguments)
    complaint = io.StringIO()
    try:
        with contextlib.redirect_stderr(complaint):
            config = tyro.cli(
                Config,
                default=base,
                args=arguments,
                prog=f"python -m hasrl_jax.{program}",
                description="Train a policy. Also: --config FILE, --resume DIR, --num-workers N, "
                "--init-policy (a policy file, a run directory or released).",
                config=(tyro.conf.FlagConversionOff,),
            )
    except SystemExit as stopped:
        if not stopped.code:  # --help
            raise
        raise ConfigError(_one_line(complaint.getvalue())) from None
    config = config_module.from_dict(config_module.to_dict(config))  # as strict as YAML: only finite numbers
    config_checks.check(config)
    return config


def override_for_policy(trained: Config, arguments: list[str], program: str) -> Config:
    """As `override`, for playing a policy: what it was trained as stays.

    Raises:
      ConfigError: also for an override of anything but the physics and the walking task's settings.
    """
    config = override(trained, arguments, program)
    for name, value in config_module.to_dict(trained).items():
        if name not in OVERRIDABLE_FOR_A_POLICY and config_module.to_dict(config)[name] != value:
            raise ConfigError(f"{name}: a trained policy fixes it; only physics and cassie settings can be overridden")
    return config


def run(job: Callable[[], None]) -> int:
    """Runs a command; expected errors become one line on stderr and an exit status, see `errors.py`."""
    try:
        job()
    except HasrlError as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_status
    except OSError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    except MemoryError as error:
        print(f"error: out of memory ({error or 'no detail'})", file=sys.stderr)
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


def _option(argument: str) -> str:
    """The name of an option, as it is documented: without a value, with hyphens."""
    return argument.partition("=")[0].replace("_", "-")


def _expand(argument: str) -> str:
    name, equals, value = argument.partition("=")
    return SHORTHAND.get(_option(argument), name) + equals + value


def _options(settings: dict[str, Any], prefix: str = "--") -> Iterator[str]:
    """The option of every config field."""
    for name, value in settings.items():
        option = prefix + name.replace("_", "-")
        if isinstance(value, dict):
            yield from _options(value, option + ".")
        else:
            yield option


def _refuse_unknown_options(arguments: list[str]) -> None:
    known = list(_options(config_module.to_dict(Config())))
    for argument in arguments:
        option = _option(argument)
        if option.startswith("--") and option not in {*known, "--help"}:
            closest = difflib.get_close_matches(option, known, n=1)
            hint = f"did you mean {closest[0]}?" if closest else "see --help"
            raise ConfigError(f"{argument.partition('=')[0]}: unknown option; {hint}")


def _one_line(complaint: str) -> str:
    """The text of tyro's framed complaint, without its frame, its title and the help below it."""
    plain = re.sub(r"\x1b\[[0-9;]*m", "", complaint)
    lines = [line.strip(" │╭╮╰╯─") for line in plain.splitlines()][1:]
    blocks = itertools.groupby(lines, lambda line: bool(line.strip("-")))  # rules separate them
    first = next((" ".join(block) for has_text, block in blocks if has_text), "")
    return first or " ".join(plain.split())
