"""The Cassie walking task: 50 observations, 10 PD targets, the clock reward.

Source: paper section II.A to II.D; constants of the published implementation.
"""

from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np

from hasrl_jax.config.schema import Config
from hasrl_jax.envs.cassie import clock, commands, randomize, rewards, terrain
from hasrl_jax.envs.cassie.ids import MOTORS, PASSIVE_JOINTS, CassieIds, cassie_ids
from hasrl_jax.envs.cassie.settings import CassieConfig
from hasrl_jax.envs.model import load_model
from hasrl_jax.envs.task import Reading, Reset, Task, Transition
from hasrl_jax.types import Array, Mirror

ASSET = Path(__file__).parent / "cassie.xml"
OBSERVATION_SIZE = 50
ACTION_SIZE = 10
NUM_ENCODERS = 16  # ten motors, six passive joints
# PD targets at zero action: the motor positions of the initial pose, rad. Source: published implementation,
# which has +0.0045 for both hip rolls; the sign here makes the two legs mirror images.
NEUTRAL_RAD = np.array([0.0045, 0.0, 0.4973, -1.1997, -1.5968, -0.0045, 0.0, 0.4973, -1.1997, -1.5968])
GRAVITY_M_S2 = 9.81
MEASURES = (
    *("forward_speed", "lateral_speed"),  # of the pelvis at the end of the environment step, m/s
    *("forward_command", "lateral_command"),  # that held during the environment step, m/s
    *("height", "heading"),  # of the pelvis, above the ground, at the end of the environment step, m and rad
    *("left_force", "right_force"),  # ground force on each foot, mean over the physics steps, N
    "motor_power",  # sum of |torque * joint velocity| over the motors, mean over the physics steps, W
    "phase",  # of the gait clock by which the environment step was judged, [0, 1)
)


class CassieState(NamedTuple):
    """What the task remembers of an episode; leading axes [...]."""

    phase: Array  # [...] gait phase in [0, 1)
    command: Array  # [..., 2] commanded forward and lateral speed, m/s
    command_s: Array  # [...] seconds until the command is drawn again
    path_y: Array  # [...] where the commanded lateral speed would have led, m
    push: Array  # [..., 2] force of the next push, world x and y, N
    push_s: Array  # [...] seconds until that push; it acts while this is not positive
    encoder_offset: Array  # [..., 16] of the motors and the passive joints, rad
    terrain: Array  # [..., K] uniform numbers that the ground was drawn from; K is 0 where it is flat
    action: Array  # [..., 10] previous action
    torque: Array  # [..., 10] joint torques at the end of the previous environment step, N m
    env_step_s: Array  # [...] duration of an environment step in this episode, s


class Constants(NamedTuple):
    """What the functions below share; none of it changes after `make`."""

    config: CassieConfig
    ids: CassieIds
    nominal: randomize.Nominal
    model: mujoco.MjModel  # with the ground as compiled
    start_qpos: np.ndarray  # [35]
    steps_per_env_step: int
    env_step_s: float  # nominal


def make(config: Config) -> Task:
    """The task with its model compiled and its names resolved."""
    ground = None if config.settings.terrain.kind == "flat" else partial(terrain.build, config.settings.terrain)
    model = load_model(ASSET, config.physics, ground)
    nominal = randomize.nominal(model)
    constants = Constants(
        config=config.settings,
        ids=cassie_ids(model),
        nominal=nominal,
        model=model,
        start_qpos=model.key("stand").qpos.copy(),
        steps_per_env_step=config.physics.steps_per_env_step,
        env_step_s=config.physics.env_step_s,
    )
    drawn = commands.COMMAND_UNIFORMS + commands.PUSH_UNIFORMS
    drawn_at_reset = drawn + 2 + NUM_ENCODERS + terrain.num_uniforms(config.settings.terrain)
    return Task(
        name="cassie",
        asset=ASSET,
        ground=ground,
        model=model,
        steps_per_env_step=config.physics.steps_per_env_step,
        observation_size=OBSERVATION_SIZE,
        action_size=ACTION_SIZE,
        reset_uniforms=randomize.num_uniforms(nominal) + drawn_at_reset,
        step_uniforms=drawn,
        reward_terms=rewards.TERMS,
        measures=MEASURES,
        mirror=mirror(),
        reset=partial(reset, constants),
        control=control,
        force=partial(force, constants) if config.settings.push.force_n[1] > 0 else None,
        physics_features=partial(physics_features, constants),
        step=partial(step, constants),
    )


