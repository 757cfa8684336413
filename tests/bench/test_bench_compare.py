"""`bench compare` and `bench scaling` run from their command line and leave nothing behind; no figure is judged."""

import importlib.util
import json
import math
from pathlib import Path

import gymnasium
import numpy as np
import psutil
import pytest
import yaml
from gymnasium.vector import AutoresetMode
from tiny import tiny_yaml

from hasrl_jax.bench import compare, learner
from hasrl_jax.bench.compare_peers import PeerProcess
from hasrl_jax.cli.bench import main
from hasrl_jax.config.convert import from_dict
from hasrl_jax.envs.registry import make_task

TINY = tiny_yaml(
    physics={"steps_per_env_step": 2}, collect={"envs_per_worker": 4, "unroll_length": 8, "max_episode_steps": 20}
)


@pytest.fixture
def tiny(tmp_path: Path) -> list[str]:
    path = tmp_path / "tiny.yaml"
    path.write_text(TINY)
    return ["compare", "--config", str(path), "--num-workers", "1", "--rounds", "1", "--json", str(path) + ".json"]


def figures_of(arguments: list[str]) -> dict:
    before = set(psutil.Process().children(recursive=True))
    assert main(arguments) == 0
    assert set(psutil.Process().children(recursive=True)) <= before
    return json.loads(Path(arguments[arguments.index("--json") + 1]).read_text())["figures"]


def test_ours_alone_is_measured_without_peers(tiny: list[str], capsys: pytest.CaptureFixture) -> None:
    figures = figures_of([*tiny, "--peers"])
    assert [cell["name"] for cell in figures["cells"]] == ["ours", "single"]
    assert (figures["env_steps_per_update"], figures["minibatches"], figures["search"]) == (128, 2, [])
    ours = figures["cells"][0]
    assert (ours["num_envs"], ours["processes"], len(ours["rounds"])) == (4, 1, 1)
    assert ours["collector_per_second"] > ours["env_steps_per_second"] > 0
    seconds = ours["collect_seconds"] + ours["learn_seconds"]
    assert ours["env_steps_per_second"] == pytest.approx(128 / seconds)
    assert "ratio" not in capsys.readouterr().out


