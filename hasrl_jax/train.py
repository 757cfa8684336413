"""The main job: collect, update, log, evaluate, save. `python -m hasrl_jax.train --backend=cpu_pool`."""

import logging
import signal
import sys
import time
from types import FrameType
from typing import NamedTuple

import jax
import numpy as np

from hasrl_jax import checkpoint, cli
from hasrl_jax.collect.cpu_pool import Collected, CpuPool, WorkerError
from hasrl_jax.collect.plan import Plan, make_plan
from hasrl_jax.config import Config
from hasrl_jax.envs.registry import make_task
from hasrl_jax.envs.task import Task
from hasrl_jax.evaluate import run_episodes
from hasrl_jax.learn import ppo
from hasrl_jax.learn.batching import pad_segments
from hasrl_jax.metrics import MetricsWriter, ProgressPrinter, Record
from hasrl_jax.run_directory import open_run
from hasrl_jax.types import Trajectory

log = logging.getLogger("hasrl_jax")
TEST_SEED = 1_000_003  # apart from every training stream


class Progress(NamedTuple):
    """Where a run stands; saved with every checkpoint."""

    iteration: int = 0  # iterations finished
    env_steps: int = 0  # environment steps collected
    seconds: float = 0.0  # spent training


def train(config: Config, resume: bool = False) -> None:
    """Runs or continues training until `total_env_steps`, Ctrl-C or SIGTERM."""
    task, plan, mesh = make_task(config), make_plan(config), ppo.make_mesh()
    sizes = (task.observation_size, task.action_size, task.mirror)
    learner = ppo.init_learner(config, *sizes, jax.random.key(config.seed))
    update = ppo.make_update(config, *sizes, mesh)
    progress, worker_states = Progress(), []
    with open_run(config, resume) as run, StopSignal() as stop:
        if resume:
            loaded = checkpoint.load(run.checkpoints, learner)
            learner, progress, worker_states = loaded.learner, Progress(**loaded.extra), loaded.blobs
        announce(config, plan, task, str(run.path), progress)
        with CpuPool(config, plan, task) as pool, MetricsWriter(run.path, progress.iteration) as writer:
            printer = ProgressPrinter(config.total_env_steps, progress.env_steps)
            pool.load(worker_states)
            parameters = ppo.export_parameters(learner)
            try:
                while progress.env_steps < config.total_env_steps and not stop.requested:
                    started = time.monotonic()
                    if not pool.busy:
                        pool.start(parameters, progress.iteration, version=progress.iteration)
                    collected = pool.finish()
                    enough = progress.env_steps + len(collected.fields["mask"]) >= config.total_env_steps
                    if config.schedule == "overlap" and not enough and not stop.requested:
                        pool.start(parameters, progress.iteration + 1, version=progress.iteration)
                    update_started = time.monotonic()
                    learner, result = update(learner, to_trajectory(collected, plan))
                    parameters = ppo.export_parameters(learner)  # waits for the update to finish
                    update_seconds = time.monotonic() - update_started

                    record = iteration_record(collected, progress, {k: float(v) for k, v in result.items()})
                    record |= {"update_seconds": update_seconds, "workers_lost": pool.workers_lost}
                    progress = Progress(
                        progress.iteration + 1,
                        progress.env_steps + len(collected.fields["mask"]),
                        progress.seconds + time.monotonic() - started,
                    )
                    if due(progress.iteration, config.evaluate.every_iterations) or enough:
                        record |= test_record(config, task, parameters)
                    record["env_steps_per_second"] = len(collected.fields["mask"]) / (time.monotonic() - started)
                    writer.write(record)
                    printer.update(record)
                    if due(progress.iteration, config.checkpoint.every_iterations):
                        save(config, run.checkpoints, progress, learner, pool)
            finally:
                save(config, run.checkpoints, progress, learner, pool)
                printer.close()
    log.info("%d environment steps in %d iterations; saved in %s", progress.env_steps, progress.iteration, run.path)


