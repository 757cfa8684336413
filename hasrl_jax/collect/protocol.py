"""The ways to collect behind one interface, so that the training loop cannot tell them apart."""

from typing import Any, NamedTuple, Protocol

from hasrl_jax.config.schema import Config
from hasrl_jax.envs.task import Task
from hasrl_jax.types import Array, Record, Trajectory

Parameters = dict[str, Array]  # on the learner's devices, named as in `policy.numpy_networks.parameter_shapes`


class Experience(NamedTuple):
    """What one iteration learns from."""

    trajectory: Trajectory  # [B, T, ...]
    env_steps: int  # collected since the last one
    record: Record  # metrics of the collection
    replayed: bool = False  # an earlier iteration learnt from the same trajectories


class Networks(NamedTuple):
    """The networks that collectors on the accelerator act with, as Flax modules."""

    policy: Any  # (observation, carry, is_first, mean, std) -> (mean action, carry); method log_std() -> [A]
    value: Any  # (observation, mean, std) -> value


class Collector(Protocol):
    """What the training loop asks of a collector.

    Making one only checks the configuration; entering its context starts what collects, leaving it frees everything.
    """

    description: str  # one line for the start of a run

    @property
    def busy(self) -> bool:
        """Between `start` and `finish`."""

    def start(self, parameters: Parameters, iteration: int, version: int) -> None:
        """Asks for one iteration's experience with these parameters; returns at once.

        The parameters may be donated to the update as soon as it returns.
        """

    def finish(self) -> Experience:
        """Waits for what `start` asked for."""

    def configure(self, config: Config, task: Task) -> None:
        """Goes on under changed settings of the task; not between `start` and `finish`.

        Episodes go on where the state of the environments keeps its shapes, and begin anew elsewhere.
        """

    def save(self) -> list[bytes]:
        """The state of the environments, for a checkpoint; empty while they are being stepped."""

    def load(self, states: list[bytes]) -> None:
        """Restores what `save` returned."""

    def __enter__(self) -> "Collector": ...

    def __exit__(self, *error: object) -> None: ...
