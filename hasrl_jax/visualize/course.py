"""Courses: what a robot that is steered is told, one leg after the other."""

from typing import TYPE_CHECKING, NamedTuple

from hasrl_jax.errors import ConfigError

if TYPE_CHECKING:
    from hasrl_jax.envs.task import Command

SLICE_S = 0.25  # every leg lasts a multiple of it


class Leg(NamedTuple):
    """Commands by name and for how long they hold; what is not named takes its default."""

    seconds: float
    told: dict[str, float]


def _weave(speed: float, rate: float, leg_s: float, turns: int) -> list[Leg]:
    """Turns to the left and to the right in alternation; the first and the last are half as long."""
    sides = [1 if turn % 2 else -1 for turn in range(turns)]
    halves = [0.5, *[1.0] * (turns - 2), 0.5]
    return [
        Leg(half * leg_s, {"forward": speed, "yaw_rate": rate * side}) for half, side in zip(halves, sides, strict=True)
    ]


COURSES: dict[str, list[Leg]] = {
    # Two circles of 2 pi / 0.5 rad/s each, one to the left and one to the right.
    "eight": [
        Leg(2.0, {"forward": 0.8}),
        Leg(12.5, {"forward": 0.8, "yaw_rate": 0.5}),
        Leg(12.5, {"forward": 0.8, "yaw_rate": -0.5}),
    ],
    "slalom": [Leg(2.0, {"forward": 1.0}), *_weave(1.0, 0.6, 3.0, 8)],
    # What somebody at a joystick would do.
    "joystick": [
        Leg(2.0, {}),
        Leg(3.0, {"forward": 1.0}),
        Leg(3.0, {"forward": 0.8, "yaw_rate": 0.6}),
        Leg(3.0, {"forward": 0.8, "yaw_rate": -0.6}),
        Leg(3.0, {"lateral": 0.4}),
        Leg(3.0, {"forward": 0.5, "height": 0.75}),
        Leg(2.0, {"forward": 1.5}),
        Leg(4.0, {"forward": 3.0}),
        Leg(2.0, {"forward": 1.5}),
        Leg(1.0, {"forward": 0.5}),
        Leg(3.0, {}),
    ],
}


def sliced(course: list[Leg]) -> list[dict[str, float]]:
    """What is told in each of the SLICE_S that a course lasts."""
    return [leg.told for leg in course for _ in range(round(leg.seconds / SLICE_S))]


def check(name: str, course: list[Leg], commands: "tuple[Command, ...]") -> None:
    """Refuses a course for a robot that does not understand it.

    Raises:
      ConfigError: names the command that is missing.
    """
    understood = {command.name for command in commands}
    missing = sorted({command for leg in course for command in leg.told} - understood)
    if missing:
        raise ConfigError(
            f"--course: {name} tells {', '.join(missing)}, and this policy understands "
            f"{', '.join(sorted(understood)) or 'nothing'}; try --policy released-steer"
        )
