"""The batched C MuJoCo environments: episodes, determinism, independence, divergence, restoring."""

import dataclasses
from typing import Any

import mujoco
import numpy as np
import pytest

from hasrl_jax.config.convert import from_dict
from hasrl_jax.envs.cpu_engine import SPLIT_FROM, CpuEnvs, EnvState, StepResult
from hasrl_jax.envs.registry import make_task
from hasrl_jax.envs.task import Transition

TASK = make_task(from_dict({}))
DISTURBED = {
    "cassie": {
        "command": {"frame": "heading"},
        "motor": {"torque_speed_curve": True},
        "randomize": {"floor_slope_deg": [5, 9], "policy_period_scale": [0.8, 1.3], "torque_lag_s": [0.002, 0.004]},
    }
}
FOLLOWING = {"cassie": {"reference": {"gaits": "library", "residual": True}}}  # motor targets about those of a gait
LAYING = make_task(from_dict({"cassie": {"termination": {"min_height_m": 0.0, "max_tilt_deg": 180.0}}}))  # never ends


@pytest.fixture(autouse=True)
def _no_warning_file() -> None:
    mujoco.set_mju_user_warning(lambda text: None)  # divergence is provoked on purpose here


def _run(envs: CpuEnvs, steps: int, seed: int = 0, state: EnvState | None = None) -> tuple[EnvState, list[StepResult]]:
    """`steps` environment steps with random actions that depend on the seed alone."""
    rng = np.random.default_rng(seed)
    state = envs.reset(rng) if state is None else state
    results = []
    for _ in range(steps):
        action = rng.uniform(-1, 1, (envs.num_envs, TASK.action_size))
        state, result = envs.step(state, action, rng)
        results.append(result)
    return state, results


def _leaves(state: EnvState) -> list[np.ndarray]:
    simple = [getattr(state, name) for name in state._fields if name not in ("task", "model_fields")]
    return [*simple, *state.task, *state.model_fields.values()]


def test_a_fall_resets_and_keeps_the_final_observation() -> None:
    envs = CpuEnvs(TASK, 4, 1000)
    rng = np.random.default_rng(0)
    state = envs.reset(rng)
    fallen = np.zeros(4, bool)
    for _ in range(120):
        before = state
        state, result = envs.step(state, rng.uniform(-1, 1, (4, 10)), rng)
        ended = result.terminated
        fallen |= ended
        assert not result.truncated.any()
        np.testing.assert_array_equal(state.is_first, ended)
        np.testing.assert_array_equal(state.episode_step, np.where(ended, 0, before.episode_step + 1))
        np.testing.assert_array_equal(state.observation[~ended], result.final_observation[~ended])
        assert (result.final_observation[ended, 0] < 0.95).all()
        np.testing.assert_array_equal(state.observation[ended, 0], 1.01)  # the initial pose
        np.testing.assert_array_equal(state.episode_return[ended], 0)
        changed = (state.model_fields["body_mass"] != before.model_fields["body_mass"]).any(axis=1)
        np.testing.assert_array_equal(changed, ended)  # another robot for another episode
    assert fallen.all()


def test_truncated_at_the_cap() -> None:
    envs = CpuEnvs(LAYING, 3, 7)
    state, results = _run(envs, 14)
    truncated = np.array([result.truncated.all() for result in results])
    np.testing.assert_array_equal(np.flatnonzero(truncated), [6, 13])
    assert not any(result.truncated.any() for index, result in enumerate(results) if index not in (6, 13))
    assert state.is_first.all()
    assert (state.episode_step == 0).all()


def test_same_seed_same_numbers() -> None:
    first, results = _run(CpuEnvs(TASK, 3, 30), 40)
    again, results_again = _run(CpuEnvs(TASK, 3, 30), 40)
    other, _ = _run(CpuEnvs(TASK, 3, 30), 40, seed=1)
    for a, b in zip(_leaves(first), _leaves(again), strict=True):
        np.testing.assert_array_equal(a, b)
    for a, b in zip(results, results_again, strict=True):
        np.testing.assert_array_equal(np.concatenate(a[4:], axis=1), np.concatenate(b[4:], axis=1))
    assert (first.physics != other.physics).any()


