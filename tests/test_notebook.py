"""The notebooks run from top to bottom, on a budget of seconds."""

import importlib.util
import os
import subprocess
import types
from pathlib import Path
from typing import Any

import pytest

nbclient = pytest.importorskip("nbclient")
nbformat = pytest.importorskip("nbformat")
pytest.importorskip("ipykernel")

ROOT = Path(__file__).parents[1]
NOTEBOOK = ROOT / "notebooks" / "cassie_colab.ipynb"
PLAY = ROOT / "notebooks" / "play.ipynb"
TINY = """
task: cartpole
physics: {timestep_s: 0.005, steps_per_env_step: 5, integrator: Euler}
network: {hidden_size: 8, initial_log_std: -1.0}
collect: {num_workers: 1, envs_per_worker: 4, env_steps_per_iteration: 128, unroll_length: 16, max_episode_steps: 40}
ppo: {epochs: 1, minibatch_trajectories: 4}
evaluate: {every_iterations: 2, episodes: 2}
"""


@pytest.mark.parametrize("path", [NOTEBOOK, PLAY])
def test_outputs_are_not_committed(path: Path) -> None:
    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    cells = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert not any(cell.outputs or cell.execution_count for cell in cells)
    assert path.stat().st_size < 20_000


def test_both_are_installed_alike() -> None:
    cells = [{cell.id: cell.source for cell in nbformat.read(path, as_version=4).cells} for path in (NOTEBOOK, PLAY)]
    assert cells[0]["install"] == cells[1]["install"]


@pytest.mark.parametrize(
    ("source", "here", "asked"),
    [
        ("git+https://example.com/x.git", [], "hasrl_jax @ git+https://example.com/x.git"),
        ("", ["hasrl_jax-0.2.0-py3-none-any.whl"], "hasrl_jax-0.2.0-py3-none-any.whl"),
        ("", ["pyproject.toml"], "."),
        ("", [], None),
    ],
)
@pytest.mark.parametrize("gpu", [False, True])
def test_what_a_fresh_machine_installs(
    source: str, here: list[str], asked: str | None, gpu: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The cell alone, where the package is not there yet; nothing is really installed."""
    cell = next(cell for cell in nbformat.read(PLAY, as_version=4).cells if cell.id == "install")
    commands: list[list[str]] = []

    def run(command: Any, **_: Any) -> Any:
        commands.append(command)
        return types.SimpleNamespace(returncode=0 if gpu else 1)

    for name in here:
        (tmp_path / name).touch()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("SOURCE", source)
    monkeypatch.setattr(subprocess, "run", run)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    if asked is None:
        with pytest.raises(SystemExit, match="SOURCE"):
            exec(cell.source, {"os": os})
        return
    exec(cell.source, {"os": os})
    if gpu:
        asked = asked.replace("hasrl_jax @", "hasrl_jax[cuda] @") if source else f"{asked}[cuda]"
    assert commands[-1][1:4] == ["-m", "pip", "install"] and commands[-1][-1] == asked


def test_the_notebook_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "tiny.yaml").write_text(TINY)
    settings = {
        "TOTAL_ENV_STEPS": "256",
        "CONFIG": str(tmp_path / "tiny.yaml"),
        "RUN_DIR": str(tmp_path / "run"),
        "OVERRIDES": "--seed 3 --ppo.clip 0.1",
        "EPISODES": "2",
        "FILM_SECONDS": "0.2",
        "XLA_FLAGS": "",  # one device, as a user has
        "IPYTHONDIR": str(tmp_path / "ipython"),
    }
    for name, value in settings.items():
        monkeypatch.setenv(name, value)
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    # Opened from its own folder, as Jupyter does.
    resources = {"metadata": {"path": str(NOTEBOOK.parent)}}
    nbclient.NotebookClient(notebook, timeout=120, kernel_name="python3", resources=resources).execute()

    assert "was installed" in printed(notebook, "install")
    assert "--backend=cpu_pool" in printed(notebook, "devices")
    assert "iteration 2 | 256 env steps" in printed(notebook, "train")
    assert "image/png" in shown(notebook, "plot")
    assert "episode_return" in printed(notebook, "evaluate")
    if "No film" not in printed(notebook, "film"):
        assert (tmp_path / "run" / "film.mp4").stat().st_size > 1000
        assert "text/html" in shown(notebook, "film")
    else:
        assert "apt-get install" in printed(notebook, "film")


def test_the_released_policy_is_played(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    settings = {"FILM_SECONDS": "0.3", "SECONDS": "0.5", "EPISODES": "1", "XLA_FLAGS": ""}
    for name, value in (settings | {"IPYTHONDIR": str(tmp_path / "ipython")}).items():
        monkeypatch.setenv(name, value)
    notebook = nbformat.read(PLAY, as_version=4)
    resources = {"metadata": {"path": str(tmp_path)}}  # anywhere: the package is installed
    nbclient.NotebookClient(notebook, timeout=120, kernel_name="python3", resources=resources).execute()

    for name in ("film", "push", "turn"):
        if "No film" not in printed(notebook, name):
            assert "text/html" in shown(notebook, name)
    assert "image/png" in shown(notebook, "python")
    assert printed(notebook, "measure").count("episode_return") == 2


def outputs(notebook: Any, name: str) -> list[Any]:
    """What the cell of this id gave."""
    return next(cell for cell in notebook.cells if cell.id == name).outputs


def printed(notebook: Any, name: str) -> str:
    return "".join(output.text for output in outputs(notebook, name) if output.output_type == "stream")


def shown(notebook: Any, name: str) -> set[str]:
    """Kinds of media that the cell displayed."""
    return {kind for output in outputs(notebook, name) for kind in output.get("data", ())}
