"""The main job: collect, update, log, evaluate, save."""

import logging
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any, NamedTuple

import jax
from jax.sharding import Mesh

from hasrl_jax.collect.backends import make_collector
from hasrl_jax.collect.protocol import Collector, Experience, Networks
from hasrl_jax.config import curriculum
from hasrl_jax.config.schema import Config
from hasrl_jax.envs.registry import make_task
from hasrl_jax.envs.task import Task, require_same_meaning
from hasrl_jax.errors import CheckpointError, DivergenceError, LearnerError, RunError, WorkerError
from hasrl_jax.evaluate.rollout import run_episodes
from hasrl_jax.learn import ppo
from hasrl_jax.learn.networks import make_networks
from hasrl_jax.policy import loading as policies
from hasrl_jax.runs import checkpoint
from hasrl_jax.runs.directory import CONFIG_FILE, RunDirectory, open_run, write_config
from hasrl_jax.runs.metrics import MetricsWriter, NullLogger, ProgressPrinter
from hasrl_jax.runs.trackers import Trackers, require_installed
from hasrl_jax.train import distributed
from hasrl_jax.train.devices import prepare_jax
from hasrl_jax.train.films import Filmer
from hasrl_jax.types import Mirror, Record

log = logging.getLogger("hasrl_jax")
EVALUATION_SEED = 1_000_003  # apart from every training stream


class Progress(NamedTuple):
    """Where a run stands; saved with every checkpoint."""

    iteration: int = 0  # iterations finished, which is also the version of the parameters
    env_steps: int = 0  # environment steps collected
    seconds: float = 0.0  # spent training
    stage: int = 0  # stages that have begun
    history: dict[str, list[float]] = {}  # noqa: RUF012 (of metrics that stages wait for; never changed in place)


class RunState(NamedTuple):
    """All that a checkpoint holds."""

    learner: ppo.LearnerState
    progress: Progress = Progress()
    env_states: Sequence[bytes] = ()  # empty: episodes begin anew


class Part(NamedTuple):
    """The run between two stages."""

    config: Config
    task: Task
    update: ppo.Update
    collector: Collector  # only that of the part in which a run begins or goes on is entered


def train(
    config: Config,
    resume: bool = False,
    init_policy: str | None = None,
    make_update: Callable[..., ppo.Update] = ppo.make_update,
) -> None:
    """Runs or continues training until `total_env_steps`, Ctrl-C or SIGTERM, through the stages of its curriculum.

    Args:
      config: the run's configuration.
      resume: continue the run in `config.run_dir`.
      init_policy: a policy file, a run directory or "released", whose parameters a new run starts from.
      make_update: makes the learner's program; benchmarks put another in its place.
    """
    require_installed(config)
    with stop_signal() as stop:
        prepare_jax(config)
        distributed.join(config)
        parts = make_parts(config, make_update)  # also refuses what cannot work
        learner = ppo.init_learner(config, *sizes(parts[0].task), jax.random.key(config.seed))
        if init_policy:
            learner = policies.with_parameters(learner, policies.load_initial(config, init_policy))
        with distributed.ending_together(config), open_run(config, resume) as run:
            _run(parts, RunState(learner), run, resume, stop)


def _run(parts: list[Part], state: RunState, run: RunDirectory, resume: bool, stop: "Stop") -> None:
    """Trains in an open run directory."""
    config = parts[0].config
    reports = config.distributed.process_id == 0
    if resume:
        loaded = checkpoint.load(run.checkpoints, state.learner, set_aside=reports)
        state = RunState(loaded.learner, progress_from(loaded.extra, config), loaded.blobs)
        if reports:
            write_config(run.path, config)  # some settings may differ from now on
    else:
        try:
            save(config, run.checkpoints, state)  # whatever happens now, --resume has a beginning
        except CheckpointError:
            (run.path / CONFIG_FILE).unlink(missing_ok=True)  # it holds no run yet: the same command may be given again
            raise
    with (
        MetricsWriter(run.path, state.progress.iteration) if reports else NullLogger() as writer,
        ProgressPrinter(config.total_env_steps, state.progress.env_steps) if reports else NullLogger() as printer,
        Trackers(config, run.path) if reports else NullLogger() as trackers,
        Filmer(run.path, [trackers.attach, printer.attach], reports) as filmer,
    ):
        trackers.attach("config", run.path / CONFIG_FILE)
        state = run_iterations(parts, state, run, stop, [writer.write, trackers.write, printer.update], filmer)
    progress = state.progress
    log.info("%d environment steps in %d iterations; saved in %s", progress.env_steps, progress.iteration, run.path)


