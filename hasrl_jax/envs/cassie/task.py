"""The Cassie walking task: 50 observations (52 in the heading frame), 10 PD targets, the clock reward.

Source: paper section II.A to II.D; constants of the published implementation.
"""

import dataclasses
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np

from hasrl_jax.config.convert import from_dict
from hasrl_jax.config.schema import Config
from hasrl_jax.envs import frames, layout, motors
from hasrl_jax.envs.cassie import clock, commands, gaits, kinematics, other_model, randomize, rewards, terrain, tracking
from hasrl_jax.envs.cassie.ids import MOTOR_SIGNS, MOTORS, PASSIVE_JOINTS, SIDES, CassieIds, cassie_ids
from hasrl_jax.envs.cassie.other_model import Names
from hasrl_jax.envs.cassie.settings import CassieConfig, RandomizeConfig
from hasrl_jax.envs.draws import between
from hasrl_jax.envs.layout import AXIAL, NEGATED, QUATERNION, SAME, VECTOR, Entry
from hasrl_jax.envs.model import load_model
from hasrl_jax.envs.task import Reading, Reset, Task, Transition
from hasrl_jax.errors import ConfigError
from hasrl_jax.types import Array

ASSET = Path(__file__).parent / "cassie.xml"
_PASSIVE_SIGNS = SAME * (2 * len(PASSIVE_JOINTS))
_MOTOR_NAMES = tuple(f"{side}-{name}" for side in SIDES for name in MOTORS)
_PASSIVE_NAMES = tuple(f"{side}-{name}" for side in SIDES for name in PASSIVE_JOINTS)
_AXES = ("x", "y", "z")
_ALONG = "along the axes of the world; in the heading frame along and across the heading to keep"
_IN_PELVIS = "in the frame of the pelvis"
# What the policy sees, followed by the commands. Source: order of the published implementation, paper section II.A.
OBSERVATION = (
    Entry("pelvis_height", "m", SAME, noise=0.02, note="above the ground; of a blind robot above the soles that stand"),
    Entry(
        "pelvis_orientation",
        "",
        QUATERNION,
        noise=0.01,
        parts=("w", *_AXES),
        note="quaternion in the world; in the heading frame relative to the heading to keep, with w >= 0",
    ),
    Entry("motor_positions", "rad", MOTOR_SIGNS, legs=True, noise=0.01, parts=_MOTOR_NAMES),
    Entry("pelvis_velocity", "m/s", VECTOR, noise=0.1, parts=_AXES, note=f"{_ALONG}; of a blind robot an estimate"),
    Entry("pelvis_angular_velocity", "rad/s", AXIAL, noise=0.2, parts=_AXES, note=_IN_PELVIS),
    Entry("motor_velocities", "rad/s", MOTOR_SIGNS, legs=True, noise=0.5, parts=_MOTOR_NAMES),
    Entry(
        "pelvis_acceleration",
        "m/s^2",
        VECTOR,
        noise=1.0,
        parts=_AXES,
        note=f"at the IMU, {_IN_PELVIS}, gravity removed",
    ),
    Entry("passive_positions", "rad", _PASSIVE_SIGNS, legs=True, noise=0.01, parts=_PASSIVE_NAMES),
    Entry("passive_velocities", "rad/s", _PASSIVE_SIGNS, legs=True, noise=0.5, parts=_PASSIVE_NAMES),
    # Half a cycle swaps the feet's clocks.
    Entry("clock", "", 2 * NEGATED, parts=("sin", "cos"), note="of 2 pi times the gait phase; zeros while it rests"),
)
ACTION = (
    Entry("motor_targets", "rad", MOTOR_SIGNS, legs=True, parts=_MOTOR_NAMES, note="relative to the neutral pose"),
)
ACTION_SIZE = layout.size(ACTION)
LIFT_M = 0.2  # an episode on a slope starts higher by what the floor rises over so far, or feet would be in it
# No-load speed of each motor over the ratio of its gear: the joint's speed at which it gives no torque, rad/s.
# Source: `user` and `gear` of the actuators in Oregon State University's cassie.xml (revolutions per minute).
NO_LOAD_SPEED_RAD_S = {
    name: rpm * 2 * np.pi / 60 / ratio
    for name, rpm, ratio in zip(MOTORS, (2900, 2900, 1300, 1300, 5500), (25, 25, 16, 16, 50), strict=True)
}
NUM_ENCODERS = len(MOTOR_SIGNS) + len(_PASSIVE_SIGNS)
# PD targets at zero action: the motor positions of the initial pose, rad. Source: published implementation,
# which has +0.0045 for both hip rolls; the sign here makes the two legs mirror images.
NEUTRAL_RAD = np.array([0.0045, 0.0, 0.4973, -1.1997, -1.5968, -0.0045, 0.0, 0.4973, -1.1997, -1.5968])
GRAVITY_M_S2 = 9.81
HEEL_UP = 0.1  # sine of the angle by which a foot points down: of its 0.16 m the heel is 1.6 cm up
END_SENSORS = ("pelvis-acceleration", "left-foot-velocity", "right-foot-velocity")
MEASURES = (
    *("forward_speed", "lateral_speed"),  # of the pelvis in the command's frame, at the end of the step, m/s
    *("forward_command", "lateral_command"),  # that held during the environment step, m/s
    *("height", "heading"),  # of the pelvis, above the ground, at the end of the environment step, m and rad
    *("left_force", "right_force"),  # ground force on each foot, mean over the physics steps, N
    "motor_power",  # sum of |torque * joint velocity| over the motors, mean over the physics steps, W
    "phase",  # of the gait clock by which the environment step was judged, [0, 1)
    # ground force on a foot whose heel is up, at the end of the environment step, N
    *("left_toe_force", "right_toe_force"),
)
HEADING_MEASURES = (
    "yaw_rate",  # of the pelvis about the vertical at the end of the environment step, rad/s
    *("yaw_rate_command", "height_command"),  # those held during the environment step, rad/s and m
    "heading_error",  # how far the heading is to the left of the one to keep, rad
)