@pytest.mark.parametrize("peer", ["sb3", "sb3_make_vec", "torch"])
def test_peer_is_searched_and_compared(peer: str, tiny: list[str], capsys: pytest.CaptureFixture) -> None:
    for module in ["torch"] if peer == "torch" else ["torch", "sb3_contrib"]:
        pytest.importorskip(module)
    figures = figures_of([*tiny, "--peers", peer, "--num-envs", "2", "--threads", "1"])
    assert [(cell["num_envs"], cell["threads"]) for cell in figures["search"]] == [(2, 1)]
    ours, _, theirs = figures["cells"]
    assert (theirs["name"], theirs["num_envs"], theirs["processes"]) == (peer, 2, 1 if peer == "sb3_make_vec" else 2)
    # torch.nn.LSTM has two bias vectors per layer where one would do
    assert theirs["parameters"] == ours["parameters"] + 2 * 4 * figures["hidden"]
    assert theirs["learn_seconds"] > 0
    (ratio,) = figures["ratios"]
    assert ratio["end_to_end"] == pytest.approx(ours["env_steps_per_second"] / theirs["env_steps_per_second"])
    assert math.isfinite(ratio["collector"])
    assert f"ours / {peer}" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("resets", "stepped"), [([], False), ([(0, 3), (2, 5)], False), ([(b, t) for b in range(4) for t in (2, 5)], True)]
)
def test_torch_sequences_equal_single_steps(
    resets: list[tuple[int, int]], stepped: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    torch = pytest.importorskip("torch")
    from hasrl_jax.bench.compare_torch import Policy

    torch.manual_seed(0)
    policy = Policy(3, 2, 5, -1.0)
    observation, carry = torch.randn(4, 7, 3), (torch.randn(2, 4, 5), torch.randn(2, 4, 5))
    is_first = torch.zeros(4, 7, dtype=torch.bool)
    is_first[0, 0] = True
    for row, t in resets:
        is_first[row, t] = True
    calls: list[int] = []
    policy.lstm.register_forward_hook(lambda *_: calls.append(1))
    means = policy.sequences(observation, carry, is_first)
    assert len(calls) == (7 if stepped else 1)
    for t in range(7):
        mean, carry = policy.step(observation[:, t], carry, is_first[:, t])
        torch.testing.assert_close(means[:, t], mean)


def test_torch_advantage_stops_where_an_episode_ends() -> None:
    torch = pytest.importorskip("torch")
    from hasrl_jax.bench.compare_torch import _advantage

    ended = torch.tensor([[False, True, False]])
    advantage = _advantage(torch.tensor([[1.0, 2.0, 4.0]]), ended, 0.5)
    torch.testing.assert_close(advantage, torch.tensor([[2.0, 2.0, 4.0]]))


def test_the_batch_tells_sb3_how_episodes_ended() -> None:
    pytest.importorskip("stable_baselines3")
    from hasrl_jax.bench.compare_sb3 import BatchVecEnv

    def make() -> gymnasium.vector.VectorEnv:
        config = from_dict(yaml.safe_load(TINY))
        name = "hasrl_jax.envs.gymnasium:hasrl_jax/CartpoleHiddenVelocity-v0"
        return gymnasium.make_vec(name, 3, config=config, autoreset_mode=AutoresetMode.SAME_STEP)

    ours, theirs = BatchVecEnv(make()), make()
    ours.seed(5)
    np.testing.assert_array_equal(ours.reset(), theirs.reset(seed=5)[0])
    ends = 0
    for _ in range(25):  # the time limit is 20 steps
        action = np.ones((3, 1), np.float32) * 0.1
        observation, reward, done, infos = ours.step(action)
        expected, expected_reward, terminated, truncated, info = theirs.step(action)
        np.testing.assert_array_equal(observation, expected)
        np.testing.assert_array_equal(reward, expected_reward.astype(np.float32))
        np.testing.assert_array_equal(done, terminated | truncated)
        for env in range(3):
            if not done[env]:
                assert infos[env] == {}
                continue
            ends += 1
            np.testing.assert_array_equal(infos[env]["terminal_observation"], info["final_obs"][env])
            assert infos[env]["TimeLimit.truncated"] == (truncated[env] and not terminated[env])
    assert ends >= 3


def test_a_torch_update_alone() -> None:
    pytest.importorskip("torch")
    config = from_dict(yaml.safe_load(TINY))
    with PeerProcess("torch_update", config, 8, 64) as peer:
        collect_seconds, seconds = peer.iterate(1)
    assert collect_seconds == 0 < seconds
    hidden, inputs = 8, make_task(config).observation_size
    lstm = 4 * hidden * (inputs + 3 * hidden) + 2 * 2 * 4 * hidden
    policy = lstm + hidden + 1 + 1  # one action: its mean and its deviation
    assert peer.parameters == policy + (inputs + 1) * hidden + (hidden + 1) * hidden + hidden + 1


def test_a_peer_is_judged_at_its_best() -> None:
    def cell(end_to_end: float, collecting: float) -> dict:
        return {"env_steps_per_second": end_to_end, "collector_per_second": collecting}

    slow, even, quick = cell(1.0, 2.0), cell(3.0, 4.0), cell(2.0, 5.0)
    assert compare.best([slow, even]) == [even]
    assert compare.best([slow, even, quick]) == [even, quick]
    assert compare.best([slow, even, cell(2.0, 4.2)]) == [even]
    cells = [{"name": "ours", **cell(12.0, 20.0)}, {"name": "torch", **even}, {"name": "torch", **quick}]
    assert compare.ratios("torch", cells) == {"peer": "torch", "end_to_end": 4.0, "collector": 4.0}


def test_missing_packages_are_one_line(
    tiny: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    assert main([*tiny, "--peers", "sb3"]) == 2
    (error,) = capsys.readouterr().err.splitlines()
    assert error.startswith("error: --peers: torch, stable-baselines3, sb3-contrib not installed")
    assert "[compare]" in error
    assert main(["learner", "--torch"]) == 2
    assert capsys.readouterr().err.startswith("error: --torch: torch not installed")


def test_the_update_takes_turns_with_torch(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture) -> None:
    pytest.importorskip("torch")
    config = from_dict({"task": "cartpole", "network": {"hidden_size": 8}, "ppo": {"minibatch_trajectories": 8}})
    monkeypatch.setattr(learner, "sizes", lambda name: (config, 16, 4))
    found = learner.in_turns(3, 1)
    assert found["ratio_least"] <= found["ratio"] <= found["ratio_most"]
    assert min(found["ours_seconds"], found["torch_seconds"]) > 0
    assert "torch / ours" in learner.tables({"cells": [], "torch": found})


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["--peers", "--rounds", "0"], "--rounds"),
        (["--peers", "--threads", "0"], "--threads"),
        (["--peers", "--num-envs", "2", "3"], "--num-envs: got 3"),
        (["--peers", "--num-workers", "0"], "collect.num_workers"),
        (["--peers", "--hidden-size", "0"], "network.hidden_size"),
    ],
)
def test_bad_input_is_one_line(
    arguments: list[str], named: str, tiny: list[str], capsys: pytest.CaptureFixture
) -> None:
    assert main([*tiny, *arguments]) == 2
    (error,) = capsys.readouterr().err.splitlines()
    assert named in error


def test_scaling_measures_every_number_of_workers(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    sizes = ["--task", "cartpole", "--envs-per-worker", "2", "--steps-per-env", "4", "--hidden", "8"]
    few = ["--num-workers", "2", "--rounds", "1", "--updates", "1", "--cores", "1"]
    figures = figures_of(["scaling", *sizes, *few, "--json", str(tmp_path / "s.json")])
    one, two, pinned = figures["cells"]
    assert (one["num_workers"], two["num_workers"]) == (1, 2)
    assert (pinned["num_workers"], pinned["cores"]) == (1, 1)
    costs = figures["costs"]
    assert costs["env_steps"] == 8
    assert all(costs[name] > 0 for name in ("step_s", "update_s"))
    per_second = 1 / (costs["step_s"] + (costs["fixed_s"] + costs["per_worker_s"]) / 8)
    assert one["predicted_env_steps_per_second"] == pytest.approx(per_second)
    assert {(cell["cores"], cell["devices"]) for cell in figures["model"]} >= {(8, 1), (256, 8)}
    assert two["env_steps"] == 2 * one["env_steps"] == 16
    assert one["share_of_ideal"] == 1
    assert two["ideal_env_steps_per_second"] in (one["env_steps_per_second"], 2 * one["env_steps_per_second"])
    timed = ("export_seconds", "broadcast_seconds", "merge_seconds", "pad_seconds", "worker_own_mb")
    assert all(cell[name] > 0 for cell in (one, two) for name in timed)
    output = capsys.readouterr().out
    assert "min(cores, workers) x one" in output
    assert "Workers that keep one learner busy" in output


@pytest.mark.parametrize("option", ["--rounds", "--updates", "--cores", "--device-speed"])
def test_scaling_refuses_nothing(option: str, capsys: pytest.CaptureFixture) -> None:
    assert main(["scaling", "--task", "cartpole", option, "0"]) == 2
    assert f"{option}: got 0" in capsys.readouterr().err
