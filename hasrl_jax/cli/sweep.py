"""`hasrl sweep`: trains again and again with settings that Optuna proposes, each run in a process of its own.

The space is a YAML file: what to vary, and how.

    ppo.policy_learning_rate: {log: [1.0e-4, 3.0e-3]}
    ppo.clip: {uniform: [0.1, 0.3]}
    ppo.epochs: {int: [2, 8]}
    network.hidden_size: {choice: [32, 64, 128]}

The study lies in the folder of the sweep; the same command goes on with it.
"""

import argparse
import importlib.util
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from hasrl_jax.cli.options import OneLineParser
from hasrl_jax.cli.parsing import log_to_terminal, run
from hasrl_jax.cli.train import parse_train
from hasrl_jax.config import strict_yaml
from hasrl_jax.config.limits import shown
from hasrl_jax.errors import ConfigError, RunError
from hasrl_jax.runs.directory import METRICS_FILE
from hasrl_jax.visualize.sweep_page import Trial, page

STUDY_FILE, PAGE_FILE = "study.db", "sweep.html"
LAST_ITERATIONS = 10  # the value of a trial is the mean of its metric over so many of its last ones
POLL_S = 0.5
WARM_UP_TRIALS = 4  # whole trials before any is pruned
FAILURES = 3  # in a row that end the sweep: a full disk fails every trial, and failed ones do not count as trials
Space = dict[str, tuple[str, list[Any]]]  # field -> (kind, its bounds or choices)

# kind -> (trial, field, values) -> value
KINDS: dict[str, Callable[[Any, str, list[Any]], Any]] = {
    "uniform": lambda trial, name, values: trial.suggest_float(name, *values),
    "log": lambda trial, name, values: trial.suggest_float(name, *values, log=True),
    "int": lambda trial, name, values: trial.suggest_int(name, *values),
    "choice": lambda trial, name, values: trial.suggest_categorical(name, values),
}


def sweep(arguments: list[str]) -> None:
    """The command.

    Raises:
      ConfigError: an impossible argument.
      RunError: the first trial failed, or `FAILURES` in a row.
    """
    known, train_arguments = _parse(arguments)
    space = read_space(known.space)
    for name, (_, values) in space.items():  # now, and not in the middle of the night
        for value in values:
            parse_train([*train_arguments, option(name, value)])
    import optuna

    optuna.logging.set_verbosity(optuna.logging.WARNING)
    known.out.mkdir(parents=True, exist_ok=True)
    study = optuna.create_study(
        storage=f"sqlite:///{known.out.resolve() / STUDY_FILE}",
        study_name="sweep",
        load_if_exists=True,
        direction="minimize" if known.minimize else "maximize",
        sampler=optuna.samplers.TPESampler(seed=known.seed),
        pruner=optuna.pruners.NopPruner() if known.no_pruning else optuna.pruners.MedianPruner(WARM_UP_TRIALS),
    )
    states = optuna.trial.TrialState
    for trial in study.get_trials(deepcopy=False, states=(states.RUNNING,)):  # of a sweep that was ended
        study.tell(trial.number, state=states.FAIL)
    failed = 0  # in a row
    while (done := len(study.get_trials(deepcopy=False, states=(states.COMPLETE, states.PRUNED)))) < known.trials:
        trial = study.ask()
        trial_run = known.out / f"trial_{trial.number:04d}"
        trial.set_user_attr("run", str(trial_run))
        options = [option(name, KINDS[kind](trial, name, values)) for name, (kind, values) in space.items()]
        print(f"trial {trial.number}: {' '.join(options)}", flush=True)
        outcome, value = states.FAIL, None
        try:
            outcome, value = train_trial([*train_arguments, *options], trial_run, trial, known.metric, states)
        finally:
            study.tell(trial, value if outcome is states.COMPLETE else None, state=outcome)
            write_page(study, known)
        print(
            f"trial {trial.number}: {outcome.name.lower()} {'' if value is None else format(value, '.4g')}", flush=True
        )
        failed = failed + 1 if outcome is states.FAIL else 0
        if failed and (not done or failed == FAILURES):
            which = "the first trial" if not done else f"{FAILURES} trials in a row"
            raise RunError(f"{trial_run}: {which} failed; the output is in {trial_run}.log")
    print(f"{known.out / PAGE_FILE}: best {study.best_value:.4g} with {study.best_params}")


