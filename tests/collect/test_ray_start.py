"""What is said when Ray does not start; needs no Ray."""

from types import SimpleNamespace

import pytest

from hasrl_jax.collect.ray.cluster import connect
from hasrl_jax.config.schema import RayConfig
from hasrl_jax.errors import WorkerError


def test_a_start_that_takes_too_long_is_one_line() -> None:
    """Ray says so with an exception of no class of its own."""

    def too_slow(**_: object) -> None:
        raise Exception("The current node timed out during startup.\nThis could happen because")

    ray = SimpleNamespace(is_initialized=lambda: False, init=too_slow)
    expected = r"^Ray does not start here \(The current node timed out during startup. This could happen because\)$"
    with pytest.raises(WorkerError, match=expected):
        connect(ray, RayConfig(), num_workers=1, bytes_per_worker=1)
