"""What is Linux only has a fallback, and Windows a clear first line."""

import ctypes
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from hasrl_jax.cli.main import main, start
from hasrl_jax.collect import worker

LINUX_ONLY = ("memfd_create", "posix_fallocate", "sched_getaffinity", "sched_setaffinity")
# Run by every interpreter at its start, those of the workers too.
REMOVE = f"""
import os
for name in {LINUX_ONLY}:
    if hasattr(os, name):
        delattr(os, name)
"""
SMALL = (
    *("--config", "cartpole", "--num-workers", "1", "--total-env-steps", "256", "--network.hidden-size", "8"),
    *("--collect.env-steps-per-iteration", "128", "--collect.unroll-length", "16", "--ppo.epochs", "1"),
    *("--collect.envs-per-worker", "4", "--ppo.minibatch-trajectories", "8", "--evaluate.episodes", "1"),
)


def test_a_run_without_what_is_linux_only(tmp_path: Path) -> None:
    (tmp_path / "sitecustomize.py").write_text(REMOVE)
    environment = os.environ | {"PYTHONPATH": str(tmp_path), "XLA_FLAGS": ""}
    gone = f"import os; print([name for name in {LINUX_ONLY} if hasattr(os, name)])"
    shown = subprocess.run([sys.executable, "-c", gone], env=environment, capture_output=True, text=True, check=True)
    assert shown.stdout.strip() == "[]"

    command = [sys.executable, "-m", "hasrl_jax.train", *SMALL, "--run-dir", str(tmp_path / "run")]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    records = [json.loads(line) for line in (tmp_path / "run" / "metrics.jsonl").read_text().splitlines()]
    assert [record["env_steps"] for record in records] == [128, 256]
    assert any((tmp_path / "run" / "checkpoints").iterdir())


def test_only_linux_is_asked_to_end_workers(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise AssertionError("prctl exists on Linux only")

    monkeypatch.setattr(ctypes, "CDLL", refuse)
    monkeypatch.setattr(sys, "platform", "darwin")
    worker.die_with_parent(os.getppid())


@pytest.mark.parametrize("command", [lambda: main(["train"]), lambda: start("doctor", [])])
def test_windows_is_told_where_to_go(command, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    monkeypatch.setattr(sys, "platform", "win32")
    assert command() == 1
    first, *more = capsys.readouterr().err.splitlines()
    assert first.startswith("error: ") and "WSL 2" in first and not more