def test_environments_do_not_touch_each_other() -> None:
    envs = CpuEnvs(LAYING, 3, 1000)
    rng = np.random.default_rng(0)
    state = envs.reset(rng)
    actions = rng.uniform(-1, 1, (10, 3, 10))
    changed_actions = actions.copy()
    changed_actions[:, 1] *= -0.5

    def play(sequence: np.ndarray) -> EnvState:
        envs.restore(state)
        current = state
        for action in sequence:
            current, _ = envs.step(current, action, np.random.default_rng(0))
        return current

    ours, theirs = play(actions), play(changed_actions)
    np.testing.assert_array_equal(ours.physics[[0, 2]], theirs.physics[[0, 2]])
    np.testing.assert_array_equal(ours.episode_return[[0, 2]], theirs.episode_return[[0, 2]])
    assert (ours.physics[1] != theirs.physics[1]).any()


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e12])
def test_a_diverged_simulation_is_flagged_alone(bad: float) -> None:
    envs = CpuEnvs(LAYING, 3, 1000)
    state, _ = _run(envs, 3)
    action = np.zeros((3, 10))
    expected, healthy = envs.step(state, action, np.random.default_rng(0))
    assert not healthy.diverged.any()
    envs.restore(state)
    physics = state.physics.copy()
    physics[1, 1 + TASK.model.nq] = bad  # a velocity
    after, result = envs.step(state._replace(physics=physics), action, np.random.default_rng(0))
    np.testing.assert_array_equal(result.diverged, [False, True, False])
    assert not (result.terminated | result.truncated).any()
    np.testing.assert_array_equal(after.is_first, [False, True, False])
    assert after.observation[1, 0] == 1.01
    assert after.episode_step[1] == 0
    for values in _leaves(after):
        assert not np.isnan(values).any()  # nothing of the bad step survives
    np.testing.assert_array_equal(after.physics[[0, 2]], expected.physics[[0, 2]])
    np.testing.assert_array_equal(result.final_observation[[0, 2]], healthy.final_observation[[0, 2]])
    _, following = envs.step(after, action, np.random.default_rng(0))
    assert not following.diverged.any()


@pytest.mark.parametrize("field", ["observation", "reward"])
def test_a_task_that_gives_nan_is_flagged_alone(field: str) -> None:
    def step(*arguments: Any) -> Transition:
        outcome = TASK.step(*arguments)
        values = getattr(outcome, field).copy()
        values[1, ...] = np.nan
        return outcome._replace(**{field: values})

    envs = CpuEnvs(dataclasses.replace(TASK, step=step), 3, 1000)
    state, results = _run(envs, 1)
    np.testing.assert_array_equal(results[0].diverged, [False, True, False])
    np.testing.assert_array_equal(state.is_first, [False, True, False])
    assert not any(np.isnan(values).any() for values in _leaves(state))


def test_a_bad_action_is_an_error() -> None:
    envs = CpuEnvs(TASK, 2, 100)
    state = envs.reset(np.random.default_rng(0))
    with pytest.raises(FloatingPointError, match="action"):
        envs.step(state, np.full((2, 10), np.nan), np.random.default_rng(0))


