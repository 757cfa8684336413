"""Motors whose torque falls with their speed, delays of the targets, and measurements with errors."""

from typing import Any

import mujoco
import numpy as np
import pytest

from hasrl_jax.config.checks import check
from hasrl_jax.config.convert import from_dict
from hasrl_jax.envs import motors
from hasrl_jax.envs.cassie.task import NEUTRAL_RAD, NO_LOAD_SPEED_RAD_S
from hasrl_jax.envs.cpu_engine import CpuEnvs, EnvState
from hasrl_jax.envs.layout import places
from hasrl_jax.envs.mjx_engine import make_engine
from hasrl_jax.envs.registry import make_task
from hasrl_jax.envs.task import Task
from hasrl_jax.errors import ConfigError

# Of the published model of Cassie, rad/s at the joint: revolutions per minute of the motor / 60 * 2 pi / gear ratio.
HIP_PITCH_NO_LOAD = 8.50848
HIP_PITCH_LIMIT, HIP_PITCH_GAIN, HIP_PITCH_DAMPING = 195.2, 88.0, 8.0
NEUTRAL_SETTINGS: dict[str, Any] = {
    "damping_scale": [1, 1],
    "mass_scale": [1, 1],
    "sliding_friction": [1, 1],
    "encoder_offset_rad": 0,
    "physics_rate_scale": [1, 1],
}


def _task(curve: bool = True, **randomize: Any) -> Task:
    cassie = {"motor": {"torque_speed_curve": curve}, "randomize": {"enabled": bool(randomize), **randomize}}
    return make_task(from_dict({"cassie": cassie}))


def _hip_pitch_torque(model: mujoco.MjModel, speed: float, target: float) -> float:
    """What the left hip pitch gives at this speed, N m, when it is told to go `target` rad further."""
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    joint = model.joint("left-hip-pitch")
    data.ctrl[:] = NEUTRAL_RAD
    data.ctrl[2] = data.qpos[joint.qposadr[0]] + target
    data.qvel[joint.dofadr[0]] = speed
    mujoco.mj_forward(model, data)
    return float(data.actuator_force[2])


@pytest.mark.parametrize(
    ("speed", "target", "torque"),
    [
        (0.0, 1.0, 88.0),  # the PD loop alone
        (2.0, 1.0, 88.0 - 16.0),
        (4.0, 9.0, 195.2),  # the driver's limit, up to half the no-load speed
        (6.0, 9.0, 2 * 195.2 * (1 - 6 / HIP_PITCH_NO_LOAD)),
        (HIP_PITCH_NO_LOAD, 9.0, 0.0),
        (-6.0, -9.0, -2 * 195.2 * (1 - 6 / HIP_PITCH_NO_LOAD)),
        (6.0, -9.0, -195.2),  # braking
    ],
)
def test_torque_falls_with_speed(speed: float, target: float, torque: float) -> None:
    assert _hip_pitch_torque(_task().model, speed, target) == pytest.approx(torque, abs=0.02)
    plain, curve = motors.without_curve(_task().model)
    assert curve is not None
    asked = np.clip(HIP_PITCH_GAIN * target - HIP_PITCH_DAMPING * speed, -HIP_PITCH_LIMIT, HIP_PITCH_LIMIT)
    assert _hip_pitch_torque(plain, speed, target) == pytest.approx(asked)
    speeds, torques = np.full(10, speed), np.full(10, asked)
    given = motors.limited(curve, torques, speeds, plain.actuator_forcerange[:, 1], np)[2]
    assert given == pytest.approx(torque, abs=0.02)


def test_no_load_speeds() -> None:
    expected = {"hip-roll": 12.147, "hip-yaw": 12.147, "hip-pitch": 8.508, "knee": 8.508, "foot": 11.519}
    assert pytest.approx(expected, abs=1e-3) == NO_LOAD_SPEED_RAD_S


def test_slow_motors_are_what_they_were() -> None:
    """A step in which no motor comes near its limits is the same with and without the curve."""
    ends = []
    for curve in (False, True):
        task = _task(curve)
        envs = CpuEnvs(task, 2, 100)
        state = envs.reset(np.random.default_rng(0))
        for _ in range(5):
            state, _ = envs.step(state, np.zeros((2, 10)), np.random.default_rng(1))
        ends.append(state.physics)
    np.testing.assert_allclose(ends[0], ends[1], atol=1e-9)


def _after_one_step(task: Task, action: float, before: float) -> EnvState:
    """Two environments that neutral actions have brought to rest, after a further step; `before`: the action so far."""
    envs = CpuEnvs(task, 2, 100)
    state = envs.reset(np.random.default_rng(0))
    state = state._replace(task=state.task._replace(action=np.full((2, 10), before)))
    return envs.step(state, np.full((2, 10), action), np.random.default_rng(1))[0]


def test_targets_arrive_late() -> None:
    """A delay of n physics steps: those of the old target, then those of the new one."""
    steps = 4
    task = _task(control_delay_s=[steps * 0.0025, steps * 0.0025 + 1e-9], **NEUTRAL_SETTINGS)
    model, late = task.model, _after_one_step(task, 0.2, -0.1)
    reference = CpuEnvs(task, 2, 100).reset(np.random.default_rng(0))
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = np.split(reference.physics[0, 1:], [model.nq])
    for step in range(10):
        data.ctrl[:] = NEUTRAL_RAD + (-0.1 if step < steps else 0.2)
        mujoco.mj_step(model, data)
    np.testing.assert_allclose(late.physics[0, 1:], np.concatenate([data.qpos, data.qvel]), atol=1e-9)


