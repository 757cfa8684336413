"""A stage gives running workers new settings of the task: no process is restarted, and the episodes go on."""

from collections.abc import Callable

import numpy as np
import pytest

from hasrl_jax.collect.buffer import Collected
from hasrl_jax.collect.decoupled import FreePool
from hasrl_jax.collect.plan import make_plan
from hasrl_jax.collect.supervisor import CpuPool
from hasrl_jax.config.convert import from_dict
from hasrl_jax.config.schema import Config
from hasrl_jax.envs.registry import make_task

Parameters = dict[str, np.ndarray]
RANDOMIZED = {"cassie": {"randomize": {"enabled": True}}}


@pytest.fixture
def config(make_config: Callable[..., Config]) -> Config:
    base = make_config("cassie", num_workers=2, envs_per_worker=2, env_steps_per_iteration=32, max_episode_steps=100)
    return from_dict({"cassie": {"randomize": {"enabled": False}}}, base)


@pytest.fixture
def parameters(make_parameters: Callable[[Config], Parameters], config: Config) -> Parameters:
    return make_parameters(config)


def two_iterations(config: Config, second: Config | None, parameters: Parameters) -> list[Collected]:
    """One iteration under each configuration; the same workers must serve both."""
    with CpuPool(config, make_plan(config), make_task(config)) as pool:
        pool.start(parameters, 0, version=0)
        collected, processes = [pool.finish()], pool.process_ids
        if second:
            pool.configure(second)
        pool.start(parameters, 1, version=1)
        collected.append(pool.finish())
        assert pool.process_ids == processes and pool.workers_lost == 0
    return collected


def test_episodes_go_on_under_the_new_settings(config: Config, parameters: Parameters) -> None:
    doubled = from_dict({"cassie": {"reward": {"scale": 2 * config.settings.reward.scale}}}, config)
    (_, before), (_, after) = (two_iterations(config, second, parameters) for second in (None, doubled))
    np.testing.assert_array_equal(after.fields["observation"], before.fields["observation"])
    np.testing.assert_allclose(after.fields["reward"], 2 * before.fields["reward"], rtol=1e-6)
    assert not after.fields["is_first"].all()


def test_episodes_begin_anew_where_their_state_gets_another_shape(config: Config, parameters: Parameters) -> None:
    first, second = two_iterations(config, from_dict(RANDOMIZED, config), parameters)
    assert first.fields["is_first"][::8].all(), "8 environment steps of each environment"
    assert second.fields["is_first"][::8].all()
    _, unchanged = two_iterations(config, None, parameters)
    assert not unchanged.fields["is_first"][::8].all()


def test_episodes_begin_anew_under_other_physics(config: Config, parameters: Parameters) -> None:
    """A robot that was drawn at random carries its physics step, and would keep it; then as in a pool of that stage."""
    randomized = from_dict(RANDOMIZED, config)
    steps = {"timestep_s": 2 * config.physics.timestep_s, "steps_per_env_step": config.physics.steps_per_env_step // 2}
    other = from_dict({"physics": steps}, randomized)
    _, coarse = two_iterations(randomized, other, parameters)
    assert coarse.fields["is_first"][::8].all()
    with CpuPool(other, make_plan(other), make_task(other)) as pool:
        pool.start(parameters, 1, version=1)
        np.testing.assert_array_equal(coarse.fields["observation"], pool.finish().fields["observation"])


def test_free_workers_take_new_settings_over_before_their_next_slot(config: Config, parameters: Parameters) -> None:
    config = from_dict({"schedule": "decoupled", "decoupled": {"max_lag": 1000}}, config)
    steep = from_dict({"cassie": {"reward": {"scale": 100.0}}}, config)
    pool = FreePool(config, make_plan(config), make_task(config))
    try:
        processes = pool.process_ids
        pool.publish(parameters, 0)
        before = pool.take(0, wait=True)
        pool.configure(steep)
        # Two slots of each worker may have been filled before it heard of the change.
        later = [pool.take(0, wait=True) for _ in range(4)][-1]
        assert np.abs(later.fields["reward"]).mean() > 10 * np.abs(before.fields["reward"]).mean()
        assert pool.process_ids == processes and pool.workers_lost == 0
    finally:
        pool.close()
