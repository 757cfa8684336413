"""`--backend=mjx` through the real command line: the same runs, metrics, checkpoints and errors as the CPU pool.

Eight simulated devices, as everywhere in the tests; the first test is a process with one device, as a user has.
"""

import json
import math
import os
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest
from tiny import tiny_yaml

from hasrl_jax.cli.evaluate import main as evaluate_main
from hasrl_jax.cli.train import main as train_main
from hasrl_jax.runs.directory import load_run_config
from hasrl_jax.train import loop as train

ROOT = Path(__file__).parents[2]
STEPS = 256  # environment steps of an iteration
TINY = tiny_yaml(
    backend="mjx",
    physics={"steps_per_env_step": 2},
    collect={"num_workers": 1, "envs_per_worker": 4, "env_steps_per_iteration": 256, "max_episode_steps": 12},
    mjx={"num_envs": 16},
    checkpoint={"every_iterations": 1, "keep": 9},
)
ONLY_POOL, ONLY_MJX = {"workers_lost"}, {"contact_overflow", "constraint_overflow"}


@pytest.fixture
def tiny(tmp_path: Path) -> Path:
    path = tmp_path / "tiny.yaml"
    path.write_text(TINY)
    return path


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two iterations in this process; the tests continue copies of it."""
    folder = tmp_path_factory.mktemp("mjx")
    (folder / "tiny.yaml").write_text(TINY)
    assert train_main(["--config", str(folder / "tiny.yaml"), "--run-dir", str(folder / "run")]) == 0
    return folder / "run"


def records(run: Path) -> list[dict]:
    return [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]


def untimed(run: Path) -> list[dict]:
    return [{name: value for name, value in record.items() if "second" not in name} for record in records(run)]


def test_the_command_trains_on_one_device(tmp_path: Path, tiny: Path) -> None:
    run = tmp_path / "run"
    command = [sys.executable, "-m", "hasrl_jax.train", "--backend=mjx", "--config", str(tiny), "--run-dir", str(run)]
    environment = {name: value for name, value in os.environ.items() if name not in ("NPROC", "XLA_FLAGS")}
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, env=environment, timeout=120)
    assert done.returncode == 0, done.stderr
    for expected in ("backend mjx", "16 MJX environments (jax)", "no accelerator", "NPROC=1", "compiling", str(run)):
        assert expected in done.stderr
    assert "iteration 2" in done.stdout
    assert [record["env_steps"] for record in records(run)] == [STEPS, 2 * STEPS]
    assert load_run_config(run).backend == "mjx"


def test_metrics_are_those_of_the_cpu_pool(trained: Path, tiny: Path, tmp_path: Path) -> None:
    assert len(jax.devices()) == 8
    pool = tmp_path / "pool"
    assert train_main(["--config", str(tiny), "--backend=cpu_pool", "--run-dir", str(pool)]) == 0
    names = [[set(record) for record in records(run)] for run in (trained, pool)]
    assert [ours - ONLY_MJX for ours in names[0]] == [theirs - ONLY_POOL for theirs in names[1]]
    for record in records(trained):
        assert record["ratio_first"] == pytest.approx(1.0, abs=1e-4)
        assert record["diverged_envs"] == record["contact_overflow"] == record["constraint_overflow"] == 0
        assert 1 <= record["episode_length_train"] <= 12
        assert all(math.isfinite(value) for value in record.values() if value is not None)


def test_a_resumed_run_gives_the_same_numbers(trained: Path, tiny: Path, tmp_path: Path) -> None:
    halves = tmp_path / "halves"
    assert train_main(["--config", str(tiny), "--run-dir", str(halves), "--total-env-steps", str(STEPS)]) == 0
    assert train_main(["--resume", str(halves), "--total-env-steps", str(2 * STEPS)]) == 0
    first, second = untimed(halves)
    expected = untimed(trained)
    assert second == expected[1]
    # The first half's last iteration is evaluated because it is the last; the evaluation changes nothing.
    assert {name: value for name, value in first.items() if name in expected[0]} == expected[0]


def test_overlap_acts_with_parameters_one_version_old(tiny: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    arguments = ["--config", str(tiny), "--run-dir", str(run), "--schedule", "overlap"]
    assert train_main([*arguments, "--total-env-steps", str(3 * STEPS)]) == 0
    assert [record["policy_lag"] for record in records(run)] == [0, 1, 1]


@pytest.mark.parametrize(("first", "second"), [("mjx", "cpu_pool"), ("cpu_pool", "mjx")])
def test_a_policy_goes_on_in_the_other_mode(first: str, second: str, tiny: Path, tmp_path: Path, caplog) -> None:
    run, figures = tmp_path / "run", tmp_path / "figures.json"
    begin = ["--config", str(tiny), "--backend", first, "--run-dir", str(run), "--total-env-steps", str(STEPS)]
    assert train_main(begin) == 0
    played = ["--run-dir", str(run), "--episodes", "3", "--seconds", "0.2", "--json", str(figures)]
    assert evaluate_main(played) == 0
    before = json.loads(figures.read_text())
    assert before["episodes"] == 3
    assert np.isfinite(before["episode_return"]["mean"])

    train.log.addHandler(caplog.handler)  # the program's messages do not reach the root logger
    try:
        goes_on = ["--resume", str(run), "--backend", second, "--total-env-steps", str(2 * STEPS)]
        assert train_main(goes_on) == 0
    finally:
        train.log.removeHandler(caplog.handler)
    assert "episodes begin anew" in caplog.text
    assert [record["iteration"] for record in records(run)] == [1, 2]
    assert records(run)[-1]["ratio_first"] == pytest.approx(1.0, abs=1e-4)
    assert load_run_config(run).backend == second
    assert evaluate_main(played) == 0


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["--physics.solver", "PGS"], ["physics.solver", "Newton"]),
        (["--mjx.num-envs", "20"], ["mjx.num_envs", "20", "8 devices", "16"]),
        (["--mjx.num-envs", "0"], ["mjx.num_envs", "0", "1"]),
        (["--collect.mode", "episodes"], ["collect.mode", "unrolls"]),
        (["--mjx.impl", "warp"], ["mjx.impl", "warp", "jax"]),
        (["--ppo.minibatch-trajectories", "12"], ["ppo.minibatch_trajectories", "8 devices"]),
    ],
    ids=["solver", "devices", "none", "mode", "warp", "minibatch"],
)
def test_bad_input_is_one_line_that_names_the_setting(
    arguments: list[str], named: list[str], tiny: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    run = tmp_path / "run"
    assert train_main(["--config", str(tiny), "--run-dir", str(run), *arguments]) != 0
    errors = [line for line in capsys.readouterr().err.splitlines() if line.startswith("error:")]
    assert len(errors) == 1
    assert all(name in errors[0] for name in named), errors
    assert not run.exists(), "the refused run must not block the corrected one"


def test_too_little_memory_is_one_line(tiny: Path, tmp_path: Path, monkeypatch, capsys) -> None:
    def fail(*_: object) -> None:
        raise jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: out of memory")

    monkeypatch.setattr("hasrl_jax.collect.mjx.MjxRollout._collect", fail)
    assert train_main(["--config", str(tiny), "--run-dir", str(tmp_path / "run")]) == 1
    errors = [line for line in capsys.readouterr().err.splitlines() if line.startswith("error:")]
    assert len(errors) == 1
    assert "mjx.num_envs: 16" in errors[0]
    assert "try 8" in errors[0]
