"""What each schedule promises, and what becomes of a run when a part of it fails."""

import functools
import json
import os
import signal
import time
from collections.abc import Callable
from pathlib import Path

import jax
import numpy as np
import psutil
import pytest
from tiny import tiny

from hasrl_jax.cli import parsing as cli
from hasrl_jax.collect.backends import make_collector
from hasrl_jax.collect.decoupled import FreePool
from hasrl_jax.collect.protocol import Networks
from hasrl_jax.collect.supervisor import CpuPool
from hasrl_jax.config.checks import check
from hasrl_jax.config.convert import from_dict
from hasrl_jax.envs.registry import make_task
from hasrl_jax.errors import ConfigError
from hasrl_jax.learn import distributions, normalize, ppo
from hasrl_jax.learn.networks import make_networks
from hasrl_jax.train import loop as train
from hasrl_jax.types import Trajectory

SCHEDULES = ("sync", "overlap", "decoupled")
STEPS = 128  # environment steps of an iteration
TINY = tiny(
    total_env_steps=10**9,
    collect={"env_steps_per_iteration": STEPS, "worker_timeout_s": 2.0},
    evaluate={"every_iterations": 0},
)
Hook = Callable[[dict], None]


@functools.cache
def compiled(schedule: str) -> ppo.Update:
    """One program per schedule for the whole file."""
    config = from_dict(TINY | {"schedule": schedule})
    task = make_task(config)
    return ppo.make_update(config, task.observation_size, task.action_size, task.mirror, ppo.make_mesh())


def workers() -> list[psutil.Process]:
    """The worker processes of this one, by age; a stopped one counts."""
    children = [child for child in psutil.Process().children() if child.status() != psutil.STATUS_ZOMBIE]
    return [child for child in children if "hasrl_jax.collect.worker" in child.cmdline()]


def open_blocks() -> int:
    """Blocks of shared memory that this process holds."""
    names = [os.readlink(entry.path) for entry in os.scandir("/proc/self/fd") if os.path.islink(entry.path)]
    return sum("memfd:hasrl_jax" in name for name in names)


def stop() -> None:
    """Asks the training loop to end after this iteration."""
    os.kill(os.getpid(), signal.SIGTERM)


@pytest.fixture
def run(tmp_path, monkeypatch):
    """`run(changes, hook, make_update)`: trains; `hook` sees each record. Returns (exit status, records)."""

    def go(changes: dict, hook: Hook | None = None, make_update: Callable | None = None) -> tuple[int, list[dict]]:
        config = from_dict(changes, from_dict(TINY | {"run_dir": str(tmp_path / "run")}))
        deadline = time.monotonic() + 120

        def update(printer: object, record: dict) -> None:
            if hook:
                hook(record)
            if time.monotonic() > deadline:
                stop()

        monkeypatch.setattr(train.ProgressPrinter, "update", update)
        make = make_update or (lambda *_: compiled(config.schedule))
        blocks_before = open_blocks()  # other tests may still hold some
        status = cli.run(lambda: train.train(config, make_update=make))
        assert not workers()
        assert open_blocks() <= blocks_before
        lines = (tmp_path / "run" / "metrics.jsonl").read_text().splitlines()
        return status, [json.loads(line) for line in lines]

    return go


def saved(tmp_path: Path) -> list[int]:
    return sorted(int(path.name.partition(".")[0]) for path in (tmp_path / "run" / "checkpoints").iterdir())


@pytest.mark.parametrize("schedule", SCHEDULES)
def test_lag_stays_within_its_bound_and_one_program_serves_all(schedule, run):
    changes = {"schedule": schedule, "total_env_steps": 12 * STEPS, "decoupled": {"max_lag": 1}}
    status, records = run(changes)
    assert status == 0
    lags = np.array([[record[f"policy_lag{end}"] for end in ("_min", "", "_max")] for record in records])
    assert (np.diff(lags, axis=1) >= 0).all()
    if schedule == "decoupled":
        assert lags.max() <= 1 and lags.min() >= 0
        assert {record["replay_ratio"] for record in records} == {1.0}
        assert len(records) <= 12
    else:
        expected = [0] * 12 if schedule == "sync" else [0] + [1] * 11
        np.testing.assert_array_equal(lags, np.repeat(np.array(expected)[:, None], 3, axis=1))
    assert compiled(schedule)._jitted._cache_size() == 1


