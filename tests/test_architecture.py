"""The arrows between the parts, and rules that hold for every file."""

import ast
import dataclasses
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import hasrl_jax
from hasrl_jax.config.tasks import config_class

PACKAGE = Path(hasrl_jax.__file__).parent
FILES = sorted(PACKAGE.rglob("*.py"))
# What each part may import besides itself and what is below it all; docs/architecture.md says why.
BELOW_ALL = {"errors", "types"}
ARROWS = {
    "errors": set(),
    "types": set(),
    "config": set(),
    "envs": {"config"},
    "learn": {"config"},
    "runs": {"config", "learn"},
    "policy": {"config", "envs", "learn", "runs"},
    "deploy": {"config", "envs", "learn", "runs", "policy"},
    "collect": {"config", "envs", "policy"},
    "evaluate": {"config", "envs", "policy", "runs"},
    "train": {"config", "envs", "learn", "runs", "policy", "collect", "evaluate"},
    "visualize": {"config", "envs", "runs", "policy", "evaluate"},
    "bench": {"config", "envs", "learn", "runs", "policy", "collect", "evaluate", "train"},
    "cli": {"config", "envs", "learn", "runs", "policy", "deploy", "collect"}
    | {"evaluate", "train", "visualize", "bench"},
}
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


def _is_entry(path: Path) -> bool:
    """Whether the file only hands over to a command line, as `python -m hasrl_jax.PROGRAM` needs it."""
    imports = set(_imports(path)) - {"sys"}
    return len(imports) == 1 and imports.pop().startswith("hasrl_jax.cli.") and len(path.read_text().splitlines()) < 10


def _part(path: Path) -> str:
    return path.relative_to(PACKAGE).with_suffix("").parts[0]


PARTS = sorted({_part(path) for path in FILES if not _is_entry(path)} - {"__init__"})


def test_every_part_has_its_arrows_stated_and_there_is_no_circle() -> None:
    assert set(PARTS) == set(ARROWS)
    below: set[str] = set()
    remaining = dict(ARROWS)
    while remaining:
        free = {part for part, arrows in remaining.items() if arrows <= below}
        assert free, f"a circle among {sorted(remaining)}"
        below |= free
        remaining = {part: arrows for part, arrows in remaining.items() if part not in free}


@pytest.mark.parametrize("part", PARTS)
def test_arrows(part: str) -> None:
    names = {name for path in FILES if _part(path) == part and not _is_entry(path) for name in _imports(path)}
    found = {name.split(".")[1] for name in names if name.startswith("hasrl_jax.")}
    assert found <= ARROWS[part] | BELOW_ALL | {part, "__version__"}


def test_no_two_files_import_each_other() -> None:
    modules = {".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts): path for path in FILES}
    arrows = {
        name: {other for found in _imports(path) for other in (found, found.rpartition(".")[0]) if other in modules}
        for name, path in modules.items()
    }
    remaining = {name: found - {name} for name, found in arrows.items()}
    while remaining:
        free = {name for name, found in remaining.items() if not found & remaining.keys()}
        assert free, f"a circle among {sorted(remaining)}"
        remaining = {name: found for name, found in remaining.items() if name not in free}


def test_no_part_but_the_task_asks_for_its_name() -> None:
    """What a task can do is said by the task; whoever asks for its name would have to know every other, too."""
    for path in FILES:
        if path.parent.name in ("cassie", "cartpole"):
            continue
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Compare):
                constants = {n.value for n in [node.left, *node.comparators] if isinstance(n, ast.Constant)}
                assert not constants & {"cassie", "cartpole"}, f"{path}:{node.lineno}"


@pytest.mark.parametrize("module", ["collect.worker", "envs.gymnasium", "bench.compare_peers"])
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
        if path.name in ("schema.py", "settings.py"):
            continue
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Attribute):
                read.add(node.attr)
            elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                named.add(node.value)
    by_name = {f"cassie.reward.{name}" for name in named}  # the weights are read by the name of their term
    unused = [path for path, name in _fields(config_class("cassie")) if name not in read and path not in by_name]
    assert not unused
