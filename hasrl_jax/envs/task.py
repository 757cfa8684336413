"""What a task is: pure functions over arrays that both physics engines call.

A task never steps physics. An engine (`cpu_engine` or `mjx_engine`) does, and asks the task what to
apply, what to average over the physics steps, and what it all means. Every function takes `xp`,
the array module (`numpy` or `jax.numpy`), and accepts any leading batch axes, written `...` below; a lone environment
has none, and MJX maps over them.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import mujoco

from hasrl_jax.envs.layout import Entry, size
from hasrl_jax.errors import ConfigError
from hasrl_jax.types import Array, Mirror


class Reading(NamedTuple):
    """What the physics engine reports after one environment step."""

    qpos: Array  # [..., nq] positions after the last physics step
    qvel: Array  # [..., nv] velocities after the last physics step
    sensordata: Array  # [..., nsensordata] sensors of the last physics step
    averages: Array  # [..., F] mean over the physics steps of `Task.physics_features`


class Reset(NamedTuple):
    """A fresh episode."""

    state: Any  # the task's own NamedTuple of arrays [..., *]
    observation: Array  # [..., O]
    qpos: Array  # [..., nq]
    qvel: Array  # [..., nv]
    model_fields: dict[str, Array]  # MjModel field name -> its randomised value [..., *field shape]


class Transition(NamedTuple):
    """The outcome of one environment step."""

    state: Any
    observation: Array  # [..., O]
    reward: Array  # [...]
    terminated: Array  # [...] bool
    reward_terms: Array  # [..., R] weighted terms in the order of `Task.reward_terms`, summing to the reward
    measures: Array  # [..., M] what evaluation reports, in the order of `Task.measures`


class Command(NamedTuple):
    """One number that a robot can be told within an episode; its measures are `<name>_command` and `measure`."""

    name: str
    unit: str
    default: float  # where nothing is told
    drawn: tuple[float, float]  # range that episodes draw from
    limits: tuple[float, float]  # what is accepted
    measure: str  # the measure that follows it
    step: float  # by which a slider or a key changes it
    keys: str = ""  # "up-down" or "left-right": the arrow keys that change it; up and left are positive


@dataclass(frozen=True)
class Task:
    """One task: its model, sizes and functions."""

    name: str
    asset: Path  # MJCF file of the model, for a copy with its visual shapes
    model: mujoco.MjModel  # without visual shapes
    steps_per_env_step: int  # physics steps per environment step
    observation: tuple[Entry, ...]  # what the policy sees, in order
    action: tuple[Entry, ...]  # what it decides, in order
    reward_terms: tuple[str, ...]
    reset_uniforms: int  # uniform [0, 1) numbers that `reset` consumes
    reset: Callable[[Array, Any], Reset]  # (uniforms [..., reset_uniforms], xp)
    control: Callable[[Any, Array, Any], Array]  # (state, action [..., A], xp) -> ctrl [..., nu]
    step: Callable[[Any, Array, Reading, Array, Any], Transition]  # (state, action, reading, uniforms, xp)
    step_uniforms: int = 0  # uniform [0, 1) numbers that `step` consumes
    # (state, xp) -> the action [..., A] that still acts at the beginning of an environment step, and for how long, s
    delay: Callable[[Any, Any], tuple[Array, Array]] | None = None
    # (state, xp) -> factor on the physics step of the coming environment step [...]
    pace: Callable[[Any, Any], Array] | None = None
    measures: tuple[str, ...] = ()
    mirror: Mirror | None = None
    # (sensordata [..., ns], xp) -> [..., F]; nothing is averaged over physics steps by default
    physics_features: Callable[[Array, Any], Array] = lambda sensordata, xp: sensordata[..., :0]
    # sensors of which only the last physics step is read; `physics_features` finds nothing valid in their place
    end_sensors: tuple[str, ...] = ()
    force: Callable[[Any, Any], Array] | None = None  # (state, xp) -> force from outside on each qvel [..., nv]
    # puts ground that changes by episode into a copy of the model
    ground: Callable[[mujoco.MjSpec], None] | None = None
    disturbed: bool = True  # whether `force` acts by itself; otherwise only after `with_push`
    commands: tuple[Command, ...] = ()
    # (state, observation, command [..., C], xp) -> (state, observation): told from now to the end of the episode
    with_command: Callable[[Any, Array, Array, Any], tuple[Any, Array]] | None = None
    # (state, force [..., 2] in N along the world's x and y, xp) -> state: pushed from now for `push_s`
    with_push: Callable[[Any, Array, Any], Any] | None = None
    push_s: float = 0.0
    # further constants that a program needs to play a policy without this package, by name, ready for JSON
    player_constants: dict[str, Any] = field(default_factory=dict)

    @property
    def observation_size(self) -> int:
        """O: numbers that the policy sees."""
        return size(self.observation)

    @property
    def action_size(self) -> int:
        """A: numbers that it decides."""
        return size(self.action)

    @property
    def env_step_s(self) -> float:
        """Nominal duration of one environment step, seconds."""
        return self.model.opt.timestep * self.steps_per_env_step


def require_same_meaning(where: str, before: Task, after: Task) -> None:
    """Refuses settings under which the numbers of a policy would mean something else.

    Args:
      where: the settings, for the message.
      before: the task that the policy was trained for.
      after: the one that it is to go on with.

    Raises:
      ConfigError: names the quantities.
    """
    tables = {
        "the policy sees": (before.observation, after.observation),
        "the actions stand for": (before.action, after.action),
    }
    for what, (its, ours) in tables.items():
        if its != ours:
            names = ", ".join(sorted({entry.name for entry in set(its) ^ set(ours)}))
            raise ConfigError(f"{where}: this changes what {what} ({names}); begin another run, with --init-policy")
