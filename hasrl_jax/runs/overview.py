"""What runs there are, and how far each has come."""

import fcntl
import json
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

from hasrl_jax.config.schema import Config
from hasrl_jax.errors import RunError
from hasrl_jax.runs.directory import CONFIG_FILE, LOCK_FILE, METRICS_FILE, load_run_config
from hasrl_jax.types import Record

TAIL_BYTES = 1 << 16  # of the metrics that are read for the last record; one has about 2 kB


class Run(NamedTuple):
    """A run directory at a glance."""

    path: Path
    config: Config
    state: str  # "running", "finished" or "stopped"
    last: Record  # the newest record of its metrics; empty before the first iteration
    changed_s: float  # when it was last written, seconds since the epoch


def find_runs(folders: Iterable[Path]) -> Iterator[Path]:
    """Run directories among the folders and directly inside them, by name.

    Raises:
      RunError: a folder does not exist.
    """
    for folder in folders:
        if not folder.is_dir():
            raise RunError(f"{folder}: there is no such folder; expected run directories, or a folder of them")
        inside = [] if (folder / CONFIG_FILE).is_file() else sorted(folder.iterdir())
        yield from (path for path in [folder, *inside] if (path / CONFIG_FILE).is_file())


def read_run(path: Path) -> Run:
    """One run.

    Raises:
      RunError: its configuration or its metrics are damaged.
    """
    config, last = load_run_config(path), last_record(path)
    steps = last.get("env_steps") or 0
    state = "finished" if steps >= config.total_env_steps else "stopped"
    times = [file.stat().st_mtime for name in (CONFIG_FILE, METRICS_FILE) if (file := path / name).exists()]
    return Run(path, config, "running" if is_running(path) else state, last, max(times))


def is_running(path: Path) -> bool:
    """Whether a process holds the run's lock."""
    try:
        with open(path / LOCK_FILE, "rb") as file:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:  # no lock file, or one that we may not read: nobody is known to hold it
        return False
    return False


def last_record(path: Path) -> Record:
    """The newest whole record of a run's metrics; empty where there is none.

    Raises:
      RunError: the file cannot be read.
    """
    file = path / METRICS_FILE
    try:
        with open(file, "rb") as stream:
            stream.seek(max(0, file.stat().st_size - TAIL_BYTES))
            lines = stream.read().splitlines()
    except FileNotFoundError:
        return {}
    except OSError as error:
        raise RunError(f"{file}: cannot be read ({error.strerror})") from None
    for line in reversed(lines):
        try:
            record = json.loads(line)
        except ValueError:  # the last line of a run that is writing
            continue
        if isinstance(record, dict):
            return record
    return {}
