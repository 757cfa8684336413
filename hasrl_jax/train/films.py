"""Films while a run trains: made by a process of its own, at the lowest priority, from a copy of the policy."""

import logging
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

from hasrl_jax.config.convert import from_dict
from hasrl_jax.config.schema import Config
from hasrl_jax.errors import CheckpointError
from hasrl_jax.learn import ppo
from hasrl_jax.policy.loading import policy_metadata
from hasrl_jax.runs import checkpoint
from hasrl_jax.runs.directory import FILMS_DIRECTORY

log = logging.getLogger("hasrl_jax")
LAST_FILM_S = 120.0  # how long the end of a run waits for a film that is being made


class Filmer:
    """Starts films, one at a time, and hands over those that are done; use as a context manager.

    A film that is due while another is being made is left out: collecting is never held up. Nothing that goes wrong
    here ends the run; the first failure is said and ends the filming.

    Args:
      run: the run directory; films are written to films/ in it.
      done: each is given the name and the path of every film.
      enabled: False films nothing: another process of the run does.
    """

    def __init__(self, run: Path, done: list[Callable[[str, Path], None]], enabled: bool = True):
        self._folder, self._done, self._failed = run / FILMS_DIRECTORY, done, not enabled
        self._process: subprocess.Popen[bytes] | None = None
        self._path = Path()

    def __enter__(self) -> "Filmer":
        return self

    def __exit__(self, *_: object) -> None:
        if self._process is not None:
            try:
                self._process.wait(LAST_FILM_S)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
            self.poll()

    def after(self, config: Config, learner: ppo.LearnerState, iteration: int) -> None:
        """Begins the film of this iteration's policy where one is due, unless another is still being made."""
        self.poll()
        every = config.video.every_iterations
        if not every or iteration % every or self._process is not None or self._failed:
            return
        self._path = self._folder / f"iteration_{iteration:06d}.mp4"
        policy = self._path.with_suffix(".npz")
        try:
            self._folder.mkdir(exist_ok=True)
            parameters = ppo.export_parameters(learner, config.network.normalize_observations)
            settings = from_dict({"run_dir": "", "stages": []}, config)
            checkpoint.save_policy(policy, parameters, policy_metadata(settings))
            with open(self._path.with_suffix(".log"), "wb") as output:
                self._process = subprocess.Popen(
                    self._command(config, policy),
                    stdin=subprocess.DEVNULL,
                    stdout=output,
                    stderr=output,
                    env=os.environ | {"JAX_PLATFORMS": "cpu"},  # the accelerator is the learner's
                    start_new_session=True,  # Ctrl-C is for the run, which lets the film be finished
                )
            os.setpriority(os.PRIO_PROCESS, self._process.pid, 19)
        except (OSError, CheckpointError) as error:
            self._give_up(str(error))

    def poll(self) -> None:
        """Hands over the film that is done, if one is."""
        if self._process is None or self._process.poll() is None:
            return
        failed, self._process = self._process.returncode, None
        output = self._path.with_suffix(".log")
        if failed:
            lines = output.read_text(errors="replace").strip().splitlines() if output.exists() else []
            self._give_up(lines[-1] if lines else f"exit status {failed}")
            return
        for leftover in (output, self._path.with_suffix(".npz")):
            leftover.unlink(missing_ok=True)
        for give in self._done:
            give("film", self._path)

    def _command(self, config: Config, policy: Path) -> list[str]:
        video = config.video
        size = ["--width", str(video.width), "--height", str(video.height), "--seconds", str(video.seconds)]
        names = ["--policy", str(policy), "--out", str(self._path), "--physics", "training"]
        return [sys.executable, "-m", "hasrl_jax.render", *names, *size]

    def _give_up(self, reason: str) -> None:
        self._failed = True
        log.warning("no more films: %s; training goes on", reason)