def train_trial(arguments: list[str], run_dir: Path, trial: Any, metric: str, states: Any) -> tuple[Any, float | None]:
    """Trains in a process of its own, and stops it where the trial is to be pruned: (state, value)."""
    command = [sys.executable, "-m", "hasrl_jax.train", *arguments, "--run-dir", str(run_dir)]
    values: list[float] = []
    steps = 0
    with open(f"{run_dir}.log", "wb") as output:
        process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=output, stderr=output)
        try:
            while process.poll() is None:
                time.sleep(POLL_S)
                for iteration, value in new_values(run_dir / METRICS_FILE, metric, steps):
                    steps = iteration
                    values.append(value)
                    trial.report(float(np.mean(values[-LAST_ITERATIONS:])), iteration)
                    if trial.should_prune():
                        process.send_signal(signal.SIGTERM)  # it saves, and can be continued by hand
                        process.wait()
                        return states.PRUNED, None
        finally:
            if process.poll() is None:
                process.terminate()
                process.wait()
    values += [value for _, value in new_values(run_dir / METRICS_FILE, metric, steps)]
    if process.returncode or not values:
        return states.FAIL, None
    return states.COMPLETE, float(np.mean(values[-LAST_ITERATIONS:]))


def new_values(path: Path, metric: str, after: int) -> Iterator[tuple[int, float]]:
    """(iteration, value) of every whole record behind iteration `after` that has the metric."""
    if not path.is_file():
        return
    for line in path.read_text(encoding="utf-8").splitlines():
        try:
            record = json.loads(line)
        except ValueError:  # it is being written
            return
        if record["iteration"] > after and record.get(metric) is not None:
            yield record["iteration"], record[metric]


def write_page(study: Any, known: argparse.Namespace) -> None:
    """Writes the page of a study."""
    trials = [
        Trial(
            number=trial.number,
            state=trial.state.name.lower(),
            value=trial.value if trial.value is not None else next(reversed(trial.intermediate_values.values()), None),
            settings=trial.params,
            run=os.path.relpath(trial.user_attrs.get("run", ""), known.out),
        )
        for trial in study.get_trials(deepcopy=False)
    ]
    (known.out / PAGE_FILE).write_text(page(known.metric, not known.minimize, trials), encoding="utf-8")


def option(name: str, value: Any) -> str:
    """A setting as an argument of `hasrl train`."""
    return f"--{name.replace('_', '-')}={value}"


def read_space(path: Path) -> Space:
    """What to vary.

    Raises:
      ConfigError: the file cannot be read, or an entry is not one of KINDS with its values.
    """
    try:
        space = strict_yaml.parse(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ConfigError(f"--space {path}: cannot be read ({' '.join(str(error).split())})") from None
    if not isinstance(space, dict) or not space:
        raise ConfigError(
            f"--space {path}: got {shown(space)}; expected fields, as in ppo.clip: {{uniform: [0.1, 0.3]}}"
        )
    found: Space = {}
    for name, given in space.items():
        entry: dict[str, Any] = given if isinstance(given, dict) and len(given) == 1 else {"": None}
        ((kind, values),) = entry.items()
        fits = isinstance(values, list) and bool(values)
        if fits and kind != "choice":
            numbers = all(isinstance(value, int | float) for value in values)
            fits = numbers and len(values) == 2 and values[0] < values[1]
        if kind not in KINDS or not fits:
            expected = f"one of {', '.join(KINDS)} with [low, high], or the choices"
            raise ConfigError(f"--space {path}: {name}: got {shown(given)}; expected {expected}")
        found[name] = (kind, values)
    return found


def _parse(arguments: list[str]) -> tuple[argparse.Namespace, list[str]]:
    parser = OneLineParser(
        prog="hasrl sweep",
        description=__doc__,
        epilog="everything else is given to `hasrl train`: --config, --task, --init-policy, single fields",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.add_argument("--space", type=Path, required=True, help="YAML file of what to vary")
    parser.add_argument("--out", type=Path, required=True, help="folder of the sweep: study, runs, page")
    parser.add_argument("--trials", type=int, default=20, help="complete or pruned ones, those of before included")
    parser.add_argument("--metric", default="episode_return_train", help="of metrics.jsonl")
    parser.add_argument("--minimize", action="store_true", help="the metric is to be low")
    parser.add_argument("--no-pruning", action="store_true", help="train every trial to its end")
    parser.add_argument("--seed", type=int, default=0, help="of what is proposed")
    known, rest = parser.parse_known_args(arguments)
    if known.trials < 1:
        raise ConfigError(f"--trials: got {known.trials}; expected at least 1")
    if importlib.util.find_spec("optuna") is None:
        raise ConfigError('sweep: optuna is not installed; pip install "hasrl_jax[sweep]"')
    for name in ("--run-dir", "--resume"):
        if any(argument.partition("=")[0].replace("_", "-") == name for argument in rest):
            raise ConfigError(f"{name}: a sweep chooses the directory of each of its runs; leave it out")
    return known, rest


def main(argv: list[str] | None = None) -> int:
    """Entry point; returns the exit status."""
    log_to_terminal()
    return run(lambda: sweep(sys.argv[1:] if argv is None else argv))