class CassieState(NamedTuple):
    """What the task remembers of an episode; leading axes [...]."""

    phase: Array  # [...] gait phase in [0, 1)
    command: Array  # [..., C] in the order of `commands.COMMANDS`
    command_s: Array  # [...] seconds until the command is drawn again
    path: Array  # [..., 2] a point that moves as commanded, world x and y, m
    lag: Array  # [..., 2] distance by which the robot is behind its commands, along and across; fades with time, m
    target_heading: Array  # [...] the heading to keep, rad; 0 in the world frame
    standing: Array  # [...] bool: the clock rests
    push: Array  # [..., 2] force of the next push, world x and y, N
    push_s: Array  # [...] seconds until that push; it acts while this is not positive
    encoder_offset: Array  # [..., 16] of the motors and the passive joints, rad
    terrain: Array  # [..., 3, 1 + blocks] the ground, as `terrain.draw` returns it; [..., 0, 0] where it is flat
    estimate: Array  # [..., 4] height and velocity of the pelvis as a blind robot has them; [..., 0] of others
    action: Array  # [..., 10] previous action
    torque: Array  # [..., 10] joint torques at the end of the previous environment step, N m
    env_step_s: Array  # [...] duration of an environment step in this episode, s
    is_drawn: Array  # [...] bool: the robot is not the nominal one
    period_scale: Array  # [...] factor on the duration of the coming environment step
    delay_s: Array  # [...] time until new targets reach the motors, s
    velocity_bias: Array  # [..., 2] error of the observed forward and lateral velocity, m/s
    velocity_lag_s: Array  # [...] time constant with which the observed velocity follows, s
    late_velocity: Array  # [..., 3] what has followed so far, of the pelvis in the world, m/s
    yaw_drift: Array  # [...] how fast the observed heading turns away, rad/s
    yaw_error: Array  # [...] how far it has, rad
    slope: Array  # [..., 2] rise of the floor along x and y, m per m
    noise: Array  # [...] factor on the noise of the observations


class Motion(NamedTuple):
    """What an environment step ended with, as the reward, the termination and the measures look at it."""

    up: Array  # [..., 3] the vertical in the frame of the pelvis
    acceleration: Array  # [..., 3] of the pelvis in its frame, gravity removed, m/s^2
    orientation: Array  # [..., 4] of the pelvis in the command's frame
    velocity: Array  # [..., 3] of the pelvis in the command's frame, m/s
    forward: Array  # [...] the first two of these
    lateral: Array  # [...]
    height: Array  # [...] of the pelvis above the ground, m


class Constants(NamedTuple):
    """What the functions below share; none of it changes after `make`."""

    config: CassieConfig
    ids: CassieIds
    legs: kinematics.Legs | None  # of a blind robot
    nominal: randomize.Nominal
    model: mujoco.MjModel  # with the ground as compiled
    start_qpos: np.ndarray  # [35]
    steps_per_env_step: int
    env_step_s: float  # nominal
    library: gaits.Library | None  # of gaits, where there is a reference
    torque_limit: np.ndarray  # [10] of the nominal motors, N m
    reward_weights: np.ndarray  # of `rewards.TERMS`
    compares: bool  # whether any term that compares with a reference counts
    least_upright: float  # cosine of the furthest tilt


def make(config: Config) -> Task:
    """The task with its model compiled and its names resolved."""
    ground = None if config.settings.terrain.kind == "flat" else partial(terrain.build, config.settings.terrain)
    return _make(config, ASSET, ground, Names())


def make_on(config: Config, file: Path, mapping: Mapping[str, Any]) -> Task:
    """The task on another MJCF file of the robot, see `other_model`.

    Args:
      config: what a policy is played under.
      file: the MJCF file.
      mapping: as `other_model.names_from` takes it.

    Raises:
      ConfigError: the file cannot be read or lacks something, or the ground is not level.
    """
    if config.settings.terrain.kind != "flat":
        raise ConfigError(f"cassie.terrain.kind: got {config.settings.terrain.kind}; expected flat with a --model")
    names = other_model.names_from(mapping, ASSET)
    # Its joints may come in another order than those of recorded states.
    config = from_dict({"cassie": {"reference": {"start_share": 0.0}}}, config)
    try:
        return _make(config, file, partial(other_model.adapt, names, file, ASSET), names)
    except ValueError as error:
        if isinstance(error, ConfigError):
            raise
        raise ConfigError(f"--model {file}: not an MJCF file that compiles ({' '.join(str(error).split())})") from None


