"""Settings of the walking task; part of `config.Config`, under `cassie`.

Every field is read somewhere, and its comment gives its meaning and unit.
"""

from dataclasses import dataclass, field
from typing import Annotated, Literal

from hasrl_jax.config.limits import Limits, Range, Share


@dataclass(frozen=True)
class CommandConfig:
    forward_m_s: Annotated[Range, Limits(-10, 10)] = (-0.3, 2.0)  # range of the commanded forward speed, m/s
    # range of the commanded lateral speed, m/s (left is positive)
    lateral_m_s: Annotated[Range, Limits(-10, 10)] = (-0.1, 0.1)
    stand_probability: Share = 0.1  # share of draws that command zero speed
    start_moving: Share = 0.0  # share of episodes that start at the commanded speed instead of at rest
    # seconds between draws; (0, 0) keeps one draw per episode
    resample_s: Annotated[Range, Limits(0, 1e6)] = (2.0, 6.0)


@dataclass(frozen=True)
class ClockConfig:
    cycle_s: Annotated[float, Limits(0.1, 10)] = 0.9  # gait cycle at zero speed, s
    # change of the cycle per m/s of commanded speed, s
    cycle_per_speed_s: Annotated[float, Limits(-10, 10)] = -0.25 / 3
    swing_fraction: Annotated[float, Limits(0.05, 0.95)] = 0.30  # share of each half cycle that is swing, at zero speed
    swing_fraction_per_speed: Annotated[float, Limits(-10, 10)] = 0.40 / 3  # change of that share per m/s
    max_swing_fraction: Annotated[float, Limits(0.05, 0.95)] = 0.90  # upper bound of that share


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
    velocity_sharpness: Annotated[float, Limits(0, 1e3)] = 1.0  # factor inside exp(-factor * E_v), 1/(m/s)
    # weight of the lateral speed error in E_v (the paper: 0)
    lateral_velocity_share: Annotated[float, Limits(0, 1e3)] = 1.0
    height_m: Annotated[float, Limits(0, 2)] = 0.9  # pelvis height above the ground that P_m asks for, m
    # factor on summed |angular velocity| and |acceleration| of the pelvis in P_m
    shaking: Annotated[float, Limits(0, 1e3)] = 0.25
    follow_lateral_command: bool = True  # P_m counts drift from the commanded path (the paper: from y = 0)


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


@dataclass(frozen=True)
class PushConfig:
    # range of the horizontal force on the pelvis, N; (0, 0) never pushes
    force_n: Annotated[Range, Limits(0, 1e5)] = (0.0, 0.0)
    # range of the time from reset, or the last push, to a push, s
    interval_s: Annotated[Range, Limits(0, 1e6)] = (3.0, 8.0)
    duration_s: Annotated[float, Limits(0, 1e3)] = 0.2  # how long a push lasts


@dataclass(frozen=True)
class TerrainConfig:
    kind: Literal["flat", "steps", "rough"] = "flat"  # steps: stairs up, then down; rough: blocks of random heights
    # rise of every step of an episode; rough: height of each block, m
    step_height_m: Annotated[Range, Limits(-0.5, 0.5)] = (-0.1, 0.1)
    # length of a step or block along x, one draw per episode, m
    step_depth_m: Annotated[Range, Limits(0.1, 2)] = (0.3, 0.5)
    flat_start_m: Annotated[float, Limits(0.5, 100)] = 1.0  # x at which the level ground of the start ends, m


@dataclass(frozen=True)
class TerminationConfig:
    min_height_m: Share = 0.6  # the episode ends when the pelvis is lower above the ground (the paper: 0.4)
    max_height_m: Annotated[float, Limits(1.02, 1e3)] = 3.0  # or higher
    # or when the pelvis tilts further from upright (the paper: no bound, 180)
    max_tilt_deg: Annotated[float, Limits(1, 180)] = 45.0


@dataclass(frozen=True)
class CassieConfig:
    command: CommandConfig = field(default_factory=CommandConfig)
    clock: ClockConfig = field(default_factory=ClockConfig)
    reward: RewardConfig = field(default_factory=RewardConfig)
    randomize: RandomizeConfig = field(default_factory=RandomizeConfig)
    push: PushConfig = field(default_factory=PushConfig)
    terrain: TerrainConfig = field(default_factory=TerrainConfig)
    termination: TerminationConfig = field(default_factory=TerminationConfig)
