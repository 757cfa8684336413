"""How the budget of an iteration is divided."""

import pytest

from hasrl_jax.collect.plan import make_plan


def test_budget_per_worker_is_the_budget_over_the_workers(make_config):
    plan = make_plan(make_config(num_workers=3, envs_per_worker=4, unroll_length=8, env_steps_per_iteration=960))
    assert (plan.steps_per_worker, plan.steps_per_env, plan.env_steps) == (320, 80, 960)


@pytest.mark.parametrize(("mode", "steps_per_env"), [("unrolls", 16), ("episodes", 9)])
def test_budget_is_rounded_up_never_down(make_config, mode, steps_per_env):
    plan = make_plan(make_config(mode=mode, envs_per_worker=4, unroll_length=8, env_steps_per_iteration=33))
    assert plan.steps_per_env == steps_per_env
    assert plan.env_steps >= 33


def test_rows_are_whole_minibatches(make_config):
    plan = make_plan(make_config(envs_per_worker=5, unroll_length=8, env_steps_per_iteration=5 * 8 * 13))
    assert plan.rows == 128  # 65 trajectories, minibatches of 64


@pytest.mark.parametrize(("cap", "expected"), [(10, 10), (1000, 24)])
def test_an_episode_is_cut_by_its_cap_or_by_the_buffer(make_config, cap, expected):
    plan = make_plan(make_config(mode="episodes", max_episode_steps=cap, env_steps_per_iteration=96))
    assert plan.max_length == expected


def test_a_symmetric_policy_carries_two_streams(make_config):
    assert make_plan(make_config(symmetric=False)).carry_shape == (2, 2, 16)
    assert make_plan(make_config(symmetric=True)).carry_shape == (2, 2, 32)


@pytest.mark.parametrize(
    ("mode", "num_workers", "expected"),
    [("unrolls", 1, (128, 128)), ("unrolls", 2, (128, 64)), ("unrolls", 3, (86, 64)), ("episodes", 2, (20, 410))],
)
def test_environments_are_chosen_to_fill_the_budget(make_config, mode, num_workers, expected):
    sizes = {"env_steps_per_iteration": 16384, "unroll_length": 64, "max_episode_steps": 420}
    plan = make_plan(make_config(mode=mode, num_workers=num_workers, envs_per_worker=0, **sizes))
    assert (plan.envs_per_worker, plan.steps_per_env) == expected
