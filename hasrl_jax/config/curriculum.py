"""A curriculum: settings that change when a run has collected so many environment steps.

Each entry of `Config.stages` reads "STEPS FIELD=VALUE FIELD=VALUE ...", with values written as in YAML and without
spaces: "2e6 cassie.command.forward_m_s=[-0.3,1.0] cassie.randomize.enabled=true". What a stage sets stays set.
"""

from typing import Any, NamedTuple

import yaml

from hasrl_jax.config import limits as config_checks
from hasrl_jax.config.schema import Config, from_dict
from hasrl_jax.errors import ConfigError

CHANGEABLE = ("cassie", "ppo", "evaluate")  # the parts of the configuration that a stage may change


class Stage(NamedTuple):
    """A part of a run under one configuration."""

    config: Config
    until_env_steps: int  # it ends when the run has collected so many


def stages(config: Config) -> list[Stage]:
    """The whole run in order; a single stage when `config.stages` is empty.

    A stage whose end is not after the end of another before it has nothing left to do.

    Raises:
      ConfigError: an entry that cannot be read, is out of order, or leads to impossible settings; names the entry.
    """
    found: list[Stage] = []
    begin, current = 0, config
    for index, text in enumerate(config.stages):
        name = f"stages[{index}]"
        at, changes = _parse(text, name)
        if at <= begin and found:
            raise ConfigError(f"{name}: begins at {at} environment steps; expected more than {begin}")
        found.append(Stage(current, min(at, config.total_env_steps)))
        begin, current = at, _apply(changes, current, name)
    return [*found, Stage(current, config.total_env_steps)]


def _parse(text: str, name: str) -> tuple[int, list[tuple[str, Any]]]:
    """The environment steps and the (dotted field, value) pairs of an entry."""
    try:
        first, *settings = text.split()
        at = int(float(first))
        pairs = [(field, yaml.safe_load(value)) for field, _, value in (setting.partition("=") for setting in settings)]
    except (ValueError, OverflowError, yaml.YAMLError):
        at, pairs = -1, []
    if at < 0 or not pairs or any(value is None for _, value in pairs):
        example = '"STEPS FIELD=VALUE ...", as in "2e6 cassie.push.force_n=[0,100]"'
        raise ConfigError(f"{name}: got {text!r}; expected {example}")
    return at, pairs


def _apply(changes: list[tuple[str, Any]], config: Config, name: str) -> Config:
    """`config` with some fields replaced, and checked."""
    for field, value in changes:
        parts = field.split(".")
        if parts[0] not in CHANGEABLE:
            raise ConfigError(f"{name}: {field} cannot change during a run; {', '.join(CHANGEABLE)} settings can")
        for part in reversed(parts):
            value = {part: value}
        try:
            config = from_dict(value, config)
        except ConfigError as error:
            raise ConfigError(f"{name}: {error}") from None
    try:
        config_checks.check(config)
    except ConfigError as error:
        raise ConfigError(f"{name}: {error}") from None
    return config