def _make(config: Config, asset: Path, ground: Callable[[mujoco.MjSpec], None] | None, names: Names) -> Task:
    lags = config.settings.randomize.enabled and max(config.settings.randomize.torque_lag_s) > 0

    def edit(spec: mujoco.MjSpec) -> None:
        if ground:
            ground(spec)
        if lags:
            motors.let_lag(spec)

    model = load_model(asset, config.physics, edit)
    if config.settings.motor.torque_speed_curve:
        speeds = {f"{side}-{name}": speed for side in SIDES for name, speed in NO_LOAD_SPEED_RAD_S.items()}
        model = motors.with_curve(model, speeds)
    if max(config.settings.randomize.floor_slope_deg) > 0:
        # Compiled, a level floor needs no orientation of its own, and C MuJoCo would not look at one.
        model.geom_sameframe[model.geom_bodyid == 0] = mujoco.mjtSameFrame.mjSAMEFRAME_NONE
    nominal = randomize.nominal(model, names.joints, names.bodies)
    ids = cassie_ids(model, names.joints, names.sensors)
    library = gaits.load(config.settings.reference.gaits) if config.settings.reference.gaits else None
    if library and asset == ASSET:  # another file may call its joints otherwise
        gaits.require_robot(library, model)
    constants = Constants(
        config=config.settings,
        ids=ids,
        legs=kinematics.legs(model, ids, names.joints) if config.settings.observe == "blind" else None,
        nominal=nominal,
        model=model,
        start_qpos=model.key("stand").qpos.copy(),
        steps_per_env_step=config.physics.steps_per_env_step,
        env_step_s=config.physics.env_step_s,
        library=library,
        torque_limit=model.actuator_forcerange[:, 1].copy(),
        reward_weights=rewards.weights(config.settings.reward),
        compares=tracking.wanted(config.settings.reference.reward),
        least_upright=float(np.cos(np.deg2rad(config.settings.termination.max_tilt_deg))),
    )
    drawn = commands.num_uniforms(config.settings.command) + commands.PUSH_UNIFORMS
    in_heading = config.settings.command.frame == "heading"
    drawn_at_reset = drawn + 2 + in_heading + NUM_ENCODERS + terrain.num_uniforms(config.settings.terrain)
    drawn_at_reset += randomize.num_uniforms_beyond(config.settings.randomize)
    drawn_at_reset += start_uniforms(config.settings)
    noisy = noise_size(config.settings)
    return Task(
        name="cassie",
        asset=asset,
        ground=ground,
        model=model,
        steps_per_env_step=config.physics.steps_per_env_step,
        observation=observation_entries(config.settings),
        action=action_entries(config.settings),
        reset_uniforms=randomize.num_uniforms(nominal) + drawn_at_reset + noisy,
        step_uniforms=drawn + noisy + has_uneven_periods(config.settings.randomize),
        reward_terms=reward_terms(config.settings),
        measures=MEASURES + (HEADING_MEASURES if in_heading else ()),
        mirror=layout.mirror(observation_entries(config.settings), ACTION),
        reset=partial(reset, constants),
        control=partial(control, constants),
        pace=pace if has_uneven_periods(config.settings.randomize) else None,
        delay=delay if max(config.settings.randomize.control_delay_s) > 0 else None,
        force=partial(force, constants),
        disturbed=config.settings.push.force_n[1] > 0,
        commands=commands.declared(config.settings.command, config.settings.reward.height_m, bounds(constants)),
        with_command=partial(with_command, config.settings),
        with_push=with_push,
        push_s=config.settings.push.duration_s,
        player_constants=player_constants(constants),
        physics_features=partial(physics_features, constants),
        end_sensors=tuple(names.sensors.get(name, name) for name in END_SENSORS),
        step=partial(step, constants),
    )


def observation_entries(config: CassieConfig) -> tuple[Entry, ...]:
    """All that the policy sees, in order."""
    return (*OBSERVATION, *(command.entry for command in commands.COMMANDS[config.command.frame]))


def reward_terms(config: CassieConfig) -> tuple[str, ...]:
    """Names of the weighted terms: those of the paper, and those that compare with a reference where any counts."""
    compared = tracking.TERMS if tracking.wanted(config.reference.reward) else ()
    return (*rewards.TERMS, *(f"reference_{name}" for name in compared))


def start_uniforms(config: CassieConfig) -> int:
    """Uniform numbers that decide whether an episode begins in a gait."""
    return int(config.reference.start_share > 0)


def follows_reference(config: CassieConfig) -> bool:
    """Whether the robot is to move as the reference does, so that only commands of its gaits make sense."""
    return config.reference.residual or tracking.wanted(config.reference.reward)


def bounds(constants: Constants) -> dict[str, tuple[float, float]]:
    """What can be commanded where the gaits there are bound it, by the field of the command's range."""
    return constants.library.bounds if constants.library and follows_reference(constants.config) else {}


def action_entries(config: CassieConfig) -> tuple[Entry, ...]:
    """All that the policy decides, in order."""
    return tuple(entry._replace(scale=config.action_range_rad) for entry in ACTION)


def has_uneven_periods(config: RandomizeConfig) -> bool:
    """Whether environment steps differ in their duration within an episode."""
    return config.enabled and config.policy_period_scale != (1.0, 1.0)


def noise_size(config: CassieConfig) -> int:
    """Uniform numbers that the noise of one observation consumes."""
    noisy = config.randomize.enabled and config.randomize.observation_noise > 0
    return layout.size(observation_entries(config)) if noisy else 0


def player_constants(constants: Constants) -> dict[str, Any]:
    """Constants, besides observations and actions, that a program needs to play a policy; see docs/deploy.md."""
    config = constants.config
    clock_fields = ["cycle_s", "cycle_per_speed_s", "quicken_above_m_s"]
    in_heading = config.command.frame == "heading"
    return {
        "command_frame": config.command.frame,
        "neutral_rad": NEUTRAL_RAD.tolist(),
        "gravity_m_s2": GRAVITY_M_S2,
        "clock": {name: getattr(config.clock, name) for name in clock_fields + ["stand_below_m_s"] * in_heading},
        **({"heading": {"max_heading_error_rad": config.command.max_heading_error_rad}} if in_heading else {}),
        **({"blind": kinematics.player_constants()} if config.observe == "blind" else {}),
        "fall": dataclasses.asdict(config.termination),
        **({"reference": reference_constants(constants)} if config.reference.residual else {}),
    }


def reference_constants(constants: Constants) -> dict[str, Any]:
    """The gaits whose motor positions a residual action is added to."""
    library = constants.library
    assert library is not None
    place = gaits.PLACES["motor_positions"]
    return {
        **{name: getattr(library, name).round(6).tolist() for name in gaits.AXES},
        "motor_curves": library.curves[..., place, :].round(5).tolist(),
        "standing_motors": library.standing[..., place].round(5).tolist(),
        "height_m_where_not_commanded": constants.config.reward.height_m,
    }


