"""Environment steps per second of machines that are not here, from what each part costs on this one.

Costs are measured per worker that always has the same n environment steps to do, so everything is linear in the number
of workers W:

    collect  = n step_s                    all workers at once, each on a core of its own
    exchange = fixed_s + W per_worker_s    one process: parameters out, buffers merged, trajectories padded
    update   = W n update_s / devices      the learner

The schedules `overlap` and `decoupled` hide the shorter side: an iteration takes max(collect, exchange + update), and
whatever is longest is the bottleneck. In `sync` it takes the sum.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np


class Costs(NamedTuple):
    """What `bench scaling` measures here."""

    env_steps: int  # n, of each worker and iteration
    cores: int  # of this machine
    step_s: float  # CPU seconds of a worker per environment step while all cores of this machine work
    fixed_s: float  # of an exchange
    per_worker_s: float  # of an exchange
    update_s: float  # of the learner per environment step, on all cores of this machine


class Prediction(NamedTuple):
    """A machine that is not here."""

    cores: int
    devices: int
    workers: int
    env_steps_per_second: float
    bottleneck: str  # collect, exchange or update: what to make faster first


def exchange_line(workers: Sequence[int], seconds: Sequence[float]) -> tuple[float, float]:
    """(fixed_s, per_worker_s) of the line through measured exchanges, by least squares; neither is below zero."""
    if len(set(workers)) == 1:
        return 0.0, max(0.0, float(np.mean(seconds))) / workers[0]
    slope, fixed = np.polyfit(workers, seconds, 1)
    if slope < 0:
        return max(0.0, float(np.mean(seconds))), 0.0
    if fixed < 0:
        return 0.0, float(np.dot(workers, seconds) / np.dot(workers, workers))
    return float(fixed), float(slope)


def predict(costs: Costs, cores: int, devices: int, device_speed: float) -> Prediction:
    """A machine with `cores` like ours and `devices` accelerators, under the schedules that hide the shorter side.

    Args:
      costs: measured here.
      cores: one of them serves the learner's process, the others a worker each.
      devices: accelerators that share the update evenly; what they say to each other is left out.
      device_speed: how many times faster one of them updates than all cores of this machine together; assumed.
    """
    workers = cores - 1
    collect = costs.env_steps * costs.step_s
    exchange = costs.fixed_s + workers * costs.per_worker_s
    update = workers * costs.env_steps * costs.update_s / (devices * device_speed)
    learner = exchange + update
    bottleneck = "collect" if collect >= learner else "exchange" if exchange >= update else "update"
    rate = workers * costs.env_steps / max(collect, learner)
    return Prediction(cores, devices, workers, rate, bottleneck)


def most_workers(costs: Costs, devices: int, device_speed: float) -> float:
    """How many workers keep one learner busy: beyond them collect < exchange + update."""
    per_worker = costs.per_worker_s + costs.env_steps * costs.update_s / (devices * device_speed)
    return max(0.0, costs.env_steps * costs.step_s - costs.fixed_s) / per_worker


def collecting_here(costs: Costs, workers: int, cores: int) -> float:
    """Environment steps per second of collecting alone, exchange included, with `workers` on `cores` like ours."""
    steps = workers * costs.env_steps
    return steps / (steps * costs.step_s / min(workers, cores) + costs.fixed_s + workers * costs.per_worker_s)
