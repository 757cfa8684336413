"""A robot that is blind to the ground: its kinematics against MuJoCo's, and its estimates against the truth."""

from typing import Any

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from hasrl_jax.config.convert import from_dict
from hasrl_jax.config.schema import Config
from hasrl_jax.envs import frames, layout
from hasrl_jax.envs.cassie import kinematics
from hasrl_jax.envs.cassie import task as cassie
from hasrl_jax.envs.cassie.ids import MOTOR_SIGNS, cassie_ids
from hasrl_jax.envs.cpu_engine import CpuEnvs
from hasrl_jax.envs.registry import make_task
from hasrl_jax.envs.task import Reading, Task
from hasrl_jax.policy import actor, loading

PLACES = layout.places(cassie.OBSERVATION)


def _poses(task: Task, count: int) -> list[mujoco.MjData]:
    """Robots in arbitrary poses with arbitrary velocities, on which no force acts."""
    rng, found = np.random.default_rng(0), []
    for _ in range(count):
        data = mujoco.MjData(task.model)
        data.qpos[:] = task.model.key("stand").qpos + rng.normal(0, 0.1, task.model.nq)
        data.qvel[:] = rng.normal(0, 1, task.model.nv)
        mujoco.mj_normalizeQuat(task.model, data.qpos)
        mujoco.mj_forward(task.model, data)
        found.append(data)
    return found


def _encoders(task: Task, data: mujoco.MjData) -> tuple[np.ndarray, np.ndarray]:
    ids = cassie_ids(task.model)
    qpos, qvel = ids.encoder_qpos, ids.encoder_qvel
    return data.qpos[qpos], data.qvel[qvel]


def test_the_soles_are_where_mujoco_has_them_and_move_as_there() -> None:
    task = make_task(from_dict({}))
    legs = kinematics.legs(task.model, cassie_ids(task.model))
    for data in _poses(task, 5):
        angle, speed = _encoders(task, data)
        ends, moving = kinematics.soles(legs, angle[legs.encoder], speed[legs.encoder], data.qvel[3:6], np)
        pelvis = data.body("cassie-pelvis")
        turn = pelvis.xmat.reshape(3, 3)
        for leg, side in enumerate(("left", "right")):
            geom = task.model.geom(f"{side}-foot")
            axis = data.geom(f"{side}-foot").xmat.reshape(3, 3)[:, 2]
            for end, sign in enumerate((1, -1)):
                point = data.geom(f"{side}-foot").xpos + sign * geom.size[1] * axis
                np.testing.assert_allclose(pelvis.xpos + turn @ ends[leg, end], point, atol=1e-12)
                jacobian = np.zeros((3, task.model.nv))
                mujoco.mj_jac(task.model, data, jacobian, None, point, geom.bodyid[0])
                np.testing.assert_allclose(data.qvel[:3] + turn @ moving[leg, end], jacobian @ data.qvel, atol=1e-12)


def test_a_vector_turns_as_a_matrix_turns_it() -> None:
    rng = np.random.default_rng(1)
    quat, vector, matrix = rng.normal(size=4), rng.normal(size=3), np.zeros(9)
    quat /= np.linalg.norm(quat)
    mujoco.mju_quat2Mat(matrix, quat)
    np.testing.assert_allclose(frames.rotated(vector, quat, np), matrix.reshape(3, 3) @ vector, atol=1e-14)


