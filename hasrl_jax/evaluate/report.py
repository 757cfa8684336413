"""Reports that are measured row by row for hours: files that hold the rows so far, and what tells policies apart."""

import hashlib
import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from hasrl_jax.config.convert import flat, from_dict, to_dict
from hasrl_jax.config.schema import Config
from hasrl_jax.envs.cassie.settings import CassieConfig
from hasrl_jax.errors import ConfigError
from hasrl_jax.policy.numpy_networks import Parameters
from hasrl_jax.runs import durable


def read(path: Path) -> dict[str, Any]:
    """An earlier report; empty when there is none that can be read."""
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) and isinstance(found.get("policies"), dict) else {}


def write(report: dict[str, Any], path: Path) -> None:
    """The whole report or, where that fails or is interrupted, the earlier one."""
    partial = path.with_name(f".{path.name}")
    partial.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    durable.replace(partial, path)


def digest(configs: Iterable[Config], revision: int, parameters: Parameters) -> str:
    """Tells policies apart, and what they are played under.

    Args:
      configs: under which they are played; settings at their defaults do not count, so that one more changes nothing.
      revision: of what the rows are.
      parameters: of the policy.
    """
    played = [_departures(config) for config in configs]
    found = hashlib.sha256(json.dumps([revision, played], sort_keys=True).encode())
    for name in sorted(parameters):
        found.update(name.encode() + parameters[name].tobytes())
    return found.hexdigest()


def _departures(config: Config) -> dict[str, Any]:
    """The settings of the task, the physics and the networks that are not the defaults, by their dotted names."""
    usual = flat(to_dict(from_dict({"task": config.task})))
    kept = f"{config.section}.", "physics.", "network.", "collect.max_episode_steps"
    found = flat(to_dict(config))
    return {name: value for name, value in found.items() if name.startswith(kept) and usual.get(name) != value}


def refuse_other_tasks(policies: dict[str, tuple[Config, Parameters]], option: str, who: str) -> None:
    """Only policies of the walking task can be measured.

    Raises:
      ConfigError: there is another one; names `option`, and `who` can be measured.
    """
    for name, (config, _) in policies.items():
        if not isinstance(config.settings, CassieConfig):
            raise ConfigError(f"{option}: {name} is of task {config.task}; only {who}")
