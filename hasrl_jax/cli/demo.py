"""`hasrl demo`: a released policy walks in the browser, or in a film where there is no screen."""

import sys
import webbrowser
from pathlib import Path

from hasrl_jax.cli.options import OneLineParser

# Three speeds for an equal share of the film each, and a push in the last one.
FILM = ("--speeds", "0", "1", "2", "--push", "150", "--width", "640", "--height", "480")
PUSH_AT_SHARE = 0.8


def main(argv: list[str] | None = None) -> int:
    """Entry point; returns the exit status."""
    parser = OneLineParser(
        prog="python -m hasrl_jax.demo",
        description="Watch a released policy, command it and push it in the browser; or film it.",
        allow_abbrev=False,
    )
    parser.add_argument(
        "--policy", default="released-fast", help="released-fast (default), released or another of the package"
    )
    parser.add_argument("--headless", action="store_true", help="write a film instead of opening a page")
    parser.add_argument("--out", type=Path, default=Path("demo.mp4"), help="the film of --headless")
    parser.add_argument("--seconds", type=float, default=12.0, help="of the film")
    parser.add_argument("--port", type=int, default=8080, help="of the page on 127.0.0.1; 0 takes a free one")
    parser.add_argument("--no-open", action="store_true", help="do not open a browser, print the address only")
    known = parser.parse_args(sys.argv[1:] if argv is None else argv)
    policy = ["--policy", known.policy]
    if known.headless:
        from hasrl_jax.cli import render

        length = ["--seconds", str(known.seconds), "--push-at", str(PUSH_AT_SHARE * known.seconds)]
        return render.main([*policy, *FILM, *length, "--out", str(known.out)])
    from hasrl_jax.cli import viewer

    return viewer.main([*policy, "--port", str(known.port)], opened=None if known.no_open else webbrowser.open)
