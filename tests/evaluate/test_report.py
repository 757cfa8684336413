"""Files that hold what was measured so far."""

from pathlib import Path

import numpy as np
import pytest

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
    found = [report.digest([1], weights), report.digest([2], weights), *(report.digest([1], x) for x in others)]
    assert len(set(found)) == 4
    assert report.digest([1], dict(reversed(weights.items()))) == found[0]