def test_a_delay_of_more_than_a_policy_period_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"cassie.randomize.control_delay_s: .* at most a policy period, 0.025 s"):
        check(from_dict({"cassie": {"randomize": {"control_delay_s": [0, 0.03]}}}))


def test_measurements_err_and_the_robot_does_not() -> None:
    """Noise is drawn anew at every step, within its width; a bias stays; neither touches physics or reward."""
    exact = _task(**NEUTRAL_SETTINGS, spring_scale=[1, 1.0000001])
    noisy = _task(**NEUTRAL_SETTINGS, observation_noise=1.0, velocity_bias_m_s=0.3)
    slices = places(noisy.observation)
    errors = []
    with_exact, with_noisy = CpuEnvs(exact, 50, 100), CpuEnvs(noisy, 50, 100)
    rng = np.random.default_rng(0)
    state = with_noisy.reset(rng)
    for _ in range(3):
        same = state._replace(task=state.task._replace(velocity_bias=np.zeros((50, 2)), noise=np.zeros(50)))
        with_exact.restore(same)
        other, exact_result = with_exact.step(same, np.zeros((50, 10)), np.random.default_rng(1))
        state, result = with_noisy.step(state, np.zeros((50, 10)), rng)
        np.testing.assert_allclose(state.physics, other.physics, atol=1e-6)
        np.testing.assert_allclose(result.reward, exact_result.reward, atol=1e-6)
        errors.append(state.observation - other.observation)
    error = np.stack(errors)
    position = error[..., slices["motor_positions"]]
    assert 0.009 < abs(position).max() <= 0.01 + 1e-6
    assert abs(np.diff(position, axis=0)).min() > 0
    velocity = error[..., slices["pelvis_velocity"]]
    assert 0.35 < abs(velocity[..., :2]).max() <= 0.4 + 1e-6
    assert abs(velocity[..., 2]).max() <= 0.1 + 1e-6
    bias = velocity[..., :2].mean(axis=0)
    np.testing.assert_allclose(bias, state.task.velocity_bias, atol=0.1)
    assert np.std(state.task.velocity_bias) > 0.1
    assert not error[..., slices["clock"]].any()
    assert not error[..., slices["forward_command"]].any()


def _torques(lag_s: float, steps: int) -> np.ndarray:
    """What the left hip pitch gives after each of some physics steps of 0.5 ms, told to go 1 rad further; [steps]."""
    randomize = NEUTRAL_SETTINGS | {"enabled": True, "torque_lag_s": [lag_s, lag_s], "spring_scale": [1, 1.0000001]}
    cassie = {"motor": {"torque_speed_curve": True}, "randomize": randomize}
    task = make_task(from_dict({"cassie": cassie, "physics": {"timestep_s": 0.0005, "steps_per_env_step": 50}}))
    envs = CpuEnvs(task, 1, 10)
    envs.reset(np.random.default_rng(0))
    model, data = envs._batch.get_model(0), mujoco.MjData(task.model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    model.opt.gravity[:] = 0
    torques = []
    for _ in range(steps):
        data.ctrl[:] = data.qpos[[model.jnt_qposadr[joint] for joint in model.actuator_trnid[:, 0]]]
        data.ctrl[2] += 1.0
        data.qvel[:] = 0
        mujoco.mj_step(model, data)
        torques.append(data.actuator_force[2])
    return np.array(torques)


def test_torque_follows_with_its_time_constant() -> None:
    """A step of the torque that is asked for leaves exp(-t / T) of it missing."""
    steps = np.arange(1, 21)
    np.testing.assert_allclose(_torques(0.003, 20), 88 * (1 - np.exp(-steps * 0.0005 / 0.003)), rtol=0.01)


def test_a_torque_that_does_not_lag_is_the_one_without_a_state() -> None:
    """The robots that are not drawn, among some that are: to the last step as if there were no lag."""
    ends = []
    for lag in ([0.0, 0.0], [0.002, 0.004]):
        randomize = {"enabled": True, "share": 0.0, "torque_lag_s": lag, "spring_scale": [0.9, 1.1]}
        task = make_task(from_dict({"cassie": {"motor": {"torque_speed_curve": True}, "randomize": randomize}}))
        envs, rng = CpuEnvs(task, 2, 3), np.random.default_rng(0)
        state = envs.reset(rng)
        for _ in range(5):  # over the end of an episode
            state, result = envs.step(state, np.full((2, 10), 0.2), rng)
            assert not result.diverged.any()
        assert task.model.na == (10 if lag[1] else 0)
        ends.append(state.physics[:, : 1 + task.model.nq + task.model.nv])
    np.testing.assert_allclose(ends[0], ends[1], atol=1e-7)


def test_a_lag_needs_motors_with_a_curve_and_a_cpu() -> None:
    lag = {"randomize": {"torque_lag_s": [0.003, 0.003]}}
    with pytest.raises(ConfigError, match=r"torque_lag_s: got .*; expected 0 0 unless cassie.motor.torque_speed_curve"):
        check(from_dict({"cassie": lag}))
    config = from_dict({"cassie": lag | {"motor": {"torque_speed_curve": True}}})
    with pytest.raises(ConfigError, match=r"set cassie.randomize.torque_lag_s to 0 0, or use cpu_pool"):
        make_engine(make_task(config), "jax", 10)
