"""Every field of metrics.jsonl is described, and every described field is written by some run."""

import json
from pathlib import Path

import numpy as np
import pytest
from tiny import tiny

from hasrl_jax.collect.mjx import Statistics, mjx_record
from hasrl_jax.config.convert import from_dict
from hasrl_jax.runs.fields import FIELDS, name_of
from hasrl_jax.train.loop import train

TINY = tiny(
    total_env_steps=256,
    collect={"num_workers": 1, "envs_per_worker": 4},
    evaluate={"every_iterations": 1, "episodes": 1},
)


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> set[str]:
    """The fields of the records of a run of each schedule, and of the MJX backend."""
    found: set[str] = set()
    for schedule in ("sync", "decoupled"):
        run_dir = tmp_path_factory.mktemp(schedule) / "run"
        train(from_dict(TINY | {"schedule": schedule, "run_dir": str(run_dir)}))
        for line in Path(run_dir, "metrics.jsonl").read_text().splitlines():
            found |= json.loads(line).keys()
    statistics = Statistics(**{name: np.ones(1 if name == "reward_terms" else ()) for name in Statistics._fields})
    return found | mjx_record(statistics, ("upright",)).keys()


def test_every_field_is_described(written: set[str]) -> None:
    assert {name_of(name) for name in written} <= FIELDS.keys()


def test_every_described_field_is_written(written: set[str]) -> None:
    assert FIELDS.keys() <= {name_of(name) for name in written}
