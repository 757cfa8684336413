"""Whatever a file or a command line holds is a configuration that can work, or one line that names what cannot."""

import contextlib
import dataclasses
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from hasrl_jax.config import curriculum
from hasrl_jax.config.checks import check
from hasrl_jax.config.convert import flat, from_dict, to_dict
from hasrl_jax.config.files import load_yaml
from hasrl_jax.config.schema import Config, StageConfig
from hasrl_jax.errors import ConfigError

FIELDS = sorted(flat(to_dict(from_dict({}))))
GROUPS = sorted({name.partition(".")[0] for name in FIELDS})
STAGE = [field.name for field in dataclasses.fields(StageConfig)]
NUMBERS = st.one_of(
    st.integers(), st.floats(), st.sampled_from([0, -1, 1, 2**31, 2**63, 10**400, 1e-320, 1e308, -0.0, True])
)
SCALARS = st.one_of(st.none(), NUMBERS, st.text(max_size=20), st.binary(max_size=4), st.dates(), st.datetimes())
VALUES = st.recursive(
    SCALARS,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from(FIELDS) | SCALARS, inner, max_size=3),
    max_leaves=6,
)
# What YAML is made of, so that texts come close to files.
PIECES = [
    *"{}[]:,-?!&*#|>'\"%@`\\\n\t ",
    "\0",
    "\ufeff",
    "\x85",
    "\ud7ff",
    "\uff11",
    "<<",
    "!!int",
    "~",
    ".inf",
    ".nan",
]
PIECES += [
    "0o7",
    "1_0",
    "12:30:45",
    "2020-02-30",
    "on",
    "yes",
    "null",
    "---",
    "...",
    *FIELDS,
    *GROUPS,
    *STAGE,
    "extends",
]
quick = settings(
    deadline=None, derandomize=True, max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


@contextlib.contextmanager
def one_line_at_most() -> Any:
    message = ""
    try:
        yield
    except ConfigError as error:
        message = str(error)
    assert len(message.splitlines()) <= 1, repr(message)
    assert len(message) < 3000


def resolve(values: Any) -> None:
    config = from_dict(values)
    check(config)
    curriculum.resolve(config)
    assert isinstance(config, Config)
    assert from_dict(to_dict(config)) == config


def nested(name: str, value: Any) -> dict[str, Any]:
    for part in reversed(name.split(".")):
        value = {part: value}
    return value


@quick
@given(st.sampled_from(FIELDS) | st.sampled_from(GROUPS), VALUES)
def test_any_value_of_any_field(name: str, value: Any) -> None:
    with one_line_at_most():
        resolve(nested(name, value))


@quick
@given(st.lists(st.dictionaries(st.sampled_from(STAGE), VALUES, max_size=3), max_size=3), st.integers(1, 10**6))
def test_any_stages(stages: list[dict[str, Any]], first: int) -> None:
    with one_line_at_most():
        resolve({"stages": stages})
    for stage in stages:  # with a beginning that works, so that what it sets is looked at
        with one_line_at_most():
            resolve({"stages": [stage | {"at_env_steps": first}]})


@quick
@given(VALUES)
def test_any_data_as_a_file(tmp_path: Path, value: Any) -> None:
    path = tmp_path / "some.yaml"
    path.write_text(yaml.safe_dump(value, allow_unicode=True), encoding="utf-8", errors="surrogatepass")
    with one_line_at_most():
        check(load_yaml(path))


@quick
@given(st.lists(st.sampled_from(PIECES), max_size=25).map("".join) | st.text(max_size=60))
def test_any_text_as_a_file(tmp_path: Path, text: str) -> None:
    path = tmp_path / "some.yaml"
    path.write_bytes(text.encode("utf-8", "surrogatepass"))
    with one_line_at_most():
        check(load_yaml(path))


@quick
@given(st.binary(max_size=40))
def test_any_bytes_as_a_file(tmp_path: Path, data: bytes) -> None:
    path = tmp_path / "some.yaml"
    path.write_bytes(data)
    with one_line_at_most():
        check(load_yaml(path))


def test_a_name_that_is_no_file(tmp_path: Path) -> None:
    for name in ("a\0b", "x" * 5000, "\ud800", "a\nb", str(tmp_path)):
        with one_line_at_most():
            load_yaml(name)
        with pytest.raises(ConfigError, match="cannot be read"):
            load_yaml(name)


@pytest.mark.parametrize("name", [":", "a:", ".a:b", "a\nb:c", "a\0:b", "x" * 5000 + ":y", "hasrl_jax:__version__"])
def test_a_task_that_is_none(name: str) -> None:
    with one_line_at_most():
        from_dict({"task": name})
    with pytest.raises(ConfigError, match=r"^task: got "):
        from_dict({"task": name})