def test_restored_environments_go_on_identically() -> None:
    envs = CpuEnvs(TASK, 3, 25)
    middle, _ = _run(envs, 20)
    copied = EnvState(*(value.copy() if isinstance(value, np.ndarray) else value for value in middle))
    ours, _ = _run(envs, 20, seed=9, state=middle)  # crosses the cap, so every model is drawn anew
    fresh = CpuEnvs(TASK, 3, 25)
    fresh.restore(copied)
    theirs, _ = _run(fresh, 20, seed=9, state=copied)
    for a, b in zip(_leaves(ours), _leaves(theirs), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("config", [{}, DISTURBED], ids=["default", "disturbed"])
@pytest.mark.parametrize("num_envs", [2, SPLIT_FROM])
@pytest.mark.parametrize("held", [True, False], ids=["held", "changing"])
def test_the_batch_equals_plain_mujoco(held: bool, num_envs: int, config: dict[str, Any]) -> None:
    task = make_task(from_dict(config))
    envs = CpuEnvs(task, num_envs, 100)
    rng = np.random.default_rng(3)
    state = envs.reset(rng)
    state, _ = envs.step(state, rng.uniform(-0.5, 0.5, (num_envs, 10)), rng)
    assert state.physics[:, 1 + task.model.nq + task.model.nv :].any() == bool(config)  # what lags in actuators
    actions = rng.uniform(-0.5, 0.5, (1 if held else task.steps_per_env_step, num_envs, 10))
    control = np.stack([task.control(state.task, action, np) for action in actions], axis=1)
    end, reading, warned = envs._simulate(state, control)
    assert not warned.any()
    for env in (0, num_envs - 1):
        model = make_task(from_dict(config)).model
        pace = task.pace(state.task, np)[env] if task.pace else 1.0
        model.opt.timestep = state.model_fields["timestep"][env] * pace
        for name in set(state.model_fields) - {"timestep"}:
            getattr(model, name)[:] = state.model_fields[name][env]
        data = mujoco.MjData(model)
        mujoco.mj_setState(model, data, state.physics[env], mujoco.mjtState.mjSTATE_FULLPHYSICS)
        features = []
        for step in range(task.steps_per_env_step):
            data.ctrl[:] = control[env, 0 if held else step]
            mujoco.mj_step(model, data)
            features.append(task.physics_features(data.sensordata.copy(), np))
        np.testing.assert_array_equal(end[env], [data.time, *data.qpos, *data.qvel, *data.act])
        np.testing.assert_array_equal(reading.sensordata[env], data.sensordata)
        np.testing.assert_allclose(reading.averages[env], np.mean(features, axis=0), rtol=1e-12)


@pytest.mark.parametrize("config", [{}, DISTURBED, FOLLOWING], ids=["default", "disturbed", "following"])
def test_a_lone_environment_is_one_of_a_batch(config: dict[str, Any]) -> None:
    delayed = {"cassie": {"randomize": {"control_delay_s": [0.0, 0.02]}, "push": {"force_n": [0, 100]}}}
    task = make_task(from_dict(delayed, from_dict(config)))
    lone, batch = CpuEnvs(task, None, 30), CpuEnvs(task, 1, 30)
    rngs = [np.random.default_rng(5) for _ in range(2)]
    ours, theirs = lone.reset(rngs[0]), batch.reset(rngs[1])
    actions = np.random.default_rng(6).uniform(-1, 1, (70, 10))  # through several falls
    ended = 0
    for action in actions:
        ours, one = lone.step(ours, action, rngs[0])
        theirs, many = batch.step(theirs, action[None], rngs[1])
        for a, b in zip([*_leaves(ours), *one], [*_leaves(theirs), *many], strict=True):
            np.testing.assert_array_equal(a, b[0])
            assert np.shape(a) == b.shape[1:]
        ended += int(one.terminated | one.truncated)
    assert ended > 1


def test_prepared_episodes_end_with_their_generator() -> None:
    """What a step draws depends on the state and the generator, not on what the environments did before."""
    first, second = CpuEnvs(LAYING, 3, 4), CpuEnvs(LAYING, 3, 4)
    start, _ = _run(first, 3)
    _run(second, 9, seed=7)  # leaves prepared episodes of another generator
    second.restore(start)
    first.restore(start)
    for a, b in zip(_leaves(_run(first, 5, 1, start)[0]), _leaves(_run(second, 5, 1, start)[0]), strict=True):
        np.testing.assert_array_equal(a, b)
    third = CpuEnvs(LAYING, 3, 4)
    third.restore(start)
    fresh, _ = third.step(start, np.zeros((3, 10)), np.random.default_rng(5))
    again, _ = third.step(fresh._replace(episode_step=start.episode_step), np.zeros((3, 10)), np.random.default_rng(5))
    np.testing.assert_array_equal(fresh.task.phase, again.task.phase)  # equal generators draw equal episodes


def test_episodes_that_follow_one_another_differ() -> None:
    envs = CpuEnvs(LAYING, 2, 1)  # every step ends both episodes, so the prepared ones are used up at once
    rng, phases = np.random.default_rng(0), []
    state = envs.reset(rng)
    for _ in range(4):
        state, _ = envs.step(state, np.zeros((2, 10)), rng)
        phases.extend(state.task.phase.tolist())
    assert len(set(phases)) == len(phases)


def test_only_robots_that_differ_have_fields_of_their_own() -> None:
    nominal = make_task(from_dict({"cassie": {"randomize": {"enabled": False}}}))
    for task, drawn in ((nominal, False), (TASK, True)):
        envs = CpuEnvs(task, 3, 100)
        state = envs.reset(np.random.default_rng(0))
        assert set(envs._fields) == set(state.model_fields)
        assert bool(envs._fields) == drawn
