"""Two training processes on this machine that share one learner."""

import json
import os
import socket
import subprocess
import sys
import threading
from pathlib import Path

import jax
import numpy as np
import pytest
import two_processes
from tiny import tiny_yaml

from hasrl_jax.cli import parsing as cli
from hasrl_jax.cli.train import main as train_main
from hasrl_jax.collect.plan import make_plan
from hasrl_jax.config.convert import from_dict
from hasrl_jax.config.curriculum import WINDOW
from hasrl_jax.config.schema import DistributedConfig
from hasrl_jax.envs.registry import make_task
from hasrl_jax.errors import ConfigError
from hasrl_jax.learn import ppo
from hasrl_jax.runs import checkpoint
from hasrl_jax.runs.directory import load_run_config
from hasrl_jax.train import distributed
from hasrl_jax.train import loop as train

SCRIPT = Path(two_processes.__file__)
TINY = tiny_yaml(collect={"num_workers": 1}, ppo={"epochs": 2}, total_env_steps=256)
# The first process alone evaluates, so it alone sees when the stage is reached.
STAGED = tiny_yaml(
    collect={"num_workers": 1},
    ppo={"policy_learning_rate": 1e-5},
    network={"learn_std": False},
    evaluate={"every_iterations": 1},
    stages=[{"at_env_steps": 128, "wait_for": {"eval_length": 1.0}, "set": {"network.initial_log_std": -2.0}}],
    total_env_steps=(WINDOW + 2) * 128,
)


def free_address() -> str:
    with socket.create_server(("127.0.0.1", 0)) as server:
        return f"127.0.0.1:{server.getsockname()[1]}"


def start(*arguments: object) -> subprocess.Popen:
    environment = os.environ | {"XLA_FLAGS": ""}  # one device each
    command = [sys.executable, *map(str, arguments)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=environment)


def outputs(processes: list[subprocess.Popen]) -> list[str]:
    """What they print; they must succeed."""
    texts = [process.communicate(timeout=300)[0] for process in processes]
    assert [process.returncode for process in processes] == [0] * len(processes), "\n".join(texts)
    return texts


def restored(run: Path) -> tuple[dict[str, np.ndarray], list[bytes]]:
    """The learner of the newest checkpoint by name, and the environments."""
    config = load_run_config(run)
    task = make_task(config)
    learner = ppo.init_learner(config, task.observation_size, task.action_size, task.mirror, jax.random.key(0))
    loaded = checkpoint.load(run / "checkpoints", learner)
    return two_processes.leaves(loaded.learner), loaded.blobs


def test_two_processes_with_half_a_batch_each_update_as_one_with_the_whole(tmp_path):
    address = free_address()
    files = [tmp_path / "0.npz", tmp_path / "1.npz"]
    processes = [start(SCRIPT, "update", index, address, file) for index, file in enumerate(files)]
    mesh = ppo.make_mesh(jax.devices()[:2])
    expected = two_processes.updated(two_processes.CONFIG, two_processes.batch(), mesh)
    outputs(processes)
    for file in files:
        actual = dict(np.load(file))
        assert actual.keys() == expected.keys()
        for name, array in expected.items():
            np.testing.assert_allclose(actual[name], array, rtol=1e-5, atol=1e-6, err_msg=f"{file.name} {name}")


def test_the_command_in_two_processes_is_one_run(tmp_path, monkeypatch):
    """It ends with the parameters of one process that has the workers of both, in one run directory."""
    (tmp_path / "tiny.yaml").write_text(STAGED)
    run, other, alone = tmp_path / "runs" / "both", tmp_path / "other", tmp_path / "alone"
    arguments = ["--config", tmp_path / "tiny.yaml", "--run-dir", run]
    arguments += ["--distributed.coordinator", free_address(), "--distributed.num-processes", 2]
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(Path(train.__file__).parents[2]))
    processes = [
        start("-m", "hasrl_jax.train", *arguments, "--distributed.process-id", 0),
        start(SCRIPT, "command", other, *arguments, "--distributed.process-id", 1),
    ]
    assert train_main(["--config", "tiny.yaml", "--run-dir", str(alone), "--num-workers", "2"]) == 0
    first, second = outputs(processes)
    assert first.count("\niteration") == WINDOW + 2
    assert "iteration" not in second
    assert [path.name for path in run.parent.iterdir()] == ["both"]
    lines = [(path / "metrics.jsonl").read_text().splitlines() for path in (run, alone)]
    records = [[json.loads(line) for line in text] for text in lines]
    assert [record["env_steps"] for record in records[0]] == [128 * (1 + index) for index in range(WINDOW + 2)]
    assert [record["stage"] for record in records[0]] == [0] * WINDOW + [1] * 2
    for both, single in zip(*records, strict=True):
        assert both["actor_loss"] == pytest.approx(single["actor_loss"], rel=1e-3, abs=1e-5)
    of_other = dict(np.load(other.with_suffix(".npz")))
    (of_first, states), (of_alone, states_alone) = restored(run), restored(alone)
    assert [len(state) for state in states] == [len(state) for state in states_alone]
    for name, array in of_first.items():
        np.testing.assert_array_equal(of_other[name], array, err_msg=name)
        np.testing.assert_allclose(array, of_alone[name], rtol=1e-4, atol=1e-4, err_msg=name)


