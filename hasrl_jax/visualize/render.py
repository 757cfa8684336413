"""Films of a policy.

Nothing here imports MuJoCo before the OpenGL library is chosen, because MuJoCo fixes it when it is imported.
"""

from collections import deque
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from hasrl_jax.envs.gymnasium import TaskEnv
    from hasrl_jax.envs.task import Command

STRIP_FRAMES = 8
STRIP_HEIGHT_PX = 270
AVERAGE_S = 0.5  # the shown measures are means over this long: a gait sways
SHADOW_PX = 2048  # shadow map; software rendering takes twice as long with the model's own size


class Moment(NamedTuple):
    """One frame of the film, taken before the environment step that it precedes."""

    image: np.ndarray  # [height, width, 3] uint8
    time_s: float  # since the start of the film
    measures: dict[str, float]  # means of the task's measures over the last AVERAGE_S
    falls: int  # episodes that have ended so far
    pushed: bool


class Push(NamedTuple):
    """A sideways force on the robot, for as long as its task's pushes last."""

    force_n: float  # to the left is positive
    at_s: float  # when it begins, since the start of the film


Commands = Sequence[dict[str, float]]  # what is told by name, each for an equal share of the film


def play(
    env: "TaskEnv",
    parameters: dict[str, np.ndarray],
    frames: int,
    seed: int,
    push: Push,
    commands: Commands = (),
) -> Iterator[Moment]:
    """Acts with the policy's mean action, one moment per environment step; an episode that ends is followed by another.

    Args:
      env: built with `render_mode="rgb_array"`.
      parameters: as `ppo.export_parameters` returns them.
      frames: environment steps to film.
      seed: of the environment.
      push: a force of 0 does nothing.
      commands: given one after the other; without any they are left to the task.
    """
    from hasrl_jax.evaluate.rollout import Player

    player, env_step_s, task = Player(env, parameters, seed), env.task.env_step_s, env.task
    recent: deque[list[float]] = deque(maxlen=round(AVERAGE_S / env_step_s) or 1)
    falls, push_frame, lasts = 0, round(push.at_s / env_step_s), round(task.push_s / env_step_s)
    told: dict[str, float] | None = None
    for frame in range(frames):
        current = commands[frame * len(commands) // frames] if commands else None
        if current is not None and (player.is_first or current != told):
            player.command(**current)
            told = current
        if push.force_n and frame == push_frame:
            env.push(0.0, push.force_n)
        pushed = push.force_n != 0 and 0 <= frame - push_frame < lasts
        image = env.render()
        assert image is not None
        yield Moment(image, frame * env_step_s, recent_means(task.measures, recent), falls, pushed)

        outcome = player.step()
        recent.append([outcome.info[name] for name in task.measures])
        if outcome.ended:
            player.begin()
            recent.clear()
            falls += 1


def recent_means(names: tuple[str, ...], recent: Sequence[list[float]]) -> dict[str, float]:
    """The mean of each measure over the rows of `recent`, but the last value of a command; nothing without rows."""
    if not recent:
        return {}
    means = zip(names, np.mean(recent, axis=0).tolist(), recent[-1], strict=True)
    return {name: last if name.endswith("_command") else mean for name, mean, last in means}


def caption(moment: Moment, commands: "tuple[Command, ...]") -> str:
    """The text drawn on a frame: time, and what follows each command; a task without commands shows its measures."""
    parts, shown = [f"{moment.time_s:5.2f} s"], moment.measures
    if commands:
        told = [command for command in commands if command.measure in shown]
        parts += [f"{command.name.replace('_', ' ')} {followed(command, shown)}" for command in told]
    else:
        parts += [f"{name.replace('_', ' ')} {value:+.2f}" for name, value in shown.items()]
    if moment.falls:
        parts.append(f"falls {moment.falls}")
    return "    ".join(parts) + ("    PUSH" if moment.pushed else "")


def followed(command: "Command", measures: dict[str, float]) -> str:
    """A command's measure beside what was asked for."""
    measured, asked = measures[command.measure], measures[f"{command.name}_command"]
    return f"{measured:+z.2f} of {asked:+z.2f} {command.unit}"


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
            writer.add_image(draw_text(moment.image, caption(moment, env.task.commands)))
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