def test_replays_stay_within_their_ratio_and_add_no_environment_steps(run, monkeypatch):
    take = FreePool.take
    monkeypatch.setattr(FreePool, "take", lambda pool, version, wait: take(pool, version, wait) if wait else None)
    changes = {"schedule": "decoupled", "total_env_steps": 8 * STEPS}
    status, records = run(changes | {"decoupled": {"replay_ratio": 1.5, "max_lag": 100}})
    assert status == 0
    # Nothing new ever waits, so the learner goes back to the newest batch whenever the average allows.
    replays = [record for record in records if record["episode_return_train"] is None]
    assert [record["iteration"] for record in replays] == [3, 6, 9]
    assert [round(record["replay_ratio"], 2) for record in records[:6]] == [1, 1, 1.5, 1.33, 1.25, 1.5]
    for record in replays:
        assert record["policy_lag_min"] >= 1
        assert record["env_steps"] == records[record["iteration"] - 2]["env_steps"]
    assert [record["env_steps"] for record in records if record not in replays] == list(range(STEPS, 9 * STEPS, STEPS))
    assert compiled("decoupled")._jitted._cache_size() == 1


@pytest.mark.parametrize("schedule", ["overlap", "decoupled"])
def test_log_probs_are_those_of_the_parameters_that_acted(schedule):
    """The learner has moved on before the trajectories are read; they still say who acted."""
    config = from_dict(TINY | {"schedule": schedule})
    task = make_task(config)
    sizes = task.observation_size, task.action_size
    old, new = (ppo.init_learner(config, *sizes, task.mirror, jax.random.key(seed)) for seed in (0, 1))
    networks = Networks(*make_networks(config.network, *sizes, task.mirror))
    policy = networks.policy
    with make_collector(config, task, ppo.make_mesh(), networks) as collector:
        collector.start(ppo.acting_parameters(old), 0, version=0)
        first = collector.finish().trajectory
        collector.start(ppo.acting_parameters(new), 1, version=1)
        batches = [first] + [collector.finish().trajectory for _ in range(4 if schedule == "decoupled" else 1)]
    seen = set()
    for steps in batches:
        for version, learner in enumerate((old, new)):
            rows = (steps.policy_version == version) & steps.mask.any(axis=1)
            seen |= {version} if rows.any() else set()
            statistics = normalize.mean_std(learner.normalizer)
            inputs = steps.observation, steps.initial_carry, steps.is_first, *statistics
            mean = policy.apply({"params": learner.policy_params}, *inputs)[0]
            log_prob = np.asarray(distributions.log_prob(steps.action, mean, learner.policy_params["log_std"]))
            np.testing.assert_allclose(log_prob[rows], steps.log_prob[rows], atol=1e-4)
    assert seen == {0, 1}


@pytest.mark.parametrize("backend", ["mjx", "ray"])
def test_decoupling_needs_workers_of_its_own(backend):
    expected = f"^schedule: got 'decoupled'; expected 'sync' or 'overlap' with backend {backend}"
    with pytest.raises(ConfigError, match=expected):
        check(from_dict({"schedule": "decoupled", "backend": backend}))


def test_the_linear_rate_counts_all_that_was_collected(run):
    """Steps that were dropped as stale count too, or the rate would not reach zero."""
    shares, update = [], compiled("decoupled")

    def recorded(learner, trajectory, replayed, progress):
        shares.append(progress)
        time.sleep(0.2)  # workers fill both of their slots meanwhile, and one of them gets too old
        return update(learner, trajectory, replayed, progress)

    total = 12 * STEPS
    changes = {"schedule": "decoupled", "total_env_steps": total, "decoupled": {"max_lag": 0}}
    status, records = run(changes, make_update=lambda *_: recorded)
    assert status == 0
    assert sum(record["dropped_stale"] for record in records) > 0
    collected = [0, *(record["env_steps"] for record in records)]
    np.testing.assert_allclose(shares, np.array(collected[:-1]) / total)
    assert collected[-1] >= total


