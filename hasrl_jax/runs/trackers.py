"""Trackers beside TensorBoard and metrics.jsonl: Weights & Biases and MLflow, each an extra of the package.

A tracker never ends a run: what it raises is said once, and training goes on without it.
"""

import contextlib
import importlib.util
import json
import logging
import os
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Protocol

from hasrl_jax.config.convert import flat, to_dict
from hasrl_jax.config.schema import Config
from hasrl_jax.errors import ConfigError
from hasrl_jax.runs.metrics import plain_number, tag
from hasrl_jax.types import Record

log = logging.getLogger("hasrl_jax")
IDS_FILE = "trackers.json"  # in the run directory: a resumed run goes on under the same identifiers
MLFLOW_FILE = "mlflow.db"  # where MLFLOW_TRACKING_URI is not set
PACKAGES = {"wandb": "wandb", "mlflow": "mlflow"}  # tracker -> what it imports


class Tracker(Protocol):
    """What a run tells a tracker."""

    def log(self, values: dict[str, float], iteration: int) -> None:
        """The metrics of an iteration by tag; none that is not finite."""

    def attach(self, name: str, path: Path) -> None:
        """A file of the run: a film, a page, a scorecard."""

    def close(self) -> None:
        """The run has ended."""


def require_installed(config: Config) -> None:
    """Refuses a tracker whose package is missing.

    Raises:
      ConfigError: says how to install it.
    """
    for name in config.track.to:
        if importlib.util.find_spec(PACKAGES[name]) is None:
            raise ConfigError(f'track.to: got {name!r}, which is not installed; pip install "hasrl_jax[{name}]"')


def git_state(folder: Path) -> dict[str, str | bool]:
    """Commit, branch and whether files differ from it, of the repository around `folder`; empty without one."""

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(folder), *arguments]
        return subprocess.run(command, capture_output=True, text=True, timeout=20, check=True).stdout.strip()

    try:
        changed = git("status", "--porcelain", "--untracked-files=no")
        return {"commit": git("rev-parse", "HEAD"), "branch": git("branch", "--show-current"), "changed": bool(changed)}
    except (OSError, subprocess.SubprocessError):
        return {}


class _Wandb:
    """Weights & Biases; offline runs lie in the run directory and are sent with `wandb sync`."""

    def __init__(self, config: Config, run: Path, identifier: str | None, facts: dict[str, Any]):
        import wandb

        self._wandb = wandb
        quiet = wandb.Settings(silent=True, console="off")
        self._run = wandb.init(
            project=config.track.project,
            name=config.track.name or run.resolve().name,
            dir=str(run),
            config=facts,
            mode="offline" if config.track.offline else "online",
            id=identifier,
            resume="allow",
            settings=quiet,
        )
        self.identifier: str = self._run.id

    def log(self, values: dict[str, float], iteration: int) -> None:
        self._run.log(values, step=iteration)

    def attach(self, name: str, path: Path) -> None:
        if path.suffix == ".mp4":
            self._run.log({name: self._wandb.Video(str(path), format="mp4")})
        else:
            self._run.save(str(path), base_path=str(path.parent), policy="now")

    def close(self) -> None:
        self._run.finish()


class _MLflow:
    """MLflow, on the server that MLFLOW_TRACKING_URI names, or in a database file of the run directory."""

    def __init__(self, config: Config, run: Path, identifier: str | None, facts: dict[str, Any]):
        from mlflow import entities
        from mlflow.tracking import MlflowClient

        self._entities = entities
        uri = os.environ.get("MLFLOW_TRACKING_URI")
        self._client = MlflowClient(uri or f"sqlite:///{run.resolve() / MLFLOW_FILE}")
        if identifier is None:
            project = config.track.project
            place = None if uri else f"{(run.resolve() / 'mlflow').as_uri()}"
            known = self._client.get_experiment_by_name(project)
            experiment = known.experiment_id if known else self._client.create_experiment(project, place)
            name = config.track.name or run.resolve().name
            identifier = self._client.create_run(experiment, run_name=name).info.run_id
            params = [entities.Param(key, str(value)) for key, value in flat(facts).items()]
            self._client.log_batch(identifier, params=params)
        self.identifier: str = identifier

    def log(self, values: dict[str, float], iteration: int) -> None:
        now_ms = int(time.time() * 1000)
        metrics = [self._entities.Metric(name, value, now_ms, iteration) for name, value in values.items()]
        self._client.log_batch(self.identifier, metrics=metrics)

    def attach(self, name: str, path: Path) -> None:
        self._client.log_artifact(self.identifier, str(path), name)

    def close(self) -> None:
        self._client.set_terminated(self.identifier)


MAKERS: dict[str, Callable[..., Any]] = {"wandb": _Wandb, "mlflow": _MLflow}


class Trackers:
    """All trackers of a run; use as a context manager.

    Args:
      config: of the run; reads `track`.
      run: the run directory. Its config.yaml is attached.
    """

    def __init__(self, config: Config, run: Path):
        self._trackers: dict[str, Tracker] = {}
        if not config.track.to:
            return
        ids_path = run / IDS_FILE
        ids: dict[str, str] = {}
        with contextlib.suppress(OSError, ValueError):
            ids = json.loads(ids_path.read_text())
        facts = to_dict(config) | {"git": git_state(Path.cwd())}
        for name in config.track.to:
            with self._forgiving(name, "cannot be started"):
                tracker = MAKERS[name](config, run, ids.get(name), facts)
                self._trackers[name] = tracker
                ids[name] = tracker.identifier
        with contextlib.suppress(OSError):
            ids_path.write_text(json.dumps(ids) + "\n")

    def __enter__(self) -> "Trackers":
        return self

    def __exit__(self, *_: object) -> None:
        self._each(lambda tracker: tracker.close())

    def write(self, record: Record) -> None:
        """The metrics of an iteration, as given to `MetricsWriter.write`."""
        values = {tag(name): float(x) for name, value in record.items() if (x := plain_number(value)) is not None}
        iteration = int(values.pop(tag("iteration")))
        self._each(lambda tracker: tracker.log(values, iteration))

    def attach(self, name: str, path: Path) -> None:
        """A file of the run under a name."""
        self._each(lambda tracker: tracker.attach(name, path))

    def _each(self, tell: Callable[[Tracker], None]) -> None:
        for name, tracker in list(self._trackers.items()):
            with self._forgiving(name, "failed"):
                tell(tracker)

    @contextlib.contextmanager
    def _forgiving(self, name: str, what: str) -> Iterator[None]:
        """A service that is away must not end days of training."""
        try:
            yield
        except Exception as error:
            self._trackers.pop(name, None)
            log.warning("%s %s (%s); training goes on without it", name, what, " ".join(str(error).split()))
