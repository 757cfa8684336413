"""The main job: collect, update, log, evaluate, save. `python -m hasrl_jax.train --backend=cpu_pool`."""

import logging
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import NamedTuple

import jax

from hasrl_jax import checkpoint, cli, distributed
from hasrl_jax.collect.cpu_pool import WorkerError
from hasrl_jax.collectors import Collector, Experience, make_collector, prepare_jax
from hasrl_jax.config import Config
from hasrl_jax.envs.registry import make_task
from hasrl_jax.envs.task import Task
from hasrl_jax.evaluate import run_episodes
from hasrl_jax.learn import ppo
from hasrl_jax.metrics import MetricsWriter, ProgressPrinter, Record, Silent
from hasrl_jax.run_directory import open_run, write_config

log = logging.getLogger("hasrl_jax")
TEST_SEED = 1_000_003  # apart from every training stream


class Progress(NamedTuple):
    """Where a run stands; saved with every checkpoint."""

    iteration: int = 0  # iterations finished, which is also the version of the parameters
    env_steps: int = 0  # environment steps collected
    seconds: float = 0.0  # spent training


def train(config: Config, resume: bool = False, make_update: Callable[..., ppo.Update] = ppo.make_update) -> None:
    """Runs or continues training until `total_env_steps`, Ctrl-C or SIGTERM.

    Args:
      config: the run's configuration.
      resume: continue the run in `config.run_dir`.
      make_update: makes the learner's program; benchmarks put another in its place.
    """
    prepare_jax(config)
    distributed.join(config)
    task, mesh = make_task(config), ppo.make_mesh()
    sizes = (task.observation_size, task.action_size, task.mirror)
    update, collector = make_update(config, *sizes, mesh), make_collector(config, task, mesh)
    reports = config.distributed.process_id == 0
    if config.distributed.num_processes > 1:
        collector = distributed.SharedExperience(config, collector, mesh)
    with distributed.ending_together(config), open_run(config, resume) as run, stop_signal() as stop:
        learner = ppo.init_learner(config, *sizes, jax.random.key(config.seed))
        progress, env_states = Progress(), []
        if resume:
            loaded = checkpoint.load(run.checkpoints, learner)
            learner, progress, env_states = loaded.learner, Progress(**loaded.extra), loaded.blobs
            if reports:
                write_config(run.path, config)  # some settings may differ from now on
        with (
            collector,
            MetricsWriter(run.path, progress.iteration) if reports else Silent() as writer,
            ProgressPrinter(config.total_env_steps, progress.env_steps) if reports else Silent() as printer,
        ):
            announce(config, collector, task, run.path, progress)
            collector.load(env_states)
            if not resume:
                save(config, run.checkpoints, progress, learner, [])  # whatever happens now, --resume has a beginning
            while progress.env_steps < config.total_env_steps and not distributed.any_process(config, bool(stop)):
                started = time.monotonic()
                if not collector.busy:
                    collector.start(learner, progress.iteration, version=progress.iteration)
                try:
                    experience = collector.finish()
                except WorkerError:
                    save(config, run.checkpoints, progress, learner, [])
                    raise
                env_steps = progress.env_steps + experience.env_steps
                if config.schedule == "overlap" and env_steps < config.total_env_steps and not stop:
                    collector.start(learner, progress.iteration + 1, version=progress.iteration)

                update_started = time.monotonic()
                learner, metrics = learn(update, learner, experience, progress.iteration + 1)
                now = time.monotonic()
                progress = Progress(progress.iteration + 1, env_steps, progress.seconds + now - started)
                record: Record = {
                    **{"iteration": progress.iteration, "env_steps": env_steps, "train_seconds": progress.seconds},
                    **experience.record,
                    **metrics,
                    "env_steps_per_second": experience.env_steps / (now - started),
                    "wait_seconds": update_started - started,
                    "update_seconds": now - update_started,
                }

                last = env_steps >= config.total_env_steps
                if reports and (due(progress.iteration, config.evaluate.every_iterations) or last):
                    record |= test_record(config, task, learner)
                writer.write(record)
                printer.update(record)
                if due(progress.iteration, config.checkpoint.every_iterations):
                    save(config, run.checkpoints, progress, learner, collector.save())
            if not due(progress.iteration, config.checkpoint.every_iterations):
                save(config, run.checkpoints, progress, learner, collector.save())
    log.info("%d environment steps in %d iterations; saved in %s", progress.env_steps, progress.iteration, run.path)


