"""The directory of a training run: created or reopened, checked and locked before any work starts.

It holds config.yaml (resolved configuration), metrics.jsonl, tensorboard/, checkpoints/ and run.lock.
"""

import dataclasses
import fcntl
import os
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from hasrl_jax.config import strict_yaml
from hasrl_jax.config.checks import check
from hasrl_jax.config.compat import upgraded
from hasrl_jax.config.convert import LAST, from_dict
from hasrl_jax.config.files import dump_yaml
from hasrl_jax.config.schema import Config
from hasrl_jax.errors import ConfigError, RunError
from hasrl_jax.runs import durable

CONFIG_FILE = "config.yaml"
METRICS_FILE = "metrics.jsonl"
TENSORBOARD_DIRECTORY = "tensorboard"
CHECKPOINTS_DIRECTORY = "checkpoints"
FILMS_DIRECTORY = "films"
LOCK_FILE = "run.lock"
OF_A_RUN = (CONFIG_FILE, METRICS_FILE, TENSORBOARD_DIRECTORY, CHECKPOINTS_DIRECTORY, FILMS_DIRECTORY, LOCK_FILE)


@dataclasses.dataclass(frozen=True)
class RunDirectory:
    """An open run directory, locked for this process."""

    path: Path

    @property
    def checkpoints(self) -> Path:
        """Where the checkpoints lie."""
        return self.path / CHECKPOINTS_DIRECTORY


@contextmanager
def open_run(config: Config, resume: bool) -> Iterator[RunDirectory]:
    """Creates the directory of a new run, or reopens that of an old one, and holds its lock.

    Args:
      config: `run_dir` says where; empty stands for runs/<task>-<time>. Written to config.yaml when the run is new.
      resume: continue the run that is there.

    Raises:
      RunError: in use by another process, holds a run already, or something else, holds none to resume, leads elsewhere
        by links, cannot be written, or has a name that is not UTF-8.
    """
    _require_utf8(Path(config.run_dir))
    if resume:
        path = Path(config.run_dir)
        _require_run(path)
    elif config.distributed.process_id:
        path = Path(config.run_dir)
    else:
        path = _create(config)
    if config.distributed.process_id:  # the first process holds it for all
        yield RunDirectory(path)
        return
    _require_inside(path)
    with _locked(path):
        if not resume:
            _require_no_run(path)
        _require_writable(path)
        if not resume:
            write_config(path, config)
        yield RunDirectory(path)


def load_run_config(run_dir: Path) -> Config:
    """The resolved configuration of a run.

    Raises:
      RunError: no such directory, not a run directory, or a damaged configuration.
    """
    run_dir = Path(run_dir)
    _require_run(run_dir)
    path = run_dir / CONFIG_FILE
    try:
        text = path.read_text(encoding="utf-8")
        values = strict_yaml.parse(text)
    except (OSError, ValueError) as error:
        raise RunError(f"{path}: cannot be read: {_reason(error)}") from None
    # A file that was cut short is often still valid YAML; defaults must not quietly take the place of what is missing.
    # Only the last group tells: others may be younger than the run.
    missing = not isinstance(values, dict) or LAST not in values
    if missing or not text.endswith("\n"):
        cut = f"{LAST} is missing" if missing else "the last line is cut short"
        raise RunError(f"{path}: damaged, or written by another version: {cut}")
    try:
        config = from_dict(upgraded(values), where=CONFIG_FILE)
        check(config)
    except ConfigError as error:
        raise RunError(f"{path}: damaged, or written by another version: {error}") from None
    return config


def _create(config: Config) -> Path:
    """The directory of a new run; a name made from the time is never shared with another run."""
    path = Path(config.run_dir)
    try:
        if config.run_dir:
            _require_nothing_else(path)
            path.mkdir(parents=True, exist_ok=True)
            return _protected(path, config)
        name = f"{config.task}-{time.strftime('%Y%m%d-%H%M%S')}"
        for suffix in ("", *(f"-{number}" for number in range(2, 1000))):
            path = Path("runs", name + suffix)
            try:
                path.mkdir(parents=True)
                return _protected(path, config)
            except FileExistsError:
                if not path.is_dir():  # `runs` itself is a file
                    raise
        raise RunError(f"{path}: too many runs were started in the same second")
    except OSError as error:
        reason = "that is a file; expected a folder" if path.is_file() else _reason(error)
        raise RunError(f"{path}: the run directory cannot be created: {reason}") from None


def _protected(path: Path, config: Config) -> Path:
    """`path`, which none but its owner can enter if the configuration wants it so."""
    if config.private:
        path.chmod(0o700)
    return path


