"""Real worker processes: what they collect, and what happens when they are lost."""

import logging
import os
import re
import signal
import subprocess
import sys
import textwrap
import time

import numpy as np
import psutil
import pytest

from hasrl_jax.collect import supervisor as cpu_pool
from hasrl_jax.collect.plan import make_plan
from hasrl_jax.collect.supervisor import CpuPool
from hasrl_jax.envs.registry import make_task
from hasrl_jax.errors import WorkerError


@pytest.fixture
def make_pool(make_config):
    """`make_pool(**collect)`: a pool that is closed at the end, after which nothing may be left."""
    shared_before = named_blocks()
    pools, seen = [], set()

    def make(**collect):
        config = make_config(**({"num_workers": 2, "env_steps_per_iteration": 192} | collect))
        pool = CpuPool(config, make_plan(config), make_task(config))
        pools.append(pool)
        seen.update(psutil.Process().children())
        return pool

    yield make
    seen.update(psutil.Process().children())
    for pool in pools:
        pool.close()
    assert not [process for process in seen if process.is_running() and "collect.worker" in " ".join(process.cmdline())]
    assert named_blocks() <= shared_before


def named_blocks() -> set[str]:
    """Shared memory with a name; semaphores are other programs', the pool has none."""
    names = os.listdir("/dev/shm") if os.path.isdir("/dev/shm") else []
    return {name for name in names if not name.startswith("sem.")}


@pytest.fixture
def parameters(make_config, make_parameters):
    return make_parameters(make_config())


def test_workers_are_given_no_more_of_the_environment_than_they_need(make_pool, monkeypatch):
    monkeypatch.setenv("CLOUD_SECRET_KEY", "abc")
    monkeypatch.setenv("HASRL_ASSETS", "there")
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    make_pool(num_workers=1)
    (worker,) = [child for child in psutil.Process().children() if "hasrl_jax.collect.worker" in child.cmdline()]
    given = worker.environ()
    assert "CLOUD_SECRET_KEY" not in given
    assert (given["HASRL_ASSETS"], given["PATH"]) == ("there", os.environ["PATH"])
    assert (given["OMP_NUM_THREADS"], given["OPENBLAS_NUM_THREADS"]) == ("1", "1")


def run(pool, parameters, iteration=0):
    pool.start(parameters, iteration, version=iteration)
    return pool.finish()


def by_worker(collected):
    """The per-step arrays of each worker that finished, and its segments re-based to them."""
    count = len(collected.statistics)
    size = len(collected.fields["mask"]) // count
    for worker in range(count):
        inside = collected.start // size == worker
        steps = {name: array[worker * size : (worker + 1) * size] for name, array in collected.fields.items()}
        yield steps, collected.start[inside] - worker * size, collected.end[inside] - worker * size


@pytest.mark.parametrize("mode", ["unrolls", "episodes"])
def test_workers_buffers_are_merged_with_indices_re_based(make_pool, parameters, mode):
    pool = make_pool(mode=mode)
    collected = run(pool, parameters)
    assert {len(array) for array in collected.fields.values()} == {192}
    assert len(collected.initial_carry) == len(collected.start) == len(collected.end)
    for steps, start, end in by_worker(collected):
        assert (start[0], end[-1]) == (0, 96)
        np.testing.assert_array_equal(start[1:], end[:-1])
        assert (steps["terminated"] | steps["truncated"])[end - 1].all()
    (first, *_), (second, *_) = by_worker(collected)
    assert np.all(first["action"] != second["action"])
    np.testing.assert_array_equal(collected.version, np.zeros(len(collected.start), np.int32))


def test_two_buffers_alternate_and_saved_environments_continue_identically(make_pool, parameters):
    pool, restored = make_pool(), make_pool()
    run(pool, parameters)
    restored.load(pool.save())
    expected, actual = run(pool, parameters, 1), run(restored, parameters, 1)
    for name, array in expected.fields.items():
        np.testing.assert_array_equal(actual.fields[name], array, err_msg=name)


def test_states_from_before_the_first_collection_or_of_other_sizes_begin_anew(make_pool, parameters, caplog):
    pool = make_pool()
    pool.load(pool.save())
    pool.load([b""] * 3)
    assert "3 workers saved, 2 run" in caplog.text
    assert len(run(pool, parameters).statistics) == 2


def test_a_killed_worker_costs_its_own_part_only(make_pool, parameters, caplog):
    undisturbed = run(make_pool(env_steps_per_iteration=20_000), parameters)
    pool = make_pool(env_steps_per_iteration=20_000)
    victim, other = pool.process_ids
    pool.start(parameters, 0, version=0)
    os.kill(victim, signal.SIGKILL)
    collected = pool.finish()
    assert re.search(rf"worker 0 \(process {victim}\) was killed by SIGKILL", caplog.text)
    assert pool.workers_lost == 1
    (_, expected), ((steps, *_),) = list(by_worker(undisturbed)), by_worker(collected)
    np.testing.assert_array_equal(steps["action"], expected[0]["action"])
    assert pool.process_ids[1] == other
    assert len(run(pool, parameters, 1).statistics) == 2


