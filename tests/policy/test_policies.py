"""The released policy loads from a fresh install and walks."""

import json
from pathlib import Path

import jax
import numpy as np
import pytest

from hasrl_jax.cli import export
from hasrl_jax.cli.parsing import to_play
from hasrl_jax.cli.train import main as train_main
from hasrl_jax.cli.train import parse_train
from hasrl_jax.config.convert import from_dict
from hasrl_jax.config.files import shipped
from hasrl_jax.envs.registry import make_task
from hasrl_jax.envs.task import Task
from hasrl_jax.errors import CheckpointError, ConfigError
from hasrl_jax.evaluate import rollout, scorecard, statistics
from hasrl_jax.learn import ppo
from hasrl_jax.policy import loading as policies
from hasrl_jax.policy import numpy_networks as numpy_policy
from hasrl_jax.runs import checkpoint


def test_the_released_policy_walks_at_the_commanded_speed() -> None:
    config, parameters = policies.load_policy_parameters(None, Path("released"))
    assert sum(path.stat().st_size for path in policies.RELEASED.values()) < 5e6
    assert config.run_dir == ""
    command = {"forward_m_s": [1.0, 1.0], "lateral_m_s": [0.0, 0.0], "stand_probability": 0.0, "start_moving": 0.0}
    changes = {"cassie": {"command": command, "randomize": {"enabled": False}}, "collect": {"max_episode_steps": 240}}
    config = from_dict(changes, config)
    task = make_task(config)
    episodes = rollout.run_episodes(config, task, parameters, episodes=2, seed=0)
    assert episodes.reached_cap.all()
    forward = episodes.measures[120:, :, task.measures.index("forward_speed")]
    np.testing.assert_allclose(forward.mean(axis=0), 1.0, atol=0.15)


def test_the_policy_for_stairs_climbs_where_the_other_falls() -> None:
    still = dict.fromkeys(("lateral_m_s", "yaw_rate_rad_s", "resample_s"), (0.0, 0.0))
    ground = {
        "terrain": {"step_height_m": [0.15, 0.15], "approach_m": [0.0, 0.0], "level_share": 0.0},
        "command": {"forward_m_s": [0.75, 0.75], "stand_probability": 0.0, **still},
    }
    stairs, its_parameters = policies.load_policy_parameters(None, "released-stairs")
    assert stairs.settings.observe == "blind"
    config = from_dict({"cassie": ground, "collect": {"max_episode_steps": 320}}, stairs)
    task = make_task(config)
    _, other_parameters = policies.load_policy_parameters(None, "released-steer")
    assert rollout.run_episodes(config, task, its_parameters, episodes=3, seed=0).reached_cap.all()
    assert not rollout.run_episodes(config, task, other_parameters, episodes=3, seed=0).reached_cap.any()


def test_the_policy_that_imitates_walks_with_the_joints_of_its_reference() -> None:
    config, parameters = policies.load_policy_parameters(None, "released-imitate")
    changes = {"command": {"forward_m_s": [0.7, 0.7], "stand_probability": 0.0, "resample_s": [0, 0]}}
    changes["reference"] = {"start_share": 0.0}
    config = from_dict({"cassie": changes, "collect": {"max_episode_steps": 200}}, config)
    task = make_task(config)
    episodes = rollout.run_episodes(config, task, parameters, episodes=2, seed=0)
    assert episodes.reached_cap.all()
    forward = episodes.measures[120:, :, task.measures.index("forward_speed")]
    np.testing.assert_allclose(forward.mean(axis=0), 0.7, atol=0.1)
    assert (episodes.episode_return > 0.8 * 200).all(), "1 a step is the reference itself"


def _held(name: str, speed: float, seconds: float) -> tuple[rollout.Episodes, Task]:
    """Two episodes of a released policy at one speed, told from rest, to their end."""
    config, parameters = policies.load_policy_parameters(None, name)
    played = to_play(config, "training", [], "evaluate")
    config = scorecard.row_config(played, scorecard.Row("speed", (speed, speed)), seconds=seconds)
    task = make_task(config)
    episodes = rollout.run_episodes(config, task, parameters, episodes=2, seed=0)
    assert episodes.reached_cap.all()
    return episodes, task


