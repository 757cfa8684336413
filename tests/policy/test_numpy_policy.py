"""The workers' forward pass equals the learner's."""

import os
import subprocess
import sys

import jax
import numpy as np
import pytest

from hasrl_jax.collect.plan import make_plan
from hasrl_jax.envs.registry import make_task
from hasrl_jax.learn import distributions, ppo
from hasrl_jax.learn.networks import Policy, make_networks
from hasrl_jax.policy import blas
from hasrl_jax.policy import numpy_networks as numpy_policy


def split(parameters, network):
    return {"params": {name.split("/")[1]: a for name, a in parameters.items() if name.startswith(f"{network}/")}}


@pytest.mark.parametrize("task_name", ["cassie", "cartpole"])
@pytest.mark.parametrize(("symmetric", "memory"), [(False, "lstm"), (True, "lstm"), (True, "none")])
def test_steps_with_resets_equal_the_flax_networks(make_config, make_parameters, task_name, symmetric, memory):
    config = make_config(task_name, symmetric, memory)
    task, plan, parameters = make_task(config), make_plan(config), make_parameters(config)
    policy, value = make_networks(config.network, task.observation_size, task.action_size, task.mirror)
    mirror = task.mirror if symmetric else None
    rng = np.random.default_rng(0)
    envs, steps = 5, 7
    observation = 3 * rng.standard_normal((envs, steps, task.observation_size), np.float32)
    observation[0, 0] = 1e6  # beyond the clip of normalised observations
    is_first = rng.random((envs, steps)) < 0.3
    start = rng.standard_normal((envs, *plan.carry_shape)).astype(np.float32)

    normalizer = parameters["normalizer/mean"], parameters["normalizer/std"]
    sequence = observation, start, is_first
    expected_mean, expected_carry = jax.jit(policy.apply)(split(parameters, "policy"), *sequence, *normalizer)
    expected_value = jax.jit(value.apply)(split(parameters, "value"), observation, *normalizer)
    carry = start
    for t in range(steps):
        inputs = numpy_policy.streams(observation[:, t], parameters, mirror)
        mean, carry = numpy_policy.policy_step(parameters, inputs, carry, is_first[:, t], mirror)
        assert mean.dtype == carry.dtype == np.float32
        np.testing.assert_allclose(mean, expected_mean[:, t], atol=1e-5)
        np.testing.assert_allclose(numpy_policy.value(parameters, inputs), expected_value[:, t], atol=1e-5, rtol=1e-5)
    np.testing.assert_allclose(carry, expected_carry, atol=1e-5)


@pytest.mark.parametrize("symmetric", [False, True])
def test_log_probability_equals_the_learners(make_config, make_parameters, symmetric):
    config = make_config("cassie", symmetric)
    task, parameters = make_task(config), make_parameters(config)
    policy, _ = make_networks(config.network, task.observation_size, task.action_size, task.mirror)
    log_std = numpy_policy.log_std(parameters, task.mirror if symmetric else None)
    np.testing.assert_allclose(log_std, policy.apply(split(parameters, "policy"), method=Policy.log_std), atol=1e-6)
    rng = np.random.default_rng(0)
    noise, mean = rng.standard_normal((2, 6, task.action_size), np.float32)
    action = mean + np.exp(log_std) * noise
    expected = distributions.log_prob(action, mean, log_std)
    np.testing.assert_allclose(numpy_policy.log_prob(noise, log_std), expected, atol=1e-4)


@pytest.mark.parametrize("memory", ["lstm", "none"])
def test_parameter_shapes_are_those_of_the_learner(make_config, memory):
    config = make_config("cassie", memory=memory)
    learner = jax.eval_shape(lambda key: ppo.init_learner(config, 50, 10, None, key), jax.random.key(0))
    shapes = {f"policy/{name}": array.shape for name, array in learner.policy_params.items()}
    shapes |= {f"value/{name}": array.shape for name, array in learner.value_params.items()}
    shapes |= {"normalizer/mean": (50,), "normalizer/std": (50,)}
    assert numpy_policy.parameter_shapes(50, 10, config.network) == shapes


def test_a_worker_multiplies_matrices_with_its_variables():
    code = "import numpy as np; a = np.ones((64, 64), np.float32); print((a @ a).sum())"
    environment = {**os.environ, **blas.blas_variables()}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout.strip()) == (0, "262144.0")


@pytest.mark.parametrize(("current", "set_"), [("X86_V4", True), ("AVX512_SKX", True), ("X86_V3", False)])
def test_only_a_cpu_with_avx_512_is_taken_for_one(monkeypatch, current, set_):
    found = {"tanh": {"ff": {"current": current, "available": "X86_V4 X86_V3 AVX512_SKX baseline(X86_V2)"}}}
    monkeypatch.setattr(np.lib.introspect, "opt_func_info", lambda **_: found)
    assert ("OPENBLAS_CORETYPE" in blas.blas_variables()) == set_
