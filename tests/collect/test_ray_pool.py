"""Workers as Ray actors on a cluster of two nodes, both on this machine's loopback interface."""

import contextlib
import dataclasses
import logging
import os
import sys
import time

import numpy as np
import psutil
import pytest

from hasrl_jax.collect.plan import make_plan
from hasrl_jax.collect.ray.cluster import import_ray
from hasrl_jax.collect.ray.pool import RayPool
from hasrl_jax.collect.supervisor import MAX_FAILURES, CpuPool
from hasrl_jax.config.schema import RayConfig
from hasrl_jax.envs.registry import make_task
from hasrl_jax.errors import ConfigError, WorkerError

# Read when Ray is loaded.
os.environ |= {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": "0" * 64, "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0"}
ray = pytest.importorskip("ray", reason='Ray is not installed: pip install "ray>=2.52"')
cluster_utils = pytest.importorskip("ray.cluster_utils")

LONG = 25_000  # environment steps of an iteration that lasts long enough to be disturbed


@pytest.fixture(scope="module")
def cluster():
    """Two nodes with two CPUs each; nothing may be left of them."""
    made = cluster_utils.Cluster(initialize_head=True, head_node_args={"num_cpus": 2, "include_dashboard": False})
    made.add_node(num_cpus=2)
    started = psutil.Process().children(recursive=True)
    yield made
    made.shutdown()
    _, alive = psutil.wait_procs(started, timeout=10)
    assert not alive


@pytest.fixture
def make_pool(make_config, cluster):
    """`make_pool(kind, **collect)`: a pool that is closed at the end; a `RayPool` joins the cluster."""
    pools = []

    def make(kind=RayPool, **collect):
        config = make_config(**({"num_workers": 2, "env_steps_per_iteration": 192} | collect))
        config = dataclasses.replace(config, ray=RayConfig(address=cluster.address))
        pools.append(kind(config, make_plan(config), make_task(config)))
        return pools[-1]

    yield make
    for pool in pools:
        pool.close()
    assert not ray.is_initialized()


def test_a_cluster_is_joined_with_a_token_or_on_purpose_without(tmp_path, monkeypatch):
    settings = RayConfig(address="10.0.0.1:6379")
    monkeypatch.setenv("HOME", str(tmp_path))
    for name in ("RAY_AUTH_MODE", "RAY_AUTH_TOKEN"):
        monkeypatch.delenv(name)
    with pytest.raises(ConfigError, match=r"^ray.address: 10.0.0.1:6379 is joined with its token; expected .*~/.ray"):
        import_ray(settings)
    assert os.environ["RAY_AUTH_MODE"] == "token"
    monkeypatch.setenv("RAY_AUTH_MODE", "disabled")
    assert import_ray(settings) is ray
    monkeypatch.setenv("RAY_AUTH_MODE", "token")
    (tmp_path / ".ray").mkdir()
    (tmp_path / ".ray" / "auth_token").write_text("0" * 64)
    assert import_ray(settings) is ray


@pytest.fixture
def parameters(make_config, make_parameters):
    return make_parameters(make_config())


@pytest.fixture(autouse=True)
def capture_warnings(caplog):
    caplog.set_level(logging.WARNING, "hasrl_jax")


def run(pool, parameters, iteration=0):
    pool.start(parameters, iteration, version=iteration)
    return pool.finish()


def wait_for_workers(pool, count, seconds=60):
    """Until that many workers can take part in the next iteration."""
    deadline = time.monotonic() + seconds
    while len(pool.places) < count and time.monotonic() < deadline:
        time.sleep(0.1)
        pool._join()
    assert len(pool.places) == count


def assert_equal(first, second):
    for name, array in first.fields.items():
        np.testing.assert_array_equal(second.fields[name], array, err_msg=name)
    for name in ("start", "end", "initial_carry", "version"):
        np.testing.assert_array_equal(getattr(second, name), getattr(first, name), err_msg=name)


def test_its_data_and_its_saved_environments_are_those_of_the_cpu_pool(make_pool, parameters, caplog):
    expected, actual = make_pool(CpuPool), make_pool()
    assert len({node for node, _ in actual.places.values()}) == 2, "the workers are spread over the nodes"
    assert_equal(run(expected, parameters), run(actual, parameters))
    states = actual.save()
    assert_equal(run(expected, parameters, 1), run(actual, parameters, 1))
    for pool in (expected, actual):  # both go back to where `actual` was
        pool.load(states)
    assert_equal(run(expected, parameters, 1), run(actual, parameters, 1))
    actual.load([b""] * 3)
    assert "3 workers saved, 2 run" in caplog.text


def test_lost_workers_cost_their_own_part_and_are_replaced(make_pool, parameters, caplog):
    pool = make_pool(num_workers=3, env_steps_per_iteration=LONG, worker_timeout_s=3.0)
    killed, stopped = psutil.Process(pool.places[0][1]), psutil.Process(pool.places[1][1])
    pool.start(parameters, 0, version=0)
    killed.kill()
    stopped.suspend()
    assert len(pool.finish().statistics) == 1
    assert pool.workers_lost == 2
    assert "worker 0 was lost" in caplog.text
    assert "worker 1 was silent for collect.worker_timeout_s=3 s" in caplog.text
    with contextlib.suppress(psutil.NoSuchProcess):
        stopped.kill()
    wait_for_workers(pool, 3)
    assert len(run(pool, parameters, 1).statistics) == 3


def test_workers_that_raise_end_in_one_error_with_the_cause(make_pool, parameters, caplog):
    pool = make_pool()
    broken = parameters | {"policy/mean_bias": np.full(1, np.nan, np.float32)}
    with pytest.raises(WorkerError, match=r"^every worker was lost.* raised \S*DivergenceError: .*not finite$"):
        run(pool, broken)
    assert caplog.text.count("ray::RayWorker.collect") == 2, "the tracebacks are shown"
    assert len(run(pool, parameters, 1).statistics) > 0
    pool._failures = [MAX_FAILURES - 1] * 2
    with pytest.raises(WorkerError, match=r"^worker \d failed 3 times in a row; the last one raised \S*Divergence"):
        run(pool, broken, 2)


def test_a_cluster_without_room_is_one_error(make_pool):
    with pytest.raises(
        WorkerError, match=r"^\d of 5 workers did not start within .*=2 s; .* the Ray cluster has 4 CPUs$"
    ):
        make_pool(num_workers=5, worker_start_timeout_s=2.0)


def test_a_lost_node_costs_its_own_part_and_the_others_go_on(make_pool, cluster, parameters):
    pool = make_pool(num_workers=4, env_steps_per_iteration=2 * LONG)
    assert len({node for node, _ in pool.places.values()}) == 2
    pool.start(parameters, 0, version=0)
    cluster.remove_node(next(iter(cluster.worker_nodes)), allow_graceful=False)
    assert len(pool.finish().statistics) == 2
    assert pool.workers_lost == 2
    assert len(run(pool, parameters, 1).statistics) == 2, "there is no room for the others"
    assert len([state for state in pool.save() if state]) == 2


def test_a_cluster_that_is_not_there_is_one_error(make_config):
    config = dataclasses.replace(make_config(), ray=RayConfig(address="127.0.0.1:1"))
    with pytest.raises(WorkerError, match=r"^ray\.address: 127\.0\.0\.1:1 cannot be joined \([^\n]*\)$"):
        RayPool(config, make_plan(config), make_task(config))
    assert not ray.is_initialized()


def test_without_ray_one_line_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(ConfigError, match=r"^backend: ray .*pip install \"ray>=2\.52\""):
        import_ray(RayConfig())
