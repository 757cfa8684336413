"""Trackers are told what a run reports, and cannot end it."""

import logging
import subprocess
from pathlib import Path

import pytest

from hasrl_jax.config.convert import from_dict
from hasrl_jax.config.schema import Config
from hasrl_jax.errors import ConfigError
from hasrl_jax.runs import trackers
from hasrl_jax.runs.trackers import Trackers

RECORD = {"iteration": 3, "episode_return_train": 2.5, "entropy": float("nan"), "eval_return": None, "reward/near": 1}
TOLD = {"train/episode_return": 2.5, "reward/near": 1.0}


def tracked(*to: str) -> Config:
    return from_dict({"task": "cartpole", "track": {"to": list(to), "project": "tests", "name": "one"}})


def test_mlflow_has_metrics_settings_git_state_and_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("mlflow")
    from mlflow.tracking import MlflowClient

    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    film = tmp_path / "film.mp4"
    film.write_bytes(b"film")
    with Trackers(tracked("mlflow"), tmp_path) as told:
        told.write(RECORD)
        told.attach("film", film)
    with Trackers(tracked("mlflow"), tmp_path) as resumed:  # goes on in the same run
        resumed.write(RECORD | {"iteration": 4, "episode_return_train": 3.5})
    client = MlflowClient(f"sqlite:///{tmp_path / 'mlflow.db'}")
    (run,) = client.search_runs([client.get_experiment_by_name("tests").experiment_id])
    history = client.get_metric_history(run.info.run_id, "train/episode_return")
    assert [(metric.step, metric.value) for metric in history] == [(3, 2.5), (4, 3.5)]
    assert set(run.data.metrics) == set(TOLD)
    assert run.data.params["ppo.clip"] == "0.2" and run.info.run_name == "one" and run.info.status == "FINISHED"
    commit = subprocess.run(["git", "rev-parse", "HEAD"], capture_output=True, text=True).stdout.strip()
    assert run.data.params.get("git.commit", "") == commit
    (artifact,) = client.list_artifacts(run.info.run_id, "film")
    assert artifact.path == "film/film.mp4"


def test_wandb_works_offline(tmp_path: Path) -> None:
    wandb = pytest.importorskip("wandb")
    page = tmp_path / "config.yaml"
    page.write_text("task: cartpole\n")
    with Trackers(tracked("wandb"), tmp_path) as told:
        told.write(RECORD)
        told.attach("config", page)
    wandb.teardown()  # its process writes what is left; at the end of a program it does so by itself
    (folder,) = (tmp_path / "wandb").glob("offline-run-*")
    (data,) = folder.glob("*.wandb")
    recorded = data.read_bytes()
    for text in (b"train/episode_return", b"2.5", b"reward/near", b"tests", b"total_env_steps"):
        assert text in recorded
    assert b"eval/return" not in recorded
    assert (folder / "files" / "config.yaml").exists()


def test_what_a_tracker_raises_is_said_once_and_ends_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    told = []

    class Fragile:
        identifier = "id"

        def __init__(self, *_: object) -> None: ...

        def log(self, values: dict, iteration: int) -> None:
            told.append(values)
            raise OSError("the service\nis away")

    monkeypatch.setitem(trackers.MAKERS, "wandb", Fragile)
    monkeypatch.setitem(trackers.MAKERS, "mlflow", lambda *_: 1 / 0)
    monkeypatch.setattr(logging.getLogger("hasrl_jax"), "handlers", [])
    monkeypatch.setattr(logging.getLogger("hasrl_jax"), "propagate", True)
    with caplog.at_level(logging.WARNING, "hasrl_jax"), Trackers(tracked("wandb", "mlflow"), tmp_path) as both:
        both.write(RECORD)
        both.write(RECORD)
    assert told == [TOLD]
    assert [record.getMessage() for record in caplog.records] == [
        "mlflow cannot be started (division by zero); training goes on without it",
        "wandb failed (the service is away); training goes on without it",
    ]


def test_a_tracker_that_is_not_installed_is_refused_before_the_run(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(trackers.PACKAGES, "wandb", "no_such_package")
    with pytest.raises(
        ConfigError, match=r"^track.to: got 'wandb', which is not installed; pip install \"hasrl_jax\[w"
    ):
        trackers.require_installed(tracked("wandb"))
    trackers.require_installed(tracked())
    with pytest.raises(ConfigError, match=r"track.to"):
        tracked("comet")
