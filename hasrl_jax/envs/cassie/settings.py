"""Settings of the walking task; part of `config.Config`, under `cassie`.

Every field is read somewhere, and its comment gives its meaning and unit.
"""

from dataclasses import dataclass, field
from typing import Annotated, Literal

from hasrl_jax.config.limits import Limits, Range, Share


@dataclass(frozen=True)
class CommandConfig:
    # world: speeds along the axes of the world, facing x, as in the paper; heading: along and across a heading that
    # turns by a commanded yaw rate, with the pelvis height as a command too
    frame: Literal["world", "heading"] = "world"
    forward_m_s: Annotated[Range, Limits(-10, 10)] = (-0.3, 2.0)  # range of the commanded forward speed, m/s
    # range of the commanded lateral speed, m/s (left is positive)
    lateral_m_s: Annotated[Range, Limits(-10, 10)] = (-0.1, 0.1)
    # heading: range of the commanded turning rate, rad/s (left)
    yaw_rate_rad_s: Annotated[Range, Limits(-10, 10)] = (0.0, 0.0)
    # heading: range of the commanded pelvis height above the ground, m
    height_m: Annotated[Range, Limits(0.1, 2)] = (0.9, 0.9)
    stand_probability: Share = 0.1  # share of draws that command zero speed
    straight_probability: Share = 0.0  # heading: share of draws with a forward speed alone
    alone_probability: Share = 0.0  # heading: share of draws that turn, or walk sideways, on the spot
    height_probability: Share = 1.0  # heading: share of draws with a height of their own; the others have the usual one
    turn_m_s2: Annotated[float, Limits(0, 100)] = 2.0  # heading: bound of |forward speed * yaw rate| in a draw, m/s^2
    # heading: between these speeds drawn heights shrink to the usual
    height_fade_m_s: Annotated[Range, Limits(0, 100)] = (1.5, 3.0)
    # heading: half width of the heading that an episode starts with, rad
    start_heading_rad: Annotated[float, Limits(0, 3.1416)] = 0.0
    # heading: the heading to keep waits for a robot that is further off it, rad
    max_heading_error_rad: Annotated[float, Limits(0.01, 3.1416)] = 0.5
    max_drift_m: Annotated[float, Limits(0.01, 1e6)] = 0.5  # heading: as does the path to keep, m
    start_moving: Share = 0.0  # share of episodes that start at the commanded speed instead of at rest
    # seconds between draws; (0, 0) keeps one draw per episode
    resample_s: Annotated[Range, Limits(0, 1e6)] = (2.0, 6.0)


@dataclass(frozen=True)
class ClockConfig:
    cycle_s: Annotated[float, Limits(0.1, 10)] = 0.9  # gait cycle at zero speed, s
    # change of the cycle per m/s of commanded speed above the next, s
    cycle_per_speed_s: Annotated[float, Limits(-10, 10)] = -0.25 / 3
    # commanded speed up to which the cycle stays as it is, m/s
    quicken_above_m_s: Annotated[float, Limits(0, 10)] = 0.0
    swing_fraction: Annotated[float, Limits(0.05, 0.95)] = 0.30  # share of each half cycle that is swing, at zero speed
    swing_fraction_per_speed: Annotated[float, Limits(-10, 10)] = 0.40 / 3  # change of that share per m/s
    max_swing_fraction: Annotated[float, Limits(0.05, 0.95)] = 0.90  # upper bound of that share
    # heading: commanded to stand and slower than this, the clock rests, m/s
    stand_below_m_s: Annotated[float, Limits(0, 10)] = 0.5