def reset(constants: Constants, uniforms: Array, xp: Any) -> Reset:
    """A fresh episode in the initial pose, from uniform numbers [..., reset_uniforms]."""
    config, nominal = constants.config, constants.nominal
    batch = uniforms.shape[:-1]
    sizes = randomize.num_uniforms(nominal), commands.COMMAND_UNIFORMS, commands.PUSH_UNIFORMS, 1, 1, NUM_ENCODERS
    model_u, command_u, push_u, phase_u, start_u, encoder_u, terrain_u = xp.split(uniforms, np.cumsum(sizes), axis=-1)

    fields = randomize.model_fields(model_u, nominal, config.randomize, xp)
    timestep = fields["timestep"] if fields else xp.full(batch, nominal.timestep)
    offset = xp.where(randomize.is_drawn(model_u, config.randomize), config.randomize.encoder_offset_rad, 0.0)
    command, command_s = commands.draw_command(command_u, config.command, xp)
    push, push_s = commands.draw_push(push_u, config.push, xp)
    state = CassieState(
        phase=phase_u[..., 0],
        command=command,
        command_s=command_s,
        path_y=xp.zeros(batch),
        push=push,
        push_s=push_s,
        encoder_offset=offset[..., None] * (2 * encoder_u - 1),
        terrain=terrain_u,
        action=xp.zeros((*batch, ACTION_SIZE)),
        torque=xp.zeros((*batch, ACTION_SIZE)),
        env_step_s=timestep * constants.steps_per_env_step,
    )
    qpos = xp.zeros((*batch, len(constants.start_qpos))) + constants.start_qpos
    start_velocity = xp.where(start_u < config.command.start_moving, command, 0.0)
    qvel = xp.concatenate([start_velocity, xp.zeros((*batch, len(nominal.dof_damping) - 2))], axis=-1)
    # Nothing accelerates yet, so the first observation needs no physics.
    observation = observe(constants, state, qpos, qvel, xp.zeros((*batch, 3)), xp)
    fields |= terrain.model_fields(terrain_u, constants.model, config.terrain, xp)
    return Reset(state, observation, qpos, qvel, fields)


def control(state: CassieState, action: Array, xp: Any) -> Array:
    """PD targets in rad, [..., 10]. The encoder offset enters because the PD loop reads the same encoder."""
    return xp.clip(action, -1.0, 1.0) + NEUTRAL_RAD - state.encoder_offset[..., :ACTION_SIZE]


def force(constants: Constants, state: CassieState, xp: Any) -> Array:
    """The push that acts now as a generalised force, [..., nv]: the first two entries move the pelvis along x and y."""
    acting = xp.where((state.push_s <= 0)[..., None], state.push, 0.0)
    rest = xp.zeros((*state.push_s.shape, len(constants.nominal.dof_damping) - 2))
    return xp.concatenate([acting, rest], axis=-1)


def physics_features(constants: Constants, sensordata: Array, xp: Any) -> Array:
    """What is averaged over physics steps, [..., 5]: ground force (N) and orientation error of each foot, motor power.

    The power, sum |torque * joint velocity| in W, is for the measures: read at the end of an environment step, when the
    PD loop has calmed down, it would be up to a fifth too low.
    """
    ids = constants.ids
    error = rewards.quaternion_error(sensordata[..., ids.foot_orientation], rewards.NEUTRAL_FOOT_QUAT)
    power = xp.abs(sensordata[..., ids.torque] * sensordata[..., ids.motor_speed]).sum(axis=-1, keepdims=True)
    return xp.concatenate([sensordata[..., ids.foot_force], error, power], axis=-1)


