"""Films a policy without a display: `python -m hasrl_jax.render --run-dir DIR --out FILE.mp4`.

Nothing here imports MuJoCo before the OpenGL library is chosen, because MuJoCo fixes it when it is imported.
"""

import argparse
import logging
import os
import subprocess
import sys
from collections import deque
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from hasrl_jax.cli.options import OneLineParser, add_policy_options, require_writable
from hasrl_jax.visualize import opengl

if TYPE_CHECKING:
    from hasrl_jax.config.schema import Config
    from hasrl_jax.envs.gymnasium import TaskEnv

STRIP_FRAMES = 8
STRIP_HEIGHT_PX = 270
PUSH_S = 0.2  # how long --push acts
SPEED_AVERAGE_S = 0.5  # the shown measures are means over this long: a gait sways
SHADOW_PX = 2048  # shadow map; software rendering takes twice as long with the model's own size


class Moment(NamedTuple):
    """One frame of the film, taken before the environment step that it precedes."""

    image: np.ndarray  # [height, width, 3] uint8
    time_s: float  # since the start of the film
    measures: dict[str, float]  # means of the task's measures over the last SPEED_AVERAGE_S
    falls: int  # episodes that have ended so far
    pushed: bool


class Push(NamedTuple):
    """A sideways force on the whole robot."""

    force_n: float  # to the left is positive
    at_s: float  # when it starts, since the start of the film


