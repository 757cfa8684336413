"""Rejects configurations that cannot work, before anything compiles or starts."""

from typing import Any

from hasrl_jax.cassie_config import CassieConfig
from hasrl_jax.config import Config, ConfigError, shown

# Lowest and highest value of every numeric field, both included; of a range, for both of its ends.
LIMITS: dict[str, tuple[float, float]] = {
    "seed": (0, 2**63 - 1),
    "total_env_steps": (1, 10**15),
    "physics.timestep_s": (1e-5, 0.01),
    "physics.steps_per_env_step": (1, 10_000),
    "physics.solver_iterations": (1, 10_000),
    "physics.line_search_iterations": (1, 10_000),
    "cassie.command.forward_m_s": (-10, 10),
    "cassie.command.lateral_m_s": (-10, 10),
    "cassie.command.yaw_rate_rad_s": (-10, 10),
    "cassie.command.height_m": (0.1, 2),
    "cassie.command.stand_probability": (0, 1),
    "cassie.command.straight_probability": (0, 1),
    "cassie.command.alone_probability": (0, 1),
    "cassie.command.height_probability": (0, 1),
    "cassie.command.turn_m_s2": (0, 100),
    "cassie.command.height_fade_m_s": (0, 100),
    "cassie.command.start_heading_rad": (0, 3.1416),
    "cassie.command.max_heading_error_rad": (0.01, 3.1416),
    "cassie.command.max_drift_m": (0.01, 1e6),
    "cassie.command.start_moving": (0, 1),
    "cassie.command.resample_s": (0, 1e6),
    "cassie.clock.cycle_s": (0.1, 10),
    "cassie.clock.cycle_per_speed_s": (-10, 10),
    "cassie.clock.quicken_above_m_s": (0, 10),
    "cassie.clock.swing_fraction": (0.05, 0.95),
    "cassie.clock.swing_fraction_per_speed": (-10, 10),
    "cassie.clock.max_swing_fraction": (0.05, 0.95),
    "cassie.reward.scale": (1e-6, 1e6),
    "cassie.reward.foot_force": (-1e6, 1e6),
    "cassie.reward.foot_velocity": (-1e6, 1e6),
    "cassie.reward.orientation": (-1e6, 1e6),
    "cassie.reward.pelvis_motion": (-1e6, 1e6),
    "cassie.reward.velocity": (-1e6, 1e6),
    "cassie.reward.hip_roll": (-1e6, 1e6),
    "cassie.reward.torque_change": (-1e6, 1e6),
    "cassie.reward.action_change": (-1e6, 1e6),
    "cassie.reward.velocity_sharpness": (0, 1e3),
    "cassie.reward.lateral_velocity_share": (0, 1e3),
    "cassie.clock.stand_below_m_s": (0, 10),
    "cassie.reward.heading_share": (0, 1e3),
    "cassie.reward.height_m": (0, 2),
    "cassie.reward.height_sharpness": (0, 1e3),
    "cassie.reward.height_band_m": (0, 2),
    "cassie.reward.height_band_per_speed": (0, 2),
    "cassie.reward.shaking": (0, 1e3),
    "cassie.randomize.share": (0, 1),
    "cassie.randomize.damping_scale": (0, 100),
    "cassie.randomize.mass_scale": (0.01, 100),
    "cassie.randomize.sliding_friction": (0, 10),
    "cassie.randomize.torsional_friction": (0, 1),
    "cassie.randomize.rolling_friction": (0, 1),
    "cassie.randomize.encoder_offset_rad": (0, 1),
    "cassie.randomize.physics_rate_scale": (0.05, 10),
    "cassie.push.force_n": (0, 1e5),
    "cassie.push.interval_s": (0, 1e6),
    "cassie.push.duration_s": (0, 1e3),
    "cassie.terrain.step_height_m": (-0.5, 0.5),
    "cassie.terrain.step_depth_m": (0.1, 2),
    "cassie.terrain.flat_start_m": (0.5, 100),  # the feet of the start reach 0.2 m
    "cassie.termination.min_height_m": (0, 1),  # the robot starts at 1.01 m
    "cassie.termination.max_height_m": (1.02, 1e3),
    "cassie.termination.max_tilt_deg": (1, 180),
    "network.hidden_size": (1, 8192),
    "network.initial_log_std": (-10, 3),
    "collect.num_workers": (1, 4096),
    "collect.envs_per_worker": (0, 65536),
    "collect.env_steps_per_iteration": (1, 10**9),
    "collect.unroll_length": (1, 10**6),
    "collect.max_episode_steps": (1, 10**6),
    "collect.worker_start_timeout_s": (1, 86400),
    "collect.worker_timeout_s": (1, 86400),
    "distributed.num_processes": (1, 4096),
    "distributed.process_id": (0, 4095),
    "distributed.start_timeout_s": (1, 86400),
    "mjx.num_envs": (1, 10**6),
    "mjx.contacts_per_env": (1, 10_000),
    "mjx.constraints_per_env": (1, 10_000),
    "ppo.epochs": (1, 1000),
    "ppo.minibatch_trajectories": (1, 10**6),
    "ppo.policy_learning_rate": (1e-12, 1),
    "ppo.value_learning_rate": (1e-12, 1),
    "ppo.adam_epsilon": (1e-16, 1),
    "ppo.max_gradient_norm": (1e-6, 1e9),
    "ppo.clip": (0.001, 0.999),
    "ppo.entropy_coefficient": (0, 1e3),
    "ppo.value_coefficient": (1e-6, 1e6),
    "ppo.discount": (0, 1),
    "ppo.gae_lambda": (0, 1),
    "ppo.max_kl": (0, 1e6),
    "decoupled.max_lag": (0, 10**6),
    "decoupled.replay_ratio": (1, 100),
    "decoupled.max_importance": (1, 1e6),
    "evaluate.every_iterations": (0, 10**9),
    "evaluate.episodes": (1, 10**5),
    "checkpoint.every_iterations": (0, 10**9),
    "checkpoint.keep": (1, 10**6),
}


