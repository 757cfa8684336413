"""The ground: one formula for boxes and heights, drawn anew for every episode, and everything measured from it."""

from typing import Any

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from hasrl_jax.config.convert import from_dict
from hasrl_jax.envs.cassie import terrain
from hasrl_jax.envs.cpu_engine import CpuEnvs
from hasrl_jax.envs.mjx_engine import make_engine
from hasrl_jax.envs.registry import make_task
from hasrl_jax.envs.task import Reading, Reset, Task
from hasrl_jax.errors import ConfigError

FLOOR_M = -0.01  # where the model has its floor


def _task(kind: str, randomize: bool = False, **settings: Any) -> Task:
    return make_task(
        from_dict({"cassie": {"terrain": {"kind": kind, **settings}, "randomize": {"enabled": randomize}}})
    )


def _fresh(task: Task, episodes: int, seed: int = 0) -> Reset:
    return task.reset(np.random.default_rng(seed).random((episodes, task.reset_uniforms)), np)


def _with_ground(task: Task, fresh: Reset, episode: int) -> mujoco.MjModel:
    model = task.model.__copy__()
    for name, values in fresh.model_fields.items():
        if name in ("geom_pos", "geom_size", "geom_quat", "bvh_aabb"):
            getattr(model, name)[:] = values[episode]
    return model


FLIGHTS = {"steps": [1, 5], "landing_m": [0.5, 1.5], "step_noise_m": 0.01, "approach_m": [0.0, 2.0]}


