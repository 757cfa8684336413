"""The tables of the documents come from kept figures."""

import json
from pathlib import Path

import pytest

from hasrl_jax.bench.documents import DocumentError, refresh

ROOT = Path(__file__).parents[2]
CELL = {
    **{"sizes": "paper", "trajectories": 100, "steps": 100, "hidden": 256, "epochs": 10},
    **{"minibatch_trajectories": 100, "seconds_per_update": 2.345, "seconds_fastest": 2.3},
    **{"torch_seconds_per_update": 4.69, "compile_seconds": 4.0, "recompiles": 0},
}
REPORT = {
    **{"bench": "learner", "command": "python -m hasrl_jax.bench learner", "date": "2026-01-02T03:04:05"},
    **{"versions": {"jax": "1.2", "mujoco": "3.4"}, "cpu": "a CPU", "cores": 2, "load_average": 0.01},
    "figures": {"cells": [CELL]},
}


def test_the_committed_tables_are_those_of_the_committed_figures(tmp_path: Path) -> None:
    for path in (ROOT / "docs").glob("*.md"):
        (tmp_path / path.name).write_text(path.read_text(encoding="utf-8"), encoding="utf-8")
    assert refresh(tmp_path, ROOT / "benchmarks" / "results") == []


def test_a_marked_block_is_written_and_the_rest_stays(tmp_path: Path) -> None:
    (tmp_path / "learner.json").write_text(json.dumps(REPORT))
    document = tmp_path / "speed.md"
    document.write_text("before\n<!-- bench learner -->\nold\n<!-- end -->\nafter\n")
    assert refresh(tmp_path, tmp_path) == [document]
    text = document.read_text()
    assert text.startswith("before\n<!-- bench learner -->\n`python -m hasrl_jax.bench learner`")
    assert text.endswith("<!-- end -->\nafter\n")
    assert "old" not in text and "Measured on 2026-01-02: 2 cores (a CPU), load 0.0" in text
    row = next(line for line in text.splitlines() if line.startswith("| paper"))
    assert row.replace(" ", "").split("|")[1:10] == ["paper", "100x100", "256", "10", "100", "2.35", "2.3", "4.69", "2"]
    assert refresh(tmp_path, tmp_path) == []


def test_missing_figures_are_named(tmp_path: Path) -> None:
    (tmp_path / "speed.md").write_text("<!-- bench learner -->\n<!-- end -->\n")
    with pytest.raises(DocumentError, match=r"speed.md: the block 'bench learner' needs .*learner.json; write it with"):
        refresh(tmp_path, tmp_path)
