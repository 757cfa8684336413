"""Configurations in YAML files."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import yaml

from hasrl_jax.config import strict_yaml, tasks
from hasrl_jax.config.convert import from_dict, to_dict
from hasrl_jax.config.limits import named, shown
from hasrl_jax.config.schema import Config
from hasrl_jax.errors import ConfigError

EXTENDS = "extends"  # the key that names the file whose values a file starts from


def _config_folder() -> Path:
    """configs/, beside the package in a checkout and inside it in a wheel."""
    package = Path(__file__).parents[1]
    folders = package / "configs", package.parent / "configs"  # beside an installed one may be another project's
    return next((folder for folder in folders if folder.is_dir()), folders[-1])


CONFIG_FOLDER = _config_folder()


def load_yaml(source: str | Path, task: str | None = None) -> Config:
    """Reads a YAML file over the defaults.

    Args:
      source: a file, or the name of one in `configs/`, without its ending.
      task: takes the place of the task that the file names.

    Raises:
      ConfigError: missing or unreadable file, invalid YAML, a key given twice, unknown fields or wrong types.
    """
    path = _resolve(source, Path())
    values = _values(path, ())
    return from_dict(values | {"task": task} if task else values, where=path.name)


def shipped(name: str) -> Config:
    """The configuration of `configs/<name>.yaml`."""
    return load_yaml(CONFIG_FOLDER / f"{name}.yaml")


def recipe(task: str) -> Config:
    """The configuration that trains a task when no file is named.

    Raises:
      ConfigError: there is no such task.
    """
    values = tasks.find(task).recipe
    return from_dict(values | {"task": task}) if isinstance(values, dict) else load_yaml(values, task)


def dump_yaml(config: Config) -> str:
    """The resolved configuration as YAML text."""
    return yaml.safe_dump(to_dict(config), sort_keys=False)


def _resolve(source: str | Path, folder: Path) -> Path:
    """The file that `source` names, seen from `folder`."""
    in_configs, path = CONFIG_FOLDER / f"{source}.yaml", folder / source
    try:
        is_there = path.exists() or Path(source).name != str(source) or not in_configs.is_file()
    except OSError:  # no file can have such a name; reading it says so
        is_there = True
    return path if is_there else in_configs


def _values(path: Path, above: tuple[Path, ...]) -> dict[str, Any]:
    """What a file says, laid over what the file says that it extends. `above`: the files that led here."""
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise ConfigError(f"--config {named(str(path))}: cannot be read ({reason}); {_shipped_names()}") from None
    try:
        values = strict_yaml.parse(text)
    except ValueError as error:
        raise ConfigError(f"--config {path}: {error}") from None
    if values is None:
        return {}
    if not isinstance(values, dict):
        raise ConfigError(f"{path.name}: expected a mapping of fields, got {shown(values)}")
    if EXTENDS not in values:
        return values
    parent = values.pop(EXTENDS)
    if not isinstance(parent, str):
        raise ConfigError(f"{path.name}.{EXTENDS}: got {shown(parent)}; expected a file, or a name in configs/")
    parent_path = _resolve(parent, path.parent)
    if parent_path.resolve() in {file.resolve() for file in (path, *above)}:
        raise ConfigError(f"{path.name}.{EXTENDS}: got {shown(parent)}, which extends this file itself")
    return _laid_over(_values(parent_path, (path, *above)), values)


def _laid_over(below: dict[str, Any], above: dict[str, Any]) -> dict[str, Any]:
    """`below` with the values of `above` in place of its own, group by group; `stages` are replaced as a whole."""
    merged = dict(below)
    for name, value in above.items():
        both = isinstance(value, dict) and isinstance(merged.get(name), dict)
        merged[name] = _laid_over(merged[name], value) if both else value
    return merged


def _shipped_names() -> str:
    names: Iterable[str] = sorted(path.stem for path in CONFIG_FOLDER.glob("*.yaml"))
    return f"shipped are {', '.join(names)}"
