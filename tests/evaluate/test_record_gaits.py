"""Recording a gait library: a small one from the released policy, and policies that have none."""

import numpy as np
import pytest

from hasrl_jax.cli import gaits as command
from hasrl_jax.config.convert import from_dict
from hasrl_jax.envs.cassie import bezier, gaits
from hasrl_jax.envs.cassie.ids import cassie_ids
from hasrl_jax.envs.registry import make_task
from hasrl_jax.errors import ConfigError
from hasrl_jax.evaluate import record_gaits
from hasrl_jax.policy import loading

GRID = {"forward_m_s": np.array([0.5, 1.0]), "lateral_m_s": np.array([0.0, 0.3]), "height_m": np.array([0.8, 0.9])}


def test_a_small_library_by_the_command(tmp_path, monkeypatch):
    """One walk without a correction, and short: its gaits are those of the package, roughly."""
    for name, value in {"TRIALS": 1, "SETTLE_CYCLES": 4, "KEPT_CYCLES": 2}.items():
        monkeypatch.setattr(record_gaits, name, value)
    bounds = ("--forward-m-s", "0.5", "1", "--lateral-m-s", "0.3", "--height-m", "0.8", "0.9")
    assert command.main([*bounds, "--out", str(tmp_path / "gaits.npz")]) == 0
    ours, whole = gaits.load(str(tmp_path / "gaits.npz")), gaits.load(gaits.USUAL)
    assert ours.curves.shape == (2, 3, 2, 2, gaits.MOTION_SIZE, 6)
    assert ours.states.shape == (2, 3, 2, 30, 67)
    np.testing.assert_allclose(ours.cycle_s, [0.75, 0.75])
    assert (ours.policy_rate_hz, ours.joints) == (40.0, whole.joints)
    np.testing.assert_allclose(ours.lateral_m_s, [-0.3, 0.0, 0.3])
    speeds = ours.states[:, 1, :, :, gaits.QPOS_SIZE].mean(axis=-1)
    np.testing.assert_allclose(speeds, [[0.5, 0.5], [1.0, 1.0]], atol=0.15)

    def motors(each: gaits.Library, phase: float) -> np.ndarray:
        told = np.array(1.0), np.array(0.0), np.array(0.9)
        return gaits.motion(each, told, np.array(phase), np.array(False), np)["motor_positions"]

    for phase in (0.1, 0.6):
        np.testing.assert_allclose(motors(ours, phase), motors(whole, phase), atol=0.15)
        assert np.abs(motors(ours, phase) - motors(whole, phase + 0.3)).max() > 0.2
    assert np.abs(ours.standing_states[:, gaits.QPOS_SIZE :]).max() < 0.5
    np.testing.assert_allclose(ours.standing[:, 14], [0.8, 0.9], atol=0.03)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--forward-m-s", "1", "1"], "--forward-m-s: got 1 1; expected the lower of two numbers first"),
        (["--height-m", "0.9", "0.8"], "--height-m: got 0.9 0.8; expected the lower of two numbers first"),
        (["--height-m", "0.9", "nan"], "--height-m: got 0.9 nan; expected the lower of two numbers first"),
        (["--lateral-m-s", "0"], "--lateral-m-s: got 0 0; expected the lower of two numbers first"),
    ],
)
def test_bounds_that_are_not_in_order_are_refused(options, message, tmp_path, capsys):
    assert command.main([*options, "--out", str(tmp_path / "gaits.npz")]) == 2
    assert message in capsys.readouterr().err


def test_the_grid_of_the_package_and_one_that_is_no_multiple_of_the_step():
    found = record_gaits.make_grid(record_gaits.BOUNDS)
    whole = gaits.load(gaits.USUAL)
    np.testing.assert_allclose(found["forward_m_s"], whole.forward_m_s)
    np.testing.assert_allclose(found["lateral_m_s"], [0.0, 0.3])
    np.testing.assert_allclose(found["height_m"], whole.height_m)
    wider = record_gaits.make_grid(record_gaits.BOUNDS | {"height_m": (0.65, 1.0)})
    np.testing.assert_allclose(wider["height_m"], [0.65, 0.65 + 0.35 / 3, 0.65 + 0.7 / 3, 1.0])


