"""`hasrl demo`: a page that is opened, or a film."""

import webbrowser
from pathlib import Path

import pytest

from hasrl_jax.cli import main, viewer
from hasrl_jax.visualize import opengl


def test_a_film_without_a_screen(tmp_path: Path) -> None:
    if opengl.choose() is None:
        pytest.skip(opengl.MISSING)
    out = tmp_path / "demo.mp4"
    assert main.main(["demo", "--headless", "--seconds", "0.2", "--out", str(out)]) == 0
    assert out.stat().st_size > 1000
    assert out.with_suffix(".png").exists()


@pytest.mark.parametrize(("arguments", "opened"), [([], True), (["--no-open"], False)])
def test_the_page_is_opened(arguments: list[str], opened: bool, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    pytest.importorskip("viser")
    addresses: list[str] = []
    monkeypatch.setattr(webbrowser, "open", addresses.append)

    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(viewer, "loop", interrupted)
    assert main.main(["demo", "--port", "0", *arguments]) == 0
    shown = capsys.readouterr().out
    assert len(addresses) == opened
    assert all(f"open {address} " in shown for address in addresses)


def test_an_unknown_policy_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("viser")
    assert main.main(["demo", "--policy", "nobody", "--no-open"]) == 1
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and "released-steer" in error
