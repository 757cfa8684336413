"""Each reward term against numbers worked out by hand."""

import dataclasses
import math

import numpy as np
import pytest

from hasrl_jax.config.convert import from_dict
from hasrl_jax.envs.cassie import clock, rewards
from hasrl_jax.envs.cassie import task as cassie
from hasrl_jax.envs.cassie.settings import RewardConfig
from hasrl_jax.envs.cpu_engine import CpuEnvs
from hasrl_jax.envs.task import Reading, Task

PAPER = RewardConfig(lateral_velocity_share=0.0, follow_lateral_command=False)
WEIGHTS = rewards.weights(PAPER)


def _errors(**changes: float) -> dict[str, np.ndarray]:
    return {name: np.array(changes.get(name, 0.0)) for name in rewards.TERMS}


def test_clock_score() -> None:
    score = rewards.clock_score(np.array([1.0, -1.0]), np.array([350.0, 175.0]), 350.0, np)
    assert score == pytest.approx(math.tan(0.3 * math.pi) - math.tan(0.15 * math.pi))
    beyond = rewards.clock_score(np.array([1.0, 0.0]), np.array([9999.0, 9999.0]), 350.0, np)
    assert beyond == pytest.approx(math.tan(0.3 * math.pi))  # the magnitude is limited


def test_quaternion_error_is_the_squared_sine_of_half_the_angle() -> None:
    quat = np.array([[math.cos(0.2), 0, math.sin(0.2), 0], [-1, 0, 0, 0]])
    error = rewards.quaternion_error(quat, np.array([1.0, 0, 0, 0]), np)
    np.testing.assert_allclose(error, [math.sin(0.2) ** 2, 0], atol=1e-12)


@pytest.mark.parametrize(
    ("lateral", "height", "speed", "expected"),
    [
        (0.049, 0.9, 0.0, 0.0),  # both inside their bands
        (-0.05, 0.9, 0.0, 0.05),
        (0.0, 0.84, 0.0, 0.06),
        (0.0, 0.84, -1.0, 0.0),  # the band widens with speed
        (0.2, 1.05, 1.0, 0.35),
    ],
)
def test_pelvis_motion_bands(lateral: float, height: float, speed: float, expected: float) -> None:
    still = np.zeros(3)
    value = rewards.pelvis_motion(np.array(lateral), np.array(height - 0.9), np.array(speed), still, still, PAPER)
    assert value == pytest.approx(expected)


def test_pelvis_motion_counts_shaking() -> None:
    angular, linear = np.array([1.0, -2.0, 0.5]), np.array([-0.5, 0.0, 4.0])
    value = rewards.pelvis_motion(np.array(0.0), np.array(0.0), np.array(0.0), angular, linear, PAPER)
    assert value == pytest.approx(0.25 * (3.5 + 4.5))


def test_weights_of_the_paper() -> None:
    terms = rewards.weighted_terms(_errors(), WEIGHTS, np)
    np.testing.assert_allclose(terms, [0, 0, 0.4, 0.3, 0.3, 0.1, 0.05, 0.05, 0])  # no error, no clock score
    best = math.tan(0.3 * math.pi)  # one foot at its limit, as its clock asks
    terms = rewards.weighted_terms(_errors(foot_force=best, foot_velocity=best), WEIGHTS, np)
    assert terms.sum() == pytest.approx(2 * (0.4 * best + 0.6))
    worse = rewards.weighted_terms(_errors(velocity=1.0, hip_roll=2.0), WEIGHTS, np)
    assert worse[4] == pytest.approx(0.3 * math.exp(-1))
    assert worse[5] == pytest.approx(0.1 * math.exp(-2))


