"""What a run reports: metrics.jsonl, TensorBoard events and lines on the terminal."""

import contextlib
import json
import logging
import math
import numbers
import os
import sys
import time
from collections import deque
from collections.abc import Iterator, Mapping
from pathlib import Path

from rich.console import Console
from rich.live import Live
from tensorboardX.event_file_writer import EventsWriter
from tensorboardX.proto.event_pb2 import Event, SessionLog  # pyright: ignore[reportAttributeAccessIssue]
from tensorboardX.proto.summary_pb2 import Summary  # pyright: ignore[reportAttributeAccessIssue]

from hasrl_jax.errors import RunError
from hasrl_jax.runs import dashboard
from hasrl_jax.runs.directory import METRICS_FILE, TENSORBOARD_DIRECTORY

log = logging.getLogger("hasrl_jax")
_COLLECT_METRICS = ("env_steps", "stage", "diverged_envs", "workers_lost", "dropped_stale", "replay_ratio")
_BLOCK = 2**16  # bytes that are read at once
_RATE_WINDOW = 20  # iterations over which the speed behind "time left" is measured


class MetricsWriter:
    """Writes one record per iteration; use as a context manager.

    Both files are written and flushed before `write` returns, by this thread: a full disk is then an error here
    and now, and a crash costs at most the record being written.

    Args:
      run: the run directory.
      start_iteration: the iteration that was restored, 0 for a new run. Later records are cut away, so that the file
        never holds an iteration twice; TensorBoard is told to hide them.

    Raises:
      RunError: the files cannot be opened or written.
    """

    def __init__(self, run: Path, start_iteration: int) -> None:
        self._path = run / METRICS_FILE
        events = run / TENSORBOARD_DIRECTORY
        try:
            events.mkdir(parents=True, exist_ok=True)
            self._file = open(self._path, "a+b", buffering=0)  # noqa: SIM115 (closed by `close`)
            self._file.truncate(_end_of_iteration(self._path, start_iteration))
            # The process id keeps two files of the same second apart.
            self._events = EventsWriter(str(events / "events"), f".{os.getpid()}")
            if start_iteration:
                restart = SessionLog(status=SessionLog.START)
                self._events.write_event(Event(wall_time=time.time(), step=start_iteration + 1, session_log=restart))
            self._events.flush()
        except OSError as error:
            raise RunError(f"{run}: the metrics cannot be written: {error.strerror}") from error

    def __enter__(self) -> "MetricsWriter":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def write(self, record: Mapping[str, float | int | None]) -> None:
        """Appends a record; `iteration` is required, and what is not finite is written as null.

        Raises:
          RunError: it cannot be written; the file then ends with the record before.
        """
        finite = {name: plain_number(value) for name, value in record.items()}
        line = json.dumps(finite, allow_nan=False).encode() + b"\n"
        end = self._file.seek(0, os.SEEK_END)
        try:
            written = self._file.write(line)
            if written != len(line):  # a nearly full disk takes a part; the rest raises the error
                self._file.write(line[written:])
        except OSError as error:
            self._file.truncate(end)
            raise RunError(f"{self._path}: cannot be written: {error.strerror}") from error
        values = [Summary.Value(tag=tag(name), simple_value=x) for name, x in finite.items() if x is not None]
        event = Event(wall_time=time.time(), step=int(finite["iteration"] or 0), summary=Summary(value=values))
        try:
            self._events.write_event(event)
            self._events.flush()
        except OSError as error:
            events = self._path.parent / TENSORBOARD_DIRECTORY
            raise RunError(f"{events}: cannot be written: {error.strerror}") from error

    def close(self) -> None:
        """Closes the files; everything was written before."""
        self._file.close()
        with contextlib.suppress(OSError):  # a full disk was reported by `write`
            self._events.close()


def tag(name: str) -> str:
    """The TensorBoard tag of a metric: grouped as train/, eval/, time/, collect/, reward/ and learner/."""
    if "/" in name:
        return name
    if name.endswith(("_seconds", "_per_second")):
        return f"time/{name}"
    if name.endswith("_train"):
        return f"train/{name.removesuffix('_train')}"
    if name.startswith("eval_"):
        return f"eval/{name.removeprefix('eval_')}"
    return f"collect/{name}" if name in _COLLECT_METRICS or name.startswith("policy_lag") else f"learner/{name}"


