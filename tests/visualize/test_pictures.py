"""Pictures: what is recorded, what is read out of it, and the files."""

from pathlib import Path

import jax
import numpy as np
import pytest
from PIL import Image

from hasrl_jax.cli import pictures
from hasrl_jax.config.convert import from_dict
from hasrl_jax.config.schema import Config
from hasrl_jax.envs.registry import make_task
from hasrl_jax.errors import ConfigError
from hasrl_jax.evaluate.rollout import Outcome
from hasrl_jax.learn import ppo
from hasrl_jax.policy import loading as policies
from hasrl_jax.runs import checkpoint
from hasrl_jax.visualize.course import COURSES
from hasrl_jax.visualize.pictures import commands, course, gait, gaits, imitation, rewards
from hasrl_jax.visualize.pictures.record import Recording, record


def _random_policy(config: Config) -> dict[str, np.ndarray]:
    task = make_task(config)
    learner = ppo.init_learner(config, task.observation_size, task.action_size, task.mirror, jax.random.key(0))
    return ppo.export_parameters(learner)


SMALL = from_dict({"network": {"hidden_size": 8}})
STEERED = from_dict({"network": {"hidden_size": 8}, "cassie": {"command": {"frame": "heading"}}})


def test_records_the_commands_in_turn() -> None:
    recording = record(SMALL, _random_policy(SMALL), [0.5, 1.0], 0.1)
    np.testing.assert_array_equal(recording.measures["forward_command"], [0.5] * 4 + [1.0] * 4)
    np.testing.assert_allclose(recording.time_s, 0.025 * np.arange(1, 9))
    assert set(recording.reward_terms) == set(make_task(SMALL).reward_terms)
    assert not recording.fell
    fallen = record(SMALL, _random_policy(SMALL), [1.5], 10.0)
    assert fallen.fell
    assert len(fallen.time_s) < 400
    with pytest.raises(ConfigError, match="cartpole"):
        record(from_dict({"task": "cartpole"}), {}, [0.0], 1.0)


def _walk(steps: int) -> Recording:
    """A robot that does as the clock says: 24 environment steps per cycle, a foot in the air for 8 of them."""
    index = np.arange(steps)
    right = np.where(index % 24 < 8, 0.0, 300.0)
    left = np.where((index + 12) % 24 < 8, 0.0, 300.0)
    ones = np.ones(steps)
    measures = {"phase": index % 24 / 24, "left_force": left, "right_force": right, "forward_speed": 0.9 * ones}
    return Recording(0.025 * (index + 1), measures | {"forward_command": ones}, {}, False)


def test_the_window_starts_with_a_cycle_and_says_who_stands() -> None:
    recording = _walk(280)
    shown = gait.window(recording)
    assert recording.measures["phase"][shown][0] == 0
    assert recording.time_s[shown][0] > gait.SETTLE_S
    assert len(recording.time_s[shown]) == round(gait.SHOWN_S / 0.025)
    assert gait.stretches(recording.measures["right_force"][:60] > 0) == [(8, 24), (32, 48), (56, 60)]
    assert gait.stretches(np.zeros(5, bool)) == []
    assert gait.title(1.0, recording, slice(0, 240)) == (
        "commanded 1 m/s, walks 0.90 m/s; both feet down 33 %, none 0 %"
    )
    fallen = _walk(40)
    assert gait.title(2.0, fallen, gait.window(fallen)) == "commanded 2 m/s: fell after 1.0 s"


def test_smoothing_over_a_cycle_leaves_the_mean() -> None:
    smooth = rewards.smooth(np.tile([0.0, 1.0, 2.0], 8), 3)
    np.testing.assert_allclose(smooth[1:-1], 1.0)
    assert np.isnan(smooth[[0, -1]]).all()
    assert np.isnan(rewards.smooth(np.full(3, 2.0), 4)).all()  # a robot that fell at once