def test_the_policy_that_follows_gaits_needs_less_power_than_the_one_they_come_from() -> None:
    power = {}
    for name in ("released-steer", "released-gaits"):
        found = statistics.summarize(*_held(name, 1.0, seconds=6.0))
        assert found["forward_speed_error"]["mean"] < 0.05
        power[name] = found["motor_power"]["mean"]
    assert power["released-gaits"] < 0.9 * power["released-steer"]


def test_the_fast_policy_goes_on_where_the_one_that_steers_ends() -> None:
    speeds = {}
    for name in ("released-steer", "released-fast"):
        episodes, task = _held(name, 4.0, seconds=5.0)
        speeds[name] = episodes.measures[120:, :, task.measures.index("forward_speed")].mean()
    assert speeds["released-steer"] < 3.0
    assert speeds["released-fast"] > 3.3


def test_the_policy_that_steers_turns_sidesteps_and_crouches_as_it_is_told() -> None:
    config, parameters = policies.load_policy_parameters(None, "released-steer")
    told = {"forward_m_s": 0.8, "lateral_m_s": 0.2, "yaw_rate_rad_s": 0.4, "height_m": 0.8}
    command = {name: [value, value] for name, value in told.items()} | {"resample_s": [0, 0], "start_moving": 0.0}
    command |= dict.fromkeys(("stand_probability", "straight_probability", "alone_probability"), 0.0)
    command |= {"height_probability": 1.0, "height_fade_m_s": [5.0, 6.0]}
    changes = {"cassie": {"command": command, "randomize": {"enabled": False}}, "collect": {"max_episode_steps": 320}}
    config = from_dict(changes, config)
    task = make_task(config)
    episodes = rollout.run_episodes(config, task, parameters, episodes=2, seed=0)
    assert episodes.reached_cap.all()
    settled = {name: values[160:].mean() for name, values in statistics.columns(episodes, task).items()}
    assert settled["forward_speed"] == pytest.approx(0.8, abs=0.15)
    assert settled["lateral_speed"] == pytest.approx(0.2, abs=0.1)
    assert settled["yaw_rate"] == pytest.approx(0.4, abs=0.1)
    assert settled["height"] == pytest.approx(0.8, abs=0.05)


def test_a_run_exports_the_policy_that_it_evaluates_and_another_starts_from_it(tmp_path: Path) -> None:
    run, out = tmp_path / "run", tmp_path / "policy.npz"
    small = ["--collect.envs-per-worker", "2", "--collect.env-steps-per-iteration", "256", "--num-workers", "1"]
    config = Path(__file__).parents[2] / "configs" / "cartpole.yaml"
    arguments = ["--config", str(config), "--run-dir", str(run), "--total-env-steps", "256", *small]
    assert train_main([*arguments, "--ppo.minibatch-trajectories", "8", "--evaluate.episodes", "2"]) == 0
    assert export.main(["--run-dir", str(run), "--out", str(out)]) == 0
    exported, from_run = policies.load_policy_parameters(None, out)[1], policies.load_policy_parameters(run, None)[1]
    assert exported.keys() == from_run.keys()
    for name, array in exported.items():
        np.testing.assert_array_equal(array, from_run[name])

    second = tmp_path / "second"
    arguments[arguments.index(str(run))] = str(second)
    still = ["--ppo.policy-learning-rate", "1e-12", "--ppo.value-learning-rate", "1e-12", "--seed", "9"]
    more = ["--init-policy", str(out), "--ppo.minibatch-trajectories", "8", "--evaluate.episodes", "2", *still]
    assert train_main([*arguments, *more]) == 0
    for name, array in policies.load_policy_parameters(second, None)[1].items():
        # One iteration's observations move statistics that count as a million a little.
        np.testing.assert_allclose(array, exported[name], atol=1e-2 if "normalizer" in name else 1e-6, err_msg=name)
    record = json.loads((second / "metrics.jsonl").read_text().splitlines()[0])
    assert record["iteration"] == 1
    np.testing.assert_allclose(record["ratio_first"], 1.0, atol=1e-4)


