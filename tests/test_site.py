"""The generated pages of the site say everything, and its link check finds what is dead."""

import dataclasses
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from hasrl_jax.config.convert import from_dict

sys.path.insert(0, str(Path(__file__).parents[1] / "tools"))
import links
import reference


def _paths(settings: Any, prefix: str = "") -> Iterator[str]:
    for field in dataclasses.fields(settings):
        value = getattr(settings, field.name)
        if dataclasses.is_dataclass(value):
            yield from _paths(value, f"{prefix}{field.name}.")
        elif field.name != "stages":
            yield prefix + field.name


def _rows(text: str) -> dict[str, list[str]]:
    """The cells of every table row by its first cell."""
    rows = [
        [cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]]
        for line in text.splitlines()
        if line.startswith("| ")
    ]
    return {row[0]: row[1:] for row in rows}


@pytest.fixture(scope="module")
def settings() -> dict[str, list[str]]:
    return _rows(reference.configuration())


def test_every_setting_is_there_with_its_meaning(settings: dict[str, list[str]]) -> None:
    paths = list(_paths(from_dict({"task": "cassie"})))
    assert len(paths) > 100
    for path in paths:
        assert len(settings[f"`{path}`"]) == 4 and settings[f"`{path}`"][-1], path


def test_defaults_limits_and_the_recipe(settings: dict[str, list[str]]) -> None:
    assert settings["`ppo.clip`"][:3] == ["0.2", "", "0.001 to 0.999"]
    assert settings["`cassie.command.forward_m_s`"][:3] == ["[-0.3, 2.0]", "[-0.3, 1.0]", "low and high: -10 to 10"]
    assert settings["`network.symmetric`"][:3] == ["false", "true", "true, false"]
    assert settings["`collect.num_workers`"][0] == "one per core"
    assert settings["`collect.mode`"][2] == "`unrolls`, `episodes`"


def test_the_tables_of_a_task_are_complete_and_in_order() -> None:
    text = reference.task_tables()
    observation = text[text.index("### Observation, 50 numbers") : text.index("### Action")]
    ends = [int(row.split(" to ")[-1]) for row in _rows(observation) if row[0].isdigit()]
    assert ends == [0, 4, 14, 17, 20, 30, 33, 39, 45, 47, 48, 49]
    rows = _rows(observation)
    assert rows["1 to 4"] == [
        "`pelvis_orientation`",
        "",
        "+ − + −",
        "0.01",
        "w, x, y, z; quaternion in the world; in the heading frame relative to the heading to keep, with w >= 0",
    ]
    assert "left hip-roll, hip-yaw, hip-pitch, knee, foot" in rows["5 to 14"][-1]
    assert "`yaw_rate`" in text and "0.4973" in text


def test_a_policy_card_has_the_hash_and_the_ranges_of_the_file() -> None:
    rows = _rows(reference.policy_facts("released-stairs"))
    assert re.fullmatch(r"`[0-9a-f]{64}`", rows["SHA-256"][0])
    assert rows["ground"] == ["steps"]
    assert rows["commands that it was trained for"][0].startswith("forward [0.2, 1.5] m/s")


def test_links_of_the_root_hold_inside_docs() -> None:
    contributing = reference.from_root("CONTRIBUTING.md")
    assert "](architecture.md)" in contributing and "](docs/" not in contributing


def test_dead_links_are_found(tmp_path: Path) -> None:
    (tmp_path / "sub").mkdir()
    (tmp_path / "index.html").write_text(
        '<h1 id="top"></h1><a href="sub/a.html#here"></a><a href="sub/"></a><a href="#top"></a><img src="b.png">'
    )
    (tmp_path / "sub" / "a.html").write_text('<p id="there"></p><a href="https://example.com/x">y</a>')
    found = links.dead_links(tmp_path)
    assert found == ["index.html: b.png", "index.html: sub/", "index.html: sub/a.html#here"]