def reset(constants: Constants, uniforms: Array, xp: Any) -> Reset:
    """A fresh episode in the initial pose, from uniform numbers [..., reset_uniforms]."""
    config, nominal = constants.config, constants.nominal
    batch = uniforms.shape[:-1]
    in_heading = config.command.frame == "heading"
    drawn = commands.num_uniforms(config.command), commands.PUSH_UNIFORMS
    sizes = [randomize.num_uniforms(nominal), *drawn, 1, 1, int(in_heading), NUM_ENCODERS]
    sizes += [terrain.num_uniforms(config.terrain), randomize.num_uniforms_beyond(config.randomize)]
    sizes.append(start_uniforms(config))
    parts = xp.split(uniforms, np.cumsum(sizes), axis=-1)
    model_u, command_u, push_u, phase_u, start_u, heading_u, encoder_u, terrain_u, more_u, gait_u, noise_u = parts

    fields = randomize.model_fields(model_u, more_u, nominal, config.randomize, xp)
    is_drawn = randomize.is_drawn(model_u, config.randomize)
    hidden = hidden_draws(more_u, is_drawn, config.randomize, xp)
    slope = hidden["slope"]
    timestep = fields["timestep"] if fields else xp.full(batch, nominal.timestep)
    offset = xp.where(is_drawn, config.randomize.encoder_offset_rad, 0.0)
    command, command_s = commands.draw_command(command_u, config.command, config.reward.height_m, xp)
    push, push_s = commands.draw_push(push_u, config.push, xp)
    half = config.command.start_heading_rad
    yaw = between(heading_u[..., 0], (-half, half)) if in_heading else xp.zeros(batch)
    turned = hidden.pop("start_turned")
    qpos = xp.zeros((*batch, len(constants.start_qpos))) + constants.start_qpos
    moving = xp.where(start_u < config.command.start_moving, command, 0.0)
    turn = xp.zeros((*batch, 4))
    if in_heading:
        turn = xp.concatenate([turn[..., :3], moving[..., 2:3]], axis=-1)
    rest = xp.zeros((*batch, len(nominal.dof_damping) - 6))
    qvel, phase = xp.concatenate([moving[..., :2], turn, rest], axis=-1), phase_u[..., 0]
    if config.reference.start_share > 0:
        begins = gait_u[..., 0] < config.reference.start_share
        qpos, qvel, phase = start_in_gait(constants, begins, (qpos, qvel, phase), command, xp)
    if max(config.randomize.floor_slope_deg) > 0:
        lift = LIFT_M * xp.sqrt((slope**2).sum(axis=-1, keepdims=True))
        qpos = xp.concatenate([qpos[..., :2], qpos[..., 2:3] + lift, qpos[..., 3:]], axis=-1)
    if in_heading or config.randomize.start_turned_rad != (0.0, 0.0):
        facing = frames.turned_quaternion(qpos[..., 3:7], yaw + turned, xp)
        qpos = xp.concatenate([qpos[..., :3], facing, qpos[..., 7:]], axis=-1)
    if in_heading:
        qpos = xp.concatenate([frames.turned(qpos[..., :3], yaw, xp), qpos[..., 3:]], axis=-1)
        qvel = xp.concatenate([frames.turned(qvel[..., :3], yaw, xp), qvel[..., 3:]], axis=-1)
    state = CassieState(
        phase=phase,
        command=command,
        command_s=command_s,
        path=xp.zeros((*batch, 2)),
        lag=xp.zeros((*batch, 2)),
        target_heading=yaw,
        standing=is_standing(config, command, qvel[..., :2], xp),
        push=push,
        push_s=push_s,
        encoder_offset=offset[..., None] * (2 * encoder_u - 1),
        terrain=terrain.draw(terrain_u, config.terrain, xp),
        estimate=xp.zeros((*batch, 0)),
        action=xp.zeros((*batch, ACTION_SIZE)),
        torque=xp.zeros((*batch, ACTION_SIZE)),
        env_step_s=timestep * constants.steps_per_env_step,
        is_drawn=is_drawn,
        period_scale=xp.ones(batch),
        late_velocity=qvel[..., :3],
        yaw_error=xp.zeros(batch),
        **hidden,
    )
    if constants.legs is not None:  # a robot that was blind before the episode, too, knows its velocity
        angle = encoders(constants, state, qpos, xp)
        above = kinematics.height(constants.legs, angle, qpos[..., 3:7], xp)
        state = state._replace(estimate=xp.concatenate([above[..., None], qvel[..., :3]], axis=-1))
    # Nothing accelerates yet, so the first observation needs no physics.
    observation = observe(constants, state, qpos, qvel, xp.zeros((*batch, 3)), noise_u, xp)
    fields |= terrain.model_fields(state.terrain, constants.model, config.terrain, xp)
    return Reset(state, observation, qpos, qvel, fields)


def start_in_gait(
    constants: Constants, begins: Array, start: tuple[Array, Array, Array], command: Array, xp: Any
) -> tuple[Array, Array, Array]:
    """Where an episode `begins` so ([...] bool), a state of the gait nearest to its command; facing along x.

    Args:
      start: otherwise: qpos [..., 35], qvel [..., 32] and phase [...], any in [0, 1).
    """
    library, told = constants.library, gait_command(constants.config, command, xp)
    assert library is not None
    resting = told_to_stand(constants.config, command, xp)
    in_gait = gaits.start(library, told, start[2], resting, xp)
    return tuple(
        xp.where(begins.reshape(begins.shape + (1,) * (other.ndim - begins.ndim)), own, other)
        for own, other in zip(in_gait, start, strict=True)
    )


def gait_command(config: CassieConfig, command: Array, xp: Any) -> tuple[Array, Array, Array]:
    """What tells gaits apart: forward and lateral speed, and height; [..., C] -> [...] each."""
    told = commands.named(command, config.command)
    usual = xp.full_like(told["forward"], config.reward.height_m)
    return told["forward"], told["lateral"], told.get("height", usual)


def reference_motion(constants: Constants, state: CassieState, xp: Any) -> dict[str, Array]:
    """The motion that the environment step which follows `state` should end in, see `gaits.motion`."""
    assert constants.library is not None
    told = gait_command(constants.config, state.command, xp)
    return gaits.motion(constants.library, told, following_phase(constants, state, xp), state.standing, xp)


