"""What an episode may differ in besides the robot: the floor, the pace of the policy, and what an estimator says."""

import math
from typing import Any

import mujoco
import numpy as np
import pytest

from hasrl_jax.config.checks import check
from hasrl_jax.config.convert import from_dict
from hasrl_jax.config.schema import Config
from hasrl_jax.envs.cpu_engine import CpuEnvs, EnvState
from hasrl_jax.envs.layout import places
from hasrl_jax.envs.registry import make_task
from hasrl_jax.errors import ConfigError

NOTHING = {
    **{key: [1.0, 1.0] for key in ("damping_scale", "mass_scale", "physics_rate_scale", "sliding_friction")},
    "torsional_friction": [0.005, 0.005],
    "rolling_friction": [1e-4, 1e-4],
    "encoder_offset_rad": 0.0,
}
STEP_S = 0.025


def _config(frame: str = "heading", share: float = 1.0, **randomize: Any) -> Config:
    command = {"frame": frame, "forward_m_s": [0, 0], "lateral_m_s": [0, 0], "resample_s": [0, 0]}
    command |= {"yaw_rate_rad_s": [0, 0], "height_m": [0.9, 0.9]}
    drawn = NOTHING | {"enabled": True, "share": share} | randomize
    return from_dict({"cassie": {"command": command, "randomize": drawn, "termination": {"max_tilt_deg": 180.0}}})


def _reset(config: Config, num_envs: int) -> tuple[CpuEnvs, EnvState, np.random.Generator]:
    envs, rng = CpuEnvs(make_task(config), num_envs, 1000), np.random.default_rng(3)
    return envs, envs.reset(rng), rng


def test_the_floor_rises_as_steeply_as_it_is_told_in_any_direction() -> None:
    task = make_task(_config(floor_slope_deg=[2.0, 8.0]))
    fresh = task.reset(np.random.default_rng(0).random((400, task.reset_uniforms)), np)
    floor = task.model.geom("floor").id
    normal, flat = np.empty((400, 3)), np.array([0.0, 0.0, 1.0])
    for row, quat in enumerate(fresh.model_fields["geom_quat"][:, floor]):
        mujoco.mju_rotVecQuat(normal[row], flat, quat)
    steepness = np.rad2deg(np.arccos(normal[:, 2]))
    assert 2.0 <= steepness.min() < 2.2 and 7.8 < steepness.max() <= 8.0
    assert all(abs(np.sin(np.arctan2(normal[:, 1], normal[:, 0]) * k).mean()) < 0.1 for k in (1, 2))
    np.testing.assert_allclose(fresh.state.slope, -normal[:, :2] / normal[:, 2:], atol=1e-12)
    others = np.delete(fresh.model_fields["geom_quat"], floor, axis=1)
    np.testing.assert_array_equal(others, np.broadcast_to(np.delete(task.model.geom_quat, floor, 0), others.shape))


def test_feet_stand_on_the_slope_and_the_height_is_taken_from_it() -> None:
    envs, state, rng = _reset(_config(floor_slope_deg=[10.0, 10.0]), 4)
    model, data = envs.task.model, mujoco.MjData(envs.task.model)
    for _ in range(10):
        state, result = envs.step(state, np.zeros((4, 10)), rng)
    bottom = model.geom("floor").pos[2]
    for env in range(envs.num_envs):
        own = envs._batch.get_model(env)
        slope = state.task.slope[env]
        assert math.hypot(*slope) == pytest.approx(math.tan(math.radians(10)))
        data.qpos[:] = state.physics[env, 1 : 1 + model.nq]
        mujoco.mj_forward(own, data)
        touched = [contact.pos for contact in data.contact if model.geom("floor").id in contact.geom]
        assert touched
        for x, y, z in touched:
            assert z == pytest.approx(bottom + slope @ [x, y], abs=0.004)
        x, y, z = data.qpos[:3]
        assert result.measures[env, envs.task.measures.index("height")] == pytest.approx(z - slope @ [x, y])
        assert result.final_observation[env, 0] == pytest.approx(z - slope @ [x, y])


