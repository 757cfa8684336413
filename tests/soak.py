"""Long runs: whether memory, descriptors and threads stay where they are. `make soak`; docs/reliability.md has figures.

Trains the cart-pole through the real command line, 2,000 iterations in each schedule, and looks at the learner and its
workers all the while. Then times how soon a run with ten records, and one with 100,000, is open again. The exit status
is 1 when something grew. Arguments: schedules; none stands for all.
"""

import json
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

import psutil

from hasrl_jax.runs.metrics import MetricsWriter

ITERATIONS = 2000
STEPS = 128  # environment steps of an iteration
SCHEDULES = ("sync", "overlap", "decoupled")
OPTIONS = (
    *("--config", "cartpole", "--network.hidden-size", 8, "--ppo.epochs", 1, "--ppo.minibatch-trajectories", 8),
    *("--num-workers", 2, "--collect.envs-per-worker", 4, "--collect.env-steps-per-iteration", STEPS),
    *("--collect.unroll-length", 16, "--evaluate.every-iterations", 200, "--evaluate.episodes", 2),
    *("--checkpoint.every-iterations", 100, "--total-env-steps", ITERATIONS * STEPS),
)
EVERY_S = 0.5  # between two looks
MOST_GROWTH = 0.03  # of the memory, from the second quarter of a run to its last
LONG, SHORT = 100_000, 10  # records


class Look(NamedTuple):
    """The learner and its workers at one moment."""

    iteration: int
    learner_mib: float
    workers_mib: float  # of all of them
    descriptors: int  # of all processes
    threads: int


def look(learner: psutil.Process, metrics: Path) -> Look:
    """Raises psutil.Error when the run is over."""
    children = learner.children(recursive=True)
    workers = [child for child in children if "hasrl_jax.collect.worker" in child.cmdline()]
    with open(metrics, "rb") as file:
        file.seek(max(0, metrics.stat().st_size - 2**14))
        lines = [line for line in file.read().splitlines(keepends=True)[1:] if line.endswith(b"\n")]
    return Look(
        json.loads(lines[-1])["iteration"] if lines else 0,
        learner.memory_info().rss / 2**20,
        sum(worker.memory_info().rss for worker in workers) / 2**20,
        sum(process.num_fds() for process in (learner, *workers)),
        sum(process.num_threads() for process in (learner, *workers)),
    )


def run(schedule: str, directory: Path) -> list[Look]:
    """Trains to the end; what was seen of it."""
    command = ["-m", "hasrl_jax.train", *OPTIONS, "--schedule", schedule, "--run-dir", directory]
    looks: list[Look] = []
    path = directory.with_suffix(".log")
    with open(path, "w") as log:
        process = subprocess.Popen([sys.executable, *map(str, command)], stdout=log, stderr=log)
        while process.poll() is None:
            time.sleep(EVERY_S)
            try:
                looks.append(look(psutil.Process(process.pid), directory / "metrics.jsonl"))
            except (psutil.Error, OSError):  # not yet begun, or over
                continue
    if process.returncode:
        raise SystemExit(f"{path.read_text()[-2000:]}{schedule}: ended with status {process.returncode}")
    return looks


def judge(schedule: str, looks: list[Look], directory: Path) -> bool:
    """Prints a line; whether nothing grew and no iteration is missing."""
    records = [json.loads(line) for line in (directory / "metrics.jsonl").read_text().splitlines()]
    end = records[-1]["iteration"]
    quarter = [one for one in looks if 0.25 * end < one.iteration <= 0.5 * end]
    last = [one for one in looks if one.iteration > 0.75 * end]
    before, after = ([statistics.median(values) for values in zip(*part, strict=True)] for part in (quarter, last))
    names = Look._fields[1:]
    shown = ", ".join(f"{name} {a:.4g} -> {b:.4g}" for name, a, b in zip(names, before[1:], after[1:], strict=True))
    lost = records[-1]["workers_lost"]
    print(
        f"{schedule}: {end} iterations, {records[-1]['train_seconds']:.0f} s; {shown}; {lost} workers lost", flush=True
    )
    grew = any(b > (1 + MOST_GROWTH) * a for a, b in zip(before[1:3], after[1:3], strict=True))
    more = any(b > a for a, b in zip(before[3:], after[3:], strict=True))
    whole = [record["iteration"] for record in records] == list(range(1, end + 1))
    return not grew and not more and whole and not lost


def seconds_to_open(records: int, directory: Path) -> float:
    """Least time of five to open the metrics of a run with so many records where it ended."""
    directory.mkdir()
    values = {f"metric_{number}": number / 7 for number in range(40)}
    lines = (json.dumps({"iteration": number, **values}) + "\n" for number in range(1, records + 1))
    (directory / "metrics.jsonl").write_text("".join(lines))
    found = []
    for _ in range(5):
        began = time.perf_counter()
        MetricsWriter(directory, records).close()
        found.append(time.perf_counter() - began)
    return min(found)


def main(schedules: list[str]) -> int:
    flat = True
    with tempfile.TemporaryDirectory() as place:
        for schedule in schedules or SCHEDULES:
            directory = Path(place, schedule)
            flat &= judge(schedule, run(schedule, directory), directory)
        short, long = (seconds_to_open(records, Path(place, str(records))) for records in (SHORT, LONG))
    print(f"opened again: {SHORT} records in {1000 * short:.2f} ms, {LONG} in {1000 * long:.2f} ms")
    return 0 if flat else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