@pytest.mark.parametrize(("bends", "weights"), [((0.0, -0.06), (0.01, 1.01)), ((-0.06, -0.045), (1.01, 0.51))])
def test_the_estimate_is_what_the_equations_say(bends: tuple[float, float], weights: tuple[float, float]) -> None:
    """One robot, with the soles from MuJoCo and the blend written out."""
    task = make_task(from_dict({}))
    legs, (data,) = kinematics.legs(task.model, cassie_ids(task.model)), _poses(task, 1)
    for side, bend in zip(("left", "right"), bends, strict=True):
        data.joint(f"{side}-shin").qpos[:] = bend
    mujoco.mj_forward(task.model, data)
    heights, speeds = [], []
    for side in ("left", "right"):
        geom, axis = data.geom(f"{side}-foot"), data.geom(f"{side}-foot").xmat.reshape(3, 3)[:, 2]
        points = [geom.xpos + sign * task.model.geom(f"{side}-foot").size[1] * axis for sign in (1, -1)]
        lower = min(points, key=lambda point: point[2])
        jacobian = np.zeros((3, task.model.nv))
        mujoco.mj_jac(task.model, data, jacobian, None, lower, task.model.geom(f"{side}-foot").bodyid[0])
        heights.append(data.qpos[2] - (lower[2] - 0.02) - 0.01)  # the sole's radius, and the floor's place
        speeds.append(data.qvel[:3] - jacobian @ data.qvel)
    share = np.array(weights) / sum(weights)
    acceleration, before = np.array([0.5, -1.0, 2.0]), np.array([0.3, 0.1, -0.2])
    turn = data.body("cassie-pelvis").xmat.reshape(3, 3)
    predicted = before + 0.025 * turn @ acceleration
    trust = 0.5 * min(1.0, sum(weights) - 0.02)
    angle, speed = _encoders(task, data)
    height, velocity = kinematics.estimate(
        legs, angle, speed, data.qvel[3:6], data.qpos[3:7], acceleration, before, np.array(0.025), np
    )
    np.testing.assert_allclose(height, share @ np.array(heights), atol=1e-12)
    np.testing.assert_allclose(velocity, predicted + trust * (share @ np.array(speeds) - predicted), atol=1e-12)


def _walk(steps: int, **cassie_settings: Any) -> tuple[np.ndarray, np.ndarray]:
    """The released policy, blind: what it sees of height and velocity, and the truth; [T, N, 4] each."""
    config, parameters = loading.load_policy_parameters(None, "released")
    told = {"forward_m_s": [0.8, 0.8], "lateral_m_s": [0.1, 0.1], "stand_probability": 0.0, "start_moving": 0.0}
    settings = {
        "observe": "blind",
        "command": told,
        "randomize": {"enabled": False},
        "push": {"force_n": [0, 0]},
        **cassie_settings,
    }
    config = from_dict({"cassie": settings}, config)
    task = make_task(config)
    envs, rng = CpuEnvs(task, 2, 10**6), np.random.default_rng(0)
    state, policy = envs.reset(rng), actor.reset(config, task, parameters, 2)
    seen, true = [], []
    for _ in range(steps):
        action, policy = actor.act(policy, state.observation, state.is_first)
        state, result = envs.step(state, action, rng)
        assert not result.terminated.any()
        velocity = state.physics[:, 1 + task.model.nq :][:, :3]
        seen.append(
            state.observation[:, [PLACES["pelvis_height"].start, *range(*PLACES["pelvis_velocity"].indices(50))]]
        )
        true.append(np.concatenate([state.physics[:, 3:4], velocity], axis=1))
    return np.array(seen), np.array(true)


def test_on_level_ground_the_estimates_are_the_truth_within_centimeters() -> None:
    seen, true = _walk(120)
    error = np.sqrt(((seen - true)[40:] ** 2).mean(axis=(0, 1)))
    assert error[0] < 0.005
    assert (error[1:] < 0.08).all()
    assert true[40:, :, 1].mean() > 0.6  # it walks


def test_the_ground_shows_only_through_the_body() -> None:
    """With the same joints before an edge, behind it and on top of it a blind robot sees the same; another does not."""
    seen = {}
    for observe in ("blind", "state"):
        settings = {"kind": "steps", "step_height_m": [0.1, 0.1], "step_depth_m": [0.4, 0.4]}
        config = from_dict({"cassie": {"observe": observe, "randomize": {"enabled": False}, "terrain": settings}})
        task = make_task(config)
        fresh = task.reset(np.random.default_rng(0).random((4, task.reset_uniforms)), np)
        qpos = fresh.qpos.copy()
        qpos[:, 0], qpos[:, 2] = [0.0, 0.99, 1.01, 1.5], [1.0, 1.0, 1.0, 1.2]
        reading = Reading(qpos, fresh.qvel, np.zeros((4, task.model.nsensordata)), np.zeros((4, 5)))
        state = fresh.state._replace(phase=np.zeros(4), command=np.zeros((4, 2)), encoder_offset=np.zeros((4, 16)))
        result = task.step(state, np.zeros((4, 10)), reading, np.full((4, task.step_uniforms), 0.5), np)
        seen[observe] = result.observation
        np.testing.assert_allclose(result.measures[:, task.measures.index("height")], [1.0, 1.0, 0.9, 1.0])
    assert np.ptp(seen["blind"], axis=0).max() == 0.0
    assert np.ptp(seen["state"][:, 0]) > 0.09
    np.testing.assert_allclose(seen["blind"][0, 0], 1.01, atol=0.02)  # in this pose the soles are so far below