def following_phase(constants: Constants, state: CassieState, xp: Any) -> Array:
    """The phase at the end of the environment step that follows `state`.

    The clock counts environment steps, as the published one does, not randomised seconds.
    """
    cycle_s = clock.cycle_seconds(layout.numbers(state.command)[0], constants.config.clock, xp)
    phase = (state.phase + constants.env_step_s / cycle_s) % 1.0
    if constants.config.command.frame == "world":  # there the clock never rests
        return phase
    return xp.where(state.standing, state.phase, phase)


def hidden_draws(uniforms: Array, is_drawn: Array, config: RandomizeConfig, xp: Any) -> dict[str, Array]:
    """What an episode draws of delays, measurements and the ground: fields of `CassieState`, and `start_turned`."""
    batch = is_drawn.shape
    scalars = ("delay_s", "velocity_lag_s", "yaw_drift", "start_turned", "noise")
    nothing = dict.fromkeys(scalars, xp.zeros(batch)) | dict.fromkeys(("velocity_bias", "slope"), xp.zeros((*batch, 2)))
    if not uniforms.shape[-1]:
        return nothing
    draws = randomize.beyond(uniforms, config, xp)
    drawn = {
        "delay_s": draws["control_delay_s"][..., 0],
        "velocity_bias": draws["velocity_bias_m_s"],
        "velocity_lag_s": draws["velocity_lag_s"][..., 0],
        "yaw_drift": draws["yaw_drift_rad_s"][..., 0],
        "start_turned": draws["start_turned_rad"][..., 0],
        "slope": draws["floor_slope"],
        "noise": xp.full(batch, config.observation_noise),
    }
    return {
        name: xp.where(is_drawn.reshape(batch + (1,) * (values.ndim - len(batch))), values, nothing[name])
        for name, values in drawn.items()
    }


def delay(state: CassieState, xp: Any) -> tuple[Array, Array]:
    """The action of the environment step before, [..., 10], and how long it still acts, s."""
    return state.action, state.delay_s


def control(constants: Constants, state: CassieState, action: Array, xp: Any) -> Array:
    """PD targets in rad, [..., 10]. The encoder offset enters because the PD loop reads the same encoder.

    A residual action is added to where the motors should be at the end of the environment step.
    Source: Xie et al. 2018.
    """
    about: Array = NEUTRAL_RAD
    if constants.config.reference.residual:
        about = reference_motion(constants, state, xp)["motor_positions"]
    targets = constants.config.action_range_rad * xp.minimum(xp.maximum(action, -1.0), 1.0) + about
    return targets - state.encoder_offset[..., :ACTION_SIZE]


def pace(state: CassieState, xp: Any) -> Array:
    """Factor on the physics step of the coming environment step, [...]."""
    return state.period_scale


def force(constants: Constants, state: CassieState, xp: Any) -> Array:
    """The push that acts now as a generalised force, [..., nv]: the first two entries move the pelvis along x and y."""
    acting = xp.where((state.push_s <= 0)[..., None], state.push, 0.0)
    rest = xp.zeros((*state.push_s.shape, len(constants.nominal.dof_damping) - 2))
    return xp.concatenate([acting, rest], axis=-1)


def physics_features(constants: Constants, sensordata: Array, xp: Any) -> Array:
    """What is averaged over physics steps: ground force (N) and orientation of each foot, motor power.

    The orientation is the error of each foot, [..., 5] altogether, or in the heading frame `rewards.turn_products` of
    each, [..., 9].
    The power, sum |torque * joint velocity| in W, is for the measures: read at the end of an environment step, when the
    PD loop has calmed down, it would be up to a fifth too low.
    """
    ids = constants.ids
    quat = sensordata[..., ids.foot_orientation]
    if constants.config.command.frame == "world":
        error = rewards.quaternion_error(quat, rewards.NEUTRAL_FOOT_QUAT, xp)
    else:
        error = rewards.turn_products(quat, rewards.NEUTRAL_FOOT_QUAT, xp).reshape((*quat.shape[:-2], 6))
    power = layout.summed(abs(sensordata[..., ids.torque] * sensordata[..., ids.motor_speed]), xp)
    return xp.concatenate([sensordata[..., ids.foot_force], error, power[..., None]], axis=-1)


def step(
    constants: Constants, state: CassieState, action: Array, reading: Reading, uniforms: Array, xp: Any
) -> Transition:
    """Reward, termination and next observation of the environment step that `reading` ends."""
    config, ids = constants.config, constants.ids
    told = commands.named(state.command, config.command)
    state = follow(constants, state, reading.qpos, xp)
    motion = motion_of(constants, state, reading, xp)
    errors = reward_errors(constants, state, told, action, reading, motion, xp)
    terms = rewards.weighted_terms(errors, constants.reward_weights, xp)
    compared = None
    if constants.compares:
        seen = seen_by_tracking(constants, state, action, reading, motion, xp)
        compared = tracking.weighted_terms(tracking.errors(seen, xp), config.reference.reward, xp)
        terms = xp.concatenate([terms, compared], axis=-1)

    limits = config.termination
    state = sense(constants, state, reading, motion.acceleration, xp)
    terminated = (motion.height < limits.min_height_m) | (motion.height > limits.max_height_m)
    terminated = terminated | (layout.numbers(motion.up)[2] < constants.least_upright)
    if compared is not None and config.reference.min_reward > 0:
        terminated = terminated | (compared.sum(axis=-1) < config.reference.min_reward)
    along, across = next_lag(state, told, motion, limits.lag_memory_s, xp)
    terminated = terminated | (along * along + across * across > limits.max_lag_m**2)
    yaw = frames.heading(reading.qpos[..., 3:7], xp)
    measured = [motion.forward, motion.lateral, told["forward"], told["lateral"], motion.height, yaw]
    left_force, right_force, *_, power = layout.numbers(reading.averages)
    measured += [left_force, right_force, power, state.phase]
    measured += layout.numbers(toe_force(constants, reading.sensordata, xp))
    if config.command.frame == "heading":
        yaw_rate = layout.total(motion.up * reading.qvel[..., 3:6])
        error = frames.wrapped(yaw - state.target_heading, xp)
        measured += [yaw_rate, told["yaw_rate"], told["height"], error]
    measures = layout.columns(measured, xp)

    drawn, elapsed_s = commands.num_uniforms(config.command), duration_s(state)
    command_u, push_u = uniforms[..., :drawn], uniforms[..., drawn : drawn + commands.PUSH_UNIFORMS]
    noise_u = uniforms[..., drawn + commands.PUSH_UNIFORMS :][..., : noise_size(config)]
    push, push_s = commands.next_push(state.push, state.push_s, elapsed_s, push_u, config.push, xp)
    command, command_s = commands.next_command(
        state.command, state.command_s, elapsed_s, command_u, config.command, config.reward.height_m, xp
    )
    late_velocity, yaw_error = estimate(constants, state, reading.qvel, xp)
    if has_uneven_periods(config.randomize):
        scale = between(uniforms[..., -1], config.randomize.policy_period_scale)
        state = state._replace(period_scale=xp.where(state.is_drawn, scale, 1.0))
    state = state._replace(
        phase=following_phase(constants, state, xp),
        standing=is_standing(config, command, seen_velocity(constants, state, reading.qvel, xp), xp),
        lag=layout.columns([along, across], xp),
        command=command,
        command_s=command_s,
        push=push,
        push_s=push_s,
        late_velocity=late_velocity,
        yaw_error=yaw_error,
        action=action,
        torque=reading.sensordata[..., ids.torque],
    )
    observation = observe(constants, state, reading.qpos, reading.qvel, motion.acceleration, noise_u, xp)
    return Transition(state, observation, layout.summed(terms, xp), terminated, terms, measures)


