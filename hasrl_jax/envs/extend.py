"""A task made from another one: with reward terms or commands of your own, and nothing edited.

    SPEC = extended(CASSIE, settings=Settings, terms={"calm_hips": calm_hips})

is a `TaskSpec` like any other: `--task my_file:SPEC` trains it, and its settings are found under the name of the first.
"""

import dataclasses
from collections import namedtuple
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from hasrl_jax.config.schema import Config
from hasrl_jax.config.tasks import TaskSpec
from hasrl_jax.envs import layout
from hasrl_jax.envs.draws import between
from hasrl_jax.envs.layout import SAME, Entry
from hasrl_jax.envs.task import Command, Reading, Reset, Task, Transition
from hasrl_jax.types import Array

HELD = "added_command"  # of the state: the numbers of the added commands, [..., C]


class Step(NamedTuple):
    """An environment step, as a term or a measure of your own sees it; leading axes [...]."""

    state: Any  # the task's own, before the step
    action: Array  # [..., A]
    reading: Reading  # what the physics reported
    transition: Transition  # what the task without your additions made of it
    command: dict[str, Array]  # your commands by name, each [...]


Function = Callable[[Step, Any], Array]  # (step, xp) -> [...]


class AddedCommand(NamedTuple):
    """A number that episodes draw once, the policy sees and anyone can tell; the last entry of the observation."""

    name: str  # the settings have a range of this name, from which it is drawn
    unit: str
    measured: Function  # what is to follow it; a measure of its own, `<name>_measured`
    default: float = 0.0  # where nothing is told
    limits: tuple[float, float] = (-10.0, 10.0)  # what is accepted
    mirror: tuple[float] = SAME  # `layout.NEGATED` where left and right swap its sign
    step: float = 0.1  # by which a slider changes it


def extended(
    spec: TaskSpec,
    settings: type | None = None,
    terms: Mapping[str, Function] | None = None,
    commands: Sequence[AddedCommand] = (),
) -> TaskSpec:
    """A task with additions.

    Args:
      spec: the task that is added to.
      settings: its settings with fields of yours: a frozen dataclass that inherits from `spec.settings`, with the
        weight of every term and the range of every command under their names.
      terms: each is multiplied by its weight and added to the reward.
      commands: each is drawn, seen and told like those that the task has.
    """
    make = partial(_make, spec, dict(terms or {}), tuple(commands))
    return dataclasses.replace(spec, make=make, settings=settings or spec.settings)


def _make(spec: TaskSpec, terms: dict[str, Function], commands: tuple[AddedCommand, ...], config: Config) -> Task:
    task: Task = spec.make(config)
    if commands:
        task = _with_commands(task, commands, config.settings)
    return _with_terms(task, terms, commands, config.settings)


def _with_terms(task: Task, terms: dict[str, Function], commands: tuple[AddedCommand, ...], settings: Any) -> Task:
    """`task` with further reward terms, and with the measures of its added commands."""

    def step(state: Any, action: Array, reading: Reading, uniforms: Array, xp: Any) -> Transition:
        done = task.step(state, action, reading, uniforms, xp)
        told = {command.name: getattr(state, HELD)[..., index] for index, command in enumerate(commands)}
        seen = Step(state, action, reading, done, told)
        added = [getattr(settings, name) * term(seen, xp) for name, term in terms.items()]
        measures = [value for c in commands for value in (c.measured(seen, xp), told[c.name])]
        return done._replace(
            reward=done.reward + sum(added),
            reward_terms=_beside(done.reward_terms, added, xp),
            measures=_beside(done.measures, measures, xp),
        )

    names = [name for command in commands for name in (f"{command.name}_measured", f"{command.name}_command")]
    return dataclasses.replace(
        task, step=step, reward_terms=(*task.reward_terms, *terms), measures=(*task.measures, *names)
    )


def _with_commands(task: Task, added: tuple[AddedCommand, ...], settings: Any) -> Task:
    """`task` whose state has one more field, `HELD`, and whose observation ends with it."""
    own = type(task.reset(np.zeros(task.reset_uniforms), np).state)
    # The fields of the task's own state, so that its other functions read this one as theirs.
    make_type: Any = namedtuple  # with names that no type checker knows
    state_of = make_type(f"{own.__name__}WithCommands", (*own._fields, HELD))
    sizes = len(task.commands), task.observation_size

    def put(state: Any, observation: Array, held: Array, xp: Any) -> tuple[Any, Array]:
        return state_of(*state[: len(own._fields)], held), xp.concatenate([observation, held], axis=-1)

    def reset(uniforms: Array, xp: Any) -> Reset:
        fresh = task.reset(uniforms[..., : task.reset_uniforms], xp)
        drawn = uniforms[..., task.reset_uniforms :]
        held = layout.columns([between(drawn[..., i], getattr(settings, c.name)) for i, c in enumerate(added)], xp)
        state, observation = put(fresh.state, fresh.observation, held, xp)
        return fresh._replace(state=state, observation=observation)

    def step(state: Any, action: Array, reading: Reading, uniforms: Array, xp: Any) -> Transition:
        done = task.step(own(*state[: len(own._fields)]), action, reading, uniforms, xp)
        following, observation = put(done.state, done.observation, getattr(state, HELD), xp)
        return done._replace(state=following, observation=observation)

    def with_command(state: Any, observation: Array, command: Array, xp: Any) -> tuple[Any, Array]:
        count, seen = sizes
        if task.with_command is not None:
            state, first = task.with_command(state, observation[..., :seen], command[..., :count], xp)
        else:
            first = observation[..., :seen]
        return put(state, first, command[..., count:], xp)

    entries = tuple(Entry(f"{c.name}_command", c.unit, c.mirror, mean=c.default) for c in added)
    observation = (*task.observation, *entries)
    declared = tuple(
        Command(c.name, c.unit, c.default, getattr(settings, c.name), c.limits, f"{c.name}_measured", c.step)
        for c in added
    )
    return dataclasses.replace(
        task,
        observation=observation,
        mirror=layout.mirror(observation, task.action) if task.mirror else None,
        reset_uniforms=task.reset_uniforms + len(added),
        reset=reset,
        step=step,
        commands=(*task.commands, *declared),
        with_command=with_command,
    )


def _beside(values: Array, added: list[Array], xp: Any) -> Array:
    """`values` [..., n] followed by arrays [...]."""
    return xp.concatenate([values, layout.columns(added, xp)], axis=-1) if added else values
