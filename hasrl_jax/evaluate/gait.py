"""What a walk looks like: contacts, cadence, duty factor, symmetry and cost of transport, from recorded measures.

All functions take arrays [T, N]: environment steps by episodes, NaN after an episode's end.
"""

import numpy as np

from hasrl_jax.envs.cassie.task import GRAVITY_M_S2

CONTACT_N = 30.0  # mean ground force in an environment step above which a foot stands; the robot weighs 327 N
MIN_SWING_S = 0.1  # a foot that scuffs the ground sooner than this after it lifted has not landed
TRAILING_N = 20.0  # force on a toe behind a lifted heel that counts as trailing
MIN_TOUCHDOWNS = 4  # of a foot, before its rhythm is spoken of


def contacts(force: np.ndarray) -> np.ndarray:
    """Whether a foot stands, from its vertical force in N: [T, N] bool; False after an episode's end."""
    return np.nan_to_num(force) > CONTACT_N


def touchdowns(contact: np.ndarray, step_s: float) -> np.ndarray:
    """Where a foot has landed that swung for `MIN_SWING_S` or longer, [T, N] bool."""
    swing = max(1, round(MIN_SWING_S / step_s))
    landed = contact.copy()
    landed[:swing] = False
    for back in range(1, swing + 1):
        landed[swing:] &= ~contact[swing - back : len(contact) - back]
    return landed


def describe(
    left_force: np.ndarray, right_force: np.ndarray, power: np.ndarray, speed: np.ndarray, mass_kg: float, step_s: float
) -> dict[str, np.ndarray]:
    """Gait figures of every episode, each [N]; NaN where an episode has too few steps for it.

    Args:
      left_force: vertical ground force of the left foot, N.
      right_force: of the right one, N.
      power: sum over the motors of |torque x velocity|, W.
      speed: forward, m/s.
      mass_kg: of the robot.
      step_s: duration of an environment step.

    Returns:
      `step_frequency_hz`, landings of both feet per second; `duty_factor`, share of the time a foot stands, mean of
      both; `duty_asymmetry`, the feet's difference in it; `phase_offset`, when the right foot lands in the left one's
      cycle (0.5 is even); `cost_of_transport`, power / (weight x |speed|), without unit.
    """
    valid = np.isfinite(left_force)
    steps = np.maximum(valid.sum(axis=0), 1)
    left, right = contacts(left_force), contacts(right_force)
    landed_left, landed_right = touchdowns(left, step_s), touchdowns(right, step_s)
    enough = np.minimum(landed_left.sum(axis=0), landed_right.sum(axis=0)) >= MIN_TOUCHDOWNS
    rhythm = np.where(enough, 1.0, np.nan)
    duty_left, duty_right = left.sum(axis=0) / steps, right.sum(axis=0) / steps
    mean_power = np.where(valid, power, 0.0).sum(axis=0) / steps
    mean_speed = np.where(valid, speed, 0.0).sum(axis=0) / steps
    with np.errstate(divide="ignore", invalid="ignore"):
        cost = mean_power / (mass_kg * GRAVITY_M_S2 * np.abs(mean_speed))
    return {
        "step_frequency_hz": rhythm * (landed_left | landed_right).sum(axis=0) / (steps * step_s),
        "duty_factor": rhythm * 0.5 * (duty_left + duty_right),
        "duty_asymmetry": rhythm * np.abs(duty_left - duty_right),
        "phase_offset": rhythm * np.array(list(map(phase_offset, landed_left.T, landed_right.T))),
        "cost_of_transport": np.where(np.abs(mean_speed) > 0.1, cost, np.nan),
    }


def trailing(left_toe: np.ndarray, right_toe: np.ndarray, step_s: float, steps_per_s: np.ndarray) -> np.ndarray:
    """How long a foot stays on its toe after its heel has lifted, mean over the steps, s, [N]; NaN without a rhythm.

    Args:
      left_toe: ground force on the left foot while its heel is up, N, [T, N].
      right_toe: of the right one.
      step_s: duration of an environment step.
      steps_per_s: landings of both feet per second, [N].
    """
    seconds = np.maximum(np.isfinite(left_toe).sum(axis=0), 1) * step_s
    on_toe = sum((np.nan_to_num(force) > TRAILING_N).sum(axis=0) * step_s for force in (left_toe, right_toe))
    return on_toe / (seconds * steps_per_s)


def phase_offset(landed_left: np.ndarray, landed_right: np.ndarray) -> float:
    """Mean share of the left foot's cycle at which the right foot lands, from landings [T]; NaN without a cycle."""
    left, right = np.flatnonzero(landed_left), np.flatnonzero(landed_right)
    if len(left) < 2:
        return float("nan")
    right = right[(right >= left[0]) & (right < left[-1])]
    cycle = np.searchsorted(left, right, side="right") - 1
    shares = (right - left[cycle]) / (left[cycle + 1] - left[cycle])
    return float(np.mean(shares)) if len(shares) else float("nan")