@pytest.mark.parametrize(
    ("kind", "randomize", "more"),
    [("steps", False, {}), ("steps", True, FLIGHTS), ("rough", True, {}), ("slopes", False, {"step_depth_m": [1, 3]})],
)
def test_the_formula_is_what_a_ray_meets(kind: str, randomize: bool, more: dict[str, Any]) -> None:
    task = _task(kind, randomize, **({"step_height_m": [0.02, 0.1]} | more))
    fresh = _fresh(task, 4)
    grounds = []
    for episode in range(4):
        model = _with_ground(task, fresh, episode)
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        x = np.concatenate([np.random.default_rng(episode).uniform(-20, 60, 300), [0.0, 0.999, 200.0]])
        hit = [_ground_below(model, data, [at, y, 30.0]) for at, y in zip(x, np.linspace(-15, 15, len(x)), strict=True)]
        expected = _height(x, fresh.state.terrain[episode])
        np.testing.assert_allclose(np.array(hit) - FLOOR_M, expected, atol=1e-9)
        assert not expected[x < 1.0].any()
        assert np.ptp(expected) > 0.05
        grounds.append(expected[: 300 // 2])
    assert len({tuple(ground) for ground in grounds}) == 4


def _height(x: np.ndarray, ground: np.ndarray) -> np.ndarray:
    """The height of one episode's ground in many places."""
    return np.asarray(terrain.height_at(x, np.broadcast_to(ground, (len(x), *ground.shape)), np))


def _ground_below(model: mujoco.MjModel, data: mujoco.MjData, point: list[float]) -> float:
    distance = mujoco.mj_ray(model, data, np.array(point), np.array([0, 0, -1.0]), None, 1, -1, np.zeros(1, np.int32))
    return point[2] - distance


def test_stairs_go_up_and_down_by_one_rise_in_one_depth() -> None:
    task = _task("steps", step_height_m=[0.02, 0.1], step_depth_m=[0.25, 0.4])
    fresh = _fresh(task, 200)
    x = np.arange(0.0, 5.0, 1e-3)
    rises, depths = [], []
    for table in fresh.state.terrain:
        ground = _height(x, table)
        edges = np.flatnonzero(np.diff(ground))
        rise, depth = ground[edges[0] + 1], np.diff(x[edges[:8]]).mean()
        np.testing.assert_allclose(np.diff(ground)[edges[:8]], rise)
        np.testing.assert_allclose(np.diff(x[edges[:8]]), depth, atol=2e-3)
        np.testing.assert_allclose(np.diff(ground)[edges[8:11]], -rise)
        rises.append(rise)
        depths.append(depth)
    assert 0.02 <= min(rises) < 0.03 and 0.09 < max(rises) < 0.1
    assert 0.25 <= min(depths) + 1e-3 < 0.27 and 0.38 < max(depths) < 0.4 + 1e-3


@pytest.mark.parametrize(
    ("kind", "settings"),
    [
        ("rough", {"step_height_m": [-0.3, 0.3], "step_depth_m": [0.2, 0.6]}),
        ("steps", {"step_height_m": [-0.2, 0.2], **FLIGHTS}),
        ("slopes", {"step_depth_m": [1.0, 3.0], "slope_deg": [-20, 20]}),
    ],
)
def test_contacts_are_found_wherever_the_ground_is(kind: str, settings: dict[str, Any]) -> None:
    """MuJoCo looks for contacts only where its tree of boxes says so; without the tree it finds the same ones."""
    task = _task(kind, **settings)
    fresh = _fresh(task, 4)
    rng = np.random.default_rng(0)
    found = []
    for episode in range(4):
        models = [_with_ground(task, fresh, episode) for _ in range(2)]
        models[1].opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_MIDPHASE
        for x in rng.uniform(-5, 45, 25):
            numbers = []
            for model in models:
                data = mujoco.MjData(model)
                data.qpos[:] = fresh.qpos[episode]
                ground = _height(np.array([x]), fresh.state.terrain[episode])
                data.qpos[0], data.qpos[2] = x, 0.9 + ground[0]
                mujoco.mj_forward(model, data)
                numbers.append(sorted(data.contact.dist.tolist()))
            assert numbers[0] == numbers[1]
            found.append(len(numbers[0]))
    assert np.mean(np.array(found) > 0) > 0.9


def test_a_standing_robot_is_carried_and_feels_its_weight() -> None:
    task = _task("steps", step_height_m=[0.05, 0.1])
    envs = CpuEnvs(task, 4, 1000)
    state = envs.reset(np.random.default_rng(0))
    physics = state.physics.copy()
    physics[:, 1] = [0.0, 2.9, 11.0, 30.0]
    physics[:, 3] += terrain.height_at(physics[:, 1], state.task.terrain, np)
    state = state._replace(physics=physics)
    forces = []
    for _ in range(12):
        state, result = envs.step(state, np.zeros((4, 10)), np.random.default_rng(1))
        assert not (result.terminated | result.diverged).any()
        forces.append(result.measures[:, 6:8].sum(axis=1))
    weight = 9.81 * task.model.body_mass.sum()
    assert (np.max(forces, axis=0) > 0.7 * weight).all()
    assert (state.observation[:, 0] > 0.6).all()


def test_height_reward_and_termination_are_relative_to_the_ground() -> None:
    rise = 0.1
    task = _task("steps", step_height_m=[rise, rise], step_depth_m=[0.4, 0.4])
    fresh = _fresh(task, 1)
    step_uniforms = np.zeros((1, task.step_uniforms))

    def outcome(x: float, z: float) -> tuple[float, bool, float, np.ndarray]:
        qpos = fresh.qpos.copy()
        qpos[:, 0], qpos[:, 2] = x, z
        reading = Reading(qpos, fresh.qvel, np.zeros((1, task.model.nsensordata)), np.zeros((1, 5)))
        result = task.step(fresh.state, np.zeros((1, 10)), reading, step_uniforms, np)
        measured = result.measures[0, task.measures.index("height")]
        return result.observation[0, 0], bool(result.terminated[0]), measured, result.reward_terms[0]

    on_the_start, on_the_third = outcome(0.0, 0.9), outcome(2.0, 0.9 + 3 * rise)
    np.testing.assert_allclose([on_the_start[0], on_the_third[0], on_the_third[2]], 0.9)
    np.testing.assert_allclose(on_the_start[3], on_the_third[3])  # the reward, term by term
    assert not outcome(0.0, 0.61)[1] and outcome(0.0, 0.59)[1]
    assert not outcome(2.0, 0.61 + 3 * rise)[1] and outcome(2.0, 0.59 + 3 * rise)[1]
    assert outcome(2.0, 0.7)[1]  # too low there, though it would do at the start


def test_level_ground_costs_nothing() -> None:
    flat, steps = _task("flat"), _task("steps")
    assert flat.ground is None
    assert flat.reset_uniforms < steps.reset_uniforms
    fresh = _fresh(flat, 3)
    assert fresh.model_fields == {}
    assert fresh.state.terrain.shape == (3, 0, 0)
    floor = flat.model.geom("floor")
    assert floor.type == mujoco.mjtGeom.mjGEOM_PLANE
    np.testing.assert_allclose(floor.pos[2], FLOOR_M)


def test_flights_have_their_number_of_steps_landings_and_errors() -> None:
    """One flight up, a landing and one down, read off the ground millimeter by millimeter."""
    settings = FLIGHTS | {"step_height_m": [-0.2, 0.2], "step_depth_m": [0.24, 0.4], "level_share": 0.25}
    fresh = _fresh(_task("steps", **settings), 120)
    x = np.arange(0.0, 12.0, 1e-3)
    counts, firsts, landings, level = [], [], [], 0
    for table in fresh.state.terrain:
        ground = _height(x, table)
        edges = np.flatnonzero(np.diff(ground))
        if not len(edges):
            level += 1
            continue
        lengths, jumps = np.diff(x[edges]), np.diff(ground)[edges]
        count = int(np.argmax(lengths > 0.45)) + 1  # the flight ends where a block is longer than any step
        rise = jumps[:count].mean()
        assert np.abs(jumps[:count] - rise).max() < 0.04  # heights are off by 1 cm, so jumps by 2 cm
        if abs(rise) > 0.03:
            assert (np.sign(jumps[count : 2 * count]) == -np.sign(rise)).all()
        counts.append(count)
        firsts.append(x[edges[0]])
        if count > 1:
            assert 0.24 - 2e-3 < lengths[0] < 0.4 + 2e-3
            landings.append(lengths[count - 1] - lengths[0])
    assert 0.1 < level / 120 < 0.4
    assert set(counts) == {1, 2, 3, 4, 5}
    assert 1.0 <= min(firsts) + 2e-3 < 1.2 and 2.8 < max(firsts) <= 3.0
    assert 0.5 <= min(landings) + 2e-3 < 0.6 and 1.4 < max(landings) <= 1.5 + 2e-3


def test_slopes_are_continuous_and_as_steep_as_drawn() -> None:
    fresh = _fresh(_task("slopes", step_depth_m=[2.0, 2.0], slope_deg=[-10, 10]), 50)
    x = np.arange(0.0, 30.0, 1e-3)
    steepest = []
    for table in fresh.state.terrain:
        rise = np.diff(_height(x, table)) / 1e-3
        steepest.append(np.rad2deg(np.arctan(np.abs(rise).max())))
    assert 9.0 < max(steepest) <= 10.0 + 1e-6  # no jump anywhere


def test_the_mean_height_is_that_of_many_samples() -> None:
    for kind, more in (("steps", FLIGHTS), ("slopes", {"step_depth_m": [0.5, 2.0]})):
        fresh = _fresh(_task(kind, **more), 5)
        for table in fresh.state.terrain:
            for x in (0.0, 1.1, 4.321, 9.0):
                samples = _height(np.linspace(x - 0.3, x + 0.3, 6001), table).mean()
                found = terrain.mean_height(np.array([x]), 0.3, table[None], np)
                np.testing.assert_allclose(found, samples, atol=1e-4)


def test_a_stage_may_change_the_ranges_during_an_episode() -> None:
    """The ground that an episode began on stays, whatever later ones are drawn from."""
    low, high = (_task("steps", step_height_m=[h, h]) for h in (0.05, 0.2))
    fresh = _fresh(low, 2)
    reading = Reading(fresh.qpos, fresh.qvel, np.zeros((2, low.model.nsensordata)), np.zeros((2, 5)))
    reading.qpos[:, 0], reading.qpos[:, 2] = 1.1, 1.0
    heights = [
        task.step(fresh.state, np.zeros((2, 10)), reading, np.zeros((2, task.step_uniforms)), np).observation[:, 0]
        for task in (low, high)
    ]
    np.testing.assert_allclose(heights, 0.95)


def test_steps_of_no_height_equal_level_ground() -> None:
    """On the start the contacts are the plane's; on blocks a foot across an edge has one more, and that is all."""
    observations, forces = [], []
    for task in (_task("flat"), _task("steps", step_height_m=[0.0, 0.0])):
        envs = CpuEnvs(task, 2, 1000)
        start = task.reset(np.full((2, task.reset_uniforms), 0.5), np)
        state = envs.reset(np.random.default_rng(0))
        physics = state.physics.copy()
        physics[:, 1:] = np.concatenate([start.qpos, start.qvel], axis=1)
        physics[:, 1] = [0.0, 3.0]
        state = state._replace(physics=physics, task=start.state, model_fields=start.model_fields)
        envs.restore(state)
        for _ in range(12):
            state, result = envs.step(state, np.zeros((2, 10)), np.random.default_rng(0))
        observations.append(state.observation)
        forces.append(result.measures[:, 6:8])
    np.testing.assert_allclose(observations[0][0], observations[1][0], atol=1e-4)
    np.testing.assert_allclose(observations[0][1], observations[1][1], atol=2e-2)
    np.testing.assert_allclose(forces[0], forces[1], atol=2.0)
    assert (forces[0] > 20).any()


def test_mjx_refuses_it_in_one_line() -> None:
    with pytest.raises(ConfigError, match=r"^cassie\.terrain\.kind: [^\n]*level ground only; set it to flat"):
        make_engine(_task("steps"), "jax", 10)


@pytest.mark.parametrize(("kind", "more"), [("steps", FLIGHTS), ("rough", {}), ("slopes", {})])
def test_numpy_equals_jax(kind: str, more: dict[str, Any]) -> None:
    task = _task(kind, **more)
    ours = _fresh(task, 3)
    theirs = task.reset(jnp.asarray(np.random.default_rng(0).random((3, task.reset_uniforms))), jnp)
    for name, values in ours.model_fields.items():
        np.testing.assert_allclose(theirs.model_fields[name], values, rtol=1e-5, atol=1e-5, err_msg=name)
    x = np.array([1.5, 4.2, -3.0])
    for half_length_m in (0.0, 0.4):
        np.testing.assert_allclose(
            terrain.mean_height(jnp.asarray(x), half_length_m, theirs.state.terrain, jnp),
            terrain.mean_height(x, half_length_m, ours.state.terrain, np),
            atol=1e-5,
        )