class Speeds(NamedTuple):
    """Commanded speeds, each for an equal share of the film."""

    forward_m_s: list[float]
    lateral_m_s: float

    def at(self, frame: int, frames: int) -> float:
        """The forward speed of a frame out of `frames`."""
        return self.forward_m_s[frame * len(self.forward_m_s) // frames]


def play(
    env: "TaskEnv",
    parameters: dict[str, np.ndarray],
    frames: int,
    seed: int,
    push: Push,
    speeds: Speeds | None = None,
) -> Iterator[Moment]:
    """Acts with the policy's mean action, one moment per environment step; an episode that ends is followed by another.

    Args:
      env: built with `render_mode="rgb_array"`.
      parameters: as `ppo.export_parameters` returns them.
      frames: environment steps to film.
      seed: of the environment.
      push: a force of 0 does nothing.
      speeds: commanded one after the other; None leaves the commands to the task.
    """
    from hasrl_jax.policy.actor import act, start

    acting = start(env.config, env.task, parameters, 1)
    env_step_s = env.task.env_step_s
    recent: deque[list[float]] = deque(maxlen=round(SPEED_AVERAGE_S / env_step_s) or 1)
    observation, _ = env.reset(seed=seed)
    is_first, falls, push_frame = True, 0, round(push.at_s / env_step_s)
    for frame in range(frames):
        time_s = frame * env_step_s
        if speeds and (is_first or speeds.at(frame - 1, frames) != speeds.at(frame, frames)):
            observation = env.set_command(speeds.at(frame, frames), speeds.lateral_m_s)
        pushed = push.force_n != 0 and 0 <= frame - push_frame < round(PUSH_S / env_step_s)
        if pushed:
            env.push(0.0, push.force_n * env_step_s)
        image = env.render()
        assert image is not None
        yield Moment(image, time_s, recent_means(env.task.measures, recent), falls, pushed)

        action, acting = act(acting, observation[None], np.array([is_first]))
        observation, _, terminated, truncated, info = env.step(action[0])
        recent.append([info[name] for name in env.task.measures])
        is_first = terminated or truncated
        if is_first:
            observation, _ = env.reset()
            recent.clear()
            falls += 1


def recent_means(names: tuple[str, ...], recent: Sequence[list[float]]) -> dict[str, float]:
    """The mean of each measure over the rows of `recent`, but the last value of a command; nothing without rows."""
    if not recent:
        return {}
    means = zip(names, np.mean(recent, axis=0).tolist(), recent[-1], strict=True)
    return {name: last if name.endswith("_command") else mean for name, mean, last in means}


def caption(moment: Moment) -> str:
    """The text drawn on a frame: time, measured and commanded speed; other tasks show their measures."""
    parts, shown = [f"{moment.time_s:5.2f} s"], moment.measures
    if "forward_command" in shown:
        parts.append(f"forward {shown['forward_speed']:+.2f} m/s, commanded {shown['forward_command']:+.2f}")
        parts.append(f"left {shown['lateral_speed']:+.2f} m/s, commanded {shown['lateral_command']:+.2f}")
    else:
        parts += [f"{name.replace('_', ' ')} {value:+.2f}" for name, value in shown.items()]
    if moment.falls:
        parts.append(f"falls {moment.falls}")
    return "    ".join(parts) + ("    PUSH" if moment.pushed else "")


def draw_text(image: np.ndarray, text: str) -> np.ndarray:
    """A copy of `image` with `text` in its upper left corner, sized to fit."""
    from PIL import Image, ImageDraw, ImageFont

    picture = Image.fromarray(image)
    draw = ImageDraw.Draw(picture)
    margin = 8
    size = max(10, image.shape[0] // 24)
    font = ImageFont.load_default(size)
    while size > 8 and draw.textlength(text, font=font) > image.shape[1] - 2 * margin:
        size -= 1
        font = ImageFont.load_default(size)
    draw.text((margin, margin), text, fill="white", font=font, stroke_width=2, stroke_fill="black")
    return np.asarray(picture)


def film(env: "TaskEnv", moments: Iterator[Moment], frames: int, out: Path, strip: Path) -> int:
    """Writes the video in real time and the strip of evenly spaced frames; returns the falls seen."""
    import imageio_ffmpeg
    import mediapy

    mediapy.set_ffmpeg(imageio_ffmpeg.get_ffmpeg_exe())
    chosen = set(np.linspace(0, frames - 1, min(STRIP_FRAMES, frames)).round().astype(int).tolist())
    stills, falls = [], 0
    with mediapy.VideoWriter(str(out), env.frame_size, fps=1 / env.task.env_step_s, crf=20) as writer:
        for index, moment in enumerate(moments):
            writer.add_image(draw_text(moment.image, caption(moment)))
            falls = moment.falls
            if index in chosen:
                stills.append(_still(moment))
    mediapy.write_image(str(strip), np.concatenate(stills, axis=1))
    return falls


def _still(moment: Moment) -> np.ndarray:
    """The middle of a frame as a square of STRIP_HEIGHT_PX with its time."""
    from PIL import Image

    height, width = moment.image.shape[:2]
    side = min(height, width)
    left, top = (width - side) // 2, (height - side) // 2
    square = Image.fromarray(moment.image[top : top + side, left : left + side])
    return draw_text(np.asarray(square.resize((STRIP_HEIGHT_PX, STRIP_HEIGHT_PX))), f"{moment.time_s:.2f} s")


def render(known: argparse.Namespace, rest: list[str]) -> None:
    """The command: loads a policy, films it, writes both files.

    Raises:
      ConfigError: an impossible argument; RunError, CheckpointError: no policy; OSError: a file cannot be written.
    """
    from hasrl_jax.cli import parsing as cli
    from hasrl_jax.envs import gymnasium as gymnasium_env
    from hasrl_jax.errors import ConfigError
    from hasrl_jax.policy.loading import load_policy_parameters, with_physics

    _check(known)
    config, parameters = load_policy_parameters(known.run_dir, known.policy)
    for name in ("push", "forward", "speeds", "lateral"):
        if config.task != "cassie" and getattr(known, name):
            raise ConfigError(f"--{name}: a policy of task {config.task} cannot be commanded or pushed; leave it out")
    config = _config_to_film(with_physics(config, known.physics), known)
    config = cli.override_for_policy(config, rest, "render")
    strip = _strip(known)
    env = gymnasium_env.TaskEnv(config, "rgb_array", known.width, known.height, known.camera, SHADOW_PX)
    try:
        frames = max(1, round(known.seconds / env.task.env_step_s))
        push = Push(known.push, known.push_at)
        speeds = Speeds(known.speeds, known.lateral or 0.0) if known.speeds else None
        falls = film(env, play(env, parameters, frames, known.seed, push, speeds), frames, known.out, strip)
    finally:
        env.close()
    print(f"{known.out} and {strip}: {frames} frames, {known.seconds:g} s, {falls} falls")


def _config_to_film(config: "Config", known: argparse.Namespace) -> "Config":
    """The nominal robot, so that the film runs in real time, what was asked for and nothing else, and no time limit."""
    from hasrl_jax.config import tasks
    from hasrl_jax.config.convert import from_dict
    from hasrl_jax.envs.gymnasium import fixed_command

    cap = max(1, round(known.seconds / config.physics.env_step_s)) + 1
    config = tasks.find(config.task).undisturbed(from_dict({"collect": {"max_episode_steps": cap}}, config))
    return fixed_command(config, known.forward, known.lateral)


def _strip(known: argparse.Namespace) -> Path:
    return known.strip or known.out.with_suffix(".png")


def _check(known: argparse.Namespace) -> None:
    from hasrl_jax.config.checks import limits_of
    from hasrl_jax.config.limits import check_number
    from hasrl_jax.config.schema import Config
    from hasrl_jax.envs.cassie.settings import CommandConfig
    from hasrl_jax.errors import ConfigError

    for name in ("width", "height"):
        value = getattr(known, name)
        if not 64 <= value <= 4096 or value % 2:
            raise ConfigError(f"--{name}: got {value}; expected an even number from 64 to 4096")
    if known.speeds and known.forward is not None:
        raise ConfigError("--speeds and --forward: give only one of them")
    for name in ("forward", "lateral", "push", "push_at", "speeds"):
        value = getattr(known, name)
        if value is not None and not np.isfinite(value).all():
            raise ConfigError(f"--{name.replace('_', '-')}: got {value}; expected finite numbers")
    if not 0 < known.seconds <= 3600:
        raise ConfigError(f"--seconds: got {known.seconds:g}; expected more than 0 and at most 3600")
    check_number("--seed", known.seed, limits_of(Config, "seed"))
    if known.speeds:
        check_number("--speeds", (min(known.speeds), max(known.speeds)), limits_of(CommandConfig, "forward_m_s"))
    for name, path, suffix in (("--out", known.out, ".mp4"), ("--strip", _strip(known), ".png")):
        require_writable(name, path, suffix)  # fail now, and not after minutes of rendering


def _parse(arguments: list[str]) -> tuple[argparse.Namespace, list[str]]:
    parser = OneLineParser(
        prog="python -m hasrl_jax.render",
        description="Film a policy. Physics and cassie settings can be overridden: --cassie.randomize.enabled True",
        allow_abbrev=False,
    )
    add_policy_options(parser)
    parser.add_argument("--out", type=Path, default=Path("policy.mp4"), help="the video")
    parser.add_argument("--strip", type=Path, help="a row of frames as one PNG; default: beside the video")
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--forward", type=float, help="commanded forward speed, m/s")
    parser.add_argument("--speeds", type=float, nargs="+", help="instead: several, each for an equal share of the film")
    parser.add_argument("--lateral", type=float, help="commanded speed to the left, m/s")
    parser.add_argument("--push", type=float, default=0.0, help=f"force to the left for {PUSH_S} s, N")
    parser.add_argument("--push-at", type=float, default=3.0, help="when the push starts, s")
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
    from hasrl_jax.cli import parsing as cli

    return cli.run(lambda: render(known, rest))


if __name__ == "__main__":
    sys.exit(main())