def observe(
    constants: Constants, state: CassieState, qpos: Array, qvel: Array, acceleration: Array, noise_u: Array, xp: Any
) -> Array:
    """The inputs of the policy, [..., O], as `observation_entries` lists them; `noise_u`: [..., noise_size]."""
    config = constants.config
    seen, orientation = state.late_velocity, qpos[..., 3:7]
    if config.randomize.enabled and config.randomize.yaw_drift_rad_s > 0:
        seen = frames.turned(seen, state.yaw_error, xp)
        orientation = frames.turned_quaternion(orientation, state.yaw_error, xp)
    velocity = seen_velocity(constants, state, seen, xp)
    biased = velocity[..., :2] + state.velocity_bias
    if constants.legs is None:
        x, _, height = layout.numbers(qpos[..., :3])
        height = height - terrain.height_at(x, state.terrain, xp)
        height = (height - slope_height(config, state, qpos, xp))[..., None]
    else:
        height = state.estimate[..., :1]
    angle, speed = encoders(constants, state, qpos, xp), encoder_speeds(constants, qvel)
    values = {
        "pelvis_height": height,
        "pelvis_orientation": pelvis_orientation(constants, state, orientation, xp),
        "motor_positions": angle[..., :ACTION_SIZE],
        "pelvis_velocity": xp.concatenate([biased, velocity[..., 2:]], axis=-1),
        "pelvis_angular_velocity": qvel[..., 3:6],
        "motor_velocities": speed[..., :ACTION_SIZE],
        "pelvis_acceleration": acceleration,
        "passive_positions": angle[..., ACTION_SIZE:],
        "passive_velocities": speed[..., ACTION_SIZE:],
        "clock": clock_signal(config, state, xp),
    }
    observation = xp.concatenate([*(values[entry.name] for entry in OBSERVATION), state.command], axis=-1)
    if not noise_u.shape[-1]:
        return observation
    width = layout.noise(observation_entries(config))
    return observation + state.noise[..., None] * width * (2 * noise_u - 1)


def toe_force(constants: Constants, sensordata: Array, xp: Any) -> Array:
    """Ground force on each foot while it points down and so stands on its toe, else 0, N, [..., 2]."""
    ids = constants.ids
    up = frames.up_in_body_frame(sensordata[..., ids.foot_orientation], xp)
    return xp.where(layout.total(up * rewards.TOE_AXIS) < -HEEL_UP, sensordata[..., ids.foot_force], 0.0)


def with_command(
    config: CassieConfig, state: CassieState, observation: Array, command: Array, xp: Any
) -> tuple[CassieState, Array]:
    """`state` and `observation` [..., O] under `command` [..., C] until the end of the episode."""
    places = layout.places(OBSERVATION)
    standing = is_standing(config, command, observation[..., places["pelvis_velocity"]], xp)
    state = state._replace(command=command, command_s=xp.full_like(state.command_s, xp.inf), standing=standing)
    unchanged = observation[..., : places["clock"].start]
    return state, xp.concatenate([unchanged, clock_signal(config, state, xp), command], axis=-1)


def with_push(state: CassieState, force: Array, xp: Any) -> CassieState:
    """`state` in which a force [..., 2] on the pelvis, along the world's x and y in N, begins to act now."""
    return state._replace(push=force, push_s=xp.zeros_like(state.push_s))


def clock_signal(config: CassieConfig, state: CassieState, xp: Any) -> Array:
    """What the policy sees of the clock, [..., 2]: zeros while it rests."""
    signal = clock.phase_signal(state.phase, xp)
    return signal if config.command.frame == "world" else xp.where(state.standing[..., None], 0.0, signal)


def follow(constants: Constants, state: CassieState, qpos: Array, xp: Any) -> CassieState:
    """`state` with the heading and the path to keep moved on by an environment step, which ended in `qpos`.

    In the heading frame the error of both is bounded: a robot that was turned or pushed away goes on from where it is
    at the commanded speeds, and need not return.
    """
    config, moved = constants.config.command, state.command[..., commands.PLANAR] * duration_s(state)[..., None]
    if config.frame == "world":
        return state._replace(path=state.path + moved)
    told = commands.named(state.command, config)
    target = state.target_heading + told["yaw_rate"] * duration_s(state)
    error, limit = frames.wrapped(target - frames.heading(qpos[..., 3:7], xp), xp), config.max_heading_error_rad
    target = frames.wrapped(target - error + xp.clip(error, -limit, limit), xp)
    drift = frames.turned(state.path + frames.turned(moved, target, xp) - qpos[..., :2], -target, xp)
    drift = xp.stack([xp.zeros_like(target), xp.clip(drift[..., 1], -config.max_drift_m, config.max_drift_m)], axis=-1)
    return state._replace(path=qpos[..., :2] + frames.turned(drift, target, xp), target_heading=target)