@dataclass(frozen=True)
class RewardConfig:
    scale: Annotated[float, Limits(1e-6, 1e6)] = 2.0  # s, multiplies the sum of the weighted terms
    foot_force: Annotated[float, Limits(-1e6, 1e6)] = 0.200  # w1, weight of S_F
    foot_velocity: Annotated[float, Limits(-1e6, 1e6)] = 0.200  # w2, weight of S_V
    orientation: Annotated[float, Limits(-1e6, 1e6)] = 0.200  # w3, weight of exp(-(E_pel + E_foot))
    pelvis_motion: Annotated[float, Limits(-1e6, 1e6)] = 0.150  # w4, weight of exp(-P_m)
    velocity: Annotated[float, Limits(-1e6, 1e6)] = 0.150  # w5, weight of exp(-E_v)
    hip_roll: Annotated[float, Limits(-1e6, 1e6)] = 0.050  # w6, weight of exp(-H_p)
    torque_change: Annotated[float, Limits(-1e6, 1e6)] = 0.025  # w7, weight of exp(-T_p)
    action_change: Annotated[float, Limits(-1e6, 1e6)] = 0.025  # w8, weight of exp(-A_p)
    motor_power: Annotated[float, Limits(-1e6, 1e6)] = 0.0  # weight of exp(-power / motor_power_w) (the paper: none)
    # mechanical power of all motors at which that term has fallen to a third, W
    motor_power_w: Annotated[float, Limits(1, 1e6)] = 300.0
    velocity_sharpness: Annotated[float, Limits(0, 1e3)] = 1.0  # factor inside exp(-factor * E_v), 1/(m/s)
    # weight of the lateral speed error in E_v (the paper: 0)
    lateral_velocity_share: Annotated[float, Limits(0, 1e3)] = 1.0
    heading_share: Annotated[float, Limits(0, 1e3)] = 1.0  # heading: weight of the heading error (rad) in E_v
    # usual pelvis height above the ground, which P_m asks for unless another is commanded, m
    height_m: Annotated[float, Limits(0, 2)] = 0.9
    height_sharpness: Annotated[float, Limits(0, 1e3)] = 1.0  # factor on the height error in P_m
    height_band_m: Annotated[float, Limits(0, 2)] = 0.05  # height error that P_m forgives at zero speed, m
    # and that it forgives besides per m/s of commanded speed, m
    height_band_per_speed: Annotated[float, Limits(0, 2)] = 0.05
    # factor on summed |angular velocity| and |acceleration| of the pelvis in P_m
    shaking: Annotated[float, Limits(0, 1e3)] = 0.25
    follow_lateral_command: bool = True  # P_m counts drift from the commanded path (the paper: from y = 0)


@dataclass(frozen=True)
class MotorConfig:
    torque_speed_curve: bool = False  # fast motors give less torque, see `envs/motors.py` (the paper: no)


@dataclass(frozen=True)
class RandomizeConfig:
    enabled: bool = True  # draw the model anew at each reset
    share: Share = 1.0  # share of episodes with a drawn model; the others have the nominal robot
    damping_scale: Annotated[Range, Limits(0, 100)] = (0.3, 5.0)  # joint damping factor, per leg joint
    mass_scale: Annotated[Range, Limits(0.01, 100)] = (0.5, 1.5)  # mass and inertia factor, per body
    sliding_friction: Annotated[Range, Limits(0, 10)] = (0.4, 1.1)  # one draw for all geoms
    torsional_friction: Annotated[Range, Limits(0, 1)] = (1e-4, 5e-4)  # one draw for all geoms, m
    rolling_friction: Annotated[Range, Limits(0, 1)] = (1e-4, 2e-4)  # one draw for all geoms, m
    encoder_offset_rad: Share = 0.01  # half width of the encoder offset, per joint, constant in an episode, rad
    # factor on the physics step, hence the policy period
    physics_rate_scale: Annotated[Range, Limits(0.05, 10)] = (0.6, 1.2)
    # Beyond the paper; as they stand here they change nothing.
    pd_gain_scale: Annotated[Range, Limits(0, 10)] = (1.0, 1.0)  # factor on both PD gains, per motor
    torque_scale: Annotated[Range, Limits(0.01, 10)] = (1.0, 1.0)  # factor on the torque limit, per motor
    spring_scale: Annotated[Range, Limits(0.01, 10)] = (1.0, 1.0)  # factor on the stiffness, per leaf spring
    payload_kg: Annotated[Range, Limits(-10, 100)] = (0.0, 0.0)  # mass that the pelvis carries, kg
    center_of_mass_m: Share = 0.0  # half width of the shift of the pelvis' center of mass along each axis, m
    # time until new targets reach the motors, one draw per episode, s; a policy period at most
    control_delay_s: Annotated[Range, Limits(0, 1)] = (0.0, 0.0)
    # time constant with which a motor's torque follows, one draw per episode, s; cassie.motor.torque_speed_curve only
    torque_lag_s: Annotated[Range, Limits(0, 0.1)] = (0.0, 0.0)
    # factor on the duration of an environment step, hence on the physics step, drawn anew for every one
    policy_period_scale: Annotated[Range, Limits(0.05, 10)] = (1.0, 1.0)
    # half width of the error of the observed forward and lateral velocity, constant in an episode, m/s
    velocity_bias_m_s: Annotated[float, Limits(0, 10)] = 0.0
    # time constant with which the observed velocity follows the true one, one draw per episode, s
    velocity_lag_s: Annotated[Range, Limits(0, 10)] = (0.0, 0.0)
    # half width of the rate at which the observed heading, and the velocity with it, turns away, rad/s
    yaw_drift_rad_s: Annotated[float, Limits(0, 10)] = 0.0
    # how far to the left of the heading to keep an episode starts, rad
    start_turned_rad: Annotated[Range, Limits(-3.1416, 3.1416)] = (0.0, 0.0)
    # steepness of the floor, rising towards any direction, deg
    floor_slope_deg: Annotated[Range, Limits(0, 30)] = (0.0, 0.0)
    # factor on the noise of each observation, which is drawn anew at every environment step
    observation_noise: Annotated[float, Limits(0, 100)] = 0.0