def check(config: Config) -> None:
    """Rejects values that cannot work.

    Raises:
      ConfigError: names the field, the value seen and what would work.
    """
    for name in LIMITS:
        value: Any = config
        for part in name.split("."):
            value = getattr(value, part)
        check_number(name, name, value)
    _check_cassie(config.cassie)
    if config.backend != "cpu_pool":
        reason = ", where collecting and learning share the devices" if config.backend == "mjx" else ""
        works = f"'sync' or 'overlap' with backend {config.backend}{reason}; decoupled needs cpu_pool"
        _require(config.schedule != "decoupled", "schedule", config.schedule, works)
    _check_machines(config)
    if config.task == "cassie" and config.cassie.randomize.enabled:
        scale, timestep_s = config.cassie.randomize.physics_rate_scale, config.physics.timestep_s
        low, high = LIMITS["physics.timestep_s"]
        _require(
            low <= timestep_s * scale[0] and timestep_s * scale[1] <= high,
            "cassie.randomize.physics_rate_scale",
            scale,
            f"physics steps from {low:g} to {high:g} s, where physics.timestep_s is {timestep_s:g}",
        )


def check_number(name: str, field: str, value: Any) -> None:
    """Rejects a number, or a (low, high) pair of numbers, outside the limits of `field`; the message names `name`."""
    low, high = LIMITS[field]
    ends = value if isinstance(value, tuple) else (value,)
    # Never true of NaN.
    _require(all(low <= end <= high for end in ends), name, value, f"{_number(low)} to {_number(high)}")
    _require(ends[0] <= ends[-1], name, value, "low <= high")


def _check_cassie(cassie: CassieConfig) -> None:
    """What must fit together among the settings of the walking task."""
    fastest = max(abs(speed) for speed in cassie.command.forward_m_s)
    above = max(fastest - cassie.clock.quicken_above_m_s, 0.0)
    _require(
        cassie.clock.cycle_s + cassie.clock.cycle_per_speed_s * above > 0.1,
        "cassie.clock.cycle_per_speed_s",
        cassie.clock.cycle_per_speed_s,
        f"a gait cycle above 0.1 s at {fastest:g} m/s",
    )


def _check_machines(config: Config) -> None:
    """What must fit together when more than one machine takes part."""
    address = config.ray.address
    _require(config.backend == "ray" or not address, "ray.address", address, "--backend=ray")
    _require(
        not address or _is_host_and_port(address), "ray.address", address, "HOST:PORT of a cluster's head, or none"
    )
    distributed, minibatch = config.distributed, config.ppo.minibatch_trajectories
    coordinator, processes, process_id = distributed.coordinator, distributed.num_processes, distributed.process_id
    _require(process_id < processes, "distributed.process_id", process_id, f"0 to {processes - 1}, or more processes")
    if processes == 1:
        _require(not coordinator, "distributed.coordinator", coordinator, "distributed.num_processes above 1")
        return
    there = "HOST:PORT of process 0, the same in all processes"
    _require(_is_host_and_port(coordinator), "distributed.coordinator", coordinator, there)
    shared = f"a multiple of the {processes} processes"
    _require(minibatch % processes == 0, "ppo.minibatch_trajectories", minibatch, shared)
    _require(config.schedule == "sync", "schedule", config.schedule, "sync with several processes")
    _require(config.backend == "cpu_pool", "backend", config.backend, "cpu_pool with several processes")


def _is_host_and_port(address: str) -> bool:
    host, _, port = address.rpartition(":")
    return host != "" and port.isdecimal() and 0 < int(port) < 65536


def _number(value: float) -> str:
    return str(value) if isinstance(value, int) else f"{value:g}"


def _require(condition: bool, name: str, value: Any, expected: str) -> None:
    if not condition:
        raise ConfigError(f"{name}: got {shown(value)}; expected {expected}")