def next_lag(
    state: CassieState, told: dict[str, Array], motion: Motion, memory_s: float, xp: Any
) -> tuple[Array, Array]:
    """The distance behind the commands in m, along and across, after an environment step of dt that ended with v.

        lag' = lag e^(-dt / memory) + (command - v) dt

    A steady error of the speed settles at about `memory` times itself, so a robot that sets off is given time.
    """
    step_s = duration_s(state)
    kept, (along, across) = xp.exp(-step_s / memory_s), layout.numbers(state.lag)
    along = along * kept + (told["forward"] - motion.forward) * step_s
    return along, across * kept + (told["lateral"] - motion.lateral) * step_s


def is_standing(config: CassieConfig, command: Array, velocity: Array, xp: Any) -> Array:
    """Whether the clock rests: commanded to stand, and not much faster than that; [..., C], [..., 2 or 3] -> [...]."""
    if config.command.frame == "world":
        return xp.zeros(command.shape[:-1], bool)
    slow = (velocity[..., :2] ** 2).sum(axis=-1) < config.clock.stand_below_m_s**2
    return slow & told_to_stand(config, command, xp)


def told_to_stand(config: CassieConfig, command: Array, xp: Any) -> Array:
    """Whether a command asks for a stand, [..., C] -> [...]; in the world frame the robot steps on the spot instead."""
    if config.command.frame == "world":
        return xp.zeros(command.shape[:-1], bool)
    return (command[..., commands.MOTION] == 0).all(axis=-1)


def duration_s(state: CassieState) -> Array:
    """Of the environment step that is about to begin or has just ended, s, [...]."""
    return state.env_step_s * state.period_scale


def estimate(constants: Constants, state: CassieState, qvel: Array, xp: Any) -> tuple[Array, Array]:
    """What a state estimator would say after an environment step: velocity, [..., 3], and error of the heading, [...].

    The velocity v is followed with the time constant T, as a low-pass filter does: the estimate moves by the share
    1 - exp(-duration / T) of its distance from v.
    """
    settings, late, elapsed = constants.config.randomize, qvel[..., :3], duration_s(state)
    if settings.enabled and max(settings.velocity_lag_s) > 0:
        share = -xp.expm1(-elapsed / xp.maximum(state.velocity_lag_s, 1e-6))
        late = state.late_velocity + share[..., None] * (late - state.late_velocity)
    return late, state.yaw_error + state.yaw_drift * elapsed


def pelvis_orientation(constants: Constants, state: CassieState, quat: Array, xp: Any) -> Array:
    """Quaternion (w, x, y, z) of the pelvis in the world, or relative to the heading to keep, [..., 4]."""
    if constants.config.command.frame == "world":
        return quat
    return frames.turned_quaternion(quat, -state.target_heading, xp)


def pelvis_velocity(constants: Constants, state: CassieState, qvel: Array, xp: Any) -> Array:
    """Linear velocity along the axes of the world, or along the heading to keep, m/s, [..., 3]; `qvel`: [..., 3 or nv].

    Not along the pelvis's own heading: it sways with every step, which at 4 m/s is 0.3 m/s of apparent lateral speed.
    """
    return in_command_frame(constants, state, qvel[..., 0:3], xp)


def in_command_frame(constants: Constants, state: CassieState, velocity: Array, xp: Any) -> Array:
    """A velocity in the world, [..., 3], as the commands count it."""
    if constants.config.command.frame == "world":
        return velocity
    return frames.turned(velocity, -state.target_heading, xp)


def seen_velocity(constants: Constants, state: CassieState, qvel: Array, xp: Any) -> Array:
    """`pelvis_velocity` as the robot has it: estimated by a blind one."""
    if constants.legs is None:
        return pelvis_velocity(constants, state, qvel, xp)
    return in_command_frame(constants, state, state.estimate[..., 1:], xp)


def encoders(constants: Constants, state: CassieState, qpos: Array, xp: Any) -> Array:
    """The angles that the encoders read, rad, [..., 16]."""
    return qpos.take(constants.ids.encoder_qpos, axis=-1, mode="clip") + state.encoder_offset


def encoder_speeds(constants: Constants, qvel: Array) -> Array:
    """How fast they turn, rad/s, [..., 16]."""
    return qvel.take(constants.ids.encoder_qvel, axis=-1, mode="clip")


def sense(constants: Constants, state: CassieState, reading: Reading, acceleration: Array, xp: Any) -> CassieState:
    """`state` with what a blind robot makes of its sensors after an environment step; that of others as it is."""
    if constants.legs is None:
        return state
    qvel = reading.qvel
    above, velocity = kinematics.estimate(
        constants.legs,
        encoders(constants, state, reading.qpos, xp),
        encoder_speeds(constants, qvel),
        qvel[..., 3:6],
        reading.qpos[..., 3:7],
        acceleration,
        state.estimate[..., 1:],
        state.env_step_s,
        xp,
    )
    return state._replace(estimate=xp.concatenate([above[..., None], velocity], axis=-1))


def motion_of(constants: Constants, state: CassieState, reading: Reading, xp: Any) -> Motion:
    """What an environment step ended with; `state` as `follow` returns it."""
    quat = reading.qpos[..., 3:7]
    up = frames.up_in_body_frame(quat, xp)
    velocity = pelvis_velocity(constants, state, reading.qvel, xp)
    forward, lateral = layout.numbers(velocity[..., :2])
    return Motion(
        up=up,
        acceleration=reading.sensordata[..., constants.ids.acceleration] - GRAVITY_M_S2 * up,
        orientation=pelvis_orientation(constants, state, quat, xp),
        velocity=velocity,
        forward=forward,
        lateral=lateral,
        height=height_above_ground(constants, state, reading.qpos, xp),
    )


