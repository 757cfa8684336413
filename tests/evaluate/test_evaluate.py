"""Evaluation: what counts, and what is refused before the work."""

import json
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest

from hasrl_jax.cli import evaluate as cli_evaluate
from hasrl_jax.cli import parsing
from hasrl_jax.cli import render as cli_render
from hasrl_jax.cli.evaluate import main as evaluate_main
from hasrl_jax.config.convert import from_dict
from hasrl_jax.config.schema import Config
from hasrl_jax.envs.cpu_engine import CpuEnvs
from hasrl_jax.envs.gymnasium import TaskEnv
from hasrl_jax.envs.registry import make_task
from hasrl_jax.errors import ConfigError
from hasrl_jax.evaluate import rollout, statistics
from hasrl_jax.learn import ppo
from hasrl_jax.learn.networks import make_networks
from hasrl_jax.policy import loading as policies
from hasrl_jax.runs import checkpoint

PHYSICS = {"timestep_s": 0.005, "steps_per_env_step": 5, "integrator": "Euler"}
CARTPOLE = {"task": "cartpole", "network": {"hidden_size": 8}, "physics": PHYSICS}


def save(config: Config, path: Path) -> Path:
    """A policy file with random parameters."""
    task = make_task(config)
    learner = ppo.init_learner(config, task.observation_size, task.action_size, task.mirror, jax.random.key(0))
    checkpoint.save_policy(path, ppo.export_parameters(learner), policies.policy_metadata(config))
    return path


@pytest.fixture(scope="module")
def policy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save(from_dict(CARTPOLE), tmp_path_factory.mktemp("policy") / "cartpole.npz")


def test_a_step_that_diverged_does_not_count(policy, monkeypatch):
    config, parameters = policies.load_policy_parameters(None, policy)
    config = from_dict({"collect": {"max_episode_steps": 4}}, config)
    task = make_task(config)
    step, calls = CpuEnvs.step, []

    def failing(self, state, action, rng):
        state, result = step(self, state, action, rng)
        calls.append(1)
        if len(calls) < 3:
            return state, result
        gone = np.array([True, False])
        broken = result._replace(diverged=gone, truncated=result.truncated & ~gone)
        return state, broken._replace(reward=np.where(gone, np.nan, 1.0), measures=np.full_like(result.measures, 1e9))

    monkeypatch.setattr(CpuEnvs, "step", failing)
    episodes = rollout.run_episodes(config, task, parameters, 2, seed=0)
    np.testing.assert_array_equal(episodes.diverged, [True, False])
    np.testing.assert_array_equal(episodes.episode_length, [2, 4])
    np.testing.assert_array_equal(episodes.reached_cap, [False, True])
    assert np.isfinite(episodes.episode_return).all()
    assert np.isnan(episodes.measures[2:, 0]).all()
    assert statistics.summarize(episodes, task)["diverged_episodes"] == 1


def test_nothing_counts_after_a_fall(policy, monkeypatch):
    """Environments begin anew by themselves; the second life of one that fell is not the episode's."""
    config, parameters = policies.load_policy_parameters(None, policy)
    config = from_dict({"collect": {"max_episode_steps": 6}}, config)
    task = make_task(config)
    step, calls = CpuEnvs.step, []

    def scripted(self, state, action, rng):
        state, result = step(self, state, action, rng)
        calls.append(action)
        fell = np.array([len(calls) in (2, 4), False, len(calls) == 6])
        reward = np.array([10.0 ** len(calls), 1.0, 2.0])
        return state, result._replace(reward=reward, terminated=fell, truncated=np.zeros(3, bool))

    monkeypatch.setattr(CpuEnvs, "step", scripted)
    episodes = rollout.run_episodes(config, task, parameters, 3, seed=0)
    np.testing.assert_array_equal(episodes.episode_return, [110.0, 6.0, 12.0])
    np.testing.assert_array_equal(episodes.episode_length, [2, 6, 6])
    np.testing.assert_array_equal(episodes.reached_cap, [False, True, False])  # the third falls in its last step
    np.testing.assert_allclose(episodes.seconds, [0.05, 0.15, 0.15])
    assert len(calls) == 6
    for env, length in enumerate([2, 6, 6]):
        changes = [(calls[i][env] - calls[i - 1][env]) ** 2 for i in range(1, length)]
        assert episodes.action_change[env] == pytest.approx(np.sqrt(np.mean(changes)))
    present = np.isfinite(episodes.measures).all(axis=2)
    np.testing.assert_array_equal(present.sum(axis=0), [2, 6, 6])
    assert present[:2, 0].all()


