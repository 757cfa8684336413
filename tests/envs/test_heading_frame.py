"""Commands in the robot's heading frame: where it faces never matters, what it is told does, and it can stand."""

import json
from pathlib import Path

import mujoco
import numpy as np
import pytest

from hasrl_jax.config.convert import from_dict
from hasrl_jax.config.files import shipped
from hasrl_jax.config.schema import Config
from hasrl_jax.envs import frames, layout
from hasrl_jax.envs.cassie import commands, rewards
from hasrl_jax.envs.cassie import task as cassie
from hasrl_jax.envs.cpu_engine import CpuEnvs, EnvState
from hasrl_jax.envs.registry import make_task
from hasrl_jax.envs.task import Reading, Task

RECORDED = json.loads((Path(__file__).parent.parent / "data" / "world_frame.json").read_text(encoding="utf-8"))
COMMAND = {
    "frame": "heading",
    "lateral_m_s": [-0.5, 0.5],
    "yaw_rate_rad_s": [-1.0, 1.0],
    "height_m": [0.65, 1.0],
    "start_heading_rad": 3.0,
    "resample_s": [0.0, 0.0],
}


def _config(**command: object) -> Config:
    return from_dict({"cassie": {"command": COMMAND | command, "randomize": {"enabled": False}}})


def _walking(steps: int, seed: int, config: Config) -> tuple[Task, CpuEnvs, EnvState, np.ndarray]:
    """Two environments in the middle of an episode under random actions, and actions."""
    task = make_task(config)
    envs, rng = CpuEnvs(task, 2, 1000), np.random.default_rng(seed)
    state = envs.reset(rng)
    for _ in range(steps):
        state, _ = envs.step(state, rng.uniform(-0.3, 0.3, (2, 10)), rng)
    return task, envs, state, rng.uniform(-0.3, 0.3, (2, 10))


@pytest.mark.parametrize("name", ["paper", "cassie_walk"])
def test_the_formulation_of_the_paper_has_the_numbers_it_had(name: str) -> None:
    """Recorded before the heading frame existed: four steps of two randomised, pushed robots."""
    recorded = RECORDED[name]
    changes = {
        "command": {"frame": "world", "resample_s": [0.03, 0.06], "start_moving": 0.5},
        "push": {"force_n": [50, 200], "interval_s": [0.02, 0.05]},
        "randomize": {"enabled": True},
        "reward": {"foot_force": 0.2, "foot_velocity": {"paper": 0.2, "cassie_walk": 0.12}[name]},
    }
    task = make_task(from_dict({"cassie": changes}, shipped(name)))
    assert (task.reset_uniforms, task.step_uniforms) == (recorded["reset_uniforms"], recorded["step_uniforms"])
    assert task.mirror is not None
    np.testing.assert_array_equal(task.mirror.observation_index, recorded["mirror"]["index"])
    np.testing.assert_array_equal(task.mirror.observation_sign, recorded["mirror"]["sign"])
    uniforms = np.random.Generator(np.random.Philox(recorded["seed"])).random((2, task.reset_uniforms))
    fresh = task.reset(uniforms, np)
    for part in ("observation", "qpos", "qvel"):
        np.testing.assert_allclose(getattr(fresh, part), recorded["start"][part], rtol=1e-12, err_msg=part)
    state = fresh.state
    for step in recorded["steps"]:
        reading = Reading(**{part: np.array(values) for part, values in step["reading"].items()})
        np.testing.assert_allclose(task.physics_features(reading.sensordata, np), step["features"], rtol=1e-12)
        result = task.step(state, np.array(step["action"]), reading, np.array(step["uniforms"]), np)
        for part in ("observation", "reward", "reward_terms", "terminated", "measures"):
            found = getattr(result, part)
            if part in ("reward_terms", "measures"):  # a term without a weight, and the forces on toes, came later
                found = found[:, : np.shape(step[part])[1]]
            np.testing.assert_allclose(found, step[part], rtol=1e-12, atol=1e-12, err_msg=part)
        state = result.state


def _turned_quat(quat: np.ndarray, angle: float) -> np.ndarray:
    result = np.empty(4)
    mujoco.mju_mulQuat(result, np.array([np.cos(angle / 2), 0, 0, np.sin(angle / 2)]), quat)
    return result