def _step(constants: cassie.Constants, task: Task, **changes: np.ndarray):
    """One step of the definition from a hand-made state and reading: still, upright, at height 0.9 m, phase 0."""
    ids = constants.ids
    fresh = task.reset(np.full((1, task.reset_uniforms), 0.5), np)
    state = fresh.state._replace(
        phase=np.zeros(1), command=np.array([[1.0, 0.1]]), torque=np.zeros((1, 10)), action=np.full((1, 10), 0.2)
    )
    qpos, qvel = fresh.qpos.copy(), np.zeros((1, task.model.nv))
    qpos[0, :3] = changes.get("position", [0, 0.0, 0.9])
    qvel[0, 0:2] = 0.7, -0.2
    qvel[0, ids.hip_roll_qvel] = 0.3, -0.4
    sensors = np.zeros((1, task.model.nsensordata))
    sensors[0, ids.acceleration] = 0, 0, 9.81 + 1.0
    sensors[0, ids.torque] = 4.0
    sensors[0, ids.foot_velocity[0]] = 0.6, 0.8, 0.0
    reading = Reading(qpos, qvel, sensors, np.array([[175.0, 350.0, 0.01, 0.02, 60.0]]))
    return task.step(state, np.full((1, 10), 0.1), reading, np.full((1, task.step_uniforms), 0.5), np), state


def _task(reward: RewardConfig) -> tuple[cassie.Constants, Task]:
    config = from_dict({})
    task = cassie.make(dataclasses.replace(config, cassie=dataclasses.replace(config.cassie, reward=reward)))
    return task.step.args[0], task


def test_a_whole_step_by_hand() -> None:
    constants, task = _task(PAPER)
    result, state = _step(constants, task)
    left, right = clock.force_clocks(state.phase, clock.swing_fraction(1.0, constants.config.clock, np), np)[0]
    gain = math.pi / 4 * 1.2
    expected = [
        0.4 * (math.tan(gain * left * 0.5) + math.tan(gain * right)),
        0.4 * math.tan(-gain * left * 0.5),  # left foot at 1 of 2 m/s, right foot still
        0.4 * math.exp(-10 * 0.03),
        0.3 * math.exp(-0.25 * 1.0),
        0.3 * math.exp(-0.3),
        0.1 * math.exp(-0.7),
        0.05 * math.exp(-0.25 * 4.0),
        0.05 * math.exp(-5 * 0.1),
        0,
    ]
    np.testing.assert_allclose(result.reward_terms[0], expected, rtol=1e-9, atol=1e-12)
    assert result.reward[0] == pytest.approx(sum(expected))
    assert 0 < left < 1  # phase 0 lies on the transition from double stance into right swing


def test_departures_from_the_paper_are_settings() -> None:
    own = dataclasses.replace(PAPER, velocity_sharpness=2.0, lateral_velocity_share=0.5, follow_lateral_command=True)
    constants, task = _task(own)
    result, state = _step(constants, task, position=np.array([0, 0.5, 0.9]))
    assert result.reward_terms[0, 4] == pytest.approx(0.3 * math.exp(-2.0 * (0.3 + 0.5 * 0.3)))
    drift = 0.5 - 0.1 * state.env_step_s[0]  # from where the commanded lateral speed leads
    assert result.reward_terms[0, 3] == pytest.approx(0.3 * math.exp(-(drift + 0.25)))
    constants, task = _task(PAPER)
    result, _ = _step(constants, task, position=np.array([0, 0.5, 0.9]))
    assert result.reward_terms[0, 3] == pytest.approx(0.3 * math.exp(-(0.5 + 0.25)))


def test_the_power_of_the_motors_has_a_term_of_its_own() -> None:
    _, task = _task(dataclasses.replace(PAPER, motor_power=0.1, motor_power_w=120.0))
    result, _ = _step(_task(PAPER)[0], task)  # its motors take 60 W
    assert result.reward_terms[0, 8] == pytest.approx(2.0 * 0.1 * math.exp(-0.5))


def test_zero_action_changes_nothing_and_terms_sum_to_the_reward() -> None:
    _, task = _task(PAPER)
    envs = CpuEnvs(task, 3, 100)
    rng = np.random.default_rng(0)
    state = envs.reset(rng)
    for _ in range(5):
        state, result = envs.step(state, np.zeros((3, 10)), rng)
        np.testing.assert_allclose(result.reward_terms[:, 7], 0.05)  # e^-0: the action never changes
        np.testing.assert_allclose(result.reward_terms.sum(axis=1), result.reward)
        assert (result.reward_terms[:, 2:] >= 0).all()
        assert (result.reward_terms[:, 2:] <= [0.4, 0.3, 0.3, 0.1, 0.05, 0.05, 0]).all()
