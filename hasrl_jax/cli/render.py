"""`hasrl render`: films a policy without a display.

Nothing here imports MuJoCo before the OpenGL library is chosen, because MuJoCo fixes it when it is imported.
"""

import argparse
import logging
import os
import subprocess
import sys
from pathlib import Path

import numpy as np

from hasrl_jax.cli.options import (
    OneLineParser,
    add_force_option,
    add_model_options,
    add_policy_options,
    require_writable,
)
from hasrl_jax.errors import ConfigError
from hasrl_jax.visualize import course, opengl
from hasrl_jax.visualize.render import SHADOW_PX, Commands, Push, film, play

COMMAND_OPTIONS = ("forward", "lateral", "yaw_rate")  # commands with an option of their own; --command takes any


def render(known: argparse.Namespace, rest: list[str]) -> None:
    """Loads a policy, films it, writes both files.

    Raises:
      ConfigError: an impossible argument; RunError, CheckpointError: no policy; OSError: a file cannot be written.
    """
    from hasrl_jax.cli.parsing import (
        override_for_policy,
        policy_to_play,
        refuse_untrained,
        robot_of,
        trained_commands,
    )
    from hasrl_jax.config import tasks
    from hasrl_jax.config.convert import from_dict
    from hasrl_jax.envs.gymnasium import TaskEnv

    if known.course:
        known.seconds = course.SLICE_S * len(course.sliced(course.COURSES[known.course]))
    _check(known)
    config, parameters = policy_to_play(known, [], "render")
    # The nominal robot, so that the film runs in real time, what was asked for and nothing else, and no time limit.
    cap = max(1, round(known.seconds / config.physics.env_step_s)) + 1
    config = tasks.find(config.task).undisturbed(from_dict({"collect": {"max_episode_steps": cap}}, config))
    trained = trained_commands(config)
    config = override_for_policy(config, rest, "render")
    strip, commands = _strip(known), _commands(known)
    env = TaskEnv(config, "rgb_array", known.width, known.height, known.camera, SHADOW_PX, robot_of(known))
    try:
        if known.push and env.task.with_push is None:
            raise ConfigError(f"--push: the robot of task {config.task} cannot be pushed; leave it out")
        if known.course:
            course.check(known.course, course.COURSES[known.course], env.task.commands)
        for told in commands:
            env.check_command(told)
            for name, value in told.items():
                refuse_untrained(name, [value], trained, known.force)
        frames = max(1, round(known.seconds / env.task.env_step_s))
        push = Push(known.push, known.push_at)
        falls = film(env, play(env, parameters, frames, known.seed, push, commands), frames, known.out, strip)
    finally:
        env.close()
    print(f"{known.out} and {strip}: {frames} frames, {known.seconds:g} s, {falls} falls")


def _commands(known: argparse.Namespace) -> Commands:
    """What is commanded one after the other; nothing where no option asks for it."""
    told = {name: getattr(known, name) for name in COMMAND_OPTIONS if getattr(known, name) is not None}
    for text in known.command or ():
        name, _, value = text.partition("=")
        try:
            told[name.replace("-", "_")] = float(value)
        except ValueError:
            raise ConfigError(f"--command: got {text}; expected NAME=NUMBER, as in height=0.8") from None
    if known.course:
        return course.sliced(course.COURSES[known.course])
    if known.speeds:
        return [told | {"forward": speed} for speed in known.speeds]
    return [told] if told else []


def _strip(known: argparse.Namespace) -> Path:
    return known.strip or known.out.with_suffix(".png")


def _check(known: argparse.Namespace) -> None:
    from hasrl_jax.config.checks import limits_of
    from hasrl_jax.config.limits import check_number
    from hasrl_jax.config.schema import Config

    for name in ("width", "height"):
        value = getattr(known, name)
        if not 64 <= value <= 4096 or value % 2:
            raise ConfigError(f"--{name}: got {value}; expected an even number from 64 to 4096")
    if known.speeds and known.forward is not None:
        raise ConfigError("--speeds and --forward: give only one of them")
    others = [name for name in (*COMMAND_OPTIONS, "speeds", "command") if getattr(known, name) is not None]
    if known.course and others:
        raise ConfigError(f"--course and --{others[0].replace('_', '-')}: give only one of them")
    for name in (*COMMAND_OPTIONS, "push", "push_at", "speeds"):
        value = getattr(known, name)
        if value is not None and not np.isfinite(value).all():
            raise ConfigError(f"--{name.replace('_', '-')}: got {value}; expected finite numbers")
    if not 0 < known.seconds <= 3600:
        raise ConfigError(f"--seconds: got {known.seconds:g}; expected more than 0 and at most 3600")
    check_number("--seed", known.seed, limits_of(Config, "seed"))
    for name, path, suffix in (("--out", known.out, ".mp4"), ("--strip", _strip(known), ".png")):
        require_writable(name, path, suffix)  # fail now, and not after minutes of rendering


def _parse(arguments: list[str]) -> tuple[argparse.Namespace, list[str]]:
    parser = OneLineParser(
        prog="python -m hasrl_jax.render",
        description="Film a policy. Physics and the task's settings can be overridden: --cassie.randomize.enabled True",
        allow_abbrev=False,
    )
    add_policy_options(parser)
    add_model_options(parser)
    add_force_option(parser)
    parser.add_argument("--out", type=Path, default=Path("policy.mp4"), help="the video")
    parser.add_argument("--strip", type=Path, help="a row of frames as one PNG; default: beside the video")
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--forward", type=float, help="commanded forward speed, m/s")
    parser.add_argument("--speeds", type=float, nargs="+", help="instead: several, each for an equal share of the film")
    parser.add_argument("--lateral", type=float, help="commanded speed to the left, m/s")
    parser.add_argument("--yaw-rate", type=float, help="commanded turning rate to the left, rad/s")
    parser.add_argument("--command", nargs="+", metavar="NAME=NUMBER", help="any of the task's commands, height=0.8")
    parser.add_argument("--course", choices=tuple(course.COURSES), help="instead: what to tell when, for its own time")
    parser.add_argument("--push", type=float, default=0.0, help="force to the left on the pelvis for 0.2 s, N")
    parser.add_argument("--push-at", type=float, default=3.0, help="when the push begins, s")
    parser.add_argument("--width", type=int, default=640, help="pixels")
    parser.add_argument("--height", type=int, default=480, help="pixels")
    parser.add_argument("--camera", default="track", help="a camera of the model (Cassie: track, side, front)")
    return parser.parse_known_args(arguments)


def main(argv: list[str] | None = None) -> int:
    """Entry point; returns the exit status."""
    logging.basicConfig(format="%(message)s", level=logging.WARNING)
    arguments = sys.argv[1:] if argv is None else argv
    known, rest = _parse(arguments)
    backend = opengl.choose()
    if backend is None:
        print(f"error: {opengl.MISSING}", file=sys.stderr)
        return 1
    if "mujoco" in sys.modules and os.environ.get("MUJOCO_GL") != backend:  # too late to choose in this process
        command = [sys.executable, "-m", "hasrl_jax.render", *arguments]
        return subprocess.run(command, env=os.environ | {"MUJOCO_GL": backend}).returncode
    os.environ["MUJOCO_GL"] = backend
    from hasrl_jax.cli.parsing import run

    return run(lambda: render(known, rest))
