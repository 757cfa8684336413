"""What goes wrong on real machines, done to real runs; docs/reliability.md has the table."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import psutil
import pytest
from tiny import tiny_yaml

from hasrl_jax.cli.train import main as train_main
from hasrl_jax.errors import CheckpointError, RunError
from hasrl_jax.runs import checkpoint
from hasrl_jax.runs.metrics import MetricsWriter
from hasrl_jax.train import loop

ROOT = Path(__file__).parents[2]
TINY = tiny_yaml(evaluate={"every_iterations": 0})
FOREVER = ("--total-env-steps", 10**9)


@pytest.fixture
def tiny(tmp_path: Path) -> Path:
    path = tmp_path / "tiny.yaml"
    path.write_text(TINY)
    return path


def train(*arguments: object) -> list[str]:
    return [sys.executable, "-m", "hasrl_jax.train", *map(str, arguments)]


def environment() -> dict[str, str]:
    return os.environ | {"XLA_FLAGS": ""}  # one device, as a user has


def start(*arguments: object) -> subprocess.Popen:
    options: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True, "cwd": ROOT}
    return subprocess.Popen(train(*arguments), env=environment(), start_new_session=True, **options)


def wait_for(process: subprocess.Popen, text: str) -> str:
    """Reads the output until a line holds `text`."""
    seen = ""
    for line in process.stdout:
        seen += line
        if text in line:
            return seen
    raise AssertionError(f"{text!r} never appeared in:\n{seen}")


def workers_of(process: subprocess.Popen) -> list[psutil.Process]:
    children = psutil.Process(process.pid).children(recursive=True)
    return [child for child in children if "hasrl_jax.collect.worker" in child.cmdline()]


def last_record(run: Path) -> dict:
    return json.loads((run / "metrics.jsonl").read_text().splitlines()[-1])


@pytest.mark.parametrize("streams", ["| head -1", "> /dev/full 2>&1", ">&-"])
def test_a_terminal_that_is_gone_costs_nothing(streams: str, tiny: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    command = ["bash", "-c", f"set -o pipefail; {' '.join(train('--config', tiny, '--run-dir', run))} {streams}"]
    done = subprocess.run(command, env=environment(), cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr and "Exception ignored" not in done.stderr
    assert last_record(run)["iteration"] == 4
    assert (run / "checkpoints" / "000000004").is_dir()


def test_a_pause_of_everything_is_not_the_silence_of_workers(tiny: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    process = start(
        "--config", tiny, "--run-dir", run, "--schedule", "overlap", "--collect.worker-timeout-s", 2, *FOREVER
    )
    try:
        wait_for(process, "iteration 3 ")
        os.killpg(process.pid, signal.SIGSTOP)
        time.sleep(5)
        os.killpg(process.pid, signal.SIGCONT)
        wait_for(process, f"iteration {last_record(run)['iteration'] + 20} ")
        assert last_record(run)["workers_lost"] == 0
    finally:
        os.killpg(process.pid, signal.SIGKILL)
        process.communicate()


def test_a_worker_killed_by_a_nameless_signal_and_then_all_at_once_are_replaced(tiny: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    process = start("--config", tiny, "--run-dir", run, *FOREVER)
    try:
        wait_for(process, "iteration 2 ")
        workers_of(process)[0].send_signal(40)
        seen = wait_for(process, "was killed by signal 40")
        for worker in workers_of(process):
            worker.kill()
        seen += wait_for(process, "was killed by SIGKILL")
        seen += wait_for(process, f"iteration {last_record(run)['iteration'] + 10} ")
        assert "Traceback" not in seen
        process.send_signal(signal.SIGTERM)
        process.communicate(timeout=60)
        assert process.returncode == 0
    finally:
        process.kill()
        process.communicate()


def is_importing(process: psutil.Process) -> bool:
    return any("jaxlib" in mapped.path for mapped in process.memory_maps())


def has_workers(process: psutil.Process) -> bool:
    return len(process.children()) > 0


@pytest.mark.parametrize("moment", [is_importing, has_workers])
def test_ctrl_c_in_the_first_seconds_is_one_line_and_leaves_nothing(
    moment: Callable[[psutil.Process], bool], tiny: Path, tmp_path: Path
) -> None:
    process = start("--config", tiny, "--run-dir", tmp_path / "run", *FOREVER)
    begun = psutil.Process(process.pid)
    while not moment(begun):
        time.sleep(0.02)
    children = begun.children(recursive=True)
    process.send_signal(signal.SIGINT)
    output = process.communicate(timeout=60)[0]
    # A child with which the package glfw looks for its library may be cut short too, and says so.
    assert f'File "{ROOT}' not in output, output
    assert "interrupted" in output or "finishing this iteration, then saving" in output
    assert process.returncode in (0, 130)
    psutil.wait_procs(children, timeout=5)  # they notice that their parent is gone
    assert not [child for child in children if child.is_running() and child.status() != psutil.STATUS_ZOMBIE]


def test_ctrl_c_before_the_first_iteration_leaves_a_run_that_goes_on(
    tiny: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    make_parts = loop.make_parts

    def interrupted(*arguments: Any) -> Any:
        signal.raise_signal(signal.SIGINT)
        return make_parts(*arguments)

    run = tmp_path / "run"
    with monkeypatch.context() as patched:
        patched.setattr(loop, "make_parts", interrupted)
        assert train_main(["--config", str(tiny), "--run-dir", str(run)]) == 0
    assert [path.name for path in (run / "checkpoints").iterdir()] == ["000000000"]
    assert train_main(["--resume", str(run)]) == 0
    assert last_record(run)["env_steps"] == 512


def test_a_first_save_that_fails_blocks_nothing(
    tiny: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["--config", str(tiny), "--run-dir", str(tmp_path / "run")]

    def fail(*_: object) -> None:
        raise CheckpointError("no space left")

    with monkeypatch.context() as patched:
        patched.setattr(checkpoint, "save", fail)
        assert train_main(arguments) == 1
    assert capsys.readouterr().err.splitlines()[-1] == "error: no space left"
    assert train_main(arguments) == 0


def test_what_is_finished_is_saved_when_the_metrics_cannot_be_written(
    tiny: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    write = MetricsWriter.write

    def fail(self: MetricsWriter, record: dict) -> None:
        if record["iteration"] == 3:
            raise RunError("metrics.jsonl: no space left")
        write(self, record)

    monkeypatch.setattr(MetricsWriter, "write", fail)
    assert train_main(["--config", str(tiny), "--run-dir", str(tmp_path / "run")]) == 1
    assert "no space left" in capsys.readouterr().err
    assert (tmp_path / "run" / "checkpoints" / "000000003").is_dir()


@pytest.mark.parametrize(
    ("option", "value"), [("normalize-observations", "False"), ("symmetric", "True"), ("learn-std", "False")]
)
def test_a_setting_that_changes_what_the_parameters_mean_is_refused(
    option: str, value: str, tiny: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = str(tmp_path / "run")
    assert train_main(["--config", str(tiny), "--run-dir", run, "--total-env-steps", "128"]) == 0
    assert train_main(["--resume", run, f"--network.{option}", value]) == 2
    error = capsys.readouterr().err.splitlines()[-1]
    assert error.startswith(f"error: network.{option.replace('-', '_')}: got {value}; this run has learnt with")


# Run by every interpreter at its start; the learner's clock keeps still, since Orbax counts the time of a save by it.
JUMPING_CLOCK = """
import itertools, sys, time
if "hasrl_jax.collect.worker" in sys.orig_argv:
    read, jumps = time.time, itertools.cycle([0, 4e7, -4e7])
    time.time = lambda: read() + next(jumps)