class ProgressPrinter:
    """One compact line per iteration; on a terminal also the `dashboard` below them.

    Args:
      total_env_steps: environment steps at which the run ends.
      start_env_steps: environment steps done before, by the run that is resumed.
    """

    def __init__(self, total_env_steps: int, start_env_steps: int = 0) -> None:
        self._total = total_env_steps
        self._history = deque([(time.monotonic(), start_env_steps)], maxlen=_RATE_WINDOW + 1)
        self._live: Live | None = None
        self._shown = dashboard.History()
        self._film = ""
        self._lost = False  # nothing can be shown any more
        if sys.stdout is not None and sys.stdout.isatty():
            # Without a refresh thread, messages of the log are never overwritten in the middle.
            self._live = Live(console=Console(file=sys.stdout, highlight=False), auto_refresh=False)
            self._live.start()
            self._live.console.show_cursor(True)  # a run that is killed must not leave the terminal without one

    def __enter__(self) -> "ProgressPrinter":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def update(self, record: Mapping[str, float | int | None]) -> None:
        """Shows a record as given to `MetricsWriter.write`."""
        env_steps = int(record.get("env_steps") or 0)
        self._history.append((time.monotonic(), env_steps))
        left = f"{_clock(self._seconds_left())} left"
        line = progress_line(record)
        with self._whatever_becomes_of_it():
            if self._live is None:
                print(f"{line} | {left}", flush=True)
                return
            self._shown.add(record)
            self._live.console.print(line, soft_wrap=True, markup=False)
            now = dashboard.machine()
            self._live.update(dashboard.view(record, self._shown, now, self._film, self._total, left), refresh=True)

    def attach(self, name: str, path: Path) -> None:
        """A film that was made is named from now on."""
        self._film = str(path)

    def close(self) -> None:
        """Gives the terminal back."""
        if self._live is not None:
            with self._whatever_becomes_of_it():
                self._live.stop()

    @contextlib.contextmanager
    def _whatever_becomes_of_it(self) -> Iterator[None]:
        """A terminal that is gone, a pipe that nobody reads any more or a full disk must not end the training."""
        try:
            yield
        except (OSError, ValueError) as error:  # ValueError: the stream was closed
            if not self._lost:
                log.warning("the progress cannot be shown (%s); training goes on, and metrics.jsonl has it all", error)
            self._lost, self._live = True, None

    def _seconds_left(self) -> float | None:
        (first_time, first_steps), (last_time, last_steps) = self._history[0], self._history[-1]
        if last_steps <= first_steps:
            return None
        return max(0, self._total - last_steps) * (last_time - first_time) / (last_steps - first_steps)


class NullLogger:
    """Takes the place of the writer and of the printer where another process reports."""

    def __enter__(self) -> "NullLogger":
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def write(self, record: Mapping[str, float | int | None]) -> None:
        """Does nothing."""

    def update(self, record: Mapping[str, float | int | None]) -> None:
        """Does nothing."""

    def attach(self, name: str, path: Path) -> None:
        """Does nothing."""


def progress_line(record: Mapping[str, float | int | None]) -> str:
    """A record as one line for the terminal; what is unknown shows as a dash, a missing test not at all."""

    def show(name: str, form: str) -> str:
        value = plain_number(record.get(name))
        return "-" if value is None else format(value, form)

    parts = [
        f"iteration {show('iteration', '.0f')}",
        f"{show('env_steps', ',.0f')} env steps",
        f"{show('env_steps_per_second', ',.0f')}/s",
        f"train return {show('episode_return_train', '.1f')} length {show('episode_length_train', '.0f')}",
    ]
    if record.get("eval_return") is not None:
        parts.append(f"eval return {show('eval_return', '.1f')} length {show('eval_length', '.0f')}")
    parts.append(f"KL {show('approx_kl', '.4f')} entropy {show('entropy', '.2f')}")
    return " | ".join(parts)


def plain_number(value: float | int | None) -> float | int | None:
    """A plain number; None for None, NaN and the infinities, which JSON does not know."""
    if value is None:
        return None
    if isinstance(value, numbers.Integral):
        return int(value)
    return float(value) if math.isfinite(value) else None


def _clock(seconds: float | None) -> str:
    if seconds is None:
        return "-:--:--"
    return f"{int(seconds) // 3600}:{int(seconds) % 3600 // 60:02d}:{int(seconds) % 60:02d}"


def _end_of_iteration(path: Path, iteration: int) -> int:
    """Where the records up to `iteration` end, bytes; what follows is later, or torn by a crash.

    Read from the end, where that is: a long run is continued as soon as a short one.
    """
    position = path.stat().st_size  # where what was read begins
    later = b""  # the end of a line that begins before
    with open(path, "rb") as file:
        while position:
            size = min(_BLOCK, position)
            position -= size
            file.seek(position)
            lines = (file.read(size) + later).splitlines(keepends=True)
            later = lines.pop(0) if position else b""
            end = position + len(later) + sum(map(len, lines))
            for line in reversed(lines):
                if line.endswith(b"\n") and _iteration_of(line) <= iteration:
                    return end
                end -= len(line)
    return 0


def _iteration_of(line: bytes) -> float:
    """Which iteration a record is of; infinity where it is none."""
    try:
        number = json.loads(line)["iteration"]
    except (ValueError, TypeError, KeyError):
        return math.inf
    return number if isinstance(number, int) else math.inf
