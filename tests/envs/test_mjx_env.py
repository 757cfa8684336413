"""MJX environments: shapes, resets, failures, and agreement with C MuJoCo.

Cassie is compiled once, in float64, where the engines agree to rounding; the cart-pole runs in float32 as in training.
"""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from hasrl_jax.bench import engine_parity as parity
from hasrl_jax.config.convert import from_dict
from hasrl_jax.config.schema import Config
from hasrl_jax.envs.mjx_engine import MjxEngine, MjxEnvState, make_engine
from hasrl_jax.envs.mjx_physics import find_loops
from hasrl_jax.envs.registry import make_task
from hasrl_jax.errors import ConfigError

CARTPOLE = from_dict({"task": "cartpole"})
NUM_ENVS = 4
TIME_LIMIT = 6


@pytest.fixture(scope="module")
def cartpole() -> MjxEngine:
    return make_engine(make_task(CARTPOLE), "jax", TIME_LIMIT)


@pytest.fixture(scope="module")
def step(cartpole: MjxEngine) -> Callable[[MjxEnvState, jax.Array], tuple[MjxEnvState, Any]]:
    return jax.jit(jax.vmap(cartpole.step))


@pytest.fixture
def start(cartpole: MjxEngine) -> MjxEnvState:
    return jax.vmap(cartpole.reset)(jax.random.split(jax.random.PRNGKey(0), NUM_ENVS))


def test_shapes_and_finite_numbers(cartpole: MjxEngine, step: Callable, start: MjxEnvState) -> None:
    task = cartpole.task
    state, result = step(start, jnp.ones((NUM_ENVS, task.action_size)))
    assert jax.tree.map(lambda x: (x.shape, x.dtype), state) == jax.tree.map(lambda x: (x.shape, x.dtype), start)
    assert result.final_observation.shape == (NUM_ENVS, task.observation_size)
    assert result.reward_terms.shape == (NUM_ENVS, len(task.reward_terms))
    assert result.measures.shape == (NUM_ENVS, len(task.measures))
    assert all(np.isfinite(x).all() for x in jax.tree.leaves((state, result)))


def test_every_episode_has_fresh_draws(step: Callable, start: MjxEnvState) -> None:
    state, beginnings = start, [np.asarray(start.observation)]
    for env_step in range(1, 2 * TIME_LIMIT + 1):
        before = state
        state, result = step(state, jnp.zeros((NUM_ENVS, 1)))
        expect_end = env_step % TIME_LIMIT == 0
        assert np.all(result.truncated == expect_end)
        assert not result.terminated.any()
        assert np.all(state.is_first == expect_end)
        if expect_end:
            beginnings.append(np.asarray(state.observation))
            # The true final observation continues the old episode; the state shows the new one.
            np.testing.assert_allclose(result.final_observation, before.observation, atol=0.1)
            assert np.all(result.final_observation != state.observation)
            assert np.all(state.episode_step == 0)
            assert np.all(state.episode_return == 0)
    assert len(np.unique(np.concatenate(beginnings)[:, 0])) == 3 * NUM_ENVS


def test_termination_beats_the_time_limit(step: Callable, start: MjxEnvState) -> None:
    fallen = start._replace(
        qpos=start.qpos.at[1, 1].set(0.5), episode_step=jnp.full(NUM_ENVS, TIME_LIMIT - 1, jnp.int32)
    )
    _, result = step(fallen, jnp.zeros((NUM_ENVS, 1)))
    np.testing.assert_array_equal(result.terminated, [False, True, False, False])
    np.testing.assert_array_equal(result.truncated, [True, False, True, True])


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e30])
def test_a_diverged_environment_is_reported_and_reset(step: Callable, start: MjxEnvState, value: float) -> None:
    broken = start._replace(qvel=start.qvel.at[2, 0].set(value), is_first=jnp.zeros(NUM_ENVS, bool))
    state, result = step(broken, jnp.zeros((NUM_ENVS, 1)))
    np.testing.assert_array_equal(result.diverged, [False, False, True, False])
    np.testing.assert_array_equal(state.is_first, [False, False, True, False])
    assert not (result.terminated | result.truncated)[2]
    assert result.reward[2] == 0
    np.testing.assert_array_equal(result.final_observation[2], start.observation[2])
    assert all(np.isfinite(x).all() for x in jax.tree.leaves((state, result)))
    healthy, _ = step(start._replace(is_first=jnp.zeros(NUM_ENVS, bool)), jnp.zeros((NUM_ENVS, 1)))
    np.testing.assert_array_equal(np.delete(state.qpos, 2, 0), np.delete(healthy.qpos, 2, 0))


def test_the_same_uniforms_give_the_same_robot() -> None:
    """Model fields from NumPy float64 and JAX float32 agree to 1e-6, relative, and so does the first observation."""
    task = make_task(from_dict({}))
    uniforms = np.random.default_rng(1).random((3, task.reset_uniforms))
    expected = task.reset(uniforms, np)
    engine = make_engine(task, "jax", TIME_LIMIT)
    state = jax.jit(jax.vmap(partial(engine.begin, jnp.zeros(2, jnp.uint32))))(jnp.asarray(uniforms))
    assert set(state.model_fields) == set(expected.model_fields) != set()
    for name, value in expected.model_fields.items():
        tolerance = 1e-5 if "invweight" in name else 1e-6  # they take the inverse of a matrix
        np.testing.assert_allclose(state.model_fields[name], value, rtol=tolerance, err_msg=name)
    np.testing.assert_allclose(state.observation, expected.observation, atol=1e-6)
    for name, value in expected.state._asdict().items():
        np.testing.assert_allclose(getattr(state.task, name), value, rtol=1e-5, atol=1e-6, err_msg=name)


