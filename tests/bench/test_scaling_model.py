"""The scaling model against machines worked out by hand."""

import pytest

from hasrl_jax.bench.scaling_model import Costs, collecting_here, exchange_line, most_workers, predict

# 1,000 steps of 1 ms each: a worker takes 1 s; 0.1 s of exchange and 0.01 s for each worker; 0.5 s of update for each.
COSTS = Costs(env_steps=1000, cores=2, step_s=1e-3, fixed_s=0.1, per_worker_s=0.01, update_s=5e-4)


def test_few_workers_wait_for_physics() -> None:
    found = predict(COSTS, cores=8, devices=1, device_speed=10.0)  # 0.1 + 0.07 + 7 * 0.05 s < 1 s
    assert (found.workers, found.bottleneck) == (7, "collect")
    assert found.env_steps_per_second == pytest.approx(7000)


def test_many_workers_wait_for_one_accelerator_then_for_the_exchange() -> None:
    one = predict(COSTS, cores=101, devices=1, device_speed=10.0)  # 0.1 + 1 + 5 s
    assert one.bottleneck == "update"
    assert one.env_steps_per_second == pytest.approx(100_000 / 6.1)
    eight = predict(COSTS, cores=101, devices=8, device_speed=10.0)  # 0.1 + 1 + 0.625 s
    assert eight.bottleneck == "exchange"
    assert eight.env_steps_per_second == pytest.approx(100_000 / 1.725)


def test_beyond_the_most_workers_the_learner_is_the_longer_side() -> None:
    assert most_workers(COSTS, 1, 10.0) == pytest.approx(0.9 / 0.06)
    for workers, bottleneck in ((15, "collect"), (16, "update")):
        assert predict(COSTS, workers + 1, 1, 10.0).bottleneck == bottleneck


def test_workers_share_the_cores_that_are_there() -> None:
    assert collecting_here(COSTS, workers=4, cores=2) == pytest.approx(4000 / (2 + 0.14))
    assert collecting_here(COSTS, workers=1, cores=2) == pytest.approx(1000 / 1.11)


@pytest.mark.parametrize(
    ("workers", "seconds", "expected"),
    [
        ([1, 2, 4], [0.3, 0.5, 0.9], (0.1, 0.2)),
        ([1, 2], [0.4, 0.2], (0.3, 0.0)),  # noise: no worker costs less than nothing
        ([1, 2, 3], [0.1, 0.3, 0.5], (0.0, 2.2 / 14)),
        ([2], [0.5], (0.0, 0.25)),
    ],
)
def test_the_line_of_exchanges(workers: list[int], seconds: list[float], expected: tuple[float, float]) -> None:
    assert exchange_line(workers, seconds) == pytest.approx(expected)