def test_curves_and_states_of_made_up_robots():
    """Robots whose hip pitch is a sine of the phase and whose cycles are all off; phases are not evenly spread."""
    config = from_dict({"cassie": {"clock": {"cycle_s": 0.75, "cycle_per_speed_s": -0.1, "quicken_above_m_s": 0.25}}})
    task = make_task(config)
    ids, grid = (
        cassie_ids(task.model),
        {name: values[:1] for name, values in GRID.items()} | {"lateral_m_s": np.zeros(1)},
    )
    even = np.arange(30) / 30
    phase = (even + np.array([-0.016, 0.0, 0.016])[:, None] + 0.01 * (-1.0) ** np.arange(30)) % 1.0
    states = np.zeros((3, 30, 1, 67))
    states[..., 3] = -1.0  # upright: a quaternion and its negative are the same
    states[..., 5] = -0.1
    states[:, :, 0, ids.motor_qpos[2]] = 0.5 + 0.2 * np.sin(2 * np.pi * phase)
    states[:, :, 0, ids.motor_qpos[7]] = 0.5 - 0.2 * np.sin(2 * np.pi * phase)
    states[0, ..., 7:35] += 0.3
    states[1, ..., 7:35] -= 0.2
    states[2, ..., 7:35] -= 0.1
    walked = record_gaits.Walked(states, phase[..., None], np.zeros((1, 3)))
    library = record_gaits.library(config, task, grid, walked, states[0, 0])
    np.testing.assert_array_equal(library.states[0, 0, 0], states[2, :, 0])  # the one nearest to the mean of the three
    motion = bezier.value(library.curves[0, 0, 0][None], even, np)
    np.testing.assert_allclose(motion[:, 2], 0.5 + 0.2 * np.sin(2 * np.pi * even), atol=4e-3)
    np.testing.assert_allclose(motion[:, 7], 0.5 - 0.2 * np.sin(2 * np.pi * even), atol=4e-3)
    np.testing.assert_allclose(motion[:, gaits.PLACES["pelvis_rotation"]], np.tile([0, 0.1, 0], (30, 1)), atol=1e-9)
    np.testing.assert_allclose(library.cycle_s, [0.725])


def test_a_quicker_clock_is_recorded_at_its_phases(monkeypatch):
    """Gaits of 2 and 4 m/s, cycles of 30 and 24 steps: a phase is missed by half a step, and only by the second.

    What the robots are told instead makes them slower, and leaves the clock alone.
    """
    config, parameters = loading.load_policy_parameters(None, "released-fast")
    monkeypatch.setattr(record_gaits, "SETTLE_CYCLES", 1)
    monkeypatch.setattr(record_gaits, "KEPT_CYCLES", 2)
    gait = np.array([[2.0, 0.0, 1e-6, 0.9], [4.0, 0.0, 1e-6, 0.9]])
    walked = record_gaits.walk(config, make_task(config), parameters, gait, gait, 30)
    slower = record_gaits.walk(config, make_task(config), parameters, gait, gait * [0.5, 1.0, 1.0, 1.0], 30)
    np.testing.assert_array_equal(slower.phase, walked.phase)
    assert slower.measured[0, 0] < walked.measured[0, 0] - 0.3
    off = (walked.phase[0] - np.arange(30)[:, None] / 30 + 0.5) % 1.0 - 0.5
    np.testing.assert_allclose(off[:, 0], 0.0, atol=1e-9)
    assert 0.25 / 24 < np.abs(off[:, 1]).max() < 0.51 / 24
    np.testing.assert_allclose(walked.phase[0, :, 1] * 24, np.rint(walked.phase[0, :, 1] * 24), atol=1e-6)
    np.testing.assert_allclose(walked.states[..., :2].mean(axis=(0, 1)), 0.0, atol=1e-9)


