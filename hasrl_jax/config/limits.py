"""Limits of numbers, written beside the fields that they bound."""

from typing import Annotated, Any, NamedTuple

from hasrl_jax.errors import ConfigError


class Limits(NamedTuple):
    """Lowest and highest value of a numeric field, both included; of a range, for both of its ends."""

    low: float
    high: float


Range = tuple[float, float]  # (low, high)
Share = Annotated[float, Limits(0, 1)]


def check_number(name: str, value: Any, limits: Limits) -> None:
    """Rejects a number, or a (low, high) pair of numbers, outside `limits`.

    Raises:
      ConfigError: names `name`, the value and what would work.
    """
    ends = value if isinstance(value, tuple) else (value,)
    # Never true of NaN.
    inside = all(limits.low <= end <= limits.high for end in ends)
    require(inside, name, value, f"{_number(limits.low)} to {_number(limits.high)}")
    require(ends[0] <= ends[-1], name, value, "low <= high")


def require(condition: bool, name: str, value: Any, expected: str) -> None:
    """Raises the ConfigError that says what `name` is and what would work, unless the condition holds."""
    if not condition:
        raise ConfigError(f"{name}: got {shown(value)}; expected {expected}")


def shown(value: Any) -> str:
    """`value` as an error message shows it: on one line, and short."""
    try:
        text = repr(value)
    except ValueError:  # Python refuses to write integers of thousands of digits
        return "a number of thousands of digits"
    return text if len(text) <= 80 else f"{text[:60]}… ({len(text)} characters)"


def named(key: Any) -> str:
    """A name as it stands, unless it would break the line of an error message or fill it."""
    return key if isinstance(key, str) and key.isprintable() and 0 < len(key) <= 80 else shown(key)


def _number(value: float) -> str:
    return str(value) if isinstance(value, int) else f"{value:g}"
