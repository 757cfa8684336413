"""Configurations as plain data and back; strict about names and types."""

import contextlib
import dataclasses
import math
import typing
from typing import Annotated, Any, Literal

from hasrl_jax.config.limits import named, shown
from hasrl_jax.config.schema import Config
from hasrl_jax.config.tasks import config_class
from hasrl_jax.errors import ConfigError

LAST = "checkpoint"  # the group that a written configuration ends with: it shows that a file is whole


def to_dict(settings: Any) -> dict[str, Any]:
    """A configuration, or a group of one, as plain dicts, lists and scalars, ready for YAML or JSON."""
    fields = sorted(dataclasses.fields(settings), key=lambda f: f.name == LAST)
    return {f.name: _plain(getattr(settings, f.name)) for f in fields}


def _plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value):
        return to_dict(value)
    if isinstance(value, dict):
        return {key: _plain(x) for key, x in value.items()}
    return [_plain(x) for x in value] if isinstance(value, tuple | list) else value


def from_dict(values: Any, base: Config | None = None, where: str = "config") -> Config:
    """`base` (default: that of the task that `values` name) with the fields named in `values` replaced.

    Where `values` name another task than `base` is for, its settings begin at their defaults.

    Raises:
      ConfigError: an unknown key or a value of another type; the message names the dotted path.
    """
    _require_mapping(values, where)
    config: Config = _replaced(_of_task(base, values.get("task"), where), values, where)
    return config


def _replaced(base: Any, values: Any, where: str) -> Any:
    """A configuration, or a group of one, with the fields named in `values` replaced."""
    _require_mapping(values, where)
    hints = typing.get_type_hints(type(base), include_extras=True)
    known = [f.name for f in dataclasses.fields(base)]
    changes = {}
    for key, value in values.items():
        path = f"{where}.{named(key)}"
        if key not in known:
            raise ConfigError(f"{path}: unknown field; known fields are {', '.join(known)}")
        current = getattr(base, key)
        is_group = dataclasses.is_dataclass(current)
        changes[key] = _replaced(current, value, path) if is_group else _convert(value, hints[key], path)
    return dataclasses.replace(base, **changes)


def _require_mapping(values: Any, where: str) -> None:
    if not isinstance(values, dict):
        raise ConfigError(f"{where}: expected a mapping of fields, got {shown(values)}")


def _of_task(base: Config | None, task: Any, where: str) -> Config:
    """`base`, or the defaults, with the group of settings of `task`."""
    if task is None:
        return base if base is not None else config_class(Config().task)()
    if not isinstance(task, str):
        raise ConfigError(f"{where}.task: got {shown(task)}; expected str")
    made_for = config_class(task)
    if base is None or type(base) is not made_for:
        shared = {f.name: getattr(base, f.name) for f in dataclasses.fields(Config)} if base is not None else {}
        return made_for(**shared | {"task": task})
    return base


def _convert(value: Any, hint: Any, path: str) -> Any:
    """`value` as the annotated type `hint`, or a ConfigError naming `path`."""
    if typing.get_origin(hint) is Annotated:
        hint = typing.get_args(hint)[0]
    origin, args = typing.get_origin(hint), typing.get_args(hint)
    if origin is Literal:
        if value in args and isinstance(value, str):
            return value
        raise ConfigError(f"{path}: got {shown(value)}; expected one of {', '.join(map(repr, args))}")
    if origin is tuple:
        return _tuple(value, args, path)
    if origin is dict:
        if not isinstance(value, dict) or not all(isinstance(key, str) for key in value):
            raise ConfigError(f"{path}: got {shown(value)}; expected a mapping of names")
        return {key: x if args[1] is Any else _convert(x, args[1], f"{path}.{named(key)}") for key, x in value.items()}
    if isinstance(hint, type) and dataclasses.is_dataclass(hint):
        return _replaced(hint(), value, path)
    return _scalar(value, hint, path)


def _tuple(value: Any, args: tuple[Any, ...], path: str) -> tuple[Any, ...]:
    """A list as a tuple of any number of one type, or of the types given."""
    if args[-1] is Ellipsis:
        if isinstance(value, list | tuple):
            return tuple(_convert(v, args[0], f"{path}[{i}]") for i, v in enumerate(value))
        raise ConfigError(f"{path}: got {shown(value)}; expected a list")
    if isinstance(value, list | tuple) and len(value) == len(args):
        return tuple(_convert(v, a, f"{path}[{i}]") for i, (v, a) in enumerate(zip(value, args, strict=True)))
    raise ConfigError(f"{path}: got {shown(value)}; expected a list of {len(args)} numbers")


def _scalar(value: Any, hint: Any, path: str) -> Any:
    """A number, a truth value or a text."""
    if hint is float and isinstance(value, str) and value.isascii():  # YAML 1.1 reads 1e-4 as a string
        with contextlib.suppress(ValueError):
            value = float(value)
    accepted: Any = {float: (int, float), int: int, bool: bool, str: str}[hint]
    if not isinstance(value, accepted) or (isinstance(value, bool) and hint is not bool):
        raise ConfigError(f"{path}: got {shown(value)}; expected {hint.__name__}")
    try:
        finite = math.isfinite(value) if hint is float else True
    except OverflowError:  # an integer beyond the largest float
        finite = False
    if not finite:
        raise ConfigError(f"{path}: got {shown(value)}; expected a finite number")
    return hint(value)


def flat(values: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested settings by dotted name."""
    found: dict[str, Any] = {}
    for name, value in values.items():
        found |= flat(value, f"{prefix}{name}.") if isinstance(value, dict) else {f"{prefix}{name}": value}
    return found