def lose(number: signal.Signals, count: int) -> Hook:
    """Sends a signal to workers after iteration 3; once as many were replaced, stops after another three iterations."""
    last = [10**9]

    def hook(record: dict) -> None:
        if record["iteration"] == 3:
            for worker in workers()[:count]:
                os.kill(worker.pid, number)
        if record["workers_lost"] >= count:
            last[0] = min(last[0], record["iteration"] + 3)
        if record["iteration"] == last[0]:
            stop()

    return hook


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP], ids=["dead", "hanging"])
@pytest.mark.parametrize("schedule", SCHEDULES)
def test_a_lost_worker_is_replaced_and_the_run_goes_on(schedule, number, run, tmp_path):
    status, records = run({"schedule": schedule}, lose(number, 1))
    assert status == 0
    assert records[-1]["workers_lost"] == 1
    assert saved(tmp_path)[-1] == records[-1]["iteration"]


@pytest.mark.parametrize("schedule", SCHEDULES)
def test_a_run_goes_on_when_all_workers_die_at_once(schedule, run, tmp_path):
    status, records = run({"schedule": schedule}, lose(signal.SIGKILL, 2))
    assert (status, records[-1]["workers_lost"]) == (0, 2)
    assert saved(tmp_path)[-1] == records[-1]["iteration"]


@pytest.mark.parametrize("schedule", SCHEDULES)
def test_a_worker_that_raises_is_named_and_replaced(schedule, run, monkeypatch, caplog):
    pools = []
    begin = CpuPool.__init__
    monkeypatch.setattr(CpuPool, "__init__", lambda pool, *args: (pools.append(pool), begin(pool, *args))[1])
    hook = lose(signal.SIGKILL, 1)

    def raise_one(record: dict) -> None:
        if record["iteration"] == 3:
            pools[0]._send(0, {"do": "collect", "iteration": 0, "slot": 9})
        hook(record | {"iteration": record["iteration"] + 1000})

    status, records = run({"schedule": schedule}, raise_one)
    assert status == 0
    assert records[-1]["workers_lost"] == 1
    assert "KeyError: 'parameters'" in caplog.text


class Failing:
    """An update that fails in its fourth call: raises, or is given a step with a number that spoils it."""

    def __init__(self, update: ppo.Update, error: Exception | tuple[str, float]):
        self.update, self.error, self.calls = update, error, 0

    def __call__(self, learner: ppo.LearnerState, trajectory: Trajectory, *args: object) -> tuple:
        self.calls += 1
        if self.calls == 4:
            if isinstance(self.error, Exception):
                raise self.error
            name, number = self.error
            values = np.array(getattr(trajectory, name))
            assert trajectory.mask[0, 0]
            values[0, 0] = number
            trajectory = trajectory._replace(**{name: values})
        return self.update(learner, trajectory, *args)


NOT_FINITE = "error: iteration 4: the update gave parameters that are not finite"


@pytest.mark.parametrize(
    ("error", "cause"),
    [
        (("reward", np.nan), NOT_FINITE),
        (("observation", 1e30), NOT_FINITE),  # its square is not finite: the statistics would be blind for ever
        (jax.errors.JaxRuntimeError("INTERNAL: device lost\nmore"), "the update failed (INTERNAL: device lost)"),
    ],
    ids=["loss", "statistics", "exception"],
)
@pytest.mark.parametrize("schedule", SCHEDULES)
def test_a_learner_that_fails_leaves_one_cause_and_a_checkpoint(schedule, error, cause, run, tmp_path, capsys):
    status, records = run({"schedule": schedule}, make_update=lambda *_: Failing(compiled(schedule), error))
    message = capsys.readouterr().err
    assert (status, message.count("\n")) == (1, 1)
    assert cause in message and "--resume" in message
    assert (len(records), saved(tmp_path)[-1]) == (3, 2)


def test_a_decoupled_run_resumes(run, tmp_path):
    status, records = run({"schedule": "decoupled", "total_env_steps": 3 * STEPS})
    assert status == 0
    config = from_dict(TINY | {"schedule": "decoupled", "run_dir": str(tmp_path / "run")})
    resumed = from_dict({"total_env_steps": records[-1]["env_steps"] + STEPS}, config)
    train.train(resumed, resume=True, make_update=lambda *_: compiled("decoupled"))
    after = [json.loads(line) for line in (tmp_path / "run" / "metrics.jsonl").read_text().splitlines()]
    assert after[: len(records)] == records
    assert after[len(records)]["policy_lag_max"] == 0
    assert after[-1]["env_steps"] >= records[-1]["env_steps"] + STEPS