def reward_errors(
    constants: Constants,
    state: CassieState,
    told: dict[str, Array],
    action: Array,
    reading: Reading,
    motion: Motion,
    xp: Any,
) -> dict[str, Array]:
    """The scores and errors of paper Table I by term name, each [...]."""
    config, ids = constants.config, constants.ids
    settings = config.reward
    speed = told["forward"]
    force_clock = clock.force_clocks(state.phase, clock.swing_fraction(speed, config.clock, xp), xp)
    most_force: Array | float = rewards.MAX_FOOT_FORCE_N
    if config.command.frame == "heading":  # elsewhere the clock never rests
        standing = state.standing[..., None]
        force_clock = xp.where(standing, clock.STAND_FORCE_CLOCK, force_clock)
        most_force = xp.where(standing, rewards.STAND_FOOT_FORCE_N, most_force)
    foot_speed = xp.sqrt(layout.total(reading.sensordata[..., ids.foot_velocity] ** 2))
    w = layout.numbers(motion.orientation)[0]
    pelvis_error = 1.0 - w * w  # `quaternion_error` from the upright pose (1, 0, 0, 0)
    forward_error, lateral_error = abs(motion.forward - speed), abs(motion.lateral - told["lateral"])
    speed_error = forward_error + settings.lateral_velocity_share * lateral_error
    if config.command.frame == "world":
        drift = layout.numbers(reading.qpos[..., :2])[1]
        if settings.follow_lateral_command:
            drift = drift - layout.numbers(state.path)[1]
        foot_error, usual_height = reading.averages[..., 2:4], settings.height_m
    else:
        target = state.target_heading
        drift = frames.turned(reading.qpos[..., :2] - state.path, -target, xp)[..., 1]
        products = reading.averages[..., 2:8].reshape((*target.shape, 2, 3))
        foot_error, usual_height = rewards.turned_quaternion_error(products, target, xp), told["height"]
        off = frames.wrapped(frames.heading(reading.qpos[..., 3:7], xp) - target, xp)
        speed_error = speed_error + settings.heading_share * xp.abs(off)
    torque_change = abs(reading.sensordata[..., ids.torque] - state.torque)
    return {
        "foot_force": rewards.clock_score(force_clock, reading.averages[..., :2], most_force, xp),
        "foot_velocity": rewards.clock_score(-force_clock, foot_speed, rewards.MAX_FOOT_SPEED_M_S, xp),
        "orientation": 10 * pelvis_error + 10 * layout.total(foot_error),
        "pelvis_motion": rewards.pelvis_motion(
            drift, motion.height - usual_height, speed, reading.qvel[..., 3:6], motion.acceleration, settings
        ),
        "velocity": settings.velocity_sharpness * speed_error,
        "hip_roll": layout.total(abs(reading.qvel[..., ids.hip_roll_qvel])),
        "torque_change": 0.25 * (layout.summed(torque_change, xp) / ACTION_SIZE),
        "action_change": 5 * (layout.summed(abs(action - state.action), xp) / ACTION_SIZE),
        "motor_power": layout.numbers(reading.averages)[-1] / settings.motor_power_w,
    }


def seen_by_tracking(
    constants: Constants, state: CassieState, action: Array, reading: Reading, ended: Motion, xp: Any
) -> tracking.Seen:
    """What the terms that compare with a reference look at; `state` as `follow` returns it."""
    config, ids = constants.config, constants.ids
    told = commands.named(state.command, config.command)
    from_path = reading.qpos[..., :2] - state.path
    yaw_rate = xp.zeros_like(told["forward"])
    motion = reference_motion(constants, state, xp)
    if config.command.frame == "heading":
        # The path to keep is always abreast of the robot, so along the heading there is nothing to compare.
        across = frames.turned(from_path, -state.target_heading, xp)[..., 1]
        from_path = layout.columns([motion["pelvis_position"][..., 0], across], xp)
        yaw_rate = told["yaw_rate"]
    force_clock = clock.force_clocks(state.phase, clock.swing_fraction(told["forward"], config.clock, xp), xp)
    return tracking.Seen(
        reference=motion,
        motors=reading.qpos[..., ids.motor_qpos],
        motor_speeds=reading.qvel[..., ids.motor_qvel],
        springs=reading.qpos[..., ids.passive_qpos[[0, 3]]],
        position=xp.concatenate([from_path, ended.height[..., None]], axis=-1),
        orientation=ended.orientation,
        velocity=ended.velocity,
        command=layout.columns([told["forward"], told["lateral"], yaw_rate], xp),
        angular_velocity=reading.qvel[..., 3:6],
        acceleration=ended.acceleration,
        torque_share=reading.sensordata[..., ids.torque] / constants.torque_limit,
        foot_force=reading.averages[..., :2],
        force_clock=xp.where(state.standing[..., None], 0.0, force_clock),  # no foot swings in a stand
        action_change=action - state.action,
        standing=state.standing,
    )


def height_above_ground(constants: Constants, state: CassieState, qpos: Array, xp: Any) -> Array:
    """Height of the pelvis above the ground, m, [...], as the reward and the termination count it."""
    half_length_m = constants.config.terrain.average_m
    x, _, height = layout.numbers(qpos[..., :3])
    height = height - terrain.mean_height(x, half_length_m, state.terrain, xp)
    return height - slope_height(constants.config, state, qpos, xp)


def slope_height(config: CassieConfig, state: CassieState, qpos: Array, xp: Any) -> Array | float:
    """Height of a sloping floor under the pelvis, m, [...]."""
    return layout.total(state.slope * qpos[..., :2]) if max(config.randomize.floor_slope_deg) > 0 else 0.0
