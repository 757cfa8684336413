"""Films while a run trains."""

import json
import os
import subprocess
import sys
from pathlib import Path

import imageio_ffmpeg
import pytest
from tiny import tiny_yaml

from hasrl_jax.visualize import opengl

TINY = tiny_yaml(
    collect={"num_workers": 1},
    evaluate={"every_iterations": 0},
    video={"every_iterations": 2, "seconds": 0.5, "width": 64, "height": 64},
    total_env_steps=384,
)


def train(folder: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    (folder / "tiny.yaml").write_text(TINY)
    command = [sys.executable, "-m", "hasrl_jax.train", "--config", str(folder / "tiny.yaml"), "--run-dir"]
    return subprocess.run(
        [*command, str(folder / "run")], env=os.environ | environment, capture_output=True, text=True, timeout=300
    )


@pytest.mark.skipif(opengl.choose() is None, reason="no OpenGL here")
def test_a_run_films_its_policy(tmp_path: Path) -> None:
    done = train(tmp_path)
    assert done.returncode == 0, done.stderr
    films = tmp_path / "run" / "films"
    assert sorted(path.name for path in films.iterdir()) == ["iteration_000002.mp4", "iteration_000002.png"]
    frames, seconds = imageio_ffmpeg.count_frames_and_secs(str(films / "iteration_000002.mp4"))
    assert seconds == pytest.approx(0.5, abs=0.1) and frames > 5


def test_a_film_that_cannot_be_made_does_not_end_the_run(tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "films").write_text("in the way")
    done = train(tmp_path)
    assert done.returncode == 0, done.stderr
    assert "no more films: " in done.stderr and done.stderr.count("no more films") == 1
    records = [json.loads(line) for line in (tmp_path / "run" / "metrics.jsonl").read_text().splitlines()]
    assert records[-1]["env_steps"] == 384