def _turned_world(constants: cassie.Constants, reading: Reading, angle: float) -> Reading:
    """`reading` of two robots as it were in a world turned by `angle`, with sensors in that world's frame."""
    rotation = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    qpos, qvel, sensors = reading.qpos.copy(), reading.qvel.copy(), reading.sensordata.copy()
    for robot in range(2):
        qpos[robot, :2], qvel[robot, :2] = rotation @ qpos[robot, :2], rotation @ qvel[robot, :2]
        qpos[robot, 3:7] = _turned_quat(qpos[robot, 3:7], angle)
        for foot in range(2):
            at, along = constants.ids.foot_orientation[foot], constants.ids.foot_velocity[foot][:2]
            sensors[robot, at] = _turned_quat(sensors[robot, at], angle)
            sensors[robot, along] = rotation @ sensors[robot, along]
    features = cassie.physics_features(constants, sensors, np)
    return Reading(qpos, qvel, sensors, features)


@pytest.mark.parametrize("angle", [-3.0, -1.2, 0.4, 2.5])
def test_where_the_robot_faces_changes_neither_observation_nor_reward(angle: float) -> None:
    task, envs, state, action = _walking(12, 3, _config())
    constants = task.step.args[0]
    _, reading, _ = envs._simulate(state, envs._control(state, action))
    reading = reading._replace(averages=task.physics_features(reading.sensordata, np))
    uniforms = np.random.default_rng(0).random((2, task.step_uniforms))
    ours = task.step(state.task, action, reading, uniforms, np)
    before = state.task._replace(
        target_heading=state.task.target_heading + angle,
        path=frames.turned(state.task.path, np.full(2, angle), np),
    )
    theirs = task.step(before, action, _turned_world(constants, reading, angle), uniforms, np)
    np.testing.assert_allclose(theirs.observation, ours.observation, atol=1e-9)
    np.testing.assert_allclose(theirs.reward_terms, ours.reward_terms, atol=1e-9)
    heading = task.measures.index("heading")
    np.testing.assert_allclose(np.delete(theirs.measures, heading, 1), np.delete(ours.measures, heading, 1), atol=1e-9)
    turn = np.exp(1j * (theirs.measures[:, heading] - ours.measures[:, heading]))
    np.testing.assert_allclose(turn, np.exp(1j * angle))


def test_an_episode_in_any_direction_is_the_same_episode() -> None:
    """Through the physics; not exact, because its friction pyramids have corners along the axes of the world."""
    task = make_task(_config(start_moving=1.0))
    uniforms = np.tile(np.random.default_rng(4).random(task.reset_uniforms), (2, 1))
    place = task.reset_uniforms - cassie.NUM_ENCODERS - 1
    uniforms[:, place] = 0.5, 0.9  # the heading: 0, and 2.4 rad
    fresh = task.reset(uniforms, np)
    np.testing.assert_allclose(frames.heading(fresh.qpos[:, 3:7], np), [0.0, 2.4], atol=1e-12)
    assert np.abs(fresh.state.command[:, :3]).min() > 0.01
    envs, rng = CpuEnvs(task, 2, 1000), np.random.default_rng(5)
    state = envs.reset(rng)
    physics = np.concatenate([state.physics[:, :1], fresh.qpos, fresh.qvel], axis=1)
    state = state._replace(physics=physics, task=fresh.state, observation=fresh.observation)
    for _ in range(8):
        np.testing.assert_allclose(state.observation[1], state.observation[0], atol=0.05)
        state, result = envs.step(state, np.tile(rng.uniform(-0.3, 0.3, 10), (2, 1)), rng)
        np.testing.assert_allclose(result.reward[1], result.reward[0], atol=0.01)


def test_the_heading_frame_is_the_world_where_the_robot_faces_x() -> None:
    """So that a policy of one formulation means something in the other."""
    heading = make_task(
        _config(start_heading_rad=0.0, forward_m_s=[1.0, 1.0], yaw_rate_rad_s=[0, 0], height_m=[0.9, 0.9])
    )
    still = {"frame": "world", "forward_m_s": [1.0, 1.0], "lateral_m_s": [0.2, 0.2], "resample_s": [0, 0]}
    world = make_task(from_dict({"cassie": {"command": still, "randomize": {"enabled": False}}}))
    envs, rng = CpuEnvs(world, 2, 1000), np.random.default_rng(0)
    state = envs.reset(rng)
    for _ in range(5):
        state, _ = envs.step(state, rng.uniform(-0.3, 0.3, (2, 10)), rng)
    action = rng.uniform(-0.3, 0.3, (2, 10))
    _, reading, _ = envs._simulate(state, envs._control(state, action))
    command = np.array([[1.0, 0.2, 0.0, 0.9]] * 2)
    theirs = state.task._replace(command=command)
    at_once = [task.physics_features(reading.sensordata, np) for task in (world, heading)]
    results = [
        task.step(before, action, reading._replace(averages=features), np.zeros((2, task.step_uniforms)), np)
        for task, before, features in zip((world, heading), (state.task, theirs), at_once, strict=True)
    ]
    np.testing.assert_allclose(results[1].observation[:, :50], results[0].observation, atol=1e-12)
    np.testing.assert_array_equal(results[1].observation[:, 50:], command[:, 2:])
    names = [name for name in rewards.TERMS if name != "velocity"]  # which counts the heading error besides
    columns = [rewards.TERMS.index(name) for name in names]
    np.testing.assert_allclose(results[1].reward_terms[:, columns], results[0].reward_terms[:, columns], atol=1e-9)


