"""The real command line: runs, resumes, survives faults and refuses what cannot work."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import psutil
import pytest
from tiny import tiny_yaml

from hasrl_jax.cli import parsing as cli
from hasrl_jax.cli.train import main as train_main
from hasrl_jax.cli.train import parse_train
from hasrl_jax.config.checks import check
from hasrl_jax.config.files import load_yaml, recipe
from hasrl_jax.errors import ConfigError
from hasrl_jax.policy.loading import load_policy_parameters

ROOT = Path(__file__).parents[2]
CONFIGS = ROOT / "configs"
# Small enough to compile and run in seconds; two workers, two environments each.
TINY = tiny_yaml(ppo={"epochs": 2})
METRICS = {
    *("iteration", "env_steps", "episode_return_train", "eval_return", "episode_length_train"),
    *("eval_length", "ratio_mean", "entropy", "actor_loss", "critic_loss", "approx_kl", "clip_fraction"),
    *(
        "explained_variance",
        "policy_lag",
        "env_steps_per_second",
        "collect_seconds",
        "update_seconds",
        "eval_seconds",
        "stage",
    ),
    *("reward/foot_force", "reward/action_change", "diverged_envs", "workers_lost"),
}


@pytest.fixture
def tiny(tmp_path: Path) -> Path:
    path = tmp_path / "tiny.yaml"
    path.write_text(TINY)
    return path


def records(run: Path) -> list[dict]:
    return [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]


def untimed(run: Path) -> list[dict]:
    return [{name: value for name, value in record.items() if "second" not in name} for record in records(run)]


def command(*arguments: object) -> list[str]:
    return [sys.executable, "-m", "hasrl_jax.train", *map(str, arguments)]


def start(*arguments: object) -> subprocess.Popen:
    environment = os.environ | {"XLA_FLAGS": ""}  # one device, as a user has
    return subprocess.Popen(
        command(*arguments), stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=environment, cwd=ROOT
    )


def wait_for(process: subprocess.Popen, text: str) -> str:
    """Reads the process's output until a line holds `text`."""
    seen = ""
    for line in process.stdout:
        seen += line
        if text in line:
            return seen
    raise AssertionError(f"{text!r} never appeared in:\n{seen}")


def test_the_command_trains_cassie_for_two_iterations(tmp_path):
    run = tmp_path / "run"
    arguments = ("--config", CONFIGS / "smoke.yaml", "--run-dir", run, "--total-env-steps", 2048)
    small = (
        "--collect.env-steps-per-iteration",
        1024,
        "--backend=cpu_pool",
        "--num-workers",
        1,
        "--evaluate.episodes",
        2,
    )
    finished = subprocess.run(
        command(*arguments, *small), capture_output=True, text=True, cwd=ROOT, env=os.environ | {"XLA_FLAGS": ""}
    )
    assert finished.returncode == 0, finished.stderr
    for expected in ("backend cpu_pool", "cpu", "1 workers", "physics 400 Hz", str(run)):
        assert expected in finished.stderr
    assert "iteration 2" in finished.stdout
    first, second = records(run)
    assert (first["iteration"], second["iteration"], second["env_steps"]) == (1, 2, 2048)
    assert second.keys() >= METRICS
    assert second["ratio_first"] == pytest.approx(1.0, abs=1e-4)
    assert list((run / "tensorboard").glob("events*"))
    assert load_yaml(run / "config.yaml").collect.num_workers == 1
    left = [child.cmdline() for child in psutil.Process().children(recursive=True)]
    assert not [line for line in left if any("hasrl_jax" in part for part in line)]


def test_a_resumed_run_gives_the_same_numbers(tmp_path, tiny):
    whole, halves = tmp_path / "whole", tmp_path / "halves"
    assert train_main(["--config", str(tiny), "--run-dir", str(whole)]) == 0
    assert train_main(["--config", str(tiny), "--run-dir", str(halves), "--total-env-steps", "256"]) == 0
    assert train_main(["--resume", str(halves), "--total-env-steps", "512"]) == 0
    assert len(untimed(whole)) == 4
    # The first half's last iteration is evaluated because it is the last; the evaluation changes nothing.
    assert untimed(halves) == untimed(whole)