def make_parts(config: Config, make_update: Callable[..., ppo.Update]) -> list[Part]:
    """What each part of the run needs; nothing starts or compiles yet.

    Parts whose learner has the same settings share one update, and so one compiled program.

    Raises:
      ConfigError: the settings do not fit together, or this machine, or a stage changes what the parameters mean.
    """
    mesh, parts = ppo.make_mesh(), list[Part]()
    for index, part_config in enumerate(curriculum.resolve(config)):
        task = make_task(part_config)
        if parts:
            require_same_meaning(f"stages[{index - 1}].set", parts[0].task, task)
        shares_update = parts and parts[-1].config.ppo == part_config.ppo  # stages change nothing else that it reads
        update = parts[-1].update if shares_update else make_update(part_config, *sizes(task), mesh)
        parts.append(Part(part_config, task, update, make_part_collector(part_config, task, mesh)))
    return parts


def make_part_collector(config: Config, task: Task, mesh: Mesh) -> Collector:
    """The collector of one process, or of all together.

    Raises:
      ConfigError: the settings do not fit together, or this machine.
    """
    networks = Networks(*make_networks(config.network, *sizes(task)))
    collector = make_collector(config, task, mesh, networks)
    if config.distributed.num_processes > 1:
        return distributed.SharedExperience(config, collector, mesh)
    return collector


def progress_from(extra: dict[str, Any], config: Config) -> Progress:
    """Where a checkpoint says that the run stands."""
    return Progress(**extra | {"stage": curriculum.begun(config, extra)})


def run_iterations(
    parts: list[Part],
    state: RunState,
    run: RunDirectory,
    stop: "Stop",
    report: list[Callable[[Record], None]],
    filmer: Filmer,
) -> RunState:
    """Collects and learns until the run ends or `stop` is true; returns what it saved.

    Args:
      parts: from `make_parts`.
      state: where the run stands.
      run: takes the checkpoints.
      stop: asked after every iteration.
      report: given the metrics of every iteration.
      filmer: films the policy where `video` asks for it.
    """
    learner, progress, env_states = state
    stages = curriculum.Stages(parts[0].config.stages, progress.stage, progress.history)
    collecting = stages.current  # the part whose settings the collector has
    with parts[collecting].collector as collector:
        announce(parts[collecting], collector, run.path, progress)
        collector.load(list(env_states))
        while not ended(parts[0].config, progress) and not distributed.any_process(parts[0].config, bool(stop)):
            part = parts[stages.current]
            config, started = part.config, time.monotonic()
            try:
                if not collector.busy:
                    if collecting != stages.current:
                        collector.configure(config, part.task)
                        collecting = stages.current
                    collector.start(acting_parameters(config, learner), progress.iteration, version=progress.iteration)
                experience = collector.finish()
            except WorkerError:
                save_what_is_finished(config, run.checkpoints, RunState(learner, progress))
                raise
            share = progress.env_steps / config.total_env_steps
            progress = progress._replace(env_steps=progress.env_steps + experience.env_steps)
            goes_on = not ended(config, progress) and not stop and not stages.due(progress.env_steps)
            if config.schedule == "overlap" and goes_on and collecting == stages.current:
                collector.start(acting_parameters(config, learner), progress.iteration + 1, version=progress.iteration)

            update_started = time.monotonic()
            learner, metrics = learn(part.update, learner, experience, share, progress.iteration + 1)
            now = time.monotonic()
            seconds = progress.seconds + now - started
            progress = progress._replace(iteration=progress.iteration + 1, seconds=seconds)
            record: Record = {
                **{"iteration": progress.iteration, "env_steps": progress.env_steps, "train_seconds": seconds},
                **{"stage": progress.stage, **experience.record, **metrics},
                "env_steps_per_second": experience.env_steps / (now - started),
                "wait_seconds": update_started - started,
                "update_seconds": now - update_started,
            }
            filmer.after(config, learner, progress.iteration)
            due_for_evaluation = due(progress.iteration, config.evaluate.every_iterations)
            if config.distributed.process_id == 0 and (due_for_evaluation or ended(config, progress)):
                record |= evaluation_record(config, part.task, learner)
            try:
                for give in report:
                    give(record)
            except RunError:
                save_what_is_finished(config, run.checkpoints, RunState(learner, progress))
                raise
            if distributed.first_process(config, stages.reached(progress.env_steps, record)):
                stages.begin()
                log.info("stage %d begins at %s environment steps", stages.current, f"{progress.env_steps:,}")
                learner = begin_stage(learner, config, parts[stages.current].config)
            progress = progress._replace(stage=stages.current, history=stages.history)
            if due(progress.iteration, config.checkpoint.every_iterations):
                save(config, run.checkpoints, RunState(learner, progress, collector.save()))
        state = RunState(learner, progress, collector.save())
        if not due(progress.iteration, parts[0].config.checkpoint.every_iterations):
            save(parts[0].config, run.checkpoints, state)
    return state


