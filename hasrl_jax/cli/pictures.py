"""`hasrl pictures`: how a policy walks, drawn."""

import argparse
import io
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from hasrl_jax.cli.options import OneLineParser, add_policy_options, require_writable
from hasrl_jax.cli.parsing import log_to_terminal, policy_to_play, run
from hasrl_jax.config.checks import limits_of
from hasrl_jax.config.limits import check_number
from hasrl_jax.config.schema import Config
from hasrl_jax.visualize.pictures import commands, course, gait, gaits, imitation, rewards

if TYPE_CHECKING:
    from matplotlib.figure import Figure

DRAWINGS = {
    "gait": gait.draw,
    "rewards": rewards.draw,
    "course": course.draw,
    "commands": commands.draw,
    "gaits": gaits.draw,
    "imitation": imitation.draw,
}
DPI = 110
COLORS = 64


def draw(arguments: list[str]) -> None:
    """Loads a policy, plays it, writes the picture.

    Raises:
      ConfigError: an impossible argument; RunError, CheckpointError: no policy.
    """
    known, rest = _parse(arguments)
    check_number("--seed", known.seed, limits_of(Config, "seed"))
    out = known.out or Path(f"{known.name}.png")
    require_writable("--out", out, ".png")
    config, parameters = policy_to_play(known, rest, "pictures")
    save(DRAWINGS[known.name](config, parameters, known.seed), out)
    print(f"{out}: {known.name}")


def save(figure: "Figure", out: Path) -> None:
    """Writes a PNG of few colours, a third of the size of matplotlib's own."""
    from PIL import Image

    drawn = io.BytesIO()
    figure.savefig(drawn, format="png", dpi=DPI)
    Image.open(drawn).convert("RGB").quantize(COLORS).save(out, optimize=True)


def _parse(arguments: list[str]) -> tuple[argparse.Namespace, list[str]]:
    parser = OneLineParser(
        prog="python -m hasrl_jax.pictures",
        description="Draw how a policy walks: the nominal robot, mean actions. Physics and cassie settings can be "
        "overridden.",
        allow_abbrev=False,
    )
    parser.add_argument(
        "name",
        choices=tuple(DRAWINGS),
        help="gait: contacts and forces; rewards: every term; of a policy that is steered, course: paths from above, "
        "commands: errors over grids of commands; gaits: the library of reference gaits; imitation: reference and "
        "motion by phase",
    )
    add_policy_options(parser)
    parser.add_argument("--out", type=Path, help="the PNG; default: NAME.png")
    return parser.parse_known_args(arguments)


def main(argv: list[str] | None = None) -> int:
    """Entry point; returns the exit status."""
    log_to_terminal()
    return run(lambda: draw(sys.argv[1:] if argv is None else argv))