BEYOND_PAPER = {
    "motor": {"torque_speed_curve": True},
    "randomize": {
        "pd_gain_scale": [0.8, 1.2],
        "torque_scale": [0.2, 0.4],  # so little that the limits are met
        "spring_scale": [0.8, 1.2],
        "payload_kg": [0, 5],
        "center_of_mass_m": 0.03,
        "control_delay_s": [0, 0.02],
        "velocity_bias_m_s": 0.2,
        "policy_period_scale": [0.8, 1.2],
        "velocity_lag_s": [0.02, 0.1],
        "yaw_drift_rad_s": 0.5,
        "start_turned_rad": [-0.5, 0.5],
        "floor_slope_deg": [3, 8],
        "observation_noise": 1.0,
    },
}


@pytest.mark.parametrize(("frame", "settings"), [("world", {}), ("heading", BEYOND_PAPER)])
def test_cassie_agrees_with_c_in_double_precision(frame: str, settings: dict[str, Any]) -> None:
    """From the same states, actions and draws: to 1e-9 after one environment step, to 1e-4 after three.

    The solver stops early in both engines, and contacts amplify the rounding in between.
    """
    command = {"frame": frame, "start_heading_rad": 2.0, "yaw_rate_rad_s": [-1, 1], "height_m": [0.65, 1.0]}
    push = {"force_n": [50, 200], "interval_s": [0, 0.5]}
    config = from_dict({"cassie": {"command": command, "push": push, **settings}})
    report = parity.measure(config, num_states=6, horizons=(1, 3), double_precision=True)
    task = make_task(config)
    for horizon, tolerance in (("1", 1e-9), ("3", 1e-4)):
        result = report["horizons"][horizon]
        for name in ("observation", "measures_relative", *task.reward_terms, "loop_error_difference_m"):
            assert result[name]["max"] < tolerance, (horizon, name)
        assert result["termination_agreement"] == 1.0
        assert result["still_running"] == 1.0
        assert result["loop_error_c_m"]["max"] < 0.02
    table = parity.to_markdown(report)
    assert "| foot_force | " in table
    assert "| 1 environment step | 3 environment steps |" in table


def test_cartpole_agrees_with_c_in_single_precision() -> None:
    """To 1e-5 (m, 0.1 rad) over ten environment steps, and both engines end their episodes at the same step."""
    report = parity.measure(_with_physics(integrator="Euler"), num_states=32, horizons=(1, 10, 40))
    assert report["horizons"]["1"]["observation"]["max"] < 1e-5
    assert report["horizons"]["10"]["observation"]["max"] < 1e-5
    last = report["horizons"]["40"]
    assert 0.0 < last["still_running"] < 1.0
    assert last["termination_agreement"] == 1.0
    assert last["upright"]["max"] == 0.0


def test_loops_hold_in_the_initial_pose() -> None:
    model = make_task(from_dict({})).model
    loops = find_loops(model)
    assert loops.body.shape == (4, 2)
    assert loops.moved_by.shape == (4, 2, model.nv)
    np.testing.assert_array_equal(loops.moved_by[..., :6], 1)  # the pelvis moves everything
    assert parity.loop_errors(model, model.key("stand").qpos[None])[0] < 0.01


def _with_physics(**changes: Any) -> Config:
    return dataclasses.replace(CARTPOLE, physics=dataclasses.replace(CARTPOLE.physics, **changes))


def test_unsupported_settings_are_named() -> None:
    with pytest.raises(ConfigError, match=r"physics.solver: MJX has no PGS; set it to Newton"):
        make_engine(make_task(_with_physics(solver="PGS")), "jax", TIME_LIMIT)
    task = make_task(CARTPOLE)
    with pytest.raises(ConfigError, match=r"mjx.impl: got 'cuda'; expected 'jax' or 'warp'"):
        make_engine(task, "cuda", TIME_LIMIT)
    with pytest.raises(ConfigError, match=r"mjx.impl: warp needs .* set mjx.impl to jax"):
        make_engine(task, "warp", TIME_LIMIT)
    task.model.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICIT
    with pytest.raises(ConfigError, match=r"mjx.impl: jax cannot run .* set backend to cpu_pool"):
        make_engine(task, "jax", TIME_LIMIT)


@pytest.mark.parametrize(("contacts", "constraints", "overflow"), [(16, 64, [0, 0]), (1, 64, [1, 0]), (16, 14, [0, 1])])
def test_warp_reports_its_limits(contacts: int, constraints: int, overflow: list[int]) -> None:
    pytest.importorskip("warp")
    engine = make_engine(make_task(from_dict({})), "warp", 100, NUM_ENVS, contacts, constraints, warp_on_cpu=True)
    state = jax.vmap(engine.reset)(jax.random.split(jax.random.PRNGKey(0), NUM_ENVS))
    advance, seen = jax.jit(jax.vmap(engine.step)), np.zeros(2, int)
    for _ in range(12):  # enough to land on both feet
        state, _ = advance(state, jnp.zeros((NUM_ENVS, engine.task.action_size)))
        seen |= np.asarray(state.overflow).any(axis=0)
    np.testing.assert_array_equal(seen, overflow)