def test_a_policy_file_is_named_as_one(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "policy.txt"
    assert export.main(["--run-dir", str(tmp_path), "--out", str(out)]) == 2
    assert capsys.readouterr().err == f"error: --out: got {out}; expected a name that ends in .npz\n"
    assert not out.exists()


def test_a_learner_given_a_policy_acts_as_it_does() -> None:
    config = shipped("cassie_stairs")
    task = make_task(config)
    learner = ppo.init_learner(config, task.observation_size, task.action_size, task.mirror, jax.random.key(0))
    released = policies.load_initial(config, "released-steer")
    given = policies.with_parameters(learner, released)
    assert jax.tree.structure(given) == jax.tree.structure(learner)
    for ours, theirs in zip(jax.tree.leaves(given), jax.tree.leaves(learner), strict=True):
        assert (ours.shape, ours.dtype) == (theirs.shape, theirs.dtype)
    exported = ppo.export_parameters(given, config.network.normalize_observations)
    assert exported.keys() == released.keys()
    for name, array in exported.items():
        np.testing.assert_allclose(array, released[name], rtol=1e-6, err_msg=name)


def test_a_policy_goes_on_in_a_task_that_shows_it_more() -> None:
    """What is new has no effect at first, so the policy that only knows straight ahead also walks in the new task."""
    config = shipped("cassie_steer")
    task = make_task(config)
    released, ours = policies.load_policy_parameters(None, "released")[1], policies.load_initial(config, "released")
    assert (task.observation_size, len(released["normalizer/mean"])) == (52, 50)
    for name in ("policy/lstm_0_input", "value/dense_0_kernel"):
        np.testing.assert_array_equal(ours[name][:50], released[name])
        assert not ours[name][50:].any()
    np.testing.assert_allclose(ours["normalizer/mean"][48:], [*released["normalizer/mean"][48:], 0.0, 0.9])
    np.testing.assert_allclose(ours["normalizer/std"][48:], [*released["normalizer/std"][48:], 0.5, 0.1])
    shapes = numpy_policy.parameter_shapes(task.observation_size, task.action_size, config.network)
    assert {name: array.shape for name, array in ours.items()} == shapes

    command = {"forward_m_s": [2.0, 2.0], "lateral_m_s": [0, 0], "yaw_rate_rad_s": [0.4, 0.4], "height_m": [0.9, 0.9]}
    command |= dict.fromkeys(("stand_probability", "straight_probability", "alone_probability", "start_moving"), 0.0)
    config = from_dict({"cassie": {"command": command}, "collect": {"max_episode_steps": 240}}, config)
    task = make_task(config)
    episodes = rollout.run_episodes(config, task, ours, episodes=2, seed=0)
    assert episodes.reached_cap.all()
    means = statistics.columns(episodes, task)
    np.testing.assert_allclose(means["forward_speed"][120:].mean(axis=0), 2.0, atol=0.2)
    np.testing.assert_allclose(means["yaw_rate"][120:].mean(axis=0), 0.4, atol=0.1)


def test_a_policy_goes_on_where_actions_reach_further() -> None:
    """What it asks for in rad stays the same near the neutral pose, and its exploration everywhere."""
    config = from_dict({"cassie": {"action_range_rad": 1.25}}, shipped("cassie_steer"))
    own, parameters = policies.load_policy_parameters(None, "released-steer")
    ours = policies.load_initial(config, "released-steer")
    mirror = make_task(own).mirror
    observation = np.random.default_rng(0).normal(size=(5, 52)) * parameters["normalizer/std"]
    observation += parameters["normalizer/mean"]
    arguments = np.zeros((5, 2, 2, 128), np.float32), np.ones(5, bool), mirror
    inputs = numpy_policy.streams(observation, parameters, mirror)
    before, _ = numpy_policy.policy_step(parameters, inputs, *arguments)
    after, _ = numpy_policy.policy_step(ours, inputs, *arguments)
    np.testing.assert_allclose(np.arctanh(after), np.arctanh(before) / 1.25, rtol=2e-3, atol=1e-5)
    np.testing.assert_allclose(1.25 * np.exp(ours["policy/log_std"]), np.exp(parameters["policy/log_std"]), rtol=1e-6)
    kept = {name for name in parameters if np.array_equal(parameters[name], ours[name])}
    assert parameters.keys() - kept == {"policy/mean_kernel", "policy/mean_bias", "policy/log_std"}


def test_a_policy_that_wants_to_see_more_than_there_is_is_refused(tmp_path: Path) -> None:
    config = shipped("cassie_steer")
    path = tmp_path / "steer.npz"
    checkpoint.save_policy(path, policies.load_initial(config, "released"), policies.policy_metadata(config))
    with pytest.raises(ConfigError, match=r"it sees yaw_rate_command \(1\); this run's policies do not"):
        policies.load_initial(shipped("cassie_walk"), str(path))


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"network": {"hidden_size": 32}}, "network.hidden_size: got 32; .* needs --network.hidden_size 64"),
        ({"network": {"symmetric": False}}, "network.symmetric: got False; .* needs --network.symmetric True"),
        ({"network": {"memory": "none"}}, "network.memory: got none; .* needs --network.memory lstm"),
        ({"task": "cartpole"}, "--init-policy released: a policy for task cassie; this run's is cartpole"),
    ],
)
def test_a_policy_of_another_shape_is_refused_in_one_line(changes: dict, named: str) -> None:
    with pytest.raises(ConfigError, match=f"^{named}$"):
        policies.load_initial(from_dict(changes, shipped("cassie_stairs")), "released")