def _require_inside(path: Path) -> None:
    """Refuses a run whose files are links to somewhere else: what is written or read would not be of this run.

    Raises:
      RunError: names the link.
    """
    inside = path.resolve()
    for name in OF_A_RUN:
        place = path / name
        if not place.resolve().is_relative_to(inside):
            raise RunError(f"{place}: a link that leads out of the run, to {place.resolve()}; put what it names here")


def _require_utf8(path: Path) -> None:
    """Refuses a path that Python took apart byte by byte, as it does where the language of the system is ASCII."""
    try:
        str(path.absolute()).encode()
    except UnicodeEncodeError:
        remedy = "set PYTHONUTF8=1, or choose another run_dir"
        raise RunError(f"{str(path)!a}: checkpoints need a path in UTF-8; {remedy}") from None


def _require_run(path: Path) -> None:
    if not path.is_dir():
        raise RunError(f"{path}: there is no such run directory")
    if not (path / CONFIG_FILE).is_file():
        runs = [parent for parent in path.resolve().parents[:2] if (parent / CONFIG_FILE).is_file()]
        hint = f"; did you mean {runs[0]}?" if runs else ""
        raise RunError(f"{path}: not a run directory, it has no {CONFIG_FILE}{hint}")
    _require_inside(path)


def _require_nothing_else(path: Path) -> None:
    """Refuses a folder of somebody's other files; hidden ones, and those without content, do not count."""
    if not path.is_dir() or (path / CONFIG_FILE).exists():
        return
    for other in sorted(path.iterdir()):
        has_content = any(other.iterdir()) if other.is_dir() else other.exists() and other.stat().st_size
        if has_content and not other.name.startswith((".", *OF_A_RUN)):
            raise RunError(f"{path}: holds {other.name} and no run; choose a new folder, {path / 'NAME'}")


def _require_no_run(path: Path) -> None:
    """Empty files and directories do not count: a start that failed leaves them behind."""
    checkpoints, metrics = path / CHECKPOINTS_DIRECTORY, path / METRICS_FILE
    has_checkpoints = checkpoints.is_dir() and any(checkpoints.iterdir())
    if (path / CONFIG_FILE).exists():
        raise RunError(f"{path}: already holds a run; continue it with --resume {path}, or choose another run_dir")
    if has_checkpoints or (metrics.is_file() and metrics.stat().st_size):
        raise RunError(f"{path}: holds parts of a run but no {CONFIG_FILE}; choose another run_dir")


def _require_writable(path: Path) -> None:
    """Creates the checkpoint directory and proves that files can be written where the run will write them."""
    place = path
    try:
        for place in (path, path / CHECKPOINTS_DIRECTORY, path / TENSORBOARD_DIRECTORY):
            place.mkdir(exist_ok=True)
            with tempfile.TemporaryFile(dir=place) as probe:
                probe.write(b"\0")
        place = path / METRICS_FILE
        with open(place, "ab"):
            pass
    except OSError as error:
        raise RunError(f"{place}: cannot be written: {_reason(error)}") from None


def write_config(run_dir: Path, config: Config) -> None:
    """Writes config.yaml, all or nothing: one cut short by a full disk would read as another configuration.

    Raises:
      RunError: it cannot be written.
    """
    path = run_dir / CONFIG_FILE
    partial = path.with_name(path.name + ".partial")
    try:
        partial.write_text(dump_yaml(config), encoding="utf-8")
        durable.replace(partial, path)
    except OSError as error:
        raise RunError(f"{path}: cannot be written: {_reason(error)}") from None


@contextmanager
def _locked(path: Path) -> Iterator[None]:
    """Holds the advisory lock of the run; the kernel frees it however this process ends."""
    lock_path = path / LOCK_FILE
    try:
        file = open(lock_path, "a+b", buffering=0)  # noqa: SIM115 (the lock lives as long as it is open)
    except OSError as error:
        raise RunError(f"{path}: cannot be written: {_reason(error)}") from None
    with file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            file.truncate(0)
            file.write(str(os.getpid()).encode())
        except BlockingIOError:
            raise RunError(f"{path}: in use by another run, process {_holder(file)}") from None
        except OSError as error:
            raise RunError(f"{lock_path}: cannot be locked: {_reason(error)}") from None
        yield  # the file stays when it is closed: removing it would free a name that others may be waiting on


def _holder(file: BinaryIO) -> str:
    file.seek(0)
    return file.read(32).decode(errors="replace") or "unknown"


def _reason(error: Exception) -> str:
    return getattr(error, "strerror", None) or " ".join(str(error).split())