def test_a_silent_worker_is_replaced(make_pool, parameters, caplog):
    pool = make_pool(worker_timeout_s=2.0)
    os.kill(pool.process_ids[1], signal.SIGSTOP)
    started = time.monotonic()
    assert len(run(pool, parameters).statistics) == 1
    assert time.monotonic() - started < 30
    assert "worker 1" in caplog.text
    assert "was silent for collect.worker_timeout_s=2 s" in caplog.text
    assert len(run(pool, parameters, 1).statistics) == 2


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
def test_saving_survives_a_lost_worker(make_pool, parameters, number):
    pool = make_pool(worker_timeout_s=2.0)
    run(pool, parameters)
    os.kill(pool.process_ids[0], number)
    lost, kept = pool.save()
    assert lost == b""
    assert kept
    pool.load([lost, kept])
    assert len(run(pool, parameters, 1).statistics) == 2


def test_when_every_worker_raises_again_and_again_the_cause_is_in_the_error(make_pool, parameters, caplog):
    pool = make_pool()
    with pytest.raises(WorkerError, match=r"failed 3 times in 3 requests; .*DivergenceError: .*not finite"):
        run(pool, parameters | {"policy/mean_bias": np.full(1, np.nan)})
    assert caplog.text.count("every worker was lost in the same iteration") == 2
    assert caplog.text.count("Traceback") >= 5


def test_an_iteration_in_which_every_worker_is_lost_is_collected_again(make_pool, parameters, caplog):
    pool, other = make_pool(), make_pool()
    pool.start(parameters, 0, version=0)
    for process_id in pool.process_ids:
        os.kill(process_id, signal.SIGKILL)
    again, expected = pool.finish(), run(other, parameters, 0)
    assert pool.workers_lost == 2
    np.testing.assert_array_equal(again.fields["observation"], expected.fields["observation"])


@pytest.mark.parametrize("iterations_between", [0, 1])
def test_a_worker_that_keeps_failing_ends_in_one_error(make_pool, parameters, iterations_between):
    """Also one that finishes an iteration before it dies again."""
    pool, iteration = make_pool(), 0
    for failure in range(cpu_pool.MAX_FAILURES):
        os.kill(pool.process_ids[0], signal.SIGKILL)
        if failure < cpu_pool.MAX_FAILURES - 1:
            for _ in range(1 + iterations_between):
                run(pool, parameters, iteration)
                iteration += 1
    requests = cpu_pool.MAX_FAILURES + iterations_between * (cpu_pool.MAX_FAILURES - 1)
    cause = rf"^worker 0 failed 3 times in {requests} requests; the last one was killed by SIGKILL$"
    with pytest.raises(WorkerError, match=cause):
        run(pool, parameters, iteration)


def test_a_replacement_that_does_not_start_is_tried_again(make_pool, parameters, monkeypatch, caplog):
    pool = make_pool()
    spawn, executables = pool._spawn, ["/bin/false"]

    def spawn_badly_once(index):
        with monkeypatch.context() as patch:
            if executables:
                patch.setattr(sys, "executable", executables.pop())
            return spawn(index)

    monkeypatch.setattr(pool, "_spawn", spawn_badly_once)
    os.kill(pool.process_ids[0], signal.SIGKILL)
    run(pool, parameters)
    assert "exited with status 1" in caplog.text
    assert len(run(pool, parameters, 1).statistics) == 2


def test_workers_that_never_start_are_one_error(make_config, monkeypatch):
    monkeypatch.setattr(sys, "executable", "/bin/false")
    config = make_config()
    with pytest.raises(WorkerError, match="worker 0 did not start: it exited with status 1"):
        CpuPool(config, make_plan(config), make_task(config))


def test_workers_leave_terminal_signals_to_the_pool(make_pool, parameters):
    pool = make_pool()
    for pid in pool.process_ids:
        os.kill(pid, signal.SIGINT)
        os.kill(pid, signal.SIGTERM)
    assert len(run(pool, parameters).statistics) == 2
    assert pool.workers_lost == 0


def test_workers_end_with_a_killed_parent(make_config):
    script = """
        import time
        from hasrl_jax.collect.supervisor import CpuPool
        from hasrl_jax.collect.plan import make_plan
        from hasrl_jax.config.convert import from_dict
        from hasrl_jax.envs.registry import make_task
        config = from_dict({"task": "cartpole", "collect": {"num_workers": 2}})
        pool = CpuPool(config, make_plan(config), make_task(config))
        print(*pool.process_ids, flush=True)
        time.sleep(60)
    """
    parent = subprocess.Popen([sys.executable, "-c", textwrap.dedent(script)], stdout=subprocess.PIPE, text=True)
    workers = [psutil.Process(int(pid)) for pid in parent.stdout.readline().split()]
    assert len(workers) == 2
    parent.kill()
    parent.wait()
    parent.stdout.close()
    _, alive = psutil.wait_procs(workers, timeout=5)
    assert not alive


@pytest.fixture(autouse=True)
def capture_warnings(caplog):
    caplog.set_level(logging.WARNING, "hasrl_jax")