def step(
    constants: Constants, state: CassieState, action: Array, reading: Reading, uniforms: Array, xp: Any
) -> Transition:
    """Reward, termination and next observation of the environment step that `reading` ends."""
    config, ids = constants.config, constants.ids
    quat = reading.qpos[..., 3:7]
    up = up_in_body_frame(quat, xp)
    acceleration = reading.sensordata[..., ids.acceleration] - GRAVITY_M_S2 * up
    torque = reading.sensordata[..., ids.torque]
    path_y = state.path_y + state.command[..., 1] * state.env_step_s
    errors = reward_errors(constants, state, action, reading, acceleration, path_y, xp)
    terms = rewards.weighted_terms(errors, config.reward, xp)

    height = height_above_ground(constants, state, reading.qpos, xp)
    limits = config.termination
    terminated = (height < limits.min_height_m) | (height > limits.max_height_m)
    terminated = terminated | (up[..., 2] < np.cos(np.deg2rad(limits.max_tilt_deg)))
    posture = xp.stack([height, heading(quat, xp)], axis=-1)
    gait = [reading.averages[..., :2], reading.averages[..., 4:], state.phase[..., None]]
    measures = xp.concatenate([reading.qvel[..., :2], state.command, posture, *gait], axis=-1)

    drawn, drawn_s = commands.draw_command(uniforms, config.command, xp)
    push_u = uniforms[..., commands.COMMAND_UNIFORMS :]
    push, push_s = commands.next_push(state.push, state.push_s, state.env_step_s, push_u, config.push, xp)
    due = state.command_s <= state.env_step_s
    cycle_s = clock.cycle_seconds(state.command[..., 0], config.clock, xp)
    state = state._replace(
        # The clock counts environment steps, as the published one does, not randomised seconds.
        phase=xp.mod(state.phase + constants.env_step_s / cycle_s, 1.0),
        command=xp.where(due[..., None], drawn, state.command),
        command_s=xp.where(due, drawn_s, state.command_s - state.env_step_s),
        path_y=path_y,
        push=push,
        push_s=push_s,
        action=action,
        torque=torque,
    )
    observation = observe(constants, state, reading.qpos, reading.qvel, acceleration, xp)
    return Transition(state, observation, terms.sum(axis=-1), terminated, terms, measures)


def observe(constants: Constants, state: CassieState, qpos: Array, qvel: Array, acceleration: Array, xp: Any) -> Array:
    """The 50 inputs of the policy in the published order, [..., 50]. Source: paper section II.A."""
    ids, offset = constants.ids, state.encoder_offset
    parts = [
        height_above_ground(constants, state, qpos, xp)[..., None],  # of the pelvis, m
        qpos[..., 3:7],  # its orientation (w, x, y, z)
        qpos[..., ids.motor_qpos] + offset[..., :ACTION_SIZE],
        qvel[..., 0:6],  # pelvis linear velocity (world frame), angular velocity (pelvis frame)
        qvel[..., ids.motor_qvel],
        acceleration,  # of the pelvis (pelvis frame), gravity removed
        qpos[..., ids.passive_qpos] + offset[..., ACTION_SIZE:],
        qvel[..., ids.passive_qvel],
        clock.phase_signal(state.phase, xp),
        state.command,
    ]
    return xp.concatenate(parts, axis=-1)


def with_command(state: CassieState, observation: Array, command: Array, xp: Any) -> tuple[CassieState, Array]:
    """`state` and `observation` [..., 50] under `command` [..., 2] (m/s) until the end of the episode."""
    state = state._replace(command=command, command_s=xp.full_like(state.command_s, xp.inf))
    return state, xp.concatenate([observation[..., :-2], command], axis=-1)