def test_when_a_process_is_killed_the_other_ends_with_one_line(tmp_path):
    (tmp_path / "tiny.yaml").write_text(TINY)
    arguments = ["-m", "hasrl_jax.train", "--config", tmp_path / "tiny.yaml", "--run-dir", tmp_path / "run"]
    arguments += ["--distributed.coordinator", free_address(), "--distributed.num-processes", 2]
    arguments += ["--total-env-steps", 10**9, "--distributed.process-id"]
    first, second = (start(*arguments, index) for index in (0, 1))
    for line in first.stdout:
        if line.startswith("iteration 2"):
            break
    second.kill()
    second.communicate()
    output = first.communicate(timeout=60)[0]
    assert first.returncode == 1
    assert "Traceback" not in output
    assert output.splitlines()[-1].startswith("error: another training process is gone")


def test_a_process_has_its_share_of_the_plan():
    whole = make_plan(from_dict({"collect": {"num_workers": 4}}))
    half = make_plan(from_dict({"collect": {"num_workers": 2}, "distributed": {"num_processes": 2}}))
    assert (2 * half.env_steps, 2 * half.rows) == (whole.env_steps, whole.rows)
    assert half.steps_per_env == whole.steps_per_env


def meet(address: str, **settings: int) -> str | None:
    """The complaint of a process, if it has one; on one line."""
    try:
        distributed.barrier(DistributedConfig(coordinator=address, **{"start_timeout_s": 20.0, **settings}))
    except ConfigError as error:
        complaint = str(error)
    else:
        return None
    assert "\n" not in complaint
    return complaint


def meet_all(*processes: dict[str, int]) -> list[str | None]:
    address, complaints = free_address(), [None] * len(processes)

    def come(index: int) -> None:
        complaints[index] = meet(address, **processes[index])

    threads = [threading.Thread(target=come, args=(index,)) for index in range(len(processes))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(timeout=30)
    return complaints


def test_processes_meet():
    assert meet_all(*({"process_id": index, "num_processes": 3} for index in (2, 0, 1))) == [None] * 3


@pytest.mark.parametrize(
    ("other", "named"),
    [
        ({"process_id": 1, "num_processes": 2}, "distributed.num_processes: got 2 in process 1 and 3 in process 0"),
        ({"process_id": 2, "num_processes": 3}, "distributed.process_id: got 2 twice"),
    ],
)
def test_processes_that_do_not_fit_together_are_one_line_each(other, named):
    short = {"start_timeout_s": 3}
    first, *others = meet_all({"num_processes": 3}, {"process_id": 2, "num_processes": 3} | short, other | short)
    assert first is not None and named in first
    for complaint in others:  # the second of them may come after process 0 has left
        assert complaint is not None
        assert "process 0 has given up, and says why" in complaint or "process 0 does not listen there" in complaint


def test_a_process_that_waits_in_vain_is_one_line():
    address = free_address()
    late = meet(address, num_processes=2, start_timeout_s=0.2)
    assert late is not None and "only processes [0] came" in late and "start_timeout_s=0.2 s" in late
    late = meet(address, num_processes=2, process_id=1, start_timeout_s=0.2)
    assert late is not None and "process 0 does not listen there" in late
    host, port = address.split(":")
    with socket.create_server((host, int(port))):
        taken = meet(address, num_processes=2)
    assert taken is not None and "cannot be used (Address already in use" in taken


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        ("--ray-address 10.0.0.1:6379", "ray.address"),
        ("--backend=ray --ray-address auto", "ray.address"),
        ("--distributed.coordinator host:1", "distributed.coordinator"),
        ("--distributed.num-processes 2", "distributed.coordinator"),
        ("--distributed.num-processes 2 --distributed.coordinator host", "distributed.coordinator"),
        ("--distributed.num-processes 2 --distributed.coordinator host:99999", "distributed.coordinator"),
        ("--distributed.process-id 1", "distributed.process_id"),
        ("--distributed.num-processes 3 --distributed.coordinator host:1", "ppo.minibatch_trajectories"),
        ("--distributed.num-processes 2 --distributed.coordinator host:1 --backend=mjx", "backend"),
        ("--distributed.num-processes 2 --distributed.coordinator host:1 --backend=ray", "backend"),
        ("--distributed.num-processes 2 --distributed.coordinator host:1 --schedule=overlap", "schedule"),
    ],
)
def test_settings_that_do_not_fit_together_are_refused(arguments, named):
    with pytest.raises(ConfigError, match=rf"^{named}: got [^\n]*; expected [^\n]*$"):
        cli.override(from_dict({}), arguments.split(), "train")


def test_records_of_processes_are_merged():
    first = {"workers_lost": 1, "diverged_envs": 0, "collect_seconds": 2.0, "episode_return_train": None, "x": None}
    second = {"workers_lost": 2, "diverged_envs": 3, "collect_seconds": 1.0, "episode_return_train": 4.0, "x": None}
    merged = {"workers_lost": 3, "diverged_envs": 3, "collect_seconds": 2.0, "episode_return_train": 4.0, "x": None}
    assert distributed.merge_records([first, second]) == merged