def begin_stage(learner: ppo.LearnerState, before: Config, after: Config) -> ppo.LearnerState:
    """The learner under the settings of another stage, of which it holds one itself."""
    if after.network.initial_log_std == before.network.initial_log_std:
        return learner  # which may have begun with another, that of `--init-policy`
    return ppo.with_deviation(learner, after.network.initial_log_std)


def ended(config: Config, progress: Progress) -> bool:
    """Whether the run has collected all that it was to collect."""
    return progress.env_steps >= config.total_env_steps


def acting_parameters(config: Config, learner: ppo.LearnerState) -> dict[str, jax.Array]:
    """What the collector acts with."""
    return ppo.acting_parameters(learner, config.network.normalize_observations)


def sizes(task: Task) -> tuple[int, int, Mirror | None]:
    """What the networks are made from."""
    return task.observation_size, task.action_size, task.mirror


def learn(
    update: ppo.Update, learner: ppo.LearnerState, experience: Experience, share: float, iteration: int
) -> tuple[ppo.LearnerState, Record]:
    """One update, finished when this returns.

    Args:
      update: the program.
      learner: donated.
      experience: to learn from.
      share: of the run's environment steps, collected before.
      iteration: for messages.

    Raises:
      DivergenceError: it gave parameters that are not finite.
      LearnerError: it failed; the donated state is lost.
    """
    resume = "nothing of it is saved; use --resume"
    try:
        learner, result = update(learner, experience.trajectory, experience.replayed, share)
        record: Record = {name: float(value) for name, value in result.items()}  # waits for the update to finish
    except jax.errors.JaxRuntimeError as error:
        cause = str(error).partition("\n")[0]
        raise LearnerError(f"iteration {iteration}: the update failed ({cause}), and {resume}") from error
    if not record.pop("parameters_finite"):
        raise DivergenceError(
            f"iteration {iteration}: the update gave parameters that are not finite, and {resume} with a lower "
            "ppo.policy_learning_rate"
        )
    return learner, record


def evaluation_record(config: Config, task: Task, learner: ppo.LearnerState) -> Record:
    """Return and length of evaluation episodes with the mean action."""
    started = time.monotonic()
    parameters = ppo.export_parameters(learner, config.network.normalize_observations)
    episodes = run_episodes(config, task, parameters, config.evaluate.episodes, seed=EVALUATION_SEED)
    return {
        "eval_return": float(episodes.episode_return.mean()),
        "eval_length": float(episodes.episode_length.mean()),
        "eval_seconds": time.monotonic() - started,
    }


def save(config: Config, directory: Path, state: RunState) -> None:
    """A checkpoint with everything needed to continue; of several processes, the first one writes it."""
    learner, progress, env_states = state
    keep = config.checkpoint.keep
    if config.distributed.process_id == 0:
        checkpoint.save(directory, progress.iteration, learner, progress._asdict(), list(env_states), keep)


def save_what_is_finished(config: Config, directory: Path, state: RunState) -> None:
    """A checkpoint on the way out; that it fails, too, must not hide why the run ends."""
    try:
        save(config, directory, state)
    except CheckpointError as error:
        log.warning("%s", error)


def due(iteration: int, every: int) -> bool:
    """Whether something done every so many iterations (0: never) is to be done after this one."""
    return every > 0 and iteration % every == 0


def announce(part: Part, collector: Collector, run_dir: Path, progress: Progress) -> None:
    """The first lines of a run: what runs where, and how fast the physics is sampled."""
    config, task, *_ = part
    devices = ", ".join(str(device) for device in jax.devices())
    log.info("task %s, backend %s, schedule %s, learner on %s", config.task, config.backend, config.schedule, devices)
    log.info(
        "%s; physics %.0f Hz, policy %.0f Hz",
        collector.description,
        1 / task.model.opt.timestep,
        1 / task.env_step_s,
    )
    after = f", continuing after iteration {progress.iteration}" if progress.iteration else ""
    stage = f", stage {progress.stage} of {len(config.stages)}" if config.stages else ""
    log.info("run directory %s%s%s", run_dir, after, stage)


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
