"""What `--help` and the reference say of a field is the comment beside it, or the one above it in full."""

from dataclasses import dataclass

from hasrl_jax.config.describe import descriptions


@dataclass
class Settings:
    """Some fields."""

    beside: int = 1  # one line, s
    # of two lines,
    # the second one too
    above: int = 2
    silent: int = 3


def test_a_comment_of_two_lines_is_read_in_full() -> None:
    assert descriptions(Settings) == {"beside": "one line, s", "above": "of two lines, the second one too"}