# Everything of the walking task that a resumed run could forget: robots of their own, pushes, stages, a falling rate.
WALKING = """
task: cassie
network: {hidden_size: 8, symmetric: true}
collect: {num_workers: 2, envs_per_worker: 2, env_steps_per_iteration: 128, unroll_length: 16, max_episode_steps: 25}
ppo: {epochs: 1, minibatch_trajectories: 8, learning_rate_schedule: linear}
cassie:
  command: {resample_s: [0.1, 0.3], start_moving: 0.5}
  push: {force_n: [50, 150], interval_s: [0.1, 0.3]}
  randomize: {share: 0.7}
stages:
  - {at_env_steps: 256, set: {cassie.command.forward_m_s: [1, 2]}}
  - {at_env_steps: 384, set: {cassie.push.force_n: [100, 300]}}
evaluate: {every_iterations: 3, episodes: 2}
checkpoint: {every_iterations: 1, keep: 9}
total_env_steps: 640
"""


def test_a_walking_run_goes_on_bit_for_bit(tmp_path):
    file, whole, broken = (tmp_path / name for name in ("walking.yaml", "whole", "broken"))
    file.write_text(WALKING)
    assert train_main(["--config", str(file), "--run-dir", str(whole)]) == 0
    shutil.copytree(whole, broken)
    for iteration in (3, 4, 5):  # as if it had been killed in the first iteration of the first stage
        shutil.rmtree(broken / "checkpoints" / f"{iteration:09d}")
    assert train_main(["--resume", str(broken)]) == 0
    seen = untimed(whole)
    assert untimed(broken) == seen
    assert [record["stage"] for record in seen] == [0, 0, 1, 2, 2]
    np.testing.assert_allclose([record["learning_rate"] / 3e-4 for record in seen], [1, 0.8, 0.6, 0.4, 0.2], rtol=1e-6)
    (config, ours), (_, theirs) = (load_policy_parameters(run, None) for run in (whole, broken))
    for name, array in ours.items():
        np.testing.assert_array_equal(array, theirs[name], err_msg=name)
    # What a policy is played with is what it was trained with last.
    assert config.settings.command.forward_m_s == (1.0, 2.0)
    assert config.settings.push.force_n == (100.0, 300.0)
    assert not config.stages
    shutil.rmtree(whole / "checkpoints" / "000000005")
    shutil.rmtree(whole / "checkpoints" / "000000004")
    settings = load_policy_parameters(whole, None)[0].settings  # of the checkpoint at which the second stage begins
    assert (settings.command.forward_m_s, settings.push.force_n) == ((1.0, 2.0), (100.0, 300.0))
    shutil.rmtree(whole / "checkpoints" / "000000003")
    settings = load_policy_parameters(whole, None)[0].settings
    assert (settings.command.forward_m_s, settings.push.force_n) == ((1.0, 2.0), (50.0, 150.0))


def test_a_curriculum_changes_settings_on_the_way_and_survives_a_break(tmp_path, tiny):
    stages = [
        {"at_env_steps": 256, "set": {"ppo.policy_learning_rate": 1e-5}},
        {"at_env_steps": 384, "set": {"network.initial_log_std": -2.0}},
    ]
    tiny.write_text(tiny_yaml(network={"learn_std": False}, stages=stages))
    assert train_main(["--config", str(tiny), "--run-dir", str(tmp_path / "whole")]) == 0
    assert train_main(["--config", str(tiny), "--run-dir", str(tmp_path / "parts"), "--total-env-steps", "384"]) == 0
    assert train_main(["--resume", str(tmp_path / "parts"), "--total-env-steps", "512"]) == 0
    whole = untimed(tmp_path / "whole")
    np.testing.assert_allclose([record["learning_rate"] for record in whole], [3e-4, 3e-4, 1e-5, 1e-5], rtol=1e-6)
    assert [record["stage"] for record in whole] == [0, 0, 1, 2]
    np.testing.assert_allclose([record["std_mean"] for record in whole], np.exp([-1, -1, -1, -2]), rtol=1e-6)
    assert without_evaluations(whole) == without_evaluations(untimed(tmp_path / "parts"))