def test_the_encoders_errors_are_in_it_and_the_clock_rests_by_the_estimate() -> None:
    command = {"frame": "heading", "stand_probability": 1.0}
    config = from_dict({"cassie": {"observe": "blind", "command": command, "randomize": {"enabled": True}}})
    task = make_task(config)
    fresh = task.reset(np.random.default_rng(0).random((3, task.reset_uniforms)), np)
    constants = task.step.args[0]
    exact = fresh.state._replace(encoder_offset=np.zeros((3, 16)))
    angle = cassie.encoders(constants, exact, fresh.qpos, np)
    without = kinematics.height(constants.legs, angle, fresh.qpos[:, 3:7], np)
    assert (np.abs(fresh.observation[:, 0] - without) > 1e-5).all()
    assert np.abs(fresh.observation[:, 0] - without).max() < 0.03
    fast = np.array([[1.0, 0.0, 0.0]])
    told = task.with_command(fresh.state, fresh.observation, np.tile([0.0, 0.0, 0.0, 0.9], (3, 1)), np)[0]
    assert told.standing.all()
    moving = fresh.observation.copy()
    moving[:, PLACES["pelvis_velocity"]] = fast
    assert not task.with_command(fresh.state, moving, np.tile([0.0, 0.0, 0.0, 0.9], (3, 1)), np)[0].standing.any()


@pytest.mark.parametrize("frame", ["world", "heading"])
def test_numpy_equals_jax_and_the_mirror_image_is_the_mirror_image(frame: str) -> None:
    config: Config = from_dict({"cassie": {"observe": "blind", "command": {"frame": frame}}})
    task = make_task(config)
    legs = kinematics.legs(task.model, cassie_ids(task.model))
    datas = _poses(task, 3)
    arrays = [np.array(part) for part in zip(*(_encoders(task, data) for data in datas), strict=True)]
    arrays += [np.array([data.qvel[3:6] for data in datas]), np.array([data.qpos[3:7] for data in datas])]
    rng = np.random.default_rng(3)
    arrays += [rng.normal(size=(3, 3)), rng.normal(size=(3, 3)), np.full(3, 0.025)]
    ours = kinematics.estimate(legs, *arrays, np)
    theirs = kinematics.estimate(legs, *map(jnp.asarray, arrays), jnp)
    for mine, other in zip(ours, theirs, strict=True):
        np.testing.assert_allclose(other, mine, atol=1e-4)
    # Mirrored: legs swapped with rolls and yaws negated, axial and polar vectors, as the layout says of each.
    angle, speed, turning, quat, acceleration, velocity, elapsed = arrays
    signs = np.array([*MOTOR_SIGNS, *cassie._PASSIVE_SIGNS])
    swap = np.array([*range(5, 10), *range(5), *range(13, 16), *range(10, 13)])
    axial, polar = np.array(layout.AXIAL), np.array(layout.VECTOR)
    mirrored = [signs * angle[:, swap], signs * speed[:, swap], axial * turning, np.array(layout.QUATERNION) * quat]
    mirrored += [polar * acceleration, polar * velocity, elapsed]
    height, moving = kinematics.estimate(legs, *mirrored, np)
    np.testing.assert_allclose(height, ours[0], atol=1e-5)
    np.testing.assert_allclose(moving, polar * ours[1], atol=1e-4)