def test_foot_orientation_is_judged_from_the_heading_to_keep() -> None:
    rng = np.random.default_rng(0)
    quats = rng.normal(size=(7, 1, 4))
    quats /= np.linalg.norm(quats, axis=-1, keepdims=True)
    reference = _turned_quat(rewards.NEUTRAL_FOOT_QUAT, 0.8)
    expected = np.mean([1 - (quat @ reference) ** 2 for quat in quats[:, 0]])
    products = rewards.turn_products(quats, rewards.NEUTRAL_FOOT_QUAT, np).mean(axis=0)
    error = rewards.turned_quaternion_error(products, np.array(0.8), np)
    # The neutral quaternion is rounded to eight digits.
    np.testing.assert_allclose(error, [expected], atol=1e-7)


def _follow(task: Task, target: float, yaw: float, command: list[float], xy: tuple[float, float] = (0, 0)):
    fresh = task.reset(np.full((1, task.reset_uniforms), 0.5), np)
    state = fresh.state._replace(command=np.array([command]), target_heading=np.array([target]), path=np.zeros((1, 2)))
    qpos = fresh.qpos.copy()
    qpos[0, :2] = xy
    qpos[0, 3:7] = np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)
    return cassie.follow(task.step.args[0], state, qpos, np)


@pytest.mark.parametrize(
    ("target", "yaw", "rate", "expected"),
    [
        (0.0, 0.0, 1.0, 0.025),  # moves on by the commanded rate
        (0.3, 0.1, -0.4, 0.29),
        (0.5, 0.0, 1.0, 0.5),  # waits for a robot that lags
        (0.0, 1.5, 0.0, 1.0),  # comes along with one that was twisted
        (3.13, -3.12, 1.0, 3.155 - 2 * np.pi),  # and knows no seam
        (3.0, -3.0, 0.0, 3.0),
    ],
)
def test_the_heading_to_keep(target: float, yaw: float, rate: float, expected: float) -> None:
    state = _follow(make_task(_config()), target, yaw, [0.0, 0.0, rate, 0.9])
    np.testing.assert_allclose(state.target_heading, [expected], atol=1e-12)


def test_the_path_to_keep_lies_abreast_of_the_robot_and_not_far() -> None:
    task = make_task(_config(max_drift_m=0.5))
    abreast = _follow(task, np.pi / 2, np.pi / 2, [1.0, 0.0, 0.0, 0.9], (0.2, 0.7))
    np.testing.assert_allclose(abreast.path, [[0.0, 0.7]], atol=1e-12)  # 0.2 m to the left of who faces +y
    far = _follow(task, np.pi / 2, np.pi / 2, [1.0, 0.0, 0.0, 0.9], (-2.0, 0.7))
    np.testing.assert_allclose(far.path, [[-1.5, 0.7]], atol=1e-12)
    aside = _follow(task, np.pi / 2, np.pi / 2, [0.0, 0.4, 0.0, 0.9])
    np.testing.assert_allclose(aside.path, [[-0.4 * 0.025, 0.0]], atol=1e-12)  # left of +y is -x