def test_every_step_has_a_duration_of_its_own() -> None:
    envs, state, rng = _reset(_config(policy_period_scale=[0.8, 1.3], control_delay_s=[0.01, 0.01]), 3)
    times, expected = [], []
    for _ in range(60):
        expected.append(STEP_S * state.task.period_scale)
        before = state.physics[:, 0]
        state, result = envs.step(state, np.zeros((3, 10)), rng)
        assert not result.diverged.any()
        times.append(np.where(state.is_first, expected[-1], state.physics[:, 0] - before))
    np.testing.assert_allclose(times, expected, rtol=1e-9)
    drawn = np.array(times[1:]) / STEP_S
    assert 0.8 <= drawn.min() < 0.82 and 1.28 < drawn.max() <= 1.3
    assert len(np.unique(drawn)) > 170  # anew for every step of every robot

    envs, state, rng = _reset(_config(policy_period_scale=[0.8, 1.3], share=0.0), 2)
    for _ in range(3):
        state, _ = envs.step(state, np.zeros((2, 10)), rng)
    np.testing.assert_allclose(state.physics[:, 0], 3 * STEP_S)


@pytest.mark.parametrize("frame", ["world", "heading"])
def test_the_observed_velocity_follows_late(frame: str) -> None:
    """A low-pass filter with the time constant T leaves exp(-t / T) of a jump after t."""
    task = make_task(_config(frame, velocity_lag_s=[0.08, 0.08]))
    fresh = task.reset(np.full((1, task.reset_uniforms), 0.5), np)
    envs = CpuEnvs(task, 1, 100)
    state = envs.reset(np.random.default_rng(0))
    _, reading, _ = envs._simulate(state, envs._control(state, np.zeros((1, 10))))
    velocity = np.array([[0.7, -0.3, 0.2]])
    reading = reading._replace(qpos=fresh.qpos, qvel=np.concatenate([velocity, np.zeros((1, 29))], axis=1))
    place, current = places(task.observation)["pelvis_velocity"], fresh.state
    for count in range(1, 5):
        done = task.step(current, np.zeros((1, 10)), reading, np.full((1, task.step_uniforms), 0.5), np)
        current, seen = done.state, done.observation[:, place]
        np.testing.assert_allclose(seen, velocity * (1 - math.exp(-count * STEP_S / 0.08)), atol=1e-12)
        assert done.measures[0, 0] == 0.7  # what is measured is the truth


@pytest.mark.parametrize("frame", ["world", "heading"])
def test_the_observed_heading_drifts_and_takes_the_velocity_along(frame: str) -> None:
    task = make_task(_config(frame, yaw_drift_rad_s=0.4))
    envs = CpuEnvs(task, 1, 100)
    state = envs.reset(np.random.default_rng(0))
    _, reading, _ = envs._simulate(state, envs._control(state, np.zeros((1, 10))))
    upright = np.array([[0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0]])
    reading = reading._replace(
        qpos=np.concatenate([upright, reading.qpos[:, 7:]], axis=1),
        qvel=np.concatenate([[[1.0, 0.0, 0.1]], np.zeros((1, 29))], axis=1),
    )
    current = state.task
    for _ in range(20):
        done = task.step(current, np.zeros((1, 10)), reading, np.full((1, task.step_uniforms), 0.5), np)
        current = done.state
    angle = float(current.yaw_drift[0]) * 20 * STEP_S
    assert 0.01 < abs(angle) <= 0.2
    where = places(task.observation)
    np.testing.assert_allclose(
        done.observation[0, where["pelvis_orientation"]], [math.cos(angle / 2), 0, 0, math.sin(angle / 2)], atol=1e-12
    )
    np.testing.assert_allclose(
        done.observation[0, where["pelvis_velocity"]], [math.cos(angle), math.sin(angle), 0.1], atol=1e-12
    )
    assert done.measures[0, task.measures.index("heading")] == 0


@pytest.mark.parametrize("frame", ["world", "heading"])
def test_an_episode_may_start_turned_away_from_its_heading(frame: str) -> None:
    envs, state, _ = _reset(_config(frame, start_turned_rad=[0.5, 0.7]), 50)
    quat = state.observation[:, places(envs.task.observation)["pelvis_orientation"]]
    turned = 2 * np.arctan2(quat[:, 3], quat[:, 0])  # the pose is upright
    assert 0.5 <= turned.min() < 0.52 and 0.68 < turned.max() <= 0.7
    assert (state.task.target_heading == 0).all()


def test_what_cannot_be_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"floor_slope_deg: got .*; expected 0 0 unless cassie.terrain.kind is flat"):
        check(from_dict({"cassie": {"terrain": {"kind": "rough"}}}, _config(floor_slope_deg=[0.0, 3.0])))
    with pytest.raises(ConfigError, match=r"policy_period_scale: got .*; expected physics steps from 1e-05 to 0.01 s"):
        check(_config(policy_period_scale=[1.0, 5.0]))
