"""`hasrl gaits`: records the library of gaits that a policy walks."""

import sys
from pathlib import Path

from hasrl_jax.cli.options import OneLineParser, require_writable
from hasrl_jax.cli.parsing import log_to_terminal, policy_to_play, run
from hasrl_jax.envs.cassie.gaits import AXES, save
from hasrl_jax.evaluate.record_gaits import BOUNDS, make_grid, record


def write(arguments: list[str]) -> None:
    """Plays a policy over the grid of gaits and writes the library.

    Raises:
      ConfigError: an impossible argument, or a policy without such gaits; RunError, CheckpointError: no policy.
    """
    parser = OneLineParser(
        prog="python -m hasrl_jax.gaits",
        description="Record a library of gaits, for cassie.reference.gaits. The one of the package is what this writes "
        "for released-steer, the default.",
        allow_abbrev=False,
    )
    parser.add_argument("--run-dir", type=Path, help="a run directory; its newest checkpoint is recorded")
    parser.add_argument("--policy", help="a policy file (.npz), or released-steer (the default)")
    parser.add_argument(
        "--physics", choices=("paper", "training"), default="training", help="as trained (the default), or 2 kHz"
    )
    forward, (_, lateral), height = (BOUNDS[name] for name in AXES)
    parser.add_argument("--forward-m-s", type=float, nargs=2, default=forward, metavar="V", help="slowest and fastest")
    parser.add_argument("--lateral-m-s", type=float, default=lateral, metavar="V", help="to either side")
    parser.add_argument("--height-m", type=float, nargs=2, default=height, metavar="M", help="lowest and highest")
    parser.add_argument("--out", type=Path, required=True, help="the file to write, .npz")
    known, rest = parser.parse_known_args(arguments)
    require_writable("--out", known.out, ".npz")
    if known.run_dir is None and known.policy is None:
        known.policy = "released-steer"
    bounds = known.forward_m_s, (0.0, known.lateral_m_s), known.height_m
    grid = make_grid(dict(zip(AXES, bounds, strict=True)))
    library = record(*policy_to_play(known, rest, "gaits"), grid)
    save(known.out, library)
    sizes = " x ".join(str(size) for size in library.curves.shape[:3])
    print(f"{known.out}: {sizes} gaits of {library.states.shape[3]} states, {known.out.stat().st_size / 1000:.0f} kB")


def main(argv: list[str] | None = None) -> int:
    """The command line; returns the exit status."""
    log_to_terminal()
    return run(lambda: write(sys.argv[1:] if argv is None else argv))
