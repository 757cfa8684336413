"""Installs a wheel in an empty environment outside the checkout, and uses it: `python tools/try_wheel.py dist`.

Nothing of the checkout but the wheel and `requirements.lock` is seen. Used are train, evaluate, export, render, the
page of the viewer, gymnasium. Ends with the first command that fails.
"""

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import urllib.request
import venv
from pathlib import Path

LOCK = Path(__file__).parents[1] / "requirements.lock"
SMALL = (
    *("--network.hidden-size", "8", "--ppo.epochs", "1", "--ppo.minibatch-trajectories", "8"),
    *("--collect.env-steps-per-iteration", "128", "--collect.unroll-length", "16", "--collect.envs-per-worker", "4"),
    *("--num-workers", "1", "--total-env-steps", "256", "--evaluate.episodes", "1"),
)
GYMNASIUM = """
import gymnasium, hasrl_jax
env = gymnasium.make("hasrl_jax/Cassie-v0")
observation, _ = env.reset(seed=0)
observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
assert observation.shape == (50,) and "reward/velocity" in info
print(hasrl_jax.__file__)
"""


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("dist", type=Path, help="a folder that holds one wheel")
    parser.add_argument("--need-films", action="store_true", help="fail where no OpenGL library can render")
    known = parser.parse_args()
    (wheel,) = known.dist.resolve().glob("*.whl")
    with tempfile.TemporaryDirectory() as folder:
        use(wheel, Path(folder), known.need_films)
    print(f"{wheel.name}: installed and used")


def use(wheel: Path, folder: Path, need_films: bool) -> None:
    """Installs the wheel below `folder`, and goes through what it offers there."""
    venv.create(folder / "env", with_pip=True)
    programs = folder / "env" / "bin"
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}

    def run(*command: str) -> str:
        print("$", *command, flush=True)
        return subprocess.run(
            [programs / command[0], *command[1:]],
            cwd=folder,
            env=environment,
            check=True,
            stdout=subprocess.PIPE,
            text=True,
        ).stdout

    run("pip", "install", "-q", "-c", str(LOCK), f"{wheel}[viewer]")
    version = wheel.name.split("-")[1]
    assert run("hasrl", "--version").strip() == version
    place = run("python", "-c", GYMNASIUM).strip()
    assert Path(place).is_relative_to(folder / "env"), f"imported from {place}, not from the wheel"
    print(run("hasrl", "doctor"))
    run("hasrl", "train", "--config", "cartpole", "--run-dir", "run", *SMALL)
    run("hasrl", "train", "--resume", "run", "--total-env-steps", "384")
    run("hasrl", "evaluate", "--run-dir", "run", "--episodes", "2", "--seconds", "1", "--json", "figures.json")
    assert json.loads((folder / "figures.json").read_text())
    run("hasrl", "export", "--run-dir", "run", "--out", "policy.npz")
    run("hasrl", "evaluate", "--policy", "policy.npz", "--episodes", "1", "--seconds", "1")
    for kind in ("", "-steer", "-fast", "-stairs", "-imitate", "-gaits"):
        released = f"released{kind}"
        run("hasrl", "evaluate", "--policy", released, "--episodes", "1", "--seconds", "1", "--physics", "training")
    run("hasrl", "figures", "curve", "--run-dir", "run", "--out", "curve.png")
    if "True" in run("python", "-c", "from hasrl_jax.visualize import opengl; print(opengl.choose() is not None)"):
        run("hasrl", "demo", "--headless", "--seconds", "0.5", "--out", "demo.mp4")
        assert (folder / "demo.mp4").stat().st_size > 1000
    elif need_films:
        sys.exit("no OpenGL library can render here")
    see_page([programs / "hasrl", "viewer", "--port", "0"], folder, environment)


def see_page(command: list[str | Path], folder: Path, environment: dict[str, str]) -> None:
    """Starts the viewer, fetches its page, and ends it with Ctrl-C."""
    print("$", *command, flush=True)
    viewer = subprocess.Popen(command, cwd=folder, env=environment, stdout=subprocess.PIPE, text=True)
    try:
        assert viewer.stdout
        line = viewer.stdout.readline()  # "open ADDRESS (this machine only); ..."
        with urllib.request.urlopen(line.split()[1], timeout=30) as answer:
            assert answer.status == 200
        viewer.send_signal(signal.SIGINT)
        assert viewer.wait(30) == 0
    finally:
        viewer.kill()


if __name__ == "__main__":
    main()
