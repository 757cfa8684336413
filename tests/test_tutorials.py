"""The tutorials work as they are written: their files, then their commands with fewer steps."""

import os
import re
import shlex
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import hasrl_jax

ROOT = Path(hasrl_jax.__file__).parents[1]
FOLDER = ROOT / "docs" / "tutorials"
BLOCK = re.compile(r'^```(\w+)(?: title="([^"]+)")?\n(.*?)^```$', re.MULTILINE | re.DOTALL)
SMALL = {
    "train": "--total-env-steps 256 --collect.num-workers 1 --collect.envs-per-worker 4 --collect.unroll-length 16 "
    "--collect.env-steps-per-iteration 128 --ppo.epochs 1 --ppo.minibatch-trajectories 8 --evaluate.every-iterations 0 "
    "--stages []",
    "evaluate": "--episodes 2 --seconds 0.5",
}


def blocks(tutorial: str) -> list[tuple[str, str, str]]:
    """(language, file name or "", text) of every block of code."""
    return [match.groups("") for match in BLOCK.finditer((FOLDER / tutorial).read_text(encoding="utf-8"))]


def offer(folder: Path) -> None:
    """What `pip install -e .` does for the entry points of the project in `folder`, without a network."""
    project = tomllib.loads((folder / "pyproject.toml").read_text())["project"]
    info = folder / f"{project['name']}-{project['version']}.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {project['version']}\n")
    lines = [
        f"[{group}]\n" + "\n".join(f"{name} = {place}" for name, place in points.items())
        for group, points in project["entry-points"].items()
    ]
    (info / "entry_points.txt").write_text("\n".join(lines) + "\n")


# Those that bring files of their own; the others play and train with what is there.
TUTORIALS = sorted(path.name for path in FOLDER.glob("*.md") if any(name for _, name, _ in blocks(path.name)))


@pytest.mark.parametrize("tutorial", TUTORIALS)
def test_it_works_to_the_letter(tutorial: str, tmp_path: Path) -> None:
    commands = []
    for language, name, text in blocks(tutorial):
        if name:
            (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / name).write_text(text)
        elif language == "bash":
            commands += text.splitlines()
    assert commands
    environment = os.environ | {"PYTHONPATH": f"{tmp_path}{os.pathsep}{ROOT}", "JAX_PLATFORMS": "cpu"}
    for command in commands:
        words = shlex.split(command)
        if words[:2] == ["pip", "install"]:
            offer(tmp_path)
            continue
        assert words[0] == "hasrl" and words[1] in SMALL, command
        words = [sys.executable, "-m", "hasrl_jax.cli.main", *words[1:], *SMALL[words[1]].split()]
        done = subprocess.run(words, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=300)
        assert done.returncode == 0, done.stderr
        if words[3] == "evaluate":
            assert "episode_return" in done.stdout


def test_the_released_policy_walks_from_python(tmp_path: Path) -> None:
    (code,) = (text for language, _, text in blocks("play.md") if language == "python")
    environment = os.environ | {"JAX_PLATFORMS": "cpu"}
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    speed, height = map(float, done.stdout.split())
    assert 0.7 < speed < 1.3 and 0.8 < height < 1.1


def test_the_robot_is_the_example() -> None:
    """The tutorial's package and the one in examples/ are one and the same."""
    named = {name: text for _, name, text in blocks("own_robot.md") if name}
    assert set(named) == {"pyproject.toml", "hasrl_walker/walker.yaml", "hasrl_walker/task.py"}
    for name, text in named.items():
        assert (ROOT / "examples" / "walker" / name).read_text() == text