def test_drawn_commands_keep_their_ranges_and_shares() -> None:
    config = _config(
        forward_m_s=[-1.0, 4.0], stand_probability=0.1, straight_probability=0.2, alone_probability=0.2,
        height_probability=0.5, turn_m_s2=2.0, height_fade_m_s=[1.5, 3.0],
    ).cassie.command  # fmt: skip
    uniforms = np.random.default_rng(0).random((20000, commands.num_uniforms(config)))
    command, _ = commands.draw_command(uniforms, config, 0.9, np)
    forward, lateral, yaw_rate, height = command.T
    for values, low, high in ((forward, -1, 4), (lateral, -0.5, 0.5), (yaw_rate, -1, 1), (height, 0.65, 1.0)):
        assert low <= values.min() < low + 0.02
        assert high - 0.02 < values.max() <= high
    moving = list(zip(forward != 0, lateral != 0, yaw_rate != 0, strict=True))
    shares = {kind: moving.count(kind) / len(moving) for kind in set(moving)}
    expected = {
        (False, False, False): 0.1,
        (True, False, False): 0.2,
        (False, False, True): 0.1,
        (False, True, False): 0.1,
        (True, True, True): 0.5,
    }
    assert shares.keys() == expected.keys()
    for kind, share in expected.items():
        assert shares[kind] == pytest.approx(share, abs=0.015)
    assert np.abs(forward * yaw_rate).max() <= 2.0 + 1e-9
    assert np.abs(yaw_rate[np.abs(forward) < 2]).max() > 0.9
    assert (height[forward > 3.0] == 0.9).all()
    slow = np.abs(forward) < 1.5
    assert (height[slow] == 0.9).mean() == pytest.approx(0.5, abs=0.02)


def test_who_is_told_to_stand_gets_a_resting_clock_until_pushed() -> None:
    task = make_task(_config(stand_probability=1.0))
    fresh = task.reset(np.full((1, task.reset_uniforms), 0.5), np)
    at = layout.places(task.observation)["clock"]
    assert fresh.state.standing.all()
    np.testing.assert_array_equal(fresh.observation[:, at], 0.0)

    def step(state: cassie.CassieState, speed: float):
        sizes = task.model.nv, task.model.nsensordata, 9
        qvel, sensors, averages = (np.zeros((1, size)) for size in sizes)
        qvel[0, 1] = speed
        return task.step(
            state, np.zeros((1, 10)), Reading(fresh.qpos, qvel, sensors, averages), np.full((1, 10), 0.5), np
        )

    still = step(fresh.state, 0.1)
    assert still.state.standing.all()
    assert still.state.phase == fresh.state.phase
    pushed = step(still.state, 0.8)
    assert not pushed.state.standing.any()
    np.testing.assert_allclose((pushed.observation[:, at] ** 2).sum(), 1.0)
    moving = step(pushed.state, 0.8)
    assert moving.state.phase == pytest.approx(fresh.state.phase + 0.025 / 0.9)
    assert step(moving.state, 0.1).state.standing.all()  # rests again


def test_standing_on_both_feet_scores_more_than_on_one() -> None:
    task = make_task(_config(stand_probability=1.0))
    fresh = task.reset(np.full((1, task.reset_uniforms), 0.5), np)
    sensors = np.zeros((1, task.model.nsensordata))

    def score(left_n: float, right_n: float) -> float:
        averages = np.zeros((1, 9))
        averages[0, :2] = left_n, right_n
        reading = Reading(fresh.qpos, np.zeros((1, task.model.nv)), sensors, averages)
        result = task.step(fresh.state, np.zeros((1, 10)), reading, np.full((1, 10), 0.5), np)
        return float(result.reward_terms[0, rewards.TERMS.index("foot_force")])

    # weight 0.2, scale 2, tan(pi/4 * 1.2 * 0.5 * share)
    assert score(160, 160) == pytest.approx(0.4 * 2 * np.tan(0.15 * np.pi))
    assert score(320, 0) == pytest.approx(0.4 * np.tan(0.15 * np.pi))
    assert score(60, 160) == pytest.approx(0.4 * (np.tan(0.15 * np.pi / 2) + np.tan(0.15 * np.pi)))


def test_a_commanded_height_is_what_the_pelvis_is_judged_by() -> None:
    reward = {"height_sharpness": 5.0, "height_band_m": 0.02, "height_band_per_speed": 0.0, "shaking": 0.0}
    config = from_dict({"cassie": {"reward": reward}}, _config())
    task = make_task(config)
    fresh = task.reset(np.full((1, task.reset_uniforms), 0.5), np)
    qpos = fresh.qpos.copy()
    qpos[0, 2] = 0.8
    reading = Reading(qpos, *(np.zeros((1, size)) for size in (task.model.nv, task.model.nsensordata, 9)))
    for height, expected in ((0.7, np.exp(-0.5)), (0.79, 1.0), (1.0, np.exp(-1.0))):
        state = fresh.state._replace(command=np.array([[0.0, 0.0, 0.1, height]]))
        result = task.step(state, np.zeros((1, 10)), reading, np.full((1, 10), 0.5), np)
        assert result.reward_terms[0, 3] == pytest.approx(0.3 * expected)