def learn(
    update: ppo.Update, learner: ppo.LearnerState, experience: Experience, iteration: int
) -> tuple[ppo.LearnerState, Record]:
    """One update, finished when this returns.

    Raises:
      FloatingPointError: it gave parameters that are not finite.
      LearnerError: it failed; the donated state is lost.
    """
    resume = "nothing of it is saved; use --resume"
    try:
        learner, result = update(learner, experience.trajectory, experience.replayed)
        record: Record = {name: float(value) for name, value in result.items()}  # waits for the update to finish
    except jax.errors.JaxRuntimeError as error:
        cause = str(error).partition("\n")[0]
        raise ppo.LearnerError(f"iteration {iteration}: the update failed ({cause}), and {resume}") from error
    if not record.pop("parameters_finite"):
        raise FloatingPointError(
            f"iteration {iteration}: the update gave parameters that are not finite, and {resume} with a lower "
            "ppo.policy_learning_rate"
        )
    return learner, record


def test_record(config: Config, task: Task, learner: ppo.LearnerState) -> Record:
    """Return and length of evaluation episodes with the mean action."""
    started = time.monotonic()
    parameters = ppo.export_parameters(learner, config.network.normalize_observations)
    episodes = run_episodes(config, task, parameters, config.evaluate.episodes, seed=TEST_SEED)
    return {
        "episode_return_test": float(episodes.episode_return.mean()),
        "episode_length_test": float(episodes.episode_length.mean()),
        "test_seconds": time.monotonic() - started,
    }


def save(
    config: Config, directory: Path, progress: Progress, learner: ppo.LearnerState, env_states: list[bytes]
) -> None:
    """A checkpoint with everything needed to continue; of several processes, the first one writes it."""
    if config.distributed.process_id == 0:
        checkpoint.save(directory, progress.iteration, learner, progress._asdict(), env_states, config.checkpoint.keep)


def due(iteration: int, every: int) -> bool:
    """Whether something done every so many iterations (0: never) is to be done after this one."""
    return every > 0 and iteration % every == 0


def announce(config: Config, collector: Collector, task: Task, run_dir: Path, progress: Progress) -> None:
    """The first lines of a run: what runs where, and how fast the physics is sampled."""
    devices = ", ".join(str(device) for device in jax.devices())
    log.info("task %s, backend %s, schedule %s, learner on %s", config.task, config.backend, config.schedule, devices)
    log.info(
        "%s; physics %.0f Hz, policy %.0f Hz",
        collector.description,
        1 / task.model.opt.timestep,
        1 / task.env_step_s,
    )
    after = f", continuing after iteration {progress.iteration}" if progress.iteration else ""
    log.info("run directory %s%s", run_dir, after)


class Stop:
    """True once a stop was requested."""

    requested = False

    def __bool__(self) -> bool:
        return self.requested


@contextmanager
def stop_signal() -> Iterator[Stop]:
    """Turns the first Ctrl-C, SIGTERM or SIGHUP into a request to stop after the iteration; the second acts at once."""
    stop = Stop()

    def request(number: int, frame: FrameType | None) -> None:
        if stop:
            raise KeyboardInterrupt
        stop.requested = True
        log.info("%s: finishing this iteration, then saving; once more stops at once", signal.Signals(number).name)

    numbers = [signal.SIGINT, signal.SIGTERM]
    if hasattr(signal, "SIGHUP") and signal.getsignal(signal.SIGHUP) != signal.SIG_IGN:  # nohup has it ignored
        numbers.append(signal.SIGHUP)
    previous = {number: signal.signal(number, request) for number in numbers}
    try:
        yield stop
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


def main(argv: list[str] | None = None) -> int:
    """The command line; returns the exit status."""
    cli.log_to_terminal()
    return cli.run(lambda: train(*cli.parse_train(sys.argv[1:] if argv is None else argv)))


if __name__ == "__main__":
    sys.exit(main())