def test_a_resumed_run_takes_no_other_policy(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="--init-policy and --resume"):
        parse_train(["--resume", str(tmp_path), "--init-policy", "released"])


def _changed(tmp_path: Path, **changes: np.ndarray) -> Path:
    """A whole policy file, with its digest, in which some arrays are others."""
    config, parameters = policies.load_policy_parameters(None, None)
    path = tmp_path / "policy.npz"
    checkpoint.save_policy(path, parameters | changes, policies.policy_metadata(config))
    return path


@pytest.mark.parametrize(
    ("name", "array", "complaint"),
    [
        ("policy/log_std", np.zeros(11, np.float32), r"is \(11,\); its configuration asks for \(10,\)"),
        ("policy/log_std", np.zeros(10), "is of type float64; expected float32"),
        ("policy/log_std", np.full(10, np.nan, np.float32), "holds numbers that are not finite"),
        ("policy/mean_bias", np.full(10, np.inf, np.float32), "holds numbers that are not finite"),
        ("policy/mean_bias", np.array(["x"] * 10), "is of type <U1; expected float32"),
        ("policy/mean_bias", np.zeros(10, complex), "is of type complex128; expected float32"),
        ("policy/mean_bias", np.zeros(10, "datetime64[s]"), r"is of type datetime64\[s\]; expected float32"),
        ("policy/mean_bias", np.zeros(10, [("a", "<f4")]), r"is of type \[\('a', '<f4'\)\]; expected float32"),
        ("normalizer/std", np.zeros(50, np.float32), "holds numbers that are not positive"),
    ],
)
def test_parameters_are_checked_before_they_act(tmp_path: Path, name: str, array: np.ndarray, complaint: str) -> None:
    path = _changed(tmp_path, **{name: array})
    with pytest.raises(CheckpointError, match=rf"^{path}: parameter {name} {complaint}$"):
        policies.load_policy_parameters(None, path)


def test_a_released_policy_that_was_replaced_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The file is whole by its own digest, and another."""
    assert policies.RELEASED_SHA256.keys() == policies.RELEASED.keys()
    other = _changed(tmp_path, **{"policy/log_std": np.zeros(10, np.float32)})
    monkeypatch.setitem(policies.RELEASED, "released", other)
    for source in ("released", None):
        with pytest.raises(CheckpointError, match=rf"^{other}: not the policy of this release: its SHA-256 is \w+…"):
            policies.load_policy_parameters(None, source)
    assert not policies.load_policy_parameters(None, other)[1]["policy/log_std"].any()


def test_no_source_is_the_released_policy() -> None:
    released = policies.load_policy_parameters(None, "released")[1]
    for name, array in policies.load_policy_parameters(None, None)[1].items():
        np.testing.assert_array_equal(array, released[name], err_msg=name)
