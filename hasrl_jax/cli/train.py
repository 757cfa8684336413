"""`hasrl train`: a configuration from a file, a run or the task's recipe, then dotted overrides, then the run."""

import sys
from pathlib import Path

from hasrl_jax.cli.options import OneLineParser
from hasrl_jax.cli.parsing import log_to_terminal, option_name, override, run
from hasrl_jax.config import curriculum
from hasrl_jax.config.convert import from_dict
from hasrl_jax.config.files import load_yaml, recipe
from hasrl_jax.config.schema import Config
from hasrl_jax.envs.registry import make_task
from hasrl_jax.envs.task import require_same_meaning
from hasrl_jax.errors import ConfigError
from hasrl_jax.runs.directory import load_run_config
from hasrl_jax.train.loop import train


def parse_train(arguments: list[str]) -> tuple[Config, bool, str | None]:
    """The configuration of a run, whether it continues one, and the policy that it starts from.

    `--config FILE` reads a YAML file, or one of `configs/` by name (default: the recipe of the task), `--resume DIR`
    the configuration of that run; `--init-policy SOURCE` names a policy file, a run directory or "released";
    everything else overrides single fields, `--ppo.clip 0.1`.

    Raises:
      ConfigError: an impossible value; RunError: `--resume` names no run.
    """
    parser = OneLineParser(prog="python -m hasrl_jax.train", add_help=False, allow_abbrev=False)
    parser.add_argument("--config", default=None, metavar="FILE")
    parser.add_argument("--resume", type=Path, default=None, metavar="DIR")
    parser.add_argument("--init-policy", default=None, metavar="SOURCE")
    parser.add_argument("--task", default=None)
    known, rest = parser.parse_known_args(arguments)
    for name in ("config", "init_policy", "task"):
        if getattr(known, name) == "":
            raise ConfigError(f"--{name.replace('_', '-')}: got an empty text; leave it out, or name one")
    if known.init_policy and known.resume:
        raise ConfigError("--init-policy and --resume: give one of them; a resumed run goes on with its own policy")
    if known.config and known.resume:
        raise ConfigError("--config and --resume: give one of them; a resumed run brings its own configuration")
    if known.resume and any(option_name(argument) == "--run-dir" for argument in rest):
        raise ConfigError("--resume and --run-dir: give only --resume; a resumed run goes on in its own directory")
    if known.resume:
        base = load_run_config(known.resume)
        if known.task not in (None, base.task):
            raise ConfigError(f"--task: got {known.task}; {known.resume} is a run of task {base.task}")
    elif known.config:
        base = load_yaml(known.config, known.task)
    else:
        base = recipe(known.task or Config().task)
    config = override(base, rest, "train")
    curriculum.resolve(config)  # refuses stages that cannot work
    if known.resume:
        _require_same_meaning(base, config)
        config = from_dict({"run_dir": str(known.resume)}, config)
    return config, known.resume is not None, known.init_policy


def _require_same_meaning(trained: Config, config: Config) -> None:
    """Refuses settings under which the parameters of a run would mean something else.

    Raises:
      ConfigError: names the setting.
    """
    for name in ("normalize_observations", "symmetric", "learn_std"):
        its, ours = getattr(trained.network, name), getattr(config.network, name)
        if its != ours:
            raise ConfigError(f"network.{name}: got {ours}; this run has learnt with {its}, so leave it at that")
    require_same_meaning(config.section, make_task(trained), make_task(config))


def main(argv: list[str] | None = None) -> int:
    """The command line; returns the exit status."""
    log_to_terminal()
    return run(lambda: train(*parse_train(sys.argv[1:] if argv is None else argv)))
