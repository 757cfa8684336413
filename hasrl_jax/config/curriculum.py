"""A curriculum: settings that change when a run has collected so many environment steps, or can do so much.

    stages:
      - at_env_steps: 4_000_000
        set: {cassie.command.forward_m_s: [-0.3, 2.0]}
      - at_env_steps: 6_000_000
        wait_for: {episode_length_train: 350}
        set: {cassie.randomize.enabled: true}

What a stage sets stays set. A stage with `wait_for` begins when each metric, averaged over its last ten values, has
also reached its value; the stages behind it wait as well.
"""

import dataclasses
from collections import deque
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from hasrl_jax.config.checks import check
from hasrl_jax.config.convert import flat, from_dict
from hasrl_jax.config.limits import named
from hasrl_jax.config.schema import Config, StageConfig
from hasrl_jax.errors import ConfigError
from hasrl_jax.types import Record

# what a stage may change besides the task's own settings
CHANGEABLE = ("physics", "ppo", "evaluate", "network.initial_log_std")
WINDOW = 10  # values of a metric that are averaged
NOW_AND_THEN = "eval_"  # how the metrics begin that not every iteration has


def resolve(config: Config) -> list[Config]:
    """The configuration of every part of the run: before the first stage, and from each stage on.

    Raises:
      ConfigError: a stage is out of order, sets nothing, or leads to impossible settings; names the stage.
    """
    resolved, begin = [config], 0
    for index, stage in enumerate(config.stages):
        name = f"stages[{index}]"
        if stage.at_env_steps <= begin:
            raise ConfigError(f"{name}.at_env_steps: got {stage.at_env_steps}; expected more than {begin}")
        if not flat(stage.set):
            raise ConfigError(f"{name}.set: got nothing; expected fields and values, {{ppo.clip: 0.1}}")
        begin = stage.at_env_steps
        resolved.append(_apply(stage.set, resolved[-1], name))
    return resolved


def begun(config: Config, extra: Mapping[str, Any]) -> int:
    """How many stages have begun where a checkpoint says that a run stands; those of version 0.1 do not name it."""
    return int(extra.get("stage", sum(stage.at_env_steps <= extra["env_steps"] for stage in config.stages)))


def in_force(config: Config, stage: int) -> Config:
    """What a policy was trained with last, once `stage` stages of its run have begun; there are none left in it."""
    return dataclasses.replace(resolve(config)[stage], stages=())


class Stages:
    """Finds out when the next stage begins.

    Args:
      stages: of the run.
      current: the part that the run is in: 0 before the first stage, i from stage i - 1 on.
      history: the last values of each metric that stages wait for, as `history` returned them.
    """

    def __init__(self, stages: tuple[StageConfig, ...], current: int, history: Mapping[str, Iterable[float]]):
        self._stages, self.current = stages, current
        names = {name for stage in stages for name in stage.wait_for}
        self._history = {name: deque(history.get(name, ()), maxlen=WINDOW) for name in sorted(names)}

    def reached(self, env_steps: int, record: Record) -> bool:
        """Takes the metrics of an iteration; whether another stage begins with it. One iteration, one stage.

        Raises:
          ConfigError: a stage waits for a metric that there is none of.
        """
        for name, values in self._history.items():
            if name not in record and not name.startswith(NOW_AND_THEN):
                raise ConfigError(f"stages: wait_for names {name!r}, which is no metric; known are {', '.join(record)}")
            value = record.get(name)
            if value is not None:
                values.append(float(value))
        if self.current == len(self._stages):
            return False
        stage = self._stages[self.current]
        return env_steps >= stage.at_env_steps and all(
            len(self._history[name]) == WINDOW and np.mean(self._history[name]) >= least
            for name, least in stage.wait_for.items()
        )

    def begin(self) -> None:
        """The stage that was reached begins."""
        self.current += 1

    def due(self, env_steps: int) -> bool:
        """Whether the next stage begins after the present iteration, whatever its metrics."""
        following = self._stages[self.current :][:1]
        return any(env_steps >= stage.at_env_steps and not stage.wait_for for stage in following)

    @property
    def history(self) -> dict[str, list[float]]:
        """What a checkpoint keeps."""
        return {name: list(values) for name, values in self._history.items()}


def _apply(changes: dict[str, Any], config: Config, name: str) -> Config:
    """`config` with some fields replaced, and checked."""
    before = config
    changeable = (*([config.section] if config.section else []), *CHANGEABLE)
    fields = [field for part in changes.items() for field in flat(dict([part]))]
    for field in fields:
        if fields.count(field) > 1:
            raise ConfigError(f"{name}.set: {named(field)} is given twice")
        if not any(field == known or field.startswith(f"{known}.") for known in changeable):
            which = ", ".join(changeable)
            raise ConfigError(f"{name}.set: {named(field)} cannot change during a run; {which} settings can")
    for field, value in changes.items():
        for part in reversed(field.split(".")):
            value = {part: value}
        try:
            config = from_dict(value, config)
        except ConfigError as error:
            raise ConfigError(f"{name}.set: {error}") from None
    try:
        check(config)
    except ConfigError as error:
        raise ConfigError(f"{name}.set: {error}") from None
    if config.network.learn_std and config.network != before.network:
        raise ConfigError(f"{name}.set: network.initial_log_std: a stage can set it where network.learn_std is false")
    if not np.isclose(config.physics.env_step_s, before.physics.env_step_s):
        raise ConfigError(
            f"{name}.set: physics.timestep_s times steps_per_env_step is {config.physics.env_step_s:g} s; expected "
            f"{before.physics.env_step_s:g} s, as before"
        )
    return config