@pytest.mark.parametrize("name", list(pictures.DRAWINGS))
def test_the_command_writes_a_small_picture(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    small = STEERED if name in ("course", "commands") else SMALL
    config = from_dict({"physics": {"timestep_s": 0.0025, "steps_per_env_step": 10}}, small)
    monkeypatch.setattr(commands, "EACH", 1)
    monkeypatch.setattr(commands, "SECONDS", 0.2)
    path, out = tmp_path / "policy.npz", tmp_path / "out.png"
    checkpoint.save_policy(path, _random_policy(config), policies.policy_metadata(config))
    monkeypatch.setattr(gait, "record", lambda *_: _walk(280))
    assert pictures.main([name, "--policy", str(path), "--physics", "training", "--out", str(out)]) == 0
    with Image.open(out) as picture:
        assert picture.width == (935 if name in ("gait", "rewards") else 1210)
        assert len(np.unique(np.asarray(picture.convert("RGB")).reshape(-1, 3), axis=0)) > 8
    assert out.stat().st_size < 150_000


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["walk"], "walk"),
        (["gait", "--out", "gait.pdf"], "--out"),
        (["gait", "--out", "missing_folder/gait.png"], "missing_folder"),
        (["gait", "--seed", "-1"], "--seed"),
    ],
)
def test_bad_arguments_are_one_line(
    arguments: list[str],
    named: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    try:
        status = pictures.main(arguments)
    except SystemExit as stopped:
        status = stopped.code
    error = capsys.readouterr().err
    assert status == 2
    assert named in error
    assert error.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_the_path_that_a_course_describes() -> None:
    """A quarter of a circle to the left, then sideways to the right: by hand."""
    step_s, rate, speed = 0.025, np.pi / 2, 1.0
    told = [{"forward": speed, "yaw_rate": rate}] * 4 + [{"lateral": -0.5}] * 4  # one second of each
    path = course.exact(told, 10, step_s)
    radius = speed / rate
    np.testing.assert_allclose(path[39], [radius, radius], atol=0.02)
    np.testing.assert_allclose(path[79] - path[39], [0.5, 0.0], atol=1e-6)  # facing y, its right is x


def test_a_course_is_walked_until_the_robot_falls() -> None:
    path = course.walk(STEERED, _random_policy(STEERED), "slalom", COURSES["slalom"], 0)
    assert path.fell
    assert len(path.position) == len(path.heading) == len(path.asked) < 400
    with pytest.raises(ConfigError, match=r"--course: slalom tells yaw_rate, .* understands forward, lateral"):
        course.walk(SMALL, _random_policy(SMALL), "slalom", COURSES["slalom"], 0)


def test_a_grid_of_commands(monkeypatch: pytest.MonkeyPatch) -> None:
    """A robot that stands for ever: it is upright everywhere, and its error is the command."""
    monkeypatch.setattr(commands, "SECONDS", 0.2)
    monkeypatch.setattr(commands, "SETTLED_S", 0.1)
    grid = commands.measure(STEERED, _random_policy(STEERED), "yaw_rate", (-0.5, 0.0), 0)
    assert grid.up.shape == grid.forward_error.shape == (2, 8)
    assert (grid.up == 1.0).all()
    np.testing.assert_allclose(grid.forward_error[0], np.abs(commands.FORWARD_M_S), atol=0.3)
    assert grid.other_error.mean() < 1.5
    with pytest.raises(ConfigError, match="needs the commands forward and yaw_rate"):
        commands.measure(SMALL, _random_policy(SMALL), "yaw_rate", (0.0,), 0)


def test_a_foot_of_the_library_swings_further_the_faster_it_walks_and_higher_than_it_stands() -> None:
    library, model = gaits.library_of(SMALL), make_task(SMALL).model
    middle = len(library.lateral_m_s) // 2
    slow, fast = (gaits.foot_path(library, model, (index, middle, 1)) for index in (2, 5))
    assert library.forward_m_s[[2, 5]].tolist() == [0.5, 2.0]
    np.testing.assert_array_equal(fast[0], fast[-1])
    # A stance of more than half a cycle of 0.75 s carries a foot back by this much at least.
    assert np.ptp(fast[:, 0]) > 2 * np.ptp(slow[:, 0]) > 2 * 0.5 * 0.375
    assert np.ptp(fast[:, 2]) > 0.05


def test_imitation_shows_the_reference_of_the_phase_beside_the_joints(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(imitation, "SETTLE_S", 0.1)
    monkeypatch.setattr(imitation, "SHOWN_S", 0.2)
    step, begun = imitation.Player.step, []

    def recorded(player: imitation.Player) -> Outcome:
        outcome = step(player)
        begun.append(outcome.info["phase"])
        return outcome

    monkeypatch.setattr(imitation.Player, "step", recorded)
    strides = imitation.walk(STEERED, _random_policy(STEERED), 0.5, 0)
    assert strides.motors.shape == strides.reference.shape == (8, 10)
    np.testing.assert_allclose(strides.phase[:-1], begun[5:])  # a step ends where the next one begins
    library = gaits.library_of(STEERED)
    middle, cell = len(library.lateral_m_s) // 2, int(np.abs(library.height_m - 0.9).argmin())
    assert library.forward_m_s[2] == 0.5
    joints = library.states[2, middle, cell][:, [7, 8, 9, 14, 20, 21, 22, 23, 28, 34]]
    place = strides.phase * len(joints)
    before, share = place.astype(int), (place % 1)[:, None]
    expected = (1 - share) * joints[before % 30] + share * joints[(before + 1) % 30]
    np.testing.assert_allclose(strides.reference, expected, atol=0.07)  # the curve that was fitted against the record
