"""`bench parity`: how closely MJX follows C MuJoCo from the same states, actions and draws; see `engine_parity`."""

import argparse
from dataclasses import replace
from pathlib import Path

from hasrl_jax.bench import engine_parity as parity
from hasrl_jax.bench.report import claim_file
from hasrl_jax.config.checks import check
from hasrl_jax.config.convert import from_dict
from hasrl_jax.config.files import load_yaml
from hasrl_jax.errors import ConfigError
from hasrl_jax.train.devices import prepare_jax


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the comparison."""
    parser.add_argument("--config", type=Path, metavar="FILE", help="task and physics; default: the config's defaults")
    parser.add_argument("--states", type=int, default=64, metavar="N", help="random states, each with its own actions")
    parser.add_argument(
        "--horizons", type=int, nargs="+", default=list(parity.HORIZONS), metavar="N", help="environment steps"
    )
    parser.add_argument("--seed", type=int, default=0, help="of states, actions and draws")
    parser.add_argument("--impl", choices=("jax", "warp"), default="jax", help="implementation of MJX")
    parser.add_argument("--solver-iterations", type=int, metavar="N", help="instead of the configuration's")
    parser.add_argument(
        "--double", action="store_true", help="MJX in float64: leaves differences of model, not rounding"
    )
    parser.add_argument("--markdown", type=Path, metavar="FILE", help="where to write the table")


def measure(arguments: argparse.Namespace) -> dict:
    """The report of `parity.measure`.

    Raises:
      ConfigError: an impossible argument.
    """
    for name, smallest in (("states", arguments.states), ("horizons", min(arguments.horizons))):
        if smallest < 1:
            raise ConfigError(f"--{name}: got {smallest}; expected at least 1")
    if arguments.seed < 0:
        raise ConfigError(f"--seed: got {arguments.seed}; expected 0 or more")
    if arguments.double and arguments.impl == "warp":
        raise ConfigError("--double: Warp computes in float32 only; leave it out")
    config = load_yaml(arguments.config) if arguments.config else from_dict({})
    if arguments.solver_iterations is not None:
        config = replace(config, physics=replace(config.physics, solver_iterations=arguments.solver_iterations))
    check(config)
    if arguments.markdown:
        claim_file(arguments.markdown)
    prepare_jax(replace(config, backend="mjx"))
    horizons = tuple(sorted(set(arguments.horizons)))
    report = parity.measure(config, arguments.states, horizons, arguments.seed, arguments.impl, arguments.double)
    if arguments.markdown:
        arguments.markdown.write_text(parity.to_markdown(report), encoding="utf-8")
    return report


def tables(figures: dict) -> str:
    """The Markdown table."""
    return parity.to_markdown(figures)