def test_the_memory_is_kept_from_step_to_step(policy, monkeypatch):
    """The actions of whole episodes against those of the learner's network on the whole sequence."""
    config, parameters = policies.load_policy_parameters(None, policy)
    config = from_dict({"collect": {"max_episode_steps": 12}}, config)
    parameters = parameters | {"policy/mean_kernel": 50 * parameters["policy/mean_kernel"]}
    task = make_task(config)
    network, _ = make_networks(config.network, task.observation_size, task.action_size, None)
    weights = {name.removeprefix("policy/"): x for name, x in parameters.items() if name.startswith("policy/")}
    statistics = parameters["normalizer/mean"], parameters["normalizer/std"]
    step, seen = CpuEnvs.step, []

    def recorded(self, state, action, rng):
        seen.append((state.observation, state.is_first, action))
        return step(self, state, action, rng)

    def expected(observation, is_first):
        return network.apply({"params": weights}, observation, None, is_first, *statistics)[0]

    monkeypatch.setattr(CpuEnvs, "step", recorded)
    rollout.run_episodes(config, task, parameters, 3, seed=0)
    observation, is_first, action = (np.stack(parts, axis=1) for parts in zip(*seen, strict=True))
    np.testing.assert_allclose(action, expected(observation, is_first), atol=1e-5)
    forgetful = np.ones_like(is_first)
    assert np.abs(action - expected(observation, forgetful)).max() > 0.01
    seen.clear()
    player = rollout.Player(TaskEnv(config), parameters, seed=0)
    for _ in range(12):
        player.step()
    observation, is_first, action = (np.stack(parts)[None] for parts in zip(*seen, strict=True))
    np.testing.assert_allclose(action, expected(observation, is_first), atol=1e-5)


def test_the_command_writes_its_summary(policy, tmp_path, capsys):
    arguments = ["--policy", str(policy), "--episodes", "2", "--seconds", "0.5", "--json", str(tmp_path / "out.json")]
    assert evaluate_main([*arguments, "--physics.solver-iterations", "8"]) == 0
    assert "diverged_episodes" in capsys.readouterr().out
    summary = json.loads((tmp_path / "out.json").read_text())
    assert summary["episodes"] == 2
    assert summary["diverged_episodes"] == 0


def test_cassie_is_judged_with_the_physics_of_the_paper(tmp_path, monkeypatch):
    small = {"network": {"hidden_size": 8}, "physics": {"solver": "CG", "line_search_iterations": 3}}
    path = save(from_dict(small), tmp_path / "cassie.npz")
    seen = []

    def stop(config):
        seen.append(config.physics)
        raise ConfigError("enough")

    monkeypatch.setattr(cli_evaluate, "make_task", stop)
    assert evaluate_main(["--policy", str(path)]) == 2
    physics = seen[0]
    assert (physics.timestep_s, physics.steps_per_env_step) == (0.0005, 50)
    assert (physics.solver, physics.integrator) == ("Newton", "Euler")
    assert (physics.solver_iterations, physics.line_search_iterations) == (50, 50)


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["--network.hidden-size", "16"], "network"),
        (["--task", "cassie"], "task"),
        (["--scorecard", "card"], "is of task cartpole"),
        (["--backend", "mjx"], "backend"),
        (["--collect.unroll-length", "3"], "collect"),
        (["--seconds", "nan"], "--seconds"),
        (["--seconds", "inf"], "--seconds"),
        (["--seconds", "-1"], "--seconds"),
        (["--seconds", "0"], "--seconds"),
        (["--seconds", "soon"], "--seconds"),
        (["--episodes", "0"], "--episodes"),
        (["--seed", "-1"], "--seed"),
        (["--json", "missing_folder/out.json"], "missing_folder"),
        (["--json", "."], "--json"),
        (["--json", "/proc/out.json"], "/proc/out.json"),
        (["--episode", "3"], "--episode"),
    ],
)
def test_bad_arguments_are_one_line(policy, arguments, named, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(cli_evaluate, "run_episodes", lambda *_: pytest.fail("the work began"))
    try:
        status = evaluate_main(["--policy", str(policy), *arguments])
    except SystemExit as stopped:
        status = stopped.code
    error = capsys.readouterr().err
    assert status == 2
    assert named in error
    assert error.count("\n") == 1
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["--network.hidden-size", "16"], "network"),
        (["--out", "missing_folder/film.mp4"], "missing_folder"),
        (["--strip", "strip.txt"], "--strip"),
        (["--seed", "1" + "0" * 30], "--seed"),
    ],
)
def test_render_refuses_the_same(policy, arguments, named, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    known, rest = cli_render._parse(["--policy", str(policy), *arguments])
    with pytest.raises(ConfigError, match=named):
        cli_render.render(known, rest)
    assert not list(tmp_path.iterdir())


def test_render_says_what_is_wrong_on_one_line():
    command = [sys.executable, "-m", "hasrl_jax.render", "--seconds", "soon"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == "error: --seconds: got 'soon'; expected a number\n"


def test_a_policy_was_trained_for_the_widest_of_its_stages():
    stages = [
        {"at_env_steps": 10, "set": {"cassie.command.forward_m_s": [-0.5, 2.0]}},
        {"at_env_steps": 20, "set": {"cassie.command.forward_m_s": [0.0, 3.0]}},
    ]
    forward, lateral = parsing.trained_commands(from_dict({"stages": stages}))
    assert (forward.drawn, lateral.drawn) == ((-0.5, 3.0), (-0.1, 0.1))
    for value in (-0.5, 3.0, 0.0):
        parsing.refuse_untrained("forward", [value], (forward, lateral), False)
    with pytest.raises(ConfigError, match=r"^--forward: got -0.6; the policy was trained for -0.5 to 3 m/s"):
        parsing.refuse_untrained("forward", [1.0, -0.6], (forward, lateral), False)
    parsing.refuse_untrained("forward", [-9.0], (forward, lateral), True)
    parsing.refuse_untrained("jump", [9.0], (forward, lateral), False)
