"""The real command line with `--backend=ray`, on this machine alone."""

import importlib.util
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import psutil
import pytest
from tiny import tiny_yaml

if importlib.util.find_spec("ray") is None:
    pytest.skip('Ray is not installed: pip install "ray>=2.52"', allow_module_level=True)

TINY = tiny_yaml(ppo={"epochs": 2}, evaluate={"every_iterations": 0}, total_env_steps=256)


def untimed(run: Path, count: int) -> list[dict]:
    """The first records without what may differ between two runs: times, and the test of the last iteration."""
    records = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()][:count]
    return [{n: v for n, v in record.items() if "second" not in n and "eval_" not in n} for record in records]


def start(run: Path, config: Path, *more: object) -> subprocess.Popen:
    config.write_text(TINY)
    arguments = ["--config", config, "--run-dir", run, "--backend=ray", "--total-env-steps", 10**9, *more]
    command = [sys.executable, "-m", "hasrl_jax.train", *map(str, arguments)]
    options: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
    return subprocess.Popen(command, env=clean_environment(), **options)


def clean_environment() -> dict[str, str]:
    return {name: value for name, value in os.environ.items() if not name.startswith("RAY_")} | {"XLA_FLAGS": ""}


def wait_for(process: subprocess.Popen, text: str) -> str:
    """Reads the output until a line holds `text`, or to its end."""
    seen = ""
    for line in process.stdout:
        seen += line
        if text in line:
            break
    return seen


def test_a_run_gives_the_numbers_of_the_cpu_pool_and_leaves_nothing(tmp_path):
    config, ray_run, pool_run = tmp_path / "tiny.yaml", tmp_path / "ray", tmp_path / "pool"
    process = start(ray_run, config)
    seen = wait_for(process, "iteration 2")
    children = psutil.Process(process.pid).children(recursive=True)
    ids = {process.pid, *(child.pid for child in children)}
    listening = {c.laddr.ip for c in psutil.net_connections("inet") if c.pid in ids and c.status == "LISTEN"}
    process.terminate()
    seen += process.communicate(timeout=120)[0]
    assert process.returncode == 0, seen
    assert "Ray: 2 workers on 1 node" in seen
    assert "Warning" not in seen
    assert listening
    assert {address.removeprefix("::ffff:") for address in listening} == {"127.0.0.1"}
    _, alive = psutil.wait_procs(children, timeout=10)
    assert not alive
    alone = [sys.executable, "-m", "hasrl_jax.train", "--config", str(config), "--run-dir", str(pool_run)]
    subprocess.run(alone, env=clean_environment(), check=True, capture_output=True)
    assert untimed(ray_run, 2) == untimed(pool_run, 2)


def test_a_killed_raylet_is_one_line_and_what_is_finished_is_saved(tmp_path):
    run = tmp_path / "run"
    process = start(run, tmp_path / "tiny.yaml", "--collect.env-steps-per-iteration", 4096)
    seen = wait_for(process, "iteration 1 ")
    children = psutil.Process(process.pid).children(recursive=True)
    next(child for child in children if child.name() == "raylet").kill()
    seen += process.communicate(timeout=120)[0]
    assert process.returncode == 1, seen
    assert "Traceback" not in seen
    own = [line for line in seen.splitlines() if line and not line.startswith((" ", "\x1b"))]  # the others are Ray's
    assert own[-1] == "error: Ray's process on this machine, the raylet, has died, and all workers with it"
    last = json.loads((run / "metrics.jsonl").read_text().splitlines()[-1])["iteration"]
    assert (run / "checkpoints" / f"{last:09}").is_dir()
    _, alive = psutil.wait_procs(children, timeout=10)
    assert not alive
