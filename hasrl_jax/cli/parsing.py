"""What the command lines share: dotted overrides of any config field, the checks, and errors on one line."""

import argparse
import contextlib
import dataclasses
import difflib
import io
import itertools
import logging
import os
import re
import sys
import typing
from collections.abc import Callable, Iterable, Iterator
from typing import Annotated, Any

import tyro

from hasrl_jax.cli.options import OneLineParser, one_of
from hasrl_jax.config import curriculum, strict_yaml, tasks
from hasrl_jax.config.checks import check
from hasrl_jax.config.convert import from_dict, to_dict
from hasrl_jax.config.describe import descriptions
from hasrl_jax.config.schema import Config
from hasrl_jax.envs.registry import Robot, make_task
from hasrl_jax.envs.task import Command
from hasrl_jax.errors import ConfigError, HasrlError
from hasrl_jax.policy.loading import load_policy_parameters, under_reference_physics
from hasrl_jax.policy.numpy_networks import Parameters

PYTHONS_WORDS = re.compile(r"(?P<kind>could not convert|invalid literal)[^:]*: (?P<value>'.*')")
TYROS_WORDS = {  # and ours
    r"Missing value for argument '(.*)'\. Expected 1 values?\.": r"\1: missing; expected a value",
    r"Missing value for argument '(.*)'\. Expected (.* values)\.": r"\1: missing; expected \2",
    r"Unrecognized options: (.*)": r"got \1, which no option takes",
    r"Error parsing (.*)": r"\1",
}
TYROS_CHOICE = re.compile(r"invalid choice ('.*') for argument '(.*)'\. Expected one of \((.*)\)\.")
NUMBERS = {"could not convert": "a number", "invalid literal": "a whole number"}
SHORTHAND = {"--num-workers": "--collect.num-workers", "--ray-address": "--ray.address"}


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
    config = from_dict(values)  # as strict as YAML: only finite numbers
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


def to_play(trained: Config, physics: str, overrides: list[str], program: str) -> Config:
    """The configuration under which a policy is played.

    Args:
      trained: what it was trained with.
      physics: "paper", the one its task is judged under, or "training".
      overrides: options for the physics and the task's settings, which come last.
      program: for messages.

    Raises:
      ConfigError: an override that cannot work, or of what a trained policy fixes.
    """
    config = tasks.find(trained.task).played(trained)
    if physics != "training":
        config = under_reference_physics(config)
    return override_for_policy(config, overrides, program)


def policy_to_play(known: argparse.Namespace, overrides: list[str], program: str) -> tuple[Config, Parameters]:
    """The policy that `options.add_policy_options` names, as `to_play` has it: (configuration, parameters).

    Raises:
      ConfigError: an impossible option; RunError, CheckpointError: no policy.
    """
    trained, parameters = load_policy_parameters(known.run_dir, known.policy)
    return to_play(trained, known.physics, overrides, program), parameters


def trained_commands(config: Config) -> tuple[Command, ...]:
    """The commands of a policy's training, each with the widest range that any of its stages drew from."""
    stages = zip(*(make_task(part).commands for part in curriculum.resolve(config)), strict=True)
    drawn = [(min(c.drawn[0] for c in command), max(c.drawn[1] for c in command), command[0]) for command in stages]
    return tuple(command._replace(drawn=(low, high)) for low, high, command in drawn)


def refuse_untrained(name: str, asked: Iterable[float], commands: tuple[Command, ...], force: bool) -> None:
    """Refuses to command what a policy was not trained for, unless it is forced.

    Args:
      name: of a command, as in `Command.name`; one that is not among `commands` is left to others.
      asked: values of it.
      commands: as `trained_commands` returns them.
      force: whether it is.

    Raises:
      ConfigError: a value outside of what was drawn, the usual one excepted.
    """
    for command in commands:
        low, high = command.drawn
        for value in asked:
            if command.name == name and not force and value != command.default and not low <= value <= high:
                raise ConfigError(
                    f"--{name.replace('_', '-')}: got {value:g}; the policy was trained for {low:g} to {high:g} "
                    f"{command.unit}, and --force commands it all the same"
                )


