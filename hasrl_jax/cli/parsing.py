"""Command lines: a YAML file, then dotted overrides of any config field, then the checks."""

import contextlib
import dataclasses
import difflib
import io
import itertools
import logging
import re
import sys
import typing
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated, Any

import tyro

from hasrl_jax.cli.options import OneLineParser
from hasrl_jax.config import curriculum, strict_yaml
from hasrl_jax.config.checks import check
from hasrl_jax.config.convert import from_dict, to_dict
from hasrl_jax.config.describe import descriptions
from hasrl_jax.config.files import load_yaml, recipe
from hasrl_jax.config.schema import Config
from hasrl_jax.errors import ConfigError, HasrlError

SHORTHAND = {"--num-workers": "--collect.num-workers", "--ray-address": "--ray.address"}


def parse_train(arguments: list[str]) -> tuple[Config, bool, str | None]:
    """The configuration of a run, whether it continues one, and the policy that it starts from.

    `--config FILE` reads a YAML file, or one of `configs/` by name (default: the recipe of the task), `--resume DIR`
    the configuration of that run; `--init-policy SOURCE` names a policy file, a run directory or "released";
    everything else overrides single fields, `--ppo.clip 0.1`.

    Raises:
      ConfigError: an impossible value; RunError: `--resume` names no run.
    """
    from hasrl_jax.runs.directory import load_run_config

    parser = OneLineParser(prog="python -m hasrl_jax.train", add_help=False, allow_abbrev=False)
    parser.add_argument("--config", default=None, metavar="FILE")
    parser.add_argument("--resume", type=Path, default=None, metavar="DIR")
    parser.add_argument("--init-policy", default=None, metavar="SOURCE")
    parser.add_argument("--task", default=None)
    known, rest = parser.parse_known_args(arguments)
    for name in ("config", "init_policy", "task"):
        if getattr(known, name) == "":
            raise ConfigError(f"--{name.replace('_', '-')}: got an empty text; leave it out, or name one")
    if known.init_policy and known.resume:
        raise ConfigError("--init-policy and --resume: give one of them; a resumed run goes on with its own policy")
    if known.config and known.resume:
        raise ConfigError("--config and --resume: give one of them; a resumed run brings its own configuration")
    if known.resume and any(_option(argument) == "--run-dir" for argument in rest):
        raise ConfigError("--resume and --run-dir: give only --resume; a resumed run goes on in its own directory")
    if known.resume:
        base = load_run_config(known.resume)
        if known.task not in (None, base.task):
            raise ConfigError(f"--task: got {known.task}; {known.resume} is a run of task {base.task}")
    elif known.config:
        base = load_yaml(known.config)
    else:
        base = recipe(known.task or Config().task)
    if known.task:
        base = from_dict({"task": known.task}, base)
    config = override(base, rest, "train")
    curriculum.resolve(config)  # refuses stages that cannot work
    if known.resume:
        config = from_dict({"run_dir": str(known.resume)}, config)
    return config, known.resume is not None, known.init_policy


def override(base: Config, arguments: list[str], program: str) -> Config:
    """`base` with the fields that the arguments name replaced, and checked.

    `--stages` takes YAML, "[{at_env_steps: 2e6, set: {ppo.clip: 0.1}}]"; "[]" is a run without stages.

    Raises:
      ConfigError: an unknown option or an impossible value, on one line.
    """
    parser = OneLineParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--stages", default=None)
    stages, arguments = parser.parse_known_args(arguments)
    arguments = [_expand(argument) for argument in arguments]
    _refuse_unknown_options(arguments, base)
    complaint = io.StringIO()
    options = _options_of(base)
    try:
        with contextlib.redirect_stderr(complaint):
            given = tyro.cli(
                options,
                default=options(**{field.name: getattr(base, field.name) for field in dataclasses.fields(base)}),
                args=arguments,
                prog=f"python -m hasrl_jax.{program}",
                description="Train a policy. Also: --config FILE, --resume DIR, --task NAME, --num-workers N, "
                "--stages YAML, --init-policy (a policy file, a run directory or released).",
                config=(tyro.conf.FlagConversionOff,),
            )
    except SystemExit as stopped:
        if not stopped.code:  # --help
            raise
        raise ConfigError(_one_line(complaint.getvalue())) from None
    values = to_dict(given)
    if stages.stages is not None:
        try:
            values["stages"] = strict_yaml.parse(stages.stages)
        except ValueError as error:
            raise ConfigError(f"--stages: {error}") from None
    config: Config = from_dict(values)  # as strict as YAML: only finite numbers
    check(config)
    return config


def _options_of(base: Config) -> type[Config]:
    """The class of `base` as tyro reads it: every field with its description, and stages, which are data, left out."""
    hints, described = typing.get_type_hints(type(base), include_extras=True), descriptions(Config)
    fields: list[tuple[str, Any, Any]] = [("stages", tyro.conf.Suppress[tyro.conf.Fixed[tuple]], base.stages)]
    for name in (field.name for field in dataclasses.fields(Config)):
        value = getattr(base, name)
        if name != "stages" and not dataclasses.is_dataclass(value):
            fields.append((name, Annotated[hints[name], tyro.conf.arg(help=described[name])], value))
    return dataclasses.make_dataclass("Config", fields, bases=(type(base),), frozen=True)


def override_for_policy(trained: Config, arguments: list[str], program: str) -> Config:
    """As `override`, for playing a policy: what it was trained as stays.

    Raises:
      ConfigError: also for an override of anything but the physics and the task's own settings.
    """
    config = override(trained, arguments, program)
    changeable = ["physics", *([trained.section] if trained.section else [])]
    for name, value in to_dict(trained).items():
        if name not in changeable and to_dict(config)[name] != value:
            can = " and ".join(changeable)
            raise ConfigError(f"{name}: a trained policy fixes it; only {can} settings can be overridden")
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


def _refuse_unknown_options(arguments: list[str], base: Config) -> None:
    known = [*_options(to_dict(base)), "--config", "--resume", "--init-policy"]
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