def reward_errors(
    constants: Constants,
    state: CassieState,
    action: Array,
    reading: Reading,
    acceleration: Array,
    path_y: Array,
    xp: Any,
) -> dict[str, Array]:
    """The scores and errors of paper Table I by term name, each [...]."""
    config, ids = constants.config, constants.ids
    settings = config.reward
    speed = state.command[..., 0]
    force_clock = clock.force_clocks(state.phase, clock.swing_fraction(speed, config.clock, xp), xp)
    foot_speed = xp.sqrt((reading.sensordata[..., ids.foot_velocity] ** 2).sum(axis=-1))
    height = height_above_ground(constants, state, reading.qpos, xp)
    drift = reading.qpos[..., 1] - (path_y if settings.follow_lateral_command else 0.0)
    pelvis_error = 1.0 - reading.qpos[..., 3] ** 2  # `quaternion_error` from the upright pose (1, 0, 0, 0)
    velocity_error = xp.abs(reading.qvel[..., :2] - state.command)
    torque_change = xp.abs(reading.sensordata[..., ids.torque] - state.torque)
    return {
        "foot_force": rewards.clock_score(force_clock, reading.averages[..., :2], rewards.MAX_FOOT_FORCE_N, xp),
        "foot_velocity": rewards.clock_score(-force_clock, foot_speed, rewards.MAX_FOOT_SPEED_M_S, xp),
        "orientation": 10 * pelvis_error + 10 * reading.averages[..., 2:4].sum(axis=-1),
        "pelvis_motion": rewards.pelvis_motion(
            drift, height, speed, reading.qvel[..., 3:6], acceleration, settings, xp
        ),
        "velocity": settings.velocity_sharpness
        * (velocity_error[..., 0] + settings.lateral_velocity_share * velocity_error[..., 1]),
        "hip_roll": xp.abs(reading.qvel[..., ids.hip_roll_qvel]).sum(axis=-1),
        "torque_change": 0.25 * torque_change.mean(axis=-1),
        "action_change": 5 * xp.abs(action - state.action).mean(axis=-1),
    }


def height_above_ground(constants: Constants, state: CassieState, qpos: Array, xp: Any) -> Array:
    """Height of the pelvis above the ground below it, m, [...]; it jumps where the pelvis passes the edge of a step."""
    return qpos[..., 2] - terrain.height_at(qpos[..., 0], state.terrain, constants.config.terrain, xp)


def up_in_body_frame(quat: Array, xp: Any) -> Array:
    """The world's vertical in the frame that `quat` (w, x, y, z) orients, [..., 4] -> [..., 3]."""
    w, x, y, z = (quat[..., i] for i in range(4))
    return xp.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], axis=-1)


def heading(quat: Array, xp: Any) -> Array:
    """Yaw angle in rad, [..., 4] -> [...]."""
    w, x, y, z = (quat[..., i] for i in range(4))
    return xp.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def mirror() -> Mirror:
    """The left-right mirror image (x-z plane) of observations and actions; half a cycle swaps the feet's clocks."""
    motor_sign = [-1.0 if name in ("hip-roll", "hip-yaw") else 1.0 for name in MOTORS] * 2
    passive_sign = [1.0] * (2 * len(PASSIVE_JOINTS))

    def swap(start: int, per_leg: int) -> list[int]:
        return [*range(start + per_leg, start + 2 * per_leg), *range(start, start + per_leg)]

    motors, passive = len(MOTORS), len(PASSIVE_JOINTS)
    index = [*range(5), *swap(5, motors), *range(15, 21), *swap(21, motors), 31, 32, 33]
    index += [*swap(34, passive), *swap(40, passive), 46, 47, 48, 49]
    vector, axial = [1.0, -1.0, 1.0], [-1.0, 1.0, -1.0]  # how mirroring acts on positions and on rotations
    sign = [1.0, 1.0, *axial, *motor_sign, *vector, *axial, *motor_sign, *vector, *passive_sign, *passive_sign]
    sign += [-1.0, -1.0, 1.0, -1.0]  # clock sin, cos; forward and lateral command
    signs = np.array(sign, np.float32), np.array(motor_sign, np.float32)
    return Mirror(np.array(index), signs[0], np.array(swap(0, motors)), signs[1])
