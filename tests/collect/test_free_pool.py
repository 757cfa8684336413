"""Workers that go their own way: order, bounds, staleness and loss."""

import os
import signal
import time
from collections.abc import Callable

import numpy as np
import pytest

from hasrl_jax.collect.decoupled import FreePool
from hasrl_jax.collect.plan import make_plan
from hasrl_jax.collect.supervisor import MAX_FAILURES
from hasrl_jax.config.convert import from_dict
from hasrl_jax.envs.registry import make_task
from hasrl_jax.errors import WorkerError

WORKERS, SLOTS, STEPS, SEGMENTS = 2, 4, 96, 12  # of a slot: steps and trajectories


@pytest.fixture
def make_pool(make_config):
    pools = []

    def make(max_lag: int = 4, **collect) -> FreePool:
        sizes = {"num_workers": WORKERS, "env_steps_per_iteration": WORKERS * STEPS, "worker_timeout_s": 2.0}
        free = {"schedule": "decoupled", "decoupled": {"max_lag": max_lag}}
        config = from_dict(free, make_config(**(sizes | collect)))
        pools.append(FreePool(config, make_plan(config), make_task(config)))
        return pools[-1]

    yield make
    for pool in pools:
        pool.close()


@pytest.fixture
def parameters(make_config, make_parameters):
    return make_parameters(make_config())


def wait_until(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


def all_full(pool: FreePool) -> bool:
    return len(pool._finished) == SLOTS


def test_workers_go_on_until_their_slots_are_full_and_no_further(make_pool, parameters):
    pool = make_pool()
    size = pool._pool._block.size
    assert pool.take(0, wait=False) is None
    for version in range(4):
        pool.publish(parameters, version)
        wait_until(lambda: all_full(pool))
        filled = list(pool._filled)
        time.sleep(0.2)
        assert (list(pool._filled), len(pool._finished), pool._at_work) == (filled, SLOTS, {})
        collected = pool.take(version, wait=True)
        assert len(collected.fields["mask"]) == WORKERS * STEPS
    assert pool._pool._block.size == size
    assert [len(pool._pool._block.slots), len(pool._pool._block.parameters)] == [2, WORKERS]


def test_the_oldest_come_first_and_a_batch_can_mix_versions(make_pool, parameters):
    pool = make_pool()
    pool.publish(parameters, 0)
    wait_until(lambda: all_full(pool))
    pool.publish(parameters, 1)
    taken = []
    for _ in range(4):
        taken.append(pool.take(1, wait=True).version)
        assert len(taken[-1]) == WORKERS * SEGMENTS
    versions = np.concatenate(taken)
    np.testing.assert_array_equal(versions, np.sort(versions))
    assert (versions == 0).sum() == SLOTS * SEGMENTS
    assert pool.pop_dropped() == (0, 0)


def test_what_is_too_old_is_dropped_counted_and_collected_anew(make_pool, parameters):
    pool = make_pool(max_lag=2)
    pool.publish(parameters, 5)
    wait_until(lambda: all_full(pool))
    assert pool.take(8, wait=False) is None
    assert pool.pop_dropped() == (SLOTS * SEGMENTS, SLOTS * STEPS)
    assert pool.pop_dropped() == (0, 0)
    pool.publish(parameters, 8)
    wait_until(lambda: pool._version == 8 and len(pool._finished) + len(pool._at_work) > 0)
    collected = pool.take(8, wait=True)
    assert collected.version.min() >= 6


def test_no_two_collections_draw_the_same_numbers_also_in_a_resumed_run(make_pool, parameters):
    actions = []
    for version in (3, 4):
        pool = make_pool()
        pool.publish(parameters, version)
        actions += [pool.take(version, wait=True).fields["action"] for _ in range(3)]
    flat = np.concatenate(actions).ravel()
    assert len(np.unique(flat)) == len(flat)


def test_one_worker_goes_on_while_the_other_hangs(make_pool, parameters):
    pool = make_pool()
    stopped, other = pool.process_ids
    os.kill(stopped, signal.SIGSTOP)
    pool.publish(parameters, 0)
    assert pool.take(0, wait=True) is not None  # both slots of the other
    assert pool.workers_lost == 0
    wait_until(lambda: pool.workers_lost == 1)
    wait_until(lambda: all_full(pool))
    assert pool.process_ids[0] != stopped and pool.process_ids[1] == other


def test_a_worker_that_keeps_failing_is_an_error_of_the_learner(make_pool, parameters, caplog):
    pool = make_pool()
    pool.publish(parameters | {"policy/mean_bias": np.full(1, np.nan)}, 0)
    with pytest.raises(WorkerError, match=rf"failed {MAX_FAILURES} times in \d requests.*DivergenceError"):
        pool.take(0, wait=True)
