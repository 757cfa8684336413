"""What a terminal shows of a run."""

import subprocess
import sys

import pytest
from rich.console import Console

from hasrl_jax.cli.completion import script
from hasrl_jax.cli.main import PROGRAMS
from hasrl_jax.runs import dashboard
from hasrl_jax.runs.dashboard import Machine


def test_the_view_says_what_the_record_says() -> None:
    history = dashboard.History()
    for value in (1.0, 4.5, 8.0):
        record = {"episode_return_train": value, "episode_length_train": None, "env_steps_per_second": 6000.0}
        history.add(record)
    record |= {"wait_seconds": 3.0, "update_seconds": 1.0, "env_steps": 250, "workers_lost": 2}
    console = Console(width=100, record=True, file=open("/dev/null", "w"))  # noqa: SIM115
    console.print(dashboard.view(record, history, Machine(4, 2.25, 7.0), "films/a.mp4", 1000, "0:01:00 left"))
    lines = console.export_text().splitlines()
    assert lines[0].split() == ["return", "8.0", "▁▅█"]
    assert lines[1].split() == ["length", "-"]
    assert lines[2].split()[:2] == ["steps/s", "6,000"]
    assert "waiting for data 75%, update 25%" in lines[3] and "evaluation" not in lines[3]
    assert "4, 2 replaced" in lines[4] and "memory 2.2 GB, 7.0 GB free" in lines[4]
    assert lines[5].split() == ["film", "films/a.mp4"]
    assert lines[6].split()[-3:] == ["25%", "0:01:00", "left"]


def test_curves_stay_within_their_bounds() -> None:
    assert dashboard.curve([]) == "" and dashboard.curve([2.0, 2.0]) == "▁▁"
    assert dashboard.curve([-1.0, 0.0, 6.0]) == "▁▂█"


def test_the_machine_counts_the_processes_of_the_run() -> None:
    before = dashboard.machine()
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as child:
        during = dashboard.machine()
        child.communicate(b"\n")
    assert during.processes == before.processes + 1 and during.memory_gb > before.memory_gb > 0.01


@pytest.mark.parametrize(
    ("typed", "expected", "never"),
    [
        (["hasrl", "tr"], "train", "viewer"),
        (["hasrl", "train", "--ppo.cl"], "--ppo.clip", "--ppo.epochs"),
        (["hasrl", "train", "--cassie.reward.hip"], "--cassie.reward.hip-roll", "--cassie.reward.scale"),
        (["hasrl", "train", "--config", "smo"], "smoke", "paper"),
        (["hasrl", "train", "--task", "cart"], "cartpole", "cassie"),
        (["hasrl", "evaluate", "--s"], "--scorecard", "--stages"),
        (["hasrl", "viewer", "--policy", "released-s"], "released-steer", "released"),
        (["hasrl", "sweep", "--s"], "--space", "--scorecard"),
    ],
)
def test_bash_completes(typed: list[str], expected: str, never: str) -> None:
    ask = f"COMP_WORDS=({' '.join(typed)}); COMP_CWORD={len(typed) - 1}; _hasrl; echo ${{COMPREPLY[@]}}"
    done = subprocess.run(["bash", "-c", script("bash", PROGRAMS) + ask], capture_output=True, text=True, check=True)
    assert expected in done.stdout.split() and never not in done.stdout.split()