def test_what_can_be_walked_is_what_was_told_in_training_and_lower_at_speed():
    settings = loading.load_policy_parameters(None, "released-fast")[0].settings  # 0.65 to 1 m, less from 1.5 to 3 m/s
    cells = np.array([[1.0, 0.3, 0.7], [-2.25, 0.0, 0.7], [2.25, 0.0, 1.0], [3.25, 0.0, 0.7], [4.0, 0.0, 1.0]])
    found = record_gaits.walkable(cells, settings)
    np.testing.assert_array_equal(found[:, :2], cells[:, :2])
    np.testing.assert_allclose(found[:, 2], [0.7, 0.775, 0.95, 0.86, 0.82])


def test_a_policy_that_is_told_no_height_or_falls_is_refused():
    config, parameters = loading.load_policy_parameters(None, "released")
    with pytest.raises(ConfigError, match="--policy: expected one that is told forward, lateral, yaw_rate, height"):
        record_gaits.record(config, parameters, GRID)
    steered, _ = loading.load_policy_parameters(None, "released-steer")
    small = {name: values[:1] for name, values in GRID.items()}
    with pytest.raises(ConfigError, match=r"--policy: a robot fell that was told forward 0\.50, lateral 0\.00"):
        record_gaits.record(steered, loading.load_baseline("zero", steered)[1], small)
    odd = from_dict({"cassie": {"clock": {"cycle_s": 0.725}}}, steered)
    with pytest.raises(
        ConfigError, match=r"cassie\.clock\.cycle_s: got 0\.725; expected an even number of policy steps"
    ):
        record_gaits.record(odd, parameters, GRID)


def test_of_every_gait_the_best_walk_is_kept(monkeypatch):
    """Robots that walk half as fast as they are told, and fall when they are told 3 m/s."""
    asked = []

    def walk(config, task, parameters, gait, told, count):
        np.testing.assert_array_equal(gait[:, 0], [1.0, 2.0])
        asked.append(told.copy())
        states = np.full((1, count, len(told), 67), len(asked))
        measured = told[:, [0, 1, 3]] * [0.5, 1.0, 1.0]
        measured[told[:, 0] >= 3.0] = np.nan
        return record_gaits.Walked(states, np.zeros(states.shape[:3]), measured)

    kept = []
    monkeypatch.setattr(record_gaits, "walk", walk)
    monkeypatch.setattr(record_gaits, "require_periodic", lambda *_: None)
    monkeypatch.setattr(record_gaits, "stand", lambda *_: None)
    monkeypatch.setattr(record_gaits, "library", lambda config, task, grid, walked, standing: kept.append(walked))
    config, parameters = loading.load_policy_parameters(None, "released-steer")
    grid = {"forward_m_s": np.array([1.0, 2.0]), "lateral_m_s": np.zeros(1), "height_m": np.array([0.9])}
    record_gaits.record(config, parameters, grid)
    np.testing.assert_allclose([told[0, 0] for told in asked], 2.0 - 0.5 ** np.arange(6))
    # The second falls when it is told 3, goes half as far from there on, falls twice more, and keeps the walk at 2.875.
    np.testing.assert_allclose([told[1, 0] for told in asked], [2.0, 3.0, 2.5, 2.875, 3.15625, 3.015625])
    np.testing.assert_allclose(kept[0].measured[:, 0], [1.0 - 0.5**6, 1.4375])
    np.testing.assert_array_equal(kept[0].states[0, 0, :, 0], [6, 4])


def test_what_differs_from_cycle_to_cycle_is_no_gait():
    states = np.zeros((4, 30, 2, 67))
    states[:, 5, 1, 20] = [0.0, 0.5, 0.0, 0.5]
    walked = record_gaits.Walked(states, np.zeros((4, 30, 2)), np.zeros((2, 3)))
    wanted = np.array([[0.5, 0.0, 0.9], [1.0, 0.3, 0.9]])
    with pytest.raises(ConfigError, match=r"no periodic gait at forward_m_s 1\.00, lateral_m_s 0\.30, height_m 0\.90"):
        record_gaits.require_periodic(walked, wanted)
    record_gaits.require_periodic(walked._replace(states=np.zeros_like(states)), wanted)
