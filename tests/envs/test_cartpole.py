"""The small task: what it hides, when it ends, and that both array libraries agree."""

import jax.numpy as jnp
import numpy as np
import pytest

from hasrl_jax.config.schema import Config
from hasrl_jax.envs.cartpole import task as cartpole
from hasrl_jax.envs.cpu_engine import CpuEnvs
from hasrl_jax.envs.task import Reading

TASK = cartpole.make(Config(task="cartpole"))


def _reading(position: float, angle: float) -> Reading:
    return Reading(np.array([[position, angle]]), np.ones((1, 2)), np.zeros((1, 0)), np.zeros((1, 0)))


def test_reset_starts_within_its_range_and_hides_the_velocities() -> None:
    uniforms = np.random.default_rng(0).random((500, TASK.reset_uniforms))
    fresh = TASK.reset(uniforms, np)
    for values in (fresh.qpos, fresh.qvel):
        assert np.abs(values).max() <= cartpole.START
        assert np.abs(values).max() > 0.95 * cartpole.START
    assert fresh.observation.shape == (500, 2)
    np.testing.assert_allclose(fresh.observation, fresh.qpos * [1, 10])


@pytest.mark.parametrize(
    ("position", "angle", "terminated"),
    [(0, 0, False), (0, 0.19, False), (0, -0.21, True), (1.01, 0, True), (-0.99, 0, False)],
)
def test_termination_and_reward(position: float, angle: float, terminated: bool) -> None:
    state = TASK.reset(np.zeros((1, 4)), np).state
    result = TASK.step(state, np.zeros((1, 1)), _reading(position, angle), np.zeros((1, 0)), np)
    assert bool(result.terminated[0]) is terminated
    assert result.reward[0] == (0.0 if terminated else 1.0)
    np.testing.assert_array_equal(result.reward_terms.sum(axis=-1), result.reward)
    np.testing.assert_allclose(result.measures[0, 0], angle)
    theirs = TASK.step(state, jnp.zeros((1, 1)), _reading(position, angle), jnp.zeros((1, 0)), jnp)
    assert bool(theirs.terminated[0]) is terminated
    np.testing.assert_allclose(theirs.observation, result.observation, rtol=1e-6)


def test_the_pole_falls_without_control_and_stands_with_the_velocity() -> None:
    def length(control) -> int:
        envs = CpuEnvs(TASK, 8, 300)
        rng = np.random.default_rng(0)
        state, steps = envs.reset(rng), 0
        while True:
            state, result = envs.step(state, control(state.physics[:, 1:3], state.physics[:, 3:5]), rng)
            steps += 1
            assert not result.diverged.any()
            if result.terminated.any() or result.truncated.any():
                return steps

    assert length(lambda qpos, qvel: np.zeros((8, 1))) < 100
    gains = np.array([0.1, 4.0, 0.2, 1.0])
    assert length(lambda qpos, qvel: (np.hstack([qpos, qvel]) @ gains)[:, None]) == 300  # the answer is known


def test_mirror_image() -> None:
    envs = CpuEnvs(TASK, 2, 300)
    state = envs.reset(np.random.default_rng(0))
    physics = np.stack([state.physics[0], state.physics[0] * [1, -1, -1, -1, -1]])
    _, result = envs.step(state._replace(physics=physics), np.array([[0.3], [-0.3]]), np.random.default_rng(0))
    observation = result.final_observation
    np.testing.assert_allclose(TASK.mirror.observation(observation[1]), observation[0], atol=1e-12)


def test_measures_of_a_last_step_are_those_of_the_episode_that_ends() -> None:
    envs = CpuEnvs(TASK, 4, 1)
    rng = np.random.default_rng(0)
    state = envs.reset(rng)
    _, result = envs.step(state, np.ones((4, 1)), rng)
    assert result.truncated.all()
    np.testing.assert_allclose(result.measures[:, 0], result.final_observation[:, 1] / 10)
