"""Files that hold what was measured so far."""

from pathlib import Path

import numpy as np
import pytest

from hasrl_jax.config.convert import from_dict, to_dict
from hasrl_jax.evaluate import report
from hasrl_jax.runs import durable

KEPT = {"policies": {"one": ["a row"]}}


@pytest.mark.parametrize("text", [None, "", '{"policies": ', "[1]", '{"policies": []}', "\x00"])
def test_what_is_no_report_counts_as_none(text: str | None, tmp_path: Path) -> None:
    path = tmp_path / "report.json"
    if text is not None:
        path.write_text(text)
    assert report.read(path) == {}


def test_an_interrupted_write_leaves_the_earlier_report(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    path = tmp_path / "report.json"
    report.write(KEPT, path)
    assert report.read(path) == KEPT and [p.name for p in tmp_path.iterdir()] == ["report.json"]
    with monkeypatch.context() as patched:
        patched.setattr(durable, "replace", interrupt)
        with pytest.raises(KeyboardInterrupt):
            report.write({"policies": {}}, path)
    assert report.read(path) == KEPT


def test_a_digest_tells_settings_and_every_parameter_apart() -> None:
    weights = {"a": np.zeros(2), "b": np.ones(2)}
    others = [weights | {"b": np.zeros(2)}, {"a": np.zeros(2), "c": np.ones(2)}]
    config, wider = from_dict({}), from_dict({"cassie": {"action_range_rad": 1.2}})
    found = [report.digest([config], 1, x) for x in (weights, *others)]
    found += [report.digest(configs, 1, weights) for configs in ([wider], [config, config])]
    assert len({*found, report.digest([config], 2, weights)}) == 6
    assert report.digest([config], 1, dict(reversed(weights.items()))) == found[0]


def test_a_digest_does_not_see_what_is_not_played_and_what_stands_at_its_default(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    weights, config = {"a": np.zeros(2)}, from_dict({"cassie": {"action_range_rad": 1.2}})
    found = report.digest([config], 1, weights)
    other = {"run_dir": "elsewhere", "ppo": {"clip": 0.1}, "collect": {"num_workers": 99}}
    assert report.digest([from_dict(other, config)], 1, weights) == found
    monkeypatch.setattr(report, "to_dict", lambda settings: {**to_dict(settings), "physics": {"of_a_later_version": 1}})
    assert report.digest([config], 1, weights) == found
