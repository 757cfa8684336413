"""MuJoCo's own window, with the keyboard for controls."""

import os
import platform
import queue
import time

import mujoco

from hasrl_jax.envs.task import Command
from hasrl_jax.errors import ConfigError
from hasrl_jax.visualize.viewer.live import Controls, Live, Pace, Push, readout

SPACE, ENTER, BACKSPACE, RIGHT, LEFT, DOWN, UP = 32, 257, 259, 262, 263, 264, 265  # GLFW's key codes
PUSH_N = 100.0
HELP = "arrows: command; Enter: push; Space: pause; Backspace: reset"


class Keys:
    """Turns pressed keys into controls.

    Args:
      commands: of the task; the arrow keys change those that name them.
      randomized: the robot of the episodes.
    """

    def __init__(self, commands: tuple[Command, ...], randomized: bool):
        self._commands = commands
        self._pressed: queue.SimpleQueue[int] = queue.SimpleQueue()
        self._held = Controls(tuple(command.default for command in commands), randomized=randomized)
        self._next_push = Push(PUSH_N, 90.0)

    def press(self, key: int) -> None:
        """A key went down; called from the window's thread."""
        self._pressed.put(key)

    def controls(self) -> Controls:
        """What was asked for so far; a push or a reset counts once, and pushes come from alternating sides."""
        held, reset, push = self._held, False, None
        while not self._pressed.empty():
            key = self._pressed.get()
            held = held._replace(command=self._changed(held.command, key), paused=held.paused ^ (key == SPACE))
            reset = reset or key == BACKSPACE
            if key == ENTER:
                push = self._next_push
                self._next_push = push._replace(direction_deg=-push.direction_deg)
        self._held = held
        return held._replace(reset=reset, push=push)

    def _changed(self, told: tuple[float, ...], key: int) -> tuple[float, ...]:
        """The command after an arrow key, within what the policy was trained for."""
        direction = {"up-down": {UP: 1, DOWN: -1}, "left-right": {LEFT: 1, RIGHT: -1}, "": {}}
        return tuple(
            round(min(max(value + direction[c.keys].get(key, 0) * c.step, c.drawn[0]), c.drawn[1]), 3)
            for c, value in zip(self._commands, told, strict=True)
        )


def require_display() -> None:
    """Says what is missing.

    Raises:
      ConfigError: there is nothing to open a window on.
    """
    if platform.system() == "Linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise ConfigError("--native: needs a display, and neither DISPLAY nor WAYLAND_DISPLAY is set")


def show(live: Live, randomized: bool) -> None:
    """Opens the window and simulates until it is closed.

    Raises:
      ConfigError: no window can be opened here.
    """
    require_display()
    from mujoco import viewer

    keys, pace, data = Keys(live.commands, randomized), Pace(), mujoco.MjData(live.model)
    try:
        window = viewer.launch_passive(
            live.model, data, key_callback=keys.press, show_left_ui=False, show_right_ui=False
        )
    except RuntimeError as error:  # macOS wants the launcher mjpython
        raise ConfigError(f"--native: {' '.join(str(error).split())}") from None
    print(HELP)
    with window:
        window.cam.type, window.cam.trackbodyid = mujoco.mjtCamera.mjCAMERA_TRACKING, 1
        while window.is_running():
            live.advance(keys.controls())
            view = live.view()
            with window.lock():
                data.qpos[:] = view.qpos
                mujoco.mj_forward(live.model, data)
            names, values = (
                "\n".join(column) for column in zip(*readout(view, live.commands, pace.share()), strict=True)
            )
            window.set_texts((None, None, names, values))
            window.sync()
            time.sleep(pace.wait_s(live.step_s))
