"""The Cassie task: what the observation holds, symmetry, commands, termination, and NumPy against JAX."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from hasrl_jax.cli.parsing import to_play
from hasrl_jax.config.convert import from_dict
from hasrl_jax.envs.cassie import commands
from hasrl_jax.envs.cassie import task as cassie
from hasrl_jax.envs.cpu_engine import CpuEnvs, EnvState
from hasrl_jax.envs.task import Reading, Task

MOTORS = ("hip-roll", "hip-yaw", "hip-pitch", "knee", "foot")
PASSIVE = ("shin", "tarsus", "foot")
NOMINAL_ROBOT = {"randomize": {"enabled": False}}


HEADING = {"frame": "heading", "yaw_rate_rad_s": [-1.0, 1.0], "height_m": [0.65, 1.0], "start_heading_rad": 3.0}


def _make(**changes: dict) -> tuple[Task, cassie.Constants]:
    task = cassie.make(from_dict({"cassie": changes}))
    return task, task.step.args[0]


def _moving_state(steps: int = 6, seed: int = 0, **changes: dict) -> tuple[Task, CpuEnvs, EnvState, np.ndarray]:
    """One environment in the middle of an episode under random actions, and an action."""
    task, _ = _make(**changes)
    envs = CpuEnvs(task, 1, 1000)
    rng = np.random.default_rng(seed)
    state = envs.reset(rng)
    for _ in range(steps):
        state, result = envs.step(state, rng.uniform(-0.3, 0.3, (1, 10)), rng)
        assert not (result.terminated | result.diverged).any()
    return task, envs, state, rng.uniform(-0.3, 0.3, (1, 10))


def _still_reading(task: Task, qpos: np.ndarray) -> Reading:
    """A robot that does not move, with sensors that read nothing."""
    sizes = (task.model.nv, task.model.nsensordata, 5)
    return Reading(qpos, *(np.zeros((*qpos.shape[:-1], size)) for size in sizes))


def test_observation_index_by_index() -> None:
    task, _ = _make()
    model, data = task.model, mujoco.MjData(task.model)
    rng = np.random.default_rng(1)
    data.qpos[:] = model.key("stand").qpos + rng.uniform(-0.05, 0.05, model.nq)
    mujoco.mj_normalizeQuat(model, data.qpos)
    data.qvel[:] = rng.normal(size=model.nv)
    mujoco.mj_forward(model, data)
    fresh = task.reset(rng.random((1, task.reset_uniforms)), np)
    reading = Reading(data.qpos[None], data.qvel[None], data.sensordata[None], np.zeros((1, 5)))
    result = task.step(fresh.state, np.zeros((1, 10)), reading, rng.random((1, task.step_uniforms)), np)
    observation, offset = result.observation[0], fresh.state.encoder_offset[0]

    def joints(names: tuple[str, ...], values: str) -> list[float]:
        return [getattr(data.joint(f"{side}-{name}"), values)[0] for side in ("left", "right") for name in names]

    rotation = data.body("cassie-pelvis").xmat.reshape(3, 3)
    acceleration = data.sensor("pelvis-acceleration").data - rotation.T @ [0, 0, 9.81]
    angle = 2 * np.pi * result.state.phase[0]
    assert observation.shape == (50,)
    np.testing.assert_allclose(observation[0], data.qpos[2])
    np.testing.assert_allclose(observation[1:5], data.body("cassie-pelvis").xquat)
    np.testing.assert_allclose(observation[5:15], joints(MOTORS, "qpos") + offset[:10])
    np.testing.assert_allclose(observation[15:18], data.qvel[0:3])
    np.testing.assert_allclose(observation[18:21], data.qvel[3:6])
    np.testing.assert_allclose(observation[21:31], joints(MOTORS, "qvel"))
    np.testing.assert_allclose(observation[31:34], acceleration, atol=1e-9)
    np.testing.assert_allclose(observation[34:40], joints(PASSIVE, "qpos") + offset[10:])
    np.testing.assert_allclose(observation[40:46], joints(PASSIVE, "qvel"))
    np.testing.assert_allclose(observation[46:48], [np.sin(angle), np.cos(angle)])
    np.testing.assert_allclose(observation[48:50], fresh.state.command[0])
    assert np.abs(offset).max() <= 0.01


def test_acceleration_is_minus_gravity_in_free_fall() -> None:
    task, _ = _make(**NOMINAL_ROBOT)
    data = mujoco.MjData(task.model)
    data.qpos[:] = task.model.key("stand").qpos
    data.qpos[2] = 3.0
    data.ctrl[:] = cassie.NEUTRAL_RAD
    mujoco.mj_step(task.model, data, 40)  # the springs settle
    fresh = task.reset(np.zeros((1, task.reset_uniforms)), np)
    reading = Reading(data.qpos[None], data.qvel[None], data.sensordata[None], np.zeros((1, 5)))
    result = task.step(fresh.state, np.zeros((1, 10)), reading, np.zeros((1, task.step_uniforms)), np)
    np.testing.assert_allclose(result.observation[0, 31:34], [0, 0, -9.81], atol=0.6)  # the legs still swing a little


def test_reset_observation_is_the_initial_pose_at_rest() -> None:
    task, _ = _make(**NOMINAL_ROBOT)
    fresh = task.reset(np.random.default_rng(0).random((4, task.reset_uniforms)), np)
    assert fresh.observation.shape == (4, 50)
    np.testing.assert_allclose(fresh.observation[:, :5], np.tile([1.01, 1, 0, 0, 0], (4, 1)))
    np.testing.assert_allclose(fresh.observation[:, 5:15], np.tile(cassie.NEUTRAL_RAD, (4, 1)), atol=1e-12)
    assert (fresh.observation[:, 15:34] == 0).all()
    assert fresh.model_fields == {}
    assert len(set(fresh.state.phase)) == 4  # the gait starts anywhere in its cycle


def test_a_share_of_episodes_starts_at_the_commanded_speed() -> None:
    task, _ = _make(command={"start_moving": 0.5})
    fresh = task.reset(np.random.default_rng(0).random((400, task.reset_uniforms)), np)
    moving = fresh.qvel.any(axis=-1)
    commanded = fresh.state.command.any(axis=-1)
    np.testing.assert_array_equal(fresh.qvel[moving, :2], fresh.state.command[moving])
    assert 0.4 < moving[commanded].mean() < 0.6
    assert not fresh.qvel[:, 2:].any()


@pytest.mark.parametrize("command", [[1.0, 0.0], [0.0, 0.6], [-0.5, 0.5]])
def test_an_episode_ends_when_the_robot_lags_behind_its_commands(command: list[float]) -> None:
    """The distance behind, fading, summed up here by itself from the speeds that the measures tell."""
    most, memory_s, step_s = 0.15, 0.7, 0.025
    fixed = {"forward_m_s": [command[0]] * 2, "lateral_m_s": [command[1]] * 2, "stand_probability": 0.0}
    bounds = {"min_height_m": 0.0, "max_tilt_deg": 180.0, "max_lag_m": most, "lag_memory_s": memory_s}
    task, _ = _make(termination=bounds, command=fixed | {"start_moving": 0.0}, **NOMINAL_ROBOT)
    envs, rng = CpuEnvs(task, 1, 1000), np.random.default_rng(0)
    state, lag = envs.reset(rng), np.zeros(2)
    speeds = [task.measures.index(name) for name in ("forward_speed", "lateral_speed")]
    steps = 0
    while np.hypot(*lag) <= most:
        state, result = envs.step(state, np.zeros((1, 10)), rng)
        steps += 1
        lag = lag * np.exp(-step_s / memory_s) + (np.array(command) - result.measures[0, speeds]) * step_s
        assert bool(result.terminated[0]) == (np.hypot(*lag) > most)
    assert 5 < steps < 40


def test_no_bound_on_the_lag_where_a_policy_is_played() -> None:
    config = from_dict({"cassie": {"termination": {"max_lag_m": 0.3, "max_tilt_deg": 40.0}}})
    for physics in ("paper", "training"):
        assert to_play(config, physics, [], "evaluate").settings.termination.max_lag_m == 1e6
        assert to_play(config, physics, [], "evaluate").settings.termination.max_tilt_deg == 40.0


def test_a_push_acts_for_its_time_and_is_then_drawn_again() -> None:
    settings = {"force_n": [50.0, 150.0], "interval_s": [0.5, 1.0], "duration_s": 0.2}
    task, _ = _make(push=settings, termination={"min_height_m": 0.0, "max_tilt_deg": 180.0}, **NOMINAL_ROBOT)
    envs = CpuEnvs(task, 2, 1000)
    assert task.force is not None
    rng = np.random.default_rng(0)
    state, forces = envs.reset(rng), []
    for _ in range(100):
        forces.append(task.force(state.task, np))
        state, _ = envs.step(state, np.zeros((envs.num_envs, 10)), rng)
    forces = np.array(forces)
    assert not forces[..., 2:].any()
    size = np.linalg.norm(forces[..., :2], axis=-1)
    assert ((size == 0) | ((size >= 50) & (size <= 150))).all()
    acting = np.pad(size[:, 0] > 0, (1, 0))
    begins, ends = np.flatnonzero(np.diff(acting.astype(int)) == 1), np.flatnonzero(np.diff(acting.astype(int)) == -1)
    assert len(ends) >= 2
    assert all(end - begin == 8 for begin, end in zip(begins, ends, strict=False))  # 0.2 s of 25 ms
    assert 20 <= begins[0] <= 40
    assert len(set(size[begins, 0])) == len(begins)


def test_a_push_changes_the_momentum_by_force_times_time() -> None:
    """In free fall nothing else acts along x and y; masses in kg, speeds of the centre of mass in m/s."""
    task, _ = _make(push={"force_n": [100.0, 100.0], "interval_s": [0.0, 0.0], "duration_s": 10.0}, **NOMINAL_ROBOT)
    envs, rng = CpuEnvs(task, 1, 1000), np.random.default_rng(0)
    state = envs.reset(rng)
    physics = state.physics.copy()
    physics[:, 3] += 1.5
    state = state._replace(physics=physics)
    state, _ = envs.step(state, np.zeros((1, 10)), rng)
    data = mujoco.MjData(task.model)
    mujoco.mj_setState(task.model, data, state.physics[0], mujoco.mjtState.mjSTATE_FULLPHYSICS)
    mujoco.mj_forward(task.model, data)
    mujoco.mj_subtreeVel(task.model, data)
    momentum = data.subtree_linvel[0, :2] * task.model.body_subtreemass[0]
    np.testing.assert_allclose(np.linalg.norm(momentum), 100.0 * task.env_step_s, rtol=0.02)


def _mirror_physics(task: Task, physics: np.ndarray) -> np.ndarray:
    """The mirror image of (time, qpos, qvel), by joint name."""
    model, mirrored = task.model, physics.copy()
    qpos, qvel = physics[1 : 1 + model.nq], physics[1 + model.nq :]
    new_qpos, new_qvel = mirrored[1 : 1 + model.nq], mirrored[1 + model.nq :]
    new_qpos[:7] = qpos[:7] * [1, -1, 1, 1, -1, 1, -1]
    new_qvel[:6] = qvel[:6] * [1, -1, 1, -1, 1, -1]
    for joint in range(model.njnt):
        side, _, kind = model.joint(joint).name.partition("-")
        if side not in ("left", "right"):
            continue
        other = model.joint(f"{'right' if side == 'left' else 'left'}-{kind}")
        to, speed_to = model.jnt_qposadr[joint], model.jnt_dofadr[joint]
        at, speed_at = other.qposadr[0], other.dofadr[0]
        if kind == "achilles-rod":  # a ball joint in a frame whose z axis points sideways
            new_qpos[to : to + 4] = qpos[at : at + 4] * [1, -1, -1, 1]
            new_qvel[speed_to : speed_to + 3] = qvel[speed_at : speed_at + 3] * [-1, -1, 1]
        else:
            sign = -1 if kind in ("hip-roll", "hip-yaw") else 1
            new_qpos[to], new_qvel[speed_to] = sign * qpos[at], sign * qvel[speed_at]
    return mirrored


def _mirror_task_state(task: Task, state: cassie.CassieState) -> cassie.CassieState:
    motors, passive = state.encoder_offset[:, :10], state.encoder_offset[:, 10:]
    encoder = np.concatenate([task.mirror.action(motors), passive[:, [3, 4, 5, 0, 1, 2]]], axis=1)
    return state._replace(
        phase=np.mod(state.phase + 0.5, 1.0),
        command=state.command * [1, -1, -1, 1][: state.command.shape[1]],
        path=state.path * [1, -1],
        target_heading=-state.target_heading,
        encoder_offset=encoder,
        action=task.mirror.action(state.action),
        torque=task.mirror.action(state.torque),
    )


@pytest.mark.parametrize("frame", ["world", "heading"])
@pytest.mark.parametrize("seed", range(3))
def test_the_mirror_image_of_a_step_is_the_step_of_the_mirror_image(seed: int, frame: str) -> None:
    command = {"resample_s": [0, 0]} | (HEADING if frame == "heading" else {})
    task, envs, state, action = _moving_state(16, seed, command=command, **NOMINAL_ROBOT)
    offset = np.random.default_rng(seed).uniform(-0.01, 0.01, (1, 16))
    state = state._replace(task=state.task._replace(encoder_offset=offset))
    mirrored = state._replace(
        physics=_mirror_physics(task, state.physics[0])[None], task=_mirror_task_state(task, state.task)
    )
    _, ours = envs.step(state, action, np.random.default_rng(0))
    _, theirs = envs.step(mirrored, task.mirror.action(action), np.random.default_rng(0))
    difference = np.abs(task.mirror.observation(theirs.final_observation) - ours.final_observation)[0]
    # Not exact: the real pelvis has its centre of mass 0.3 mm off the middle plane. A wrong sign or index shows as
    # a difference of the size of the values themselves.
    assert np.delete(difference, [31, 32, 33]).max() < 0.02
    assert difference[31:34].max() < 0.2  # accelerations in contact, m/s^2, of values around 10
    np.testing.assert_allclose(theirs.reward_terms, ours.reward_terms, atol=0.01)
    np.testing.assert_allclose(theirs.reward, ours.reward, atol=0.01)


def test_mirroring_twice_changes_nothing() -> None:
    task, _ = _make(command=HEADING)
    mirror = task.mirror
    observation, action = np.arange(1.0, 53), np.arange(1.0, 11)
    np.testing.assert_array_equal(mirror.observation(mirror.observation(observation)), observation)
    np.testing.assert_array_equal(mirror.action(mirror.action(action)), action)
    np.testing.assert_array_equal(mirror.action(cassie.NEUTRAL_RAD), cassie.NEUTRAL_RAD)


def test_commands_are_drawn_again_when_due() -> None:
    task, _ = _make(command={"resample_s": [2.0, 6.0], "stand_probability": 0.0})
    fresh = task.reset(np.random.default_rng(0).random((2, task.reset_uniforms)), np)
    step_s = fresh.state.env_step_s
    state = fresh.state._replace(command_s=np.array([step_s[0] * 0.5, 3.0]))
    uniforms = np.tile([1.0, 0.0, 0.9, 0.25, 0.0, 0.0, 0.0], (2, 1))
    result = task.step(state, np.zeros((2, 10)), _still_reading(task, fresh.qpos), uniforms, np)
    np.testing.assert_allclose(result.state.command[0], [2.0, -0.1])
    np.testing.assert_allclose(result.state.command_s[0], 3.0)
    np.testing.assert_allclose(result.state.command[1], state.command[1])
    np.testing.assert_allclose(result.state.command_s[1], 3.0 - step_s[1])
    np.testing.assert_allclose(result.observation[:, 48:], result.state.command)  # the policy sees the new command


def test_command_draws() -> None:
    settings = from_dict({}).cassie.command
    uniforms = np.random.default_rng(0).random((2000, 4))
    command, seconds = commands.draw_command(uniforms, settings, 0.9, np)
    standing = (command == 0).all(axis=1)
    assert 0.07 < standing.mean() < 0.13
    low, high = settings.forward_m_s
    assert low <= command[:, 0].min() < low + 0.1
    assert high - 0.1 < command[:, 0].max() < high
    assert np.abs(command[:, 1]).max() <= 0.1
    assert seconds.min() >= 2
    assert seconds.max() < 6
    once = from_dict({"cassie": {"command": {"resample_s": [0, 0]}}}).cassie.command
    assert np.isinf(commands.draw_command(uniforms, once, 0.9, np)[1]).all()  # one command per episode


def test_path_follows_the_commanded_lateral_speed() -> None:
    task, _ = _make(**NOMINAL_ROBOT)
    fresh = task.reset(np.full((1, task.reset_uniforms), 0.5), np)
    state = fresh.state._replace(command=np.array([[0.5, 0.08]]), command_s=np.array([99.0]))
    for _ in range(4):
        state = task.step(state, np.zeros((1, 10)), _still_reading(task, fresh.qpos), np.zeros((1, 7)), np).state
    np.testing.assert_allclose(state.path, [[4 * 0.025 * 0.5, 4 * 0.025 * 0.08]])


@pytest.mark.parametrize(
    ("height", "roll_deg", "pitch_deg", "expected"),
    [
        (0.9, 0, 0, False),
        (0.59, 0, 0, True),
        (3.01, 0, 0, True),
        (0.9, 46, 0, True),
        (0.9, 0, -46, True),
        (0.9, 44, 0, False),
    ],
)
def test_each_cause_of_termination(height: float, roll_deg: float, pitch_deg: float, expected: bool) -> None:
    task, _ = _make(**NOMINAL_ROBOT)
    fresh = task.reset(np.full((1, task.reset_uniforms), 0.5), np)
    qpos = fresh.qpos.copy()
    half = np.deg2rad([roll_deg, pitch_deg]) / 2
    qpos[0, 2:7] = height, np.cos(half.sum()), np.sin(half[0]), np.sin(half[1]), 0
    result = task.step(fresh.state, np.zeros((1, 10)), _still_reading(task, qpos), np.zeros((1, 7)), np)
    assert bool(result.terminated[0]) is expected


def test_yaw_alone_never_terminates_and_is_reported() -> None:
    task, _ = _make(**NOMINAL_ROBOT)
    fresh = task.reset(np.full((1, task.reset_uniforms), 0.5), np)
    qpos = fresh.qpos.copy()
    qpos[0, 3:7] = np.cos(1.0), 0, 0, np.sin(1.0)
    result = task.step(fresh.state, np.zeros((1, 10)), _still_reading(task, qpos), np.zeros((1, 7)), np)
    assert not result.terminated[0]
    assert result.measures[0, task.measures.index("heading")] == pytest.approx(2.0)


def test_measures_for_gait_analysis_are_means_over_the_physics_steps() -> None:
    task, envs, state, action = _moving_state(steps=16, **NOMINAL_ROBOT)
    model, data = task.model, mujoco.MjData(task.model)
    mujoco.mj_setState(model, data, state.physics[0], mujoco.mjtState.mjSTATE_FULLPHYSICS)
    data.ctrl[:] = task.control(state.task, action, np)[0]
    forces, powers = [], []
    for _ in range(task.steps_per_env_step):
        mujoco.mj_step(model, data)
        forces.append([data.sensor(f"{side}-foot-force").data[0] for side in ("left", "right")])
        powers.append(np.abs(data.actuator_force * data.actuator_velocity).sum())  # unit gears: of the joints
    _, result = envs.step(state, action, np.random.default_rng(0))
    measures = dict(zip(task.measures, result.measures[0], strict=True))
    assert max(map(max, forces)) > 10  # a foot is on the ground
    np.testing.assert_allclose([measures["left_force"], measures["right_force"]], np.mean(forces, axis=0), rtol=1e-9)
    assert measures["motor_power"] == pytest.approx(np.mean(powers), rel=1e-9)
    assert measures["phase"] == state.task.phase[0]


@pytest.mark.parametrize(("pitch_deg", "on_toe"), [(-20, False), (3, False), (9, True), (30, True)])
def test_a_foot_that_points_down_stands_on_its_toe(pitch_deg: float, on_toe: bool) -> None:
    """MuJoCo's own frame of the foot, of a robot that is tipped over as a whole."""
    task, constants = _make(**NOMINAL_ROBOT)
    model, data = task.model, mujoco.MjData(task.model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_forward(model, data)
    ends = [data.geom(f"{side}-foot").xmat.reshape(3, 3)[:, 2] for side in ("left", "right")]
    flat = np.rad2deg([np.arcsin(-end[2] * np.sign(end[0])) for end in ends])  # how far each points down
    half = np.deg2rad(pitch_deg - flat.mean()) / 2
    assert abs(flat[0] - flat[1]) < 0.1 and abs(flat.mean()) < 2
    data.qpos[3:7] = np.cos(half), 0, np.sin(half), 0
    mujoco.mj_forward(model, data)
    reading = _still_reading(task, data.qpos[None].copy())
    reading.sensordata[:] = data.sensordata
    reading.sensordata[0, constants.ids.foot_force] = 50.0, 90.0
    fresh = task.reset(np.full((1, task.reset_uniforms), 0.5), np)
    result = task.step(fresh.state, np.zeros((1, 10)), reading, np.zeros((1, task.step_uniforms)), np)
    first = task.measures.index("left_toe_force")
    np.testing.assert_allclose(result.measures[0, first : first + 2], [50.0, 90.0] if on_toe else 0)


def test_the_clock_advances_by_one_environment_step() -> None:
    task, _ = _make()
    fresh = task.reset(np.full((1, task.reset_uniforms), 0.5), np)
    state = fresh.state._replace(phase=np.array([0.99]), command=np.array([[0.0, 0.0]]))
    result = task.step(state, np.zeros((1, 10)), _still_reading(task, fresh.qpos), np.zeros((1, 7)), np)
    np.testing.assert_allclose(result.state.phase, 0.99 + 0.025 / 0.9 - 1)


def test_control_by_hand() -> None:
    task, _ = _make()
    fresh = task.reset(np.full((2, task.reset_uniforms), 0.5), np)
    offset = np.zeros((2, 16))
    offset[1, :10] = 0.01 * np.arange(10)
    state = fresh.state._replace(encoder_offset=offset)
    action = np.array([[0.5, -0.5, 1.0, -1.0, 1.5, -7.0, 0.0, 0.0, 0.0, 0.0], 10 * [0.0]])
    neutral = [0.0045, 0.0, 0.4973, -1.1997, -1.5968, -0.0045, 0.0, 0.4973, -1.1997, -1.5968]
    expected = np.array([neutral, neutral])
    expected[0] += [0.5, -0.5, 1.0, -1.0, 1.0, -1.0, 0.0, 0.0, 0.0, 0.0]  # 1.5 and -7 are cut off
    expected[1] -= [0.0, 0.01, 0.02, 0.03, 0.04, 0.05, 0.06, 0.07, 0.08, 0.09]
    np.testing.assert_allclose(task.control(state, action, np), expected, atol=1e-12)


def test_an_action_reaches_as_far_as_it_is_set_to() -> None:
    task, _ = _make(action_range_rad=1.4)
    fresh = task.reset(np.full((1, task.reset_uniforms), 0.5), np)
    action = np.array([[0.5, -0.5, 1.0, -1.0, 1.5, 0.0, 0.0, 0.0, 0.0, 0.0]])
    moved = task.control(fresh.state, action, np) - task.control(fresh.state, np.zeros((1, 10)), np)
    np.testing.assert_allclose(moved, [[0.7, -0.7, 1.4, -1.4, 1.4, 0, 0, 0, 0, 0]], atol=1e-12)
    assert [entry.scale for entry in task.action] == [1.4]


def test_the_policy_reads_the_encoder_that_its_targets_are_tracked_with() -> None:
    """A motor that has reached its target is seen where the policy asked it to be, whatever the encoder's offset."""
    task, constants = _make()
    fresh = task.reset(np.random.default_rng(2).random((1, task.reset_uniforms)), np)
    assert np.abs(fresh.state.encoder_offset).min() > 0
    asked = np.linspace(-0.4, 0.5, 10)[None]
    qpos = fresh.qpos.copy()
    qpos[0, constants.ids.motor_qpos] = task.control(fresh.state, asked, np)[0]
    result = task.step(fresh.state, asked, _still_reading(task, qpos), np.zeros((1, task.step_uniforms)), np)
    np.testing.assert_allclose(result.observation[0, 5:15], cassie.NEUTRAL_RAD + asked[0], atol=1e-12)


def test_changes_of_action_and_torque_count_from_the_step_before() -> None:
    task, constants = _make(**NOMINAL_ROBOT)
    fresh = task.reset(np.full((1, task.reset_uniforms), 0.5), np)
    changes = [task.reward_terms.index(name) for name in ("torque_change", "action_change")]
    state, terms = fresh.state, []
    for torque, action in ((4.0, 0.1), (-2.0, 0.3), (-2.0, 1.5)):  # N m, the same for all motors
        reading = _still_reading(task, fresh.qpos)
        reading.sensordata[0, constants.ids.torque] = torque
        result = task.step(state, np.full((1, 10), action), reading, np.zeros((1, task.step_uniforms)), np)
        state = result.state
        terms.append(result.reward_terms[0, changes])
    # 2 * 0.025 * e^(-0.25 |change of torque|) and 2 * 0.025 * e^(-5 |change of action|); both begin at 0.
    np.testing.assert_allclose(terms, 0.05 * np.exp([[-1.0, -0.5], [-1.5, -1.0], [0.0, -6.0]]))


def test_a_step_is_judged_by_the_command_that_was_held_in_it() -> None:
    task, _ = _make(command={"resample_s": [2.0, 6.0], "stand_probability": 0.0}, **NOMINAL_ROBOT)
    fresh = task.reset(np.full((1, task.reset_uniforms), 0.5), np)
    held = fresh.state._replace(command=np.array([[0.6, 0.05]]), command_s=np.zeros(1), phase=np.array([0.2]))
    uniforms = np.array([[1.0, 0.0, 0.9, 0.25, 0.0, 0.0, 0.0]])  # draws 2 m/s ahead, 0.1 m/s to the right
    result = task.step(held, np.zeros((1, 10)), _still_reading(task, fresh.qpos), uniforms, np)
    np.testing.assert_allclose(result.state.command, [[2.0, -0.1]])
    np.testing.assert_allclose(result.state.phase, 0.2 + 0.025 / (0.9 - 0.25 / 3 * 0.6))
    np.testing.assert_allclose(result.state.path, [[0.025 * 0.6, 0.025 * 0.05]])
    speed_error = 0.6 + 0.05  # of a robot that stands
    velocity = task.reward_terms.index("velocity")
    np.testing.assert_allclose(result.reward_terms[0, velocity], 2 * 0.15 * np.exp(-speed_error))
    measures = dict(zip(task.measures, result.measures[0], strict=True))
    assert (measures["forward_command"], measures["lateral_command"]) == (0.6, 0.05)


def test_times_and_distances_follow_the_episode_s_own_step_and_the_clock_does_not() -> None:
    """A randomised physics rate changes how long an environment step lasts."""
    task, _ = _make(push={"force_n": [50.0, 50.0]})
    fresh = task.reset(np.full((2, task.reset_uniforms), 0.5), np)
    step_s = np.array([0.02, 0.04])
    state = fresh.state._replace(
        env_step_s=step_s,
        command=np.array([[1.0, -0.1], [1.0, -0.1]]),
        command_s=np.array([3.0, 3.0]),
        push_s=np.array([2.0, 2.0]),
        phase=np.array([0.5, 0.5]),
    )
    for _ in range(2):
        reading = _still_reading(task, fresh.qpos)
        state = task.step(state, np.zeros((2, 10)), reading, np.zeros((2, task.step_uniforms)), np).state
    np.testing.assert_allclose(state.path, [[0.04, -0.004], [0.08, -0.008]])
    np.testing.assert_allclose(state.command_s, [2.96, 2.92])
    np.testing.assert_allclose(state.push_s, [1.96, 1.92])
    np.testing.assert_allclose(state.phase, 0.5 + 2 * 0.025 / (0.9 - 0.25 / 3))


@pytest.mark.parametrize("command", [{}, HEADING])
def test_numpy_equals_jax(command: dict) -> None:
    task, envs, state, action = _moving_state(command=command)
    _, reading, _ = envs._simulate(state, envs._control(state, action))
    rng = np.random.default_rng(5)
    reset_uniforms, uniforms = rng.random((1, task.reset_uniforms)), rng.random((1, task.step_uniforms))
    ours = task.reset(reset_uniforms, np), task.step(state.task, action, reading, uniforms, np)
    arguments = jax.tree.map(jnp.asarray, (state.task, action, reading, uniforms))
    theirs = jax.jit(lambda u: task.reset(u, jnp))(reset_uniforms), jax.jit(lambda *a: task.step(*a, jnp))(*arguments)
    for a, b in zip(jax.tree.leaves(ours), jax.tree.leaves(theirs), strict=True):
        assert a.shape == b.shape
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-4)  # float64 against float32
