"""Whether a written file acts as the policy does that it was written from."""

import time
from typing import NamedTuple

import numpy as np

from hasrl_jax.config.schema import Config
from hasrl_jax.deploy.files import Step
from hasrl_jax.envs.cpu_engine import CpuEnvs
from hasrl_jax.envs.task import Task
from hasrl_jax.policy import actor
from hasrl_jax.policy.numpy_networks import Parameters

STEPS = 1000
TOLERANCE = 1e-5  # of an action, whose range is -1 to 1


class Comparison(NamedTuple):
    """What came out of playing a file beside its policy."""

    difference: float  # largest absolute difference of any number of any action
    inference_s: float  # median duration of a step of the file


def compare(config: Config, task: Task, parameters: Parameters, step: Step, steps: int = STEPS) -> Comparison:
    """Plays the policy in one environment and shows `step` the same observations, with an LSTM state of its own.

    Args:
      config: what the policy was trained with.
      task: of `config`.
      parameters: as `learn.ppo.export_parameters` returns them.
      step: the file, as the format's `load` returns it.
      steps: environment steps; episodes that end are followed by others.
    """
    envs, rng = CpuEnvs(task, 1, config.collect.max_episode_steps), np.random.Generator(np.random.Philox(0))
    state, policy = envs.reset(rng), actor.reset(config, task, parameters, 1)
    carry, difference, durations = policy.carry.copy(), 0.0, []
    for _ in range(steps):
        observation = state.observation.astype(np.float32)
        if state.is_first[0]:
            carry = np.zeros_like(carry)
        action, policy = actor.act(policy, observation, state.is_first)
        started = time.perf_counter()
        theirs, carry = step(observation, carry)
        durations.append(time.perf_counter() - started)
        difference = max(difference, float(np.abs(theirs - action).max()))
        state, _ = envs.step(state, action, rng)
    return Comparison(difference, float(np.median(durations)))
