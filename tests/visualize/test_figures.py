"""Figures of runs on disk: what they read, how runs are told apart, and the command line."""

import json
from pathlib import Path

import numpy as np
import pytest

from hasrl_jax.cli.figures import main as figures_main
from hasrl_jax.config.convert import from_dict
from hasrl_jax.config.files import dump_yaml
from hasrl_jax.errors import RunError
from hasrl_jax.visualize import curves as figures


def _run(directory: Path, **changes: dict) -> Path:
    """A run directory with five iterations."""
    directory.mkdir()
    (directory / "config.yaml").write_text(dump_yaml(from_dict(changes)))
    records = [
        {
            "iteration": i + 1,
            "env_steps": 100 * (i + 1),
            "episode_return_train": None if i == 0 else float(i),
            "episode_length_train": 10.0 * i,
            "ratio_mean": 1.0,
            "entropy": -i,
            "collect_seconds": 1.0,
            "update_seconds": 2.0,
            **({"eval_return": 5.0} if i == 3 else {}),
        }
        for i in range(5)
    ]
    (directory / "metrics.jsonl").write_text("".join(json.dumps(record) + "\n" for record in records))
    return directory


def test_metrics_keep_their_gaps(tmp_path: Path) -> None:
    run = figures.read_metrics(_run(tmp_path / "a"))
    np.testing.assert_array_equal(run["episode_return_train"], [np.nan, 1, 2, 3, 4])
    np.testing.assert_array_equal(run["eval_return"], [np.nan, np.nan, np.nan, 5, np.nan])


def test_runs_are_named_by_what_differs() -> None:
    configs = [
        from_dict({"ppo": {"policy_learning_rate": rate}, "seed": seed}) for seed, rate in enumerate((1e-4, 6e-4))
    ]
    assert figures.differences(configs) == ["policy_learning_rate 0.0001", "policy_learning_rate 0.0006"]
    assert figures.differences([from_dict({})]) == [""]


def test_moving_mean_skips_gaps() -> None:
    means = figures.moving_mean(np.array([np.nan, 1.0, 3.0, np.nan, 5.0]), width=2)
    np.testing.assert_array_equal(means, [np.nan, 1, 2, 3, 5])


@pytest.mark.parametrize("name", ["fig3", "fig4", "curve"])
def test_each_figure_is_written(name: str, tmp_path: Path) -> None:
    runs = [str(_run(tmp_path / "a"))]
    if name != "fig3":
        runs.append(str(_run(tmp_path / "b", ppo={"clip": 0.1})))
    out = tmp_path / "figure.png"
    assert figures_main([name, "--run-dir", *runs, "--out", str(out)]) == 0
    assert out.stat().st_size > 5000


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["fig3", "--run-dir", "a", "a"], "--run-dir: got 2 runs; fig3 shows one"),
        (["fig4", "--run-dir", "a", "--labels", "x", "y"], "--labels: got 2; expected one for each of 1 runs"),
        (["fig4", "--run-dir", "a", "--out", "x.gif"], "--out: got x.gif; expected a name that ends in .png"),
        (["fig4", "--run-dir", "nowhere"], "nowhere: there is no such run directory"),
    ],
)
def test_bad_arguments(
    arguments: list[str], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    _run(tmp_path / "a")
    monkeypatch.chdir(tmp_path)
    assert figures_main(arguments) != 0
    assert capsys.readouterr().err.strip() == f"error: {message}"


@pytest.mark.parametrize("text", ["", "{"])
def test_damaged_metrics(text: str, tmp_path: Path) -> None:
    run = _run(tmp_path / "a")
    (run / "metrics.jsonl").write_text(text)
    with pytest.raises(RunError, match=r"metrics.jsonl: (damaged|holds no iteration)"):
        figures.read_metrics(run)
