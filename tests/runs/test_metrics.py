"""The metrics file holds every iteration once, and nothing that is not JSON."""

import contextlib
import json
import math
import os
import resource
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tensorboardX.proto.event_pb2 import Event, SessionLog  # pyright: ignore[reportAttributeAccessIssue]

from hasrl_jax.errors import RunError
from hasrl_jax.runs import metrics
from hasrl_jax.runs.metrics import MetricsWriter, ProgressPrinter, progress_line, tag

TORN = [b'{"iteration": 4, "entr\n', b"\0\0\0\n", b'"text"\n', b"[]\n", b"\n"]


def records(run: Path) -> list[dict]:
    return [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]


def events(run: Path) -> list[Event]:
    """All events of all files, in the order of writing; the format is length, checksum, data, checksum."""
    found = []
    for path in sorted((run / "tensorboard").iterdir(), key=lambda path: path.stat().st_mtime_ns):
        data = path.read_bytes()
        while data:
            size = int.from_bytes(data[:8], "little")
            found.append(Event.FromString(data[12 : 12 + size]))
            data = data[16 + size :]
    return found


def write(run: Path, iterations: range, start: int = 0) -> None:
    with MetricsWriter(run, start) as writer:
        for iteration in iterations:
            writer.write({"iteration": iteration, "entropy": iteration / 3})


def test_records_are_plain_json(tmp_path: Path) -> None:
    before = threading.active_count()
    with MetricsWriter(tmp_path, 0) as writer:
        record: dict[str, Any] = {"iteration": np.int64(1), "entropy": np.float32(0.5)}
        writer.write(record | {"a": math.nan, "b": -math.inf, "c": None})
        assert records(tmp_path) == [{"iteration": 1, "entropy": 0.5, "a": None, "b": None, "c": None}]  # flushed
        assert threading.active_count() == before
    assert b"NaN" not in (tmp_path / "metrics.jsonl").read_bytes()


def test_tensorboard_events(tmp_path: Path) -> None:
    with MetricsWriter(tmp_path, 0) as writer:
        writer.write({"iteration": 7, "eval_return": 2.5, "approx_kl": math.nan, "reward/foot_force": 0.25})
    *_, event = events(tmp_path)
    assert event.step == 7
    values = {value.tag: value.simple_value for value in event.summary.value}
    assert values == {"learner/iteration": 7, "eval/return": 2.5, "reward/foot_force": 0.25}


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("episode_return_train", "train/episode_return"),
        ("eval_length", "eval/length"),
        ("test_seconds", "time/test_seconds"),
        ("env_steps_per_second", "time/env_steps_per_second"),
        ("workers_lost", "collect/workers_lost"),
        ("reward/velocity", "reward/velocity"),
        ("std_mean", "learner/std_mean"),
    ],
)
def test_tags(name: str, expected: str) -> None:
    assert tag(name) == expected


def test_resume_cuts_what_is_later_than_the_checkpoint(tmp_path: Path) -> None:
    write(tmp_path, range(1, 8))
    write(tmp_path, range(5, 7), start=4)
    assert [record["iteration"] for record in records(tmp_path)] == [1, 2, 3, 4, 5, 6]
    restarts = [event for event in events(tmp_path) if event.session_log.status == SessionLog.START]
    assert [event.step for event in restarts] == [5]
    write(tmp_path, range(0))
    assert records(tmp_path) == []  # a run that starts over keeps nothing


@pytest.mark.parametrize("torn", [b'{"iteration": 4, "entr', b'{"iteration": 4}', b"\0\0\0\n", b'"text"\n', b"[]\n\n"])
def test_torn_last_line_is_cut(tmp_path: Path, torn: bytes) -> None:
    write(tmp_path, range(1, 4))
    with open(tmp_path / "metrics.jsonl", "ab") as file:
        file.write(torn)
    write(tmp_path, range(4, 5), start=9)
    assert [record["iteration"] for record in records(tmp_path)] == [1, 2, 3, 4]