@dataclass(frozen=True)
class PushConfig:
    # range of the horizontal force on the pelvis, N; (0, 0) never pushes
    force_n: Annotated[Range, Limits(0, 1e5)] = (0.0, 0.0)
    # range of the time from reset, or the last push, to a push, s
    interval_s: Annotated[Range, Limits(0, 1e6)] = (3.0, 8.0)
    duration_s: Annotated[float, Limits(0, 1e3)] = 0.2  # how long a push lasts


@dataclass(frozen=True)
class TerrainConfig:
    # steps: flights of stairs, by turns up and down; rough: blocks of random heights; slopes: of random inclinations
    kind: Literal["flat", "steps", "rough", "slopes"] = "flat"
    # rise of every step of an episode, where it is negative the first flight leads down; rough: height of each block, m
    step_height_m: Annotated[Range, Limits(-0.5, 0.5)] = (-0.1, 0.1)
    # length of a step, block or slope along x, one draw per episode, m
    step_depth_m: Annotated[Range, Limits(0.1, 4)] = (0.3, 0.5)
    step_noise_m: Annotated[float, Limits(0, 0.2)] = 0.0  # steps: half width of the error of each one's height, m
    # steps: number in every flight, one draw per episode
    steps: Annotated[tuple[int, int], Limits(1, 48)] = (8, 8)
    # steps: by how much the last one of a flight is longer than the others, one draw per episode, m
    landing_m: Annotated[Range, Limits(0, 4)] = (0.0, 0.0)
    slope_deg: Annotated[Range, Limits(-45, 45)] = (-10.0, 10.0)  # slopes: inclination of each, degrees
    flat_start_m: Annotated[float, Limits(0.5, 100)] = 1.0  # x at which the level ground of the start ends, m
    approach_m: Annotated[Range, Limits(0, 100)] = (0.0, 0.0)  # by how much further on it ends, a draw per episode, m
    level_share: Share = 0.0  # share of episodes whose ground is level all the same
    # reward and end count heights from the mean ground so far before and behind the pelvis, at 0 from under it, m
    average_m: Annotated[float, Limits(0, 2)] = 0.0


@dataclass(frozen=True)
class TermConfig:
    weight: Annotated[float, Limits(-1e6, 1e6)] = 0.0  # factor on exp(-sharpness * error)
    sharpness: Annotated[float, Limits(0, 1e6)] = 1.0  # factor on the error, see `envs/cassie/tracking.py`