def without_evaluations(records: list[dict]) -> list[dict]:
    return [{name: value for name, value in record.items() if "eval" not in name} for record in records]


def test_overlap_acts_with_parameters_one_version_old(tmp_path, tiny):
    run = tmp_path / "run"
    assert train_main(["--config", str(tiny), "--run-dir", str(run), "--schedule", "overlap"]) == 0
    assert [record["policy_lag"] for record in records(run)] == [0, 1, 1, 1]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_saves_and_leaves_no_process(tmp_path, tiny, number):
    run = tmp_path / "run"
    process = start("--config", tiny, "--run-dir", run, "--total-env-steps", 10**9)
    wait_for(process, "iteration 3")
    workers = psutil.Process(process.pid).children(recursive=True)
    assert len(workers) == 2
    process.send_signal(number)
    output = process.communicate(timeout=60)[0]
    assert process.returncode == 0, output
    assert not [worker for worker in workers if worker.is_running()]
    last = records(run)[-1]["iteration"]
    assert (run / "checkpoints" / f"{last:09d}").is_dir()


def test_a_killed_worker_is_named_and_the_run_goes_on(tmp_path, tiny):
    process = start("--config", tiny, "--run-dir", tmp_path / "run", "--total-env-steps", 10**9)
    wait_for(process, "iteration 2")
    psutil.Process(process.pid).children()[0].kill()
    seen = wait_for(process, "starting another")
    assert "SIGKILL" in seen
    wait_for(process, "iteration")
    process.terminate()
    process.communicate(timeout=60)
    assert process.returncode == 0
    assert records(tmp_path / "run")[-1]["workers_lost"] == 1


def test_a_killed_run_leaves_no_worker_and_resumes(tmp_path, tiny):
    run = tmp_path / "run"
    process = start("--config", tiny, "--run-dir", run, "--total-env-steps", 10**9)
    wait_for(process, "iteration 5")
    workers = psutil.Process(process.pid).children(recursive=True)
    process.kill()
    process.wait()
    gone, alive = psutil.wait_procs(workers, timeout=10)
    assert len(gone) == 2
    assert not alive
    saved = records(run)[-1]["iteration"] // 2 * 2
    assert train_main(["--resume", str(run), "--total-env-steps", str((saved + 1) * 128)]) == 0
    assert [record["iteration"] for record in records(run)] == list(range(1, saved + 2))