@given(
    lines=st.lists(
        st.one_of(st.integers(0, 9).map(lambda n: b'{"iteration": %d, "x": [1]}\n' % n), st.sampled_from(TORN))
    ),
    torn=st.sampled_from([b"", *TORN]),
    iteration=st.integers(0, 9),
    block=st.integers(1, 60),
)
def test_the_end_of_an_iteration_is_found_from_either_side(
    lines: list[bytes], torn: bytes, iteration: int, block: int, tmp_path_factory: pytest.TempPathFactory
) -> None:
    path = tmp_path_factory.mktemp("metrics") / "metrics.jsonl"
    path.write_bytes(b"".join([*lines, torn.rstrip(b"\n")]))
    expected = position = 0
    for line in path.read_bytes().splitlines(keepends=True):  # from the beginning
        position += len(line)
        if line.startswith(b'{"iteration": ') and line.endswith(b"}\n") and line[14] - ord("0") <= iteration:
            expected = position
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(metrics, "_BLOCK", block)
        assert metrics._end_of_iteration(path, iteration) == expected


def test_a_long_run_is_resumed_from_the_end_of_its_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    lines = [json.dumps({"iteration": n, "entropy": n / 3}).encode() + b"\n" for n in range(1, 100_001)]
    (tmp_path / "metrics.jsonl").write_bytes(b"".join(lines))
    parsed: list[bytes] = []
    loads = json.loads
    monkeypatch.setattr(json, "loads", lambda line: parsed.append(line) or loads(line))
    write(tmp_path, range(99_996, 99_998), start=99_995)
    assert len(parsed) == 6  # the five that are cut, and the one before
    monkeypatch.undo()
    assert [record["iteration"] for record in records(tmp_path)] == list(range(1, 99_998))


def test_disk_full(tmp_path: Path) -> None:
    """A limit on file size stands in for the disk: the second record does not fit."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    writer = MetricsWriter(tmp_path, 0)
    writer.write({"iteration": 1})
    resource.setrlimit(resource.RLIMIT_FSIZE, (200, hard))
    try:
        with pytest.raises(RunError, match=rf"^{tmp_path}/metrics\.jsonl: cannot be written: File too large$"):
            writer.write({"iteration": 2, "name" * 100: 0.1})
        writer.close()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert records(tmp_path) == [{"iteration": 1}]


def test_unwritable_place(tmp_path: Path) -> None:
    (tmp_path / "tensorboard").write_text("")
    with pytest.raises(RunError, match=f"{tmp_path}: the metrics cannot be written: File exists"):
        MetricsWriter(tmp_path, 0)


def test_plain_progress_is_one_line_per_iteration(capsys: pytest.CaptureFixture) -> None:
    printer = ProgressPrinter(total_env_steps=3000, start_env_steps=1000)
    printer.update({"iteration": 1, "env_steps": 2000, "eval_return": 3.0, "approx_kl": math.nan})
    printer.update({"iteration": 2.0, "env_steps": 3000, "env_steps_per_second": 12345.6, "entropy": 1.5})
    printer.close()
    first, second = capsys.readouterr().out.splitlines()
    assert "iteration 1 | 2,000 env steps | -/s" in first and "eval return 3.0" in first and "KL - " in first
    assert "12,346/s" in second and "entropy 1.50" in second and second.endswith("0:00:00 left")
    assert "test" not in second


def test_terminal_progress(monkeypatch: pytest.MonkeyPatch) -> None:
    """On a terminal the lines stay and a bar follows them."""
    master, slave = os.openpty()
    with open(slave, "w") as terminal:
        monkeypatch.setattr("sys.stdout", terminal)
        monkeypatch.setenv("TERM", "xterm")
        printer = ProgressPrinter(total_env_steps=4000)
        printer.update({"iteration": 1, "env_steps": 1000})
        printer.close()
    shown = ""
    with contextlib.suppress(OSError):  # the end of what was written
        while True:
            shown += os.read(master, 100_000).decode()
    os.close(master)
    assert progress_line({"iteration": 1, "env_steps": 1000}) in shown and "25%" in shown and " left" in shown
