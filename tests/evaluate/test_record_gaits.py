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
    for name, value in {"GRID": GRID, "TRIALS": 1, "SETTLE_CYCLES": 4, "KEPT_CYCLES": 2}.items():
        monkeypatch.setattr(record_gaits, name, value)
    assert command.main(["--out", str(tmp_path / "gaits.npz")]) == 0
    ours, whole = gaits.load(str(tmp_path / "gaits.npz")), gaits.load(gaits.PACKAGED)
    assert ours.curves.shape == (2, 3, 2, 2, gaits.MOTION_SIZE, 6)
    assert ours.states.shape == (2, 3, 2, 30, 67)
    assert (ours.cycle_s, ours.policy_rate_hz, ours.joints) == (0.75, 40.0, whole.joints)
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


def test_curves_and_states_of_made_up_robots():
    """Robots whose hip pitch is a sine of the phase and whose every second cycle is off."""
    task = make_task(from_dict({}))
    ids, grid = (
        cassie_ids(task.model),
        {name: values[:1] for name, values in GRID.items()} | {"lateral_m_s": np.zeros(1)},
    )
    phase = np.arange(30) / 30
    states = np.zeros((3, 30, 1, 67))
    states[..., 3] = -1.0  # upright: a quaternion and its negative are the same
    states[..., 5] = -0.1
    states[:, :, 0, ids.motor_qpos[2]] = 0.5 + 0.2 * np.sin(2 * np.pi * phase)
    states[:, :, 0, ids.motor_qpos[7]] = 0.5 - 0.2 * np.sin(2 * np.pi * phase)
    states[0, ..., 7:35] += 0.3
    states[1, ..., 7:35] -= 0.2
    states[2, ..., 7:35] -= 0.1
    library = record_gaits.library(task, grid, states, states[0, 0], 0.75)
    np.testing.assert_array_equal(library.states[0, 0, 0], states[2, :, 0])  # the one nearest to the mean of the three
    motion = bezier.value(library.curves[0, 0, 0][None], phase, np)
    np.testing.assert_allclose(motion[:, 2], 0.5 + 0.2 * np.sin(2 * np.pi * phase), atol=3e-3)
    np.testing.assert_allclose(motion[:, 7], 0.5 - 0.2 * np.sin(2 * np.pi * phase), atol=3e-3)
    np.testing.assert_allclose(motion[:, gaits.PLACES["pelvis_rotation"]], np.tile([0, 0.1, 0], (30, 1)), atol=1e-9)


def test_a_policy_that_is_told_no_height_or_falls_is_refused():
    config, parameters = loading.load_policy_parameters(None, "released")
    with pytest.raises(ConfigError, match="--policy: expected one that is told forward, lateral, yaw_rate, height"):
        record_gaits.record(config, parameters)
    steered, _ = loading.load_policy_parameters(None, "released-steer")
    small = {name: values[:1] for name, values in GRID.items()}
    with pytest.raises(ConfigError, match=r"--policy: a robot fell that was told forward 0\.50, lateral 0\.00"):
        record_gaits.record(steered, loading.load_baseline("zero", steered)[1], small)
    odd = from_dict({"cassie": {"clock": {"cycle_s": 0.725}}}, steered)
    with pytest.raises(ConfigError, match=r"cassie\.clock: got 0\.725 s; expected one even number of policy steps"):
        record_gaits.record(odd, parameters)


def test_what_differs_from_cycle_to_cycle_is_no_gait():
    states = np.zeros((4, 30, 2, 67))
    states[:, 5, 1, 20] = [0.0, 0.5, 0.0, 0.5]
    walked = record_gaits.Walked(states, np.zeros((2, 3)))
    wanted = np.array([[0.5, 0.0, 0.9], [1.0, 0.3, 0.9]])
    with pytest.raises(ConfigError, match=r"no periodic gait at forward_m_s 1\.00, lateral_m_s 0\.30, height_m 0\.90"):
        record_gaits.require_periodic(walked, wanted)
    record_gaits.require_periodic(walked._replace(states=np.zeros_like(states)), wanted)
