"""The arrows between the parts, and rules that hold for every file."""

import ast
import dataclasses
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import hasrl_jax
from hasrl_jax import config

PACKAGE = Path(hasrl_jax.__file__).parent
FILES = sorted(PACKAGE.rglob("*.py"))
# What a worker process must not pay for.
HEAVY = ("jax", "jaxlib", "flax", "optax", "orbax", "scipy", "matplotlib", "mediapy", "tyro", "rich")


def _imports(path: Path) -> Iterator[str]:
    """Dotted names that a file imports, anywhere in it."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative imports hide where a name comes from"
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def _own_parts(folder: str) -> set[str]:
    """Parts of the package that the files of a subpackage import."""
    names = {name for path in (PACKAGE / folder).rglob("*.py") for name in _imports(path)}
    return {name.split(".")[1] for name in names if name.startswith("hasrl_jax.")}


@pytest.mark.parametrize("folder", ["envs", "collect", "learn"])
def test_arrows(folder: str) -> None:
    allowed = {"envs": {"envs"}, "collect": {"collect", "envs"}, "learn": {"learn"}}[folder]
    assert _own_parts(folder) <= allowed | {"cassie_config", "config", "config_checks", "types"}


@pytest.mark.parametrize("module", ["collect.worker", "envs.gymnasium_env", "bench.compare_peers"])
def test_a_sub_process_imports_nothing_heavy(module: str) -> None:
    code = f"import hasrl_jax.{module}, sys; print(*{{name.partition('.')[0] for name in sys.modules}})"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
    assert not set(HEAVY) & set(done.stdout.split())


def _fields(settings: type, prefix: str = "") -> Iterator[tuple[str, str]]:
    """(dotted path, name) of every field that is not itself a group of fields."""
    instance = settings()
    for field in dataclasses.fields(instance):
        value = getattr(instance, field.name)
        if dataclasses.is_dataclass(value):
            yield from _fields(type(value), f"{prefix}{field.name}.")
        else:
            yield prefix + field.name, field.name


def test_every_config_field_is_read() -> None:
    read, named = set(), set()
    for path in FILES:
        if path.name in ("config.py", "cassie_config.py"):
            continue
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Attribute):
                read.add(node.attr)
            elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                named.add(node.value)
    by_name = {f"cassie.reward.{name}" for name in named}  # the weights are read by the name of their term
    unused = [path for path, name in _fields(config.Config) if name not in read and path not in by_name]
    assert not unused
