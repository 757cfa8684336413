"""UniLab in `bench compare`: what share of its own physics limit it reaches, since it has no Cassie.

It runs in a virtual environment of its own, because it pins another MuJoCo, on a copy of its package: the robot's
meshes, which only pictures need, are loaded over the network and not part of it, so tetrahedra of the same names stand
in for them. Its G1 walks on flat ground with its PPO; times are those that it prints for every iteration.
"""

import os
import re
import shutil
import statistics
import struct
import subprocess
from pathlib import Path
from typing import NamedTuple

from hasrl_jax.errors import ConfigError, WorkerError
from hasrl_jax.policy.blas import ONE_THREAD

ROBOT = Path("assets/robots/g1")  # in its package
TIMESTEP_S, PHYSICS_STEPS = 0.02 / 3, 3  # of an environment step. Source: `sim_dt`, `ctrl_dt` of its G1 flat walk
STEPS_PER_ENV = 24  # of an iteration. Source: `num_steps_per_env` of its PPO
WARM_UP = 2  # iterations that are not counted
TIMES = re.compile(r"collection(?: time)?:\s*([\d.]+)\s*s\b.*?learning(?: time)?:?\s*([\d.]+)\s*s\b", re.I | re.S)


class Iteration(NamedTuple):
    """Seconds of one iteration."""

    collect: float
    learn: float


def measure(python: Path, folder: Path, num_envs: int, iterations: int, cores: int) -> dict:
    """Its speed, its limit, and its shares of it.

    Args:
      python: the interpreter of a virtual environment with the package `unilab[mujoco]`.
      folder: an empty folder for the copy of the package.
      num_envs: environments.
      iterations: that count.
      cores: processes of the limit.

    Raises:
      ConfigError: the package is not there.
      WorkerError: it does not run.
    """
    package = prepare(python, folder)
    before = limit(python, package, cores)
    found = train(python, folder, num_envs, iterations)
    after = limit(python, package, cores)
    steps, bound = num_envs * STEPS_PER_ENV, statistics.fmean((before, after))
    collect, learn = (statistics.median(times) for times in zip(*found, strict=True))
    return {
        "name": "unilab, G1",
        "num_envs": num_envs,
        **shares(steps / collect, steps / (collect + learn), bound),
        "limits": [before, after],
        "rounds": [iteration._asdict() for iteration in found],
        "version": version_of(python),
    }


def shares(collecting: float, end_to_end: float, bound: float) -> dict[str, float]:
    """Environment steps/s, and what part of the limit `bound` they are."""
    return {
        "limit_env_steps_per_second": bound,
        "collector_per_second": collecting,
        "env_steps_per_second": end_to_end,
        "collecting_share": collecting / bound,
        "end_to_end_share": end_to_end / bound,
    }


def prepare(python: Path, folder: Path) -> Path:
    """Copies the package to `folder`/src, where it also looks for its files, and puts in what it lacks."""
    source = ask(python, "import importlib.util as u; print(u.find_spec('unilab').submodule_search_locations[0])")
    package = folder / "src" / "unilab"
    shutil.copytree(source, package, ignore=shutil.ignore_patterns("__pycache__"))
    description = (package / ROBOT / "g1.xml").read_text(encoding="utf-8")
    meshes = package / ROBOT / "assets"
    meshes.mkdir(exist_ok=True)
    for name in re.findall(r'<mesh [^>]*file="([^"]+)"', description):
        if not (meshes / name).is_file():
            (meshes / name).write_bytes(tetrahedron())
    return package


def tetrahedron(side_m: float = 0.02) -> bytes:
    """A binary STL file."""
    corners = [(0.0, 0.0, 0.0), (side_m, 0.0, 0.0), (0.0, side_m, 0.0), (0.0, 0.0, side_m)]
    faces = [(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)]
    body = b"".join(
        struct.pack("<12fH", 0.0, 0.0, 0.0, *(x for corner in face for x in corners[corner]), 0) for face in faces
    )
    return bytes(80) + struct.pack("<I", len(faces)) + body


def limit(python: Path, package: Path, processes: int, seconds: float = 4.0) -> float:
    """Environment steps per second of bare `mj_step` in so many processes."""
    script, model = Path(__file__).with_name("unilab_limit.py"), package / ROBOT / "scene_flat.xml"
    command = [str(python), str(script), str(model), str(TIMESTEP_S), str(PHYSICS_STEPS), str(seconds)]
    running = [
        subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=os.environ | ONE_THREAD)
        for _ in range(processes)
    ]
    rate = 0.0
    for process in running:
        output, _ = process.communicate()
        if process.returncode:
            raise WorkerError(f"--unilab: the limit of its model ended with status {process.returncode}")
        env_steps, spent = map(float, output.split())
        rate += env_steps / spent
    return rate


def train(python: Path, folder: Path, num_envs: int, iterations: int) -> list[Iteration]:
    """The times of its PPO's iterations after the first ones."""
    start = "import sys; from unilab.cli import train_main; sys.exit(train_main(sys.argv[1:]))"
    options = ["--algo", "ppo", "--task", "g1_walk_flat", "--sim", "mujoco", "--render-mode", "none"]
    settings = [f"algo.num_envs={num_envs}", f"algo.max_iterations={iterations + WARM_UP}", "training.device=cpu"]
    found = subprocess.run(
        [str(python), "-c", start, *options, *settings],
        cwd=folder,
        env=os.environ | {"PYTHONPATH": str(folder / "src")},
        capture_output=True,
        text=True,
        check=False,
    )
    times = parse(found.stdout)
    if found.returncode or len(times) <= WARM_UP:
        last = (found.stderr or found.stdout).strip().splitlines()[-1:]
        raise WorkerError(f"--unilab: training ended with status {found.returncode}: {' '.join(last)}")
    return times[WARM_UP:]


def parse(output: str) -> list[Iteration]:
    """The times that its training prints, in order."""
    return [Iteration(float(collect), float(learn)) for collect, learn in TIMES.findall(output)]


def version_of(python: Path) -> str:
    """Of its package."""
    return ask(python, "from importlib import metadata; print(metadata.version('unilab'))")


def ask(python: Path, code: str) -> str:
    """What `code` prints under the interpreter."""
    try:
        found = subprocess.run([str(python), "-c", code], capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        raise ConfigError(
            f'--unilab: got {python}; expected the Python of a virtual environment with "unilab[mujoco]"'
        ) from None
    return found.stdout.strip()
