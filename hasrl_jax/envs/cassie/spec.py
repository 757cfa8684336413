"""What there is to know of the walking task before it is made."""

import numpy as np

from hasrl_jax.config.checks import limits_of
from hasrl_jax.config.convert import from_dict
from hasrl_jax.config.files import CONFIG_FOLDER, shipped
from hasrl_jax.config.limits import require
from hasrl_jax.config.schema import Config, PhysicsConfig
from hasrl_jax.config.tasks import TaskSpec
from hasrl_jax.envs.cassie import clock, gaits, tracking
from hasrl_jax.envs.cassie.settings import CassieConfig, TerminationConfig
from hasrl_jax.envs.cassie.task import follows_reference, make, make_on

ROUNDING_S = 1e-6  # of a gait cycle


def check(config: Config) -> None:
    """What must fit together among the settings of the walking task.

    Raises:
      ConfigError: names the field, the value and what would work.
    """
    settings: CassieConfig = config.settings
    fastest = max(abs(speed) for speed in settings.command.forward_m_s)
    above = max(fastest - settings.clock.quicken_above_m_s, 0.0)
    require(
        settings.clock.cycle_s + settings.clock.cycle_per_speed_s * above > 0.1,
        "cassie.clock.cycle_per_speed_s",
        settings.clock.cycle_per_speed_s,
        f"a gait cycle above 0.1 s at {fastest:g} m/s",
    )
    longest = config.physics.env_step_s
    require(
        settings.randomize.control_delay_s[1] <= longest,
        "cassie.randomize.control_delay_s",
        settings.randomize.control_delay_s,
        f"at most a policy period, {longest:g} s",
    )
    _check_reference(config)
    if settings.randomize.enabled:
        require(
            settings.motor.torque_speed_curve or settings.randomize.torque_lag_s[1] == 0,
            "cassie.randomize.torque_lag_s",
            settings.randomize.torque_lag_s,
            "0 0 unless cassie.motor.torque_speed_curve is true",
        )
        timestep_s = config.physics.timestep_s
        low, high = limits_of(PhysicsConfig, "timestep_s")
        shortest = longest = timestep_s
        for name in ("physics_rate_scale", "policy_period_scale"):  # they multiply
            scale = getattr(settings.randomize, name)
            shortest, longest = shortest * scale[0], longest * scale[1]
            require(
                low <= shortest and longest <= high,
                f"cassie.randomize.{name}",
                scale,
                f"physics steps from {low:g} to {high:g} s, where physics.timestep_s is {timestep_s:g}",
            )
        require(
            settings.terrain.kind == "flat" or settings.randomize.floor_slope_deg[1] == 0,
            "cassie.randomize.floor_slope_deg",
            settings.randomize.floor_slope_deg,
            "0 0 unless cassie.terrain.kind is flat",
        )


def played(config: Config) -> Config:
    """`config` in which no episode ends because the robot lags behind its commands."""
    return from_dict({"cassie": {"termination": {"max_lag_m": TerminationConfig().max_lag_m}}}, config)


def _check_reference(config: Config) -> None:
    """Raises the ConfigError of gaits that do not fit what uses them."""
    settings: CassieConfig = config.settings
    reference = settings.reference
    uses = {
        "cassie.reference.start_share": reference.start_share,
        "cassie.reference.residual": reference.residual,
        "cassie.reference.reward": follows_reference(settings) and not reference.residual,
    }
    used = [name for name, value in uses.items() if value]
    require(
        reference.min_reward == 0 or tracking.wanted(reference.reward),
        "cassie.reference.min_reward",
        reference.min_reward,
        "0 where no term of cassie.reference.reward has a weight",
    )
    if not reference.gaits:
        works = f"{', '.join(gaits.PACKAGED)}, or a file of `hasrl gaits`, where {', '.join(used)} needs one"
        require(not used, gaits.FIELD, reference.gaits, works)
        return
    library = gaits.load(reference.gaits)
    rate_hz = 1 / config.physics.env_step_s
    require(
        abs(rate_hz - library.policy_rate_hz) < 1e-6 * rate_hz,
        gaits.FIELD,
        reference.gaits,
        f"gaits of the policy rate that physics gives, {rate_hz:g} Hz; these are of {library.policy_rate_hz:g} Hz",
    )
    fastest = max(abs(speed) for speed in settings.command.forward_m_s)
    speeds = np.array([*(speed for speed in library.forward_m_s if abs(speed) < fastest), fastest])
    ours = clock.cycle_seconds(speeds, settings.clock, np)
    theirs = np.interp(speeds, library.forward_m_s, library.cycle_s)
    worst = np.abs(ours - theirs).argmax()
    field = "cycle_per_speed_s" if settings.clock.cycle_per_speed_s else "cycle_s"
    require(
        bool(abs(ours[worst] - theirs[worst]) < ROUNDING_S),
        f"cassie.clock.{field}",
        getattr(settings.clock, field),
        f"what makes a cycle of {theirs[worst]:g} s at {speeds[worst]:g} m/s, that of the gaits {reference.gaits}",
    )
    require(
        settings.randomize.control_delay_s[1] == 0 or not reference.residual,
        "cassie.randomize.control_delay_s",
        settings.randomize.control_delay_s,
        "(0, 0) with cassie.reference.residual, whose targets move on with the reference",
    )
    if follows_reference(settings):
        usual = settings.reward.height_m, settings.reward.height_m
        in_heading = settings.command.frame == "heading"
        for name, (low, high) in library.bounds.items():
            is_usual = name == "height_m" and not in_heading
            told = usual if is_usual else getattr(settings.command, name)
            field = "cassie.reward.height_m" if is_usual else f"cassie.command.{name}"
            inside = low - 1e-6 <= told[0] and told[1] <= high + 1e-6
            shown = told[0] if is_usual else told
            require(inside, field, shown, f"within {low:g} to {high:g}, where there are gaits in {reference.gaits}")


def undisturbed(config: Config) -> Config:
    """`config` with the nominal robot, from rest, facing x, and no pushes but those that are asked for."""
    command = {"start_moving": 0.0, "start_heading_rad": 0.0}
    still = {"randomize": {"enabled": False}, "push": {"force_n": [0, 0]}, "command": command}
    still["reference"] = {"start_share": 0.0, "min_reward": 0.0}
    return played(from_dict({"cassie": still}, config))


def randomized(config: Config) -> Config:
    """`config` with a robot drawn anew for every episode."""
    return from_dict({"cassie": {"randomize": {"enabled": True, "share": 1.0}}}, config)


def reference_physics() -> PhysicsConfig:
    """2 kHz, as in the paper."""
    return shipped("paper").physics


SPEC = TaskSpec(
    name="cassie",
    make=make,
    make_on=make_on,
    menagerie="agility_cassie",
    recipe=CONFIG_FOLDER / "cassie_walk.yaml",
    settings=CassieConfig,
    check=check,
    reference_physics=reference_physics,
    played=played,
    undisturbed=undisturbed,
    randomized=randomized,
)