def robot_of(known: argparse.Namespace) -> Robot | None:
    """The other model that `options.add_model_options` names.

    Raises:
      ConfigError: names without a model.
    """
    if known.mapping and not known.model:
        raise ConfigError("--mapping: names of a --model; give that too")
    return Robot(known.model, known.mapping) if known.model else None


def run(job: Callable[[], None]) -> int:
    """Runs a command; expected errors become one line on stderr and an exit status, see `errors.py`."""
    try:
        job()
    except HasrlError as error:
        return _complain(f"error: {error}", error.exit_status)
    except OSError as error:
        return _complain(f"error: {error}", 1)
    except MemoryError as error:
        return _complain(f"error: out of memory ({error or 'no detail'})", 1)
    except KeyboardInterrupt:
        return _complain("interrupted", 130)
    finally:
        _leave_streams_writable()
    return 0


def _complain(text: str, status: int) -> int:
    with contextlib.suppress(OSError, ValueError):  # nobody is there to read it
        print(text, file=sys.stderr)
    return status


def _leave_streams_writable() -> None:
    """What is still to be written when Python ends must not fail on a pipe or terminal that is gone."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        try:
            if stream is not None:
                stream.flush()
        except (OSError, ValueError):
            with contextlib.suppress(OSError, ValueError):
                os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def log_to_terminal() -> None:
    """Shows the program's own messages, and nobody else's, as plain lines on stderr."""
    logging.raiseExceptions = False  # a terminal that is gone is no reason for a traceback
    logger = logging.getLogger("hasrl_jax")
    logger.setLevel(logging.INFO)
    logger.propagate = False
    others = [handler for handler in logger.handlers if type(handler) is not logging.StreamHandler]
    logger.handlers = [*others, logging.StreamHandler()]  # sys.stderr may be another one by now


def option_name(argument: str) -> str:
    """The name of an option, as it is documented: without a value, with hyphens."""
    return argument.partition("=")[0].replace("_", "-")


def _expand(argument: str) -> str:
    name, equals, value = argument.partition("=")
    return SHORTHAND.get(option_name(argument), name) + equals + value


def options_of_fields(settings: dict[str, Any], prefix: str = "--") -> Iterator[str]:
    """The option of every config field."""
    for name, value in settings.items():
        option = prefix + name.replace("_", "-")
        if isinstance(value, dict):
            yield from options_of_fields(value, option + ".")
        else:
            yield option


def _refuse_unknown_options(arguments: list[str], base: Config) -> None:
    known = [*options_of_fields(to_dict(base)), "--config", "--resume", "--init-policy"]
    for argument in arguments:
        option = option_name(argument)
        if option.startswith("--") and option not in {*known, "--help"}:
            inside = [field for field in known if f".{option[2:]}" in field]  # its end alone, --forward
            closest = difflib.get_close_matches(option, known, n=1) or inside
            hint = f"did you mean {closest[0]}?" if closest else "see --help"
            raise ConfigError(f"{argument.partition('=')[0]}: unknown option; {hint}")


def _one_line(complaint: str) -> str:
    """The text of tyro's framed complaint, without its frame, its title and the help below it."""
    plain = re.sub(r"\x1b\[[0-9;]*m", "", complaint)
    lines = [line.strip(" │╭╮╰╯─") for line in plain.splitlines()][1:]
    blocks = itertools.groupby(lines, lambda line: bool(line.strip("-")))  # rules separate them
    first = next((" ".join(block) for has_text, block in blocks if has_text), "") or " ".join(plain.split())
    for theirs, ours in TYROS_WORDS.items():
        first = re.sub(f"^{theirs}$", ours, first)
    first = TYROS_CHOICE.sub(lambda found: one_of(found[2], found[1], found[3]), first)
    return PYTHONS_WORDS.sub(lambda found: f"got {found['value']}; expected {NUMBERS[found['kind']]}", first)