"""


def test_clocks_of_workers_that_jump_by_a_year_and_a_cache_that_cannot_be_written_cost_nothing(
    tiny: Path, tmp_path: Path
) -> None:
    (tmp_path / "sitecustomize.py").write_text(JUMPING_CLOCK)
    (tmp_path / "cache" / "hasrl_jax").mkdir(parents=True)
    (tmp_path / "cache" / "hasrl_jax" / "compiled").symlink_to("/proc/sys")  # where nobody can make files, root neither
    changed = {"PYTHONPATH": str(tmp_path), "XDG_CACHE_HOME": str(tmp_path / "cache")}
    options = ("--schedule", "overlap", "--collect.worker-timeout-s", 2)
    command = train("--config", tiny, "--run-dir", tmp_path / "run", *options)
    done = subprocess.run(
        command, env=environment() | changed, cwd=ROOT, capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr
    record = last_record(tmp_path / "run")
    assert (record["iteration"], record["workers_lost"]) == (4, 0)


def test_a_full_cache_costs_nothing_and_what_was_cut_off_in_it_neither(tiny: Path, tmp_path: Path) -> None:
    """The cache is a file system of its own that holds half a compiled program; the second start finds that half."""
    mounted = ["unshare", "--user", "--map-root-user", "--mount", "sh", "-c"]
    if not shutil.which("unshare") or subprocess.run([*mounted, "mount -t tmpfs none /mnt"], check=False).returncode:
        pytest.skip("no file system may be mounted here")
    (cache := tmp_path / "cache").mkdir()
    runs = [tmp_path / "first", tmp_path / "second"]
    first, second = (" ".join(train("--config", tiny, "--run-dir", run)) for run in runs)
    script = f"mount -t tmpfs -o size=8k none {cache} && {first} && ls {cache}/hasrl_jax/compiled && {second}"
    changed = {"XDG_CACHE_HOME": str(cache)}
    done = subprocess.run(
        [*mounted, script],
        env=environment() | changed,
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr
    assert [last_record(run)["iteration"] for run in runs] == [4, 4]
    assert "-cache\n" in done.stdout, "nothing was left in it"


def test_too_few_open_files_are_one_line(tiny: Path, tmp_path: Path) -> None:
    command = ["bash", "-c", f"ulimit -n 20; exec {' '.join(train('--config', tiny, '--run-dir', tmp_path / 'run'))}"]
    done = subprocess.run(command, env=environment(), cwd=ROOT, capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stderr.count("\n")) == (1, 1)
    assert done.stderr.startswith("error: at most 20 files may be open at once; expected 64 or more")