def test_a_run_directory_in_use_is_refused(tmp_path, tiny, capsys):
    process = start("--config", tiny, "--run-dir", tmp_path / "run", "--total-env-steps", 10**9)
    wait_for(process, "iteration 2")
    assert train_main(["--resume", str(tmp_path / "run")]) == 1
    error = capsys.readouterr().err
    assert "in use" in error
    assert str(process.pid) in error
    process.terminate()
    process.communicate(timeout=60)


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["--config", "missing.yaml"], "missing.yaml"),
        (["--num-workers", "0"], "collect.num_workers"),
        (["--ppo.clip", "2"], "ppo.clip"),
        (["--collect.envs-per-worker", "-1"], "collect.envs_per_worker"),
        (["--resume", "missing_run"], "missing_run"),
        (["--resume", "missing_run", "--run-dir", "elsewhere"], "--run-dir"),
        (["--resume", "missing_run", "--run_dir=elsewhere"], "--run-dir"),
        (["--task", "hopper"], "task: got 'hopper'"),
        (["--backend=tpu_pool"], "--backend"),
        (["--no-such-field", "1"], "--no-such-field"),
    ],
)
def test_bad_input_is_one_line_that_names_it(arguments, named, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert train_main(arguments) in (1, 2)
    error = capsys.readouterr().err
    assert named in error
    assert error.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_an_option_without_its_value_is_one_line(capsys):
    with pytest.raises(SystemExit) as stopped:
        train_main(["--config"])
    assert stopped.value.code == 2
    assert capsys.readouterr().err == "error: --config: missing; expected a value\n"


def test_resuming_the_checkpoints_of_a_run_names_the_run(tmp_path, capsys):
    run = tmp_path / "run"
    (run / "checkpoints" / "000000001").mkdir(parents=True)
    (run / "config.yaml").touch()
    for inside in (run / "checkpoints", run / "checkpoints" / "000000001"):
        assert train_main(["--resume", str(inside)]) == 1
        assert capsys.readouterr().err.endswith(f"did you mean {run}?\n")


def test_too_little_memory_is_one_line(capsys):
    def job() -> None:
        raise MemoryError("Unable to allocate 7 TiB")

    assert cli.run(job) == 1
    assert capsys.readouterr().err == "error: out of memory (Unable to allocate 7 TiB)\n"


def test_a_checkpoint_of_another_network_size_is_refused(tmp_path, tiny, capsys):
    run = tmp_path / "run"
    assert train_main(["--config", str(tiny), "--run-dir", str(run), "--total-env-steps", "128"]) == 0
    assert train_main(["--resume", str(run), "--network.hidden-size", "16", "--total-env-steps", "256"]) == 1
    assert "network.hidden_size" in capsys.readouterr().err
    assert train_main(["--resume", str(run), "--total-env-steps", "256"]) == 0, "the refusal must not harm the run"


def test_without_a_config_file_the_walking_recipe_is_used():
    assert parse_train([]) == (load_yaml("cassie_walk"), False, None)
    assert parse_train(["--num-workers=3"])[0].collect.num_workers == 3


def test_a_task_brings_its_own_recipe():
    config = parse_train(["--task", "cartpole"])[0]
    assert config == load_yaml("cartpole") == recipe("cartpole")
    assert config.settings is None and not config.stages


@pytest.mark.parametrize("path", sorted(CONFIGS.glob("*.yaml")), ids=lambda path: path.stem)
def test_every_config_file_is_valid(path):
    check(load_yaml(path))


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("ppo: {clipp: 0.1}", "ppo.clipp"),
        ("ppo: {clip: wide}", "ppo.clip"),
        ("collect: {mode: batches}", "collect.mode"),
        ("cassie: {command: {forward_m_s: [1]}}", "cassie.command.forward_m_s"),
        ("ppo: 3", "ppo"),
        ("seed: true", "seed"),
        ("a: [", "not valid YAML"),
        ("ppo: {clip: .nan}", "ppo.clip"),
    ],
)
def test_a_config_file_is_read_strictly(text, named, tmp_path):
    path = tmp_path / "bad.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=named.replace(".", r"\.")) as caught:
        load_yaml(path)
    assert "\n" not in str(caught.value)


def test_a_policy_without_memory_trains_goes_on_and_is_played(tiny, tmp_path):
    run, whole = tmp_path / "run", tmp_path / "whole"
    options = ["--config", str(tiny), "--num-workers", "1", "--network.memory", "none"]
    assert train_main([*options, "--run-dir", str(run), "--total-env-steps", "256"]) == 0
    assert train_main(["--resume", str(run), "--total-env-steps", "512"]) == 0
    assert train_main([*options, "--run-dir", str(whole)]) == 0
    assert len(records(run)) == 4
    assert untimed(run) == untimed(whole)
    assert records(run)[0]["ratio_first"] == pytest.approx(1.0, abs=1e-5)
    _, parameters = load_policy_parameters(run, None)
    assert "policy/dense_1_kernel" in parameters and "policy/lstm_0_input" not in parameters


def test_the_lstm_learns_a_task_that_needs_memory(tmp_path):
    """A cart-pole with hidden velocities is solved: every test episode lasts to the time limit."""
    run = tmp_path / "run"
    started = time.monotonic()
    arguments = ["--config", str(CONFIGS / "cartpole.yaml"), "--run-dir", str(run), "--num-workers", "2"]
    assert train_main(arguments) == 0
    last = records(run)[-1]
    assert last["eval_length"] == 200, f"after {time.monotonic() - started:.0f} s: {last}"