def to_trajectory(collected: Collected, plan: Plan) -> Trajectory:
    """The centralised buffer as trajectories padded on the right, in whole minibatches (paper III.B)."""
    rows = plan.rows * -(-len(collected.start) // plan.rows)
    version = np.full(len(collected.start), collected.version, np.int32)
    fields = collected.fields | {"initial_carry": collected.initial_carry, "policy_version": version}
    return pad_segments(fields, collected.start, collected.end, plan.max_length, rows)


def iteration_record(collected: Collected, progress: Progress, result: dict[str, float]) -> Record:
    """What is known of an iteration before the evaluation, under the names of the metrics file."""
    fields = collected.fields
    ended = fields["episode_length"] > 0
    terms = [statistics["reward_terms"] for statistics in collected.statistics]
    return {
        "iteration": progress.iteration + 1,
        "env_steps": progress.env_steps + len(fields["mask"]),
        "episode_return_train": float(fields["episode_return"][ended].mean()) if ended.any() else None,
        "episode_length_train": float(fields["episode_length"][ended].mean()) if ended.any() else None,
        **result,
        "policy_lag": progress.iteration - collected.version,
        "collect_seconds": collected.seconds,
        "diverged_envs": sum(statistics["diverged"] for statistics in collected.statistics),
        **{f"reward/{name}": float(np.mean([term[name] for term in terms])) for name in terms[0]},
    }


def test_record(config: Config, task: Task, parameters: dict[str, np.ndarray]) -> Record:
    """Return and length of evaluation episodes with the mean action."""
    started = time.monotonic()
    episodes = run_episodes(config, task, parameters, config.evaluate.episodes, seed=TEST_SEED)
    return {
        "episode_return_test": float(episodes.episode_return.mean()),
        "episode_length_test": float(episodes.episode_length.mean()),
        "test_seconds": time.monotonic() - started,
    }


def save(config: Config, directory, progress: Progress, learner: ppo.LearnerState, pool: CpuPool) -> None:
    """A checkpoint; the environments' state is part of it unless they are collecting meanwhile."""
    worker_states = [] if pool.busy else pool.save()
    checkpoint.save(directory, progress.iteration, learner, progress._asdict(), worker_states, config.checkpoint.keep)


def due(iteration: int, every: int) -> bool:
    return every > 0 and iteration % every == 0


def announce(config: Config, plan: Plan, task: Task, run_dir: str, progress: Progress) -> None:
    """The first lines of a run: what runs where, and how fast the physics is sampled."""
    devices = ", ".join(str(device) for device in jax.devices())
    log.info("task %s, backend %s, schedule %s, learner on %s", config.task, config.backend, config.schedule, devices)
    log.info(
        "%d workers x %d environments, %d environment steps per iteration; physics %.0f Hz, policy %.0f Hz",
        plan.num_workers,
        plan.envs_per_worker,
        plan.env_steps,
        1 / task.model.opt.timestep,
        1 / task.env_step_s,
    )
    log.info("run directory %s%s", run_dir, f", continuing after iteration {progress.iteration}" if progress.iteration else "")


class StopSignal:
    """Turns the first Ctrl-C or SIGTERM into a request to stop after this iteration; the second acts at once."""

    def __init__(self) -> None:
        self.requested = False
        self._previous: dict[int, object] = {}

    def __enter__(self) -> "StopSignal":
        for number in (signal.SIGINT, signal.SIGTERM):
            self._previous[number] = signal.signal(number, self._request)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)

    def _request(self, number: int, frame: FrameType | None) -> None:
        if self.requested:
            raise KeyboardInterrupt
        self.requested = True
        log.info("%s: finishing this iteration, then saving; once more stops at once", signal.Signals(number).name)


def main(argv: list[str] | None = None) -> int:
    cli.log_to_terminal()
    return cli.run(lambda: train(*cli.parse_train(sys.argv[1:] if argv is None else argv)))


if __name__ == "__main__":
    sys.exit(main())
