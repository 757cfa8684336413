"""`hasrl viewer`: watch a policy, command it and push it, in the browser or in MuJoCo's own window."""

import argparse
import sys
import time
from collections.abc import Callable

from hasrl_jax.cli.options import OneLineParser, add_model_options, add_policy_options
from hasrl_jax.cli.parsing import log_to_terminal, policy_to_play, robot_of, run
from hasrl_jax.config.checks import limits_of
from hasrl_jax.config.limits import check_number
from hasrl_jax.config.schema import Config
from hasrl_jax.errors import ConfigError
from hasrl_jax.visualize.viewer import browser, native
from hasrl_jax.visualize.viewer.guard import is_loopback
from hasrl_jax.visualize.viewer.live import Live, Pace


def view(arguments: list[str], opened: Callable[[str], object] | None = None) -> None:
    """The command: loads a policy and shows it until it is interrupted.

    Args:
      arguments: the command line.
      opened: called with the address of the page.

    Raises:
      ConfigError: an impossible argument, or nothing to show it with; RunError, CheckpointError: no policy.
    """
    known, rest = _parse(arguments)
    check_number("--seed", known.seed, limits_of(Config, "seed"))
    if not 0 <= known.port < 65536:
        raise ConfigError(f"--port: got {known.port}; expected 0 to 65535")
    if known.native:
        native.require_display()
    else:
        browser.require_viser()
        browser.free_port(known.port, known.host)
    config, parameters = policy_to_play(known, rest, "viewer")
    live = Live(config, parameters, known.seed, known.randomized, robot_of(known))
    if known.native:
        native.show(live, known.randomized)
        return
    page = browser.Browser(live, known.port, known.randomized, known.host)
    try:
        whose = "this machine only" if is_loopback(known.host) else "whoever has this address; it is not encrypted"
        print(f"open {page.url} ({whose}); Ctrl-C ends the viewer", flush=True)
        if opened:
            opened(page.url)
        loop(live, page, Pace(), lambda: False)
    except KeyboardInterrupt:
        print("ended")
    finally:
        page.close()


def loop(live: Live, page: browser.Browser, pace: Pace, stop: Callable[[], bool]) -> None:
    """Simulates in real time until `stop`."""
    while not stop():
        live.advance(page.controls())
        page.show(live.view(), pace.share())
        time.sleep(pace.wait_s(live.step_s))


def _parse(arguments: list[str]) -> tuple[argparse.Namespace, list[str]]:
    parser = OneLineParser(
        prog="python -m hasrl_jax.viewer",
        description="Watch a policy in the browser, command it and push it. Physics and the task's settings can be "
        "overridden: --cassie.randomize.mass-scale 0.8 1.2",
        allow_abbrev=False,
    )
    add_policy_options(parser)
    add_model_options(parser)
    parser.add_argument("--randomized", action="store_true", help="begin with a randomised robot")
    parser.add_argument("--port", type=int, default=8080, help="of the page; 0 takes a free one")
    hosts = f"address to listen on; {browser.ANY_HOST}: all of this machine, for those who have the token"
    parser.add_argument("--host", default=browser.HOST, help=hosts)
    parser.add_argument("--native", action="store_true", help="MuJoCo's own window instead of the browser")
    return parser.parse_known_args(arguments)


def main(argv: list[str] | None = None, opened: Callable[[str], object] | None = None) -> int:
    """Entry point; returns the exit status. `opened` is called with the address of the page."""
    log_to_terminal()
    return run(lambda: view(sys.argv[1:] if argv is None else argv, opened))
