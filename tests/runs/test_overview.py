"""`hasrl runs` and `hasrl compare` on run directories written by hand."""

import fcntl
import json
from pathlib import Path

import pytest

from hasrl_jax.cli import main
from hasrl_jax.config.convert import from_dict
from hasrl_jax.errors import RunError
from hasrl_jax.runs import overview
from hasrl_jax.runs.directory import CONFIG_FILE, METRICS_FILE, write_config
from hasrl_jax.visualize import comparison


def write_run(path: Path, clip: float, env_steps: int, returns: list[float]) -> Path:
    path.mkdir(parents=True)
    write_config(path, from_dict({"task": "cartpole", "total_env_steps": 300, "ppo": {"clip": clip}}))
    records = [
        {
            "iteration": i,
            "env_steps": env_steps * i // len(returns),
            "episode_return_train": value,
            "entropy": None,
            "train_seconds": 1800.0 * i,
        }
        for i, value in enumerate(returns, 1)
    ]
    (path / METRICS_FILE).write_text("".join(json.dumps(record) + "\n" for record in records))
    return path


def write_scores(path: Path, share: float) -> None:
    row = {"title": "1 m/s", "randomized": False, "share_up": {"mean": share, "low": 0, "high": 1}}
    (path / comparison.SCORECARD).parent.mkdir()
    (path / comparison.SCORECARD).write_text(json.dumps({"policies": {"p": [row]}}))


@pytest.fixture
def two_runs(tmp_path: Path) -> tuple[Path, Path]:
    return (
        write_run(tmp_path / "runs" / "first", 0.2, 300, [1.0, 2.5]),
        write_run(tmp_path / "runs" / "second", 0.3, 200, [3.0, 4.5]),
    )


def test_runs_are_listed_with_how_far_they_came(
    two_runs: tuple[Path, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    (two_runs[0].parent / "no_run").mkdir()
    with open(two_runs[1] / METRICS_FILE, "a") as file:
        file.write('{"iteration": 3, "env_st')  # it is being written
    assert main.main(["runs", str(two_runs[0].parent)]) == 0
    lines = {line.split()[0]: line.split() for line in capsys.readouterr().out.splitlines()[1:]}
    assert lines[str(two_runs[0])][1:8] == ["cartpole", "finished", "300", "300", "2.5", "-", "1.0"]
    assert lines[str(two_runs[1])][1:8] == ["cartpole", "stopped", "200", "300", "4.5", "-", "1.0"]
    assert len(lines) == 2
    with open(two_runs[1] / "run.lock", "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        assert overview.read_run(two_runs[1]).state == "running"
    assert overview.read_run(two_runs[1]).state == "stopped"


def test_a_damaged_run_is_named_and_hides_no_other(
    two_runs: tuple[Path, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    (two_runs[0] / CONFIG_FILE).write_text("task: [")
    assert main.main(["runs", str(two_runs[0].parent)]) == 0
    out = capsys.readouterr().out
    assert f"unreadable: {two_runs[0]}/config.yaml: " in out and str(two_runs[1]) in out
    assert main.main(["runs", str(two_runs[0] / "nowhere")]) == 1
    assert "there is no such folder" in capsys.readouterr().err


def test_a_comparison_shows_what_differs_and_only_that(
    two_runs: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "page.html"
    assert main.main(["compare", *map(str, two_runs), "--out", str(out)]) == 0
    text = out.read_text()
    assert "<td>ppo.clip</td><td>0.2</td><td>0.3</td>" in text
    assert "ppo.epochs" not in text and "<td>run_dir" not in text
    assert "<td>episode_return_train</td><td>2.5</td><td>4.5</td>" in text
    assert "<td>entropy</td>" not in text  # nobody has one
    assert "hasrl evaluate --run-dir" in text and "data:image/png;base64,iVBOR" in text
    write_scores(two_runs[1], 0.875)
    assert main.main(["compare", *map(str, two_runs), "--out", str(out)]) == 0
    assert "<td>1 m/s: up to the end, %</td><td>–</td><td>87.5</td>" in out.read_text()
    capsys.readouterr()
    assert main.main(["compare", *(7 * [str(two_runs[0])]), "--out", str(out)]) == 2
    assert capsys.readouterr().err == "error: runs: got 7; expected at most 6, one for each color\n"


def test_a_damaged_scorecard_is_refused_on_one_line(two_runs: tuple[Path, Path]) -> None:
    write_scores(two_runs[0], 0.5)
    (two_runs[0] / comparison.SCORECARD).write_text('{"policies": {}}')
    with pytest.raises(RunError, match=r"scorecard.json: damaged \("):
        comparison.load(two_runs[0])