@dataclass(frozen=True)
class TrackingConfig:
    scale: Annotated[float, Limits(1e-6, 1e6)] = 1.0  # multiplies the sum of the terms
    joints: TermConfig = TermConfig(sharpness=30.0)  # of the motor positions, weighted squares, rad^2
    springs: TermConfig = TermConfig(sharpness=1000.0)  # of the leaf springs at the knees, rad^2
    center_of_mass: TermConfig = TermConfig(sharpness=1.0)  # of the pelvis' position, m^2
    attitude: TermConfig = TermConfig(sharpness=10.0)  # of the pelvis' orientation, squared sine of half the angle
    path: TermConfig = TermConfig(sharpness=3.0)  # of the pelvis' horizontal position, m^2
    height: TermConfig = TermConfig(sharpness=10.0)  # of the pelvis, m
    forward_speed: TermConfig = TermConfig(sharpness=5.0)  # from the command, m/s
    lateral_speed: TermConfig = TermConfig(sharpness=5.0)  # from the command, m/s
    turning: TermConfig = TermConfig(sharpness=1.0)  # of the pelvis, from the commanded yaw rate, (rad/s)^2
    torque: TermConfig = TermConfig(sharpness=1.0)  # mean square of the motors' shares of their limits
    swing_force: TermConfig = TermConfig(sharpness=1.0)  # ground force under feet that should swing, in 350 N
    acceleration: TermConfig = TermConfig(sharpness=1.0)  # of the pelvis, square, in units of gravity
    action_change: TermConfig = TermConfig(sharpness=2.0)  # mean of the changes
    still: TermConfig = TermConfig(sharpness=50.0)  # mean square of the motors' speeds while the clock rests, (rad/s)^2


@dataclass(frozen=True)
class ReferenceConfig:
    # the gaits that are used below: none, those of the package ("library", "library_fast"), or a file of `hasrl gaits`
    gaits: str = ""
    # share of episodes that begin in a state of the gait nearest to their command, at any phase
    start_share: Share = 0.0
    residual: bool = False  # actions are added to the motor positions of the reference, not to the neutral pose
    # the episode ends where the terms of `reward` sum to less; 0 never
    min_reward: Annotated[float, Limits(0, 1e6)] = 0.0
    reward: TrackingConfig = field(default_factory=TrackingConfig)


@dataclass(frozen=True)
class TerminationConfig:
    min_height_m: Share = 0.6  # the episode ends when the pelvis is lower above the ground (the paper: 0.4)
    max_height_m: Annotated[float, Limits(1.02, 1e3)] = 3.0  # or higher
    # or when the pelvis tilts further from upright (the paper: no bound, 180)
    max_tilt_deg: Annotated[float, Limits(1, 180)] = 45.0
    # or when it has fallen behind the commanded speeds, or run ahead of them, by more than this; a spur for training,
    # not in force where a policy is played (the paper: no bound), m
    max_lag_m: Annotated[float, Limits(0.01, 1e6)] = 1e6
    lag_memory_s: Annotated[float, Limits(0.1, 1e6)] = 1.0  # time constant in which that distance is forgotten, s


@dataclass(frozen=True)
class CassieConfig:
    # height above the ground and velocity in the observation: state, the true ones; blind, what encoders and IMU give
    observe: Literal["state", "blind"] = "state"
    # furthest PD target from the neutral pose, which an action of 1 asks for, rad (the paper: 1)
    action_range_rad: Annotated[float, Limits(0.1, 3)] = 1.0
    command: CommandConfig = field(default_factory=CommandConfig)
    clock: ClockConfig = field(default_factory=ClockConfig)
    reward: RewardConfig = field(default_factory=RewardConfig)
    motor: MotorConfig = field(default_factory=MotorConfig)
    randomize: RandomizeConfig = field(default_factory=RandomizeConfig)
    push: PushConfig = field(default_factory=PushConfig)
    terrain: TerrainConfig = field(default_factory=TerrainConfig)
    reference: ReferenceConfig = field(default_factory=ReferenceConfig)
    termination: TerminationConfig = field(default_factory=TerminationConfig)
