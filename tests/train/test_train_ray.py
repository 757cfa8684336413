"""The real command line with `--backend=ray`, on this machine alone."""

import importlib.util
import json
import os
import subprocess
import sys
from pathlib import Path

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


def test_a_run_gives_the_numbers_of_the_cpu_pool_and_leaves_nothing(tmp_path):
    config = tmp_path / "tiny.yaml"
    config.write_text(TINY)
    ray_run, pool_run = tmp_path / "ray", tmp_path / "pool"
    arguments = [sys.executable, "-m", "hasrl_jax.train", "--config", config, "--run-dir", ray_run, "--backend=ray"]
    command = [*map(str, arguments), "--total-env-steps", str(10**9)]
    clean = {name: value for name, value in os.environ.items() if not name.startswith("RAY_")} | {"XLA_FLAGS": ""}
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=clean)
    seen = ""
    for line in process.stdout:
        seen += line
        if "iteration 2" in line:
            break
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
    subprocess.run(alone, env=clean, check=True, capture_output=True)
    assert untimed(ray_run, 2) == untimed(pool_run, 2)
