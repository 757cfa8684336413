"""The viewer's page: a panel of controls, the robot, a floor. Served to this machine only, unless told otherwise."""

import contextlib
import io
import math
import secrets
import socket
import threading
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from hasrl_jax.envs.task import Command
from hasrl_jax.errors import ConfigError
from hasrl_jax.visualize.viewer.guard import PARAMETER, guarded, is_loopback
from hasrl_jax.visualize.viewer.live import Controls, Live, Push, View, readout
from hasrl_jax.visualize.viewer.shapes import shapes

if TYPE_CHECKING:
    import viser

HOST, ANY_HOST = "127.0.0.1", "0.0.0.0"  # viser's own default is the second
PUSH_N = (10.0, 400.0)
DIRECTIONS_DEG = {"to the left": 90.0, "to the right": -90.0, "forward": 0.0, "backward": 180.0}
FLOOR_M = -0.01  # height of the model's floor
TILE_M = 1.0
SHOWN_GROUND_M = 5.0  # half size of the boxes of the ground, at most; they are endless to the robot
READOUT_EVERY = 8  # environment steps
ARROW_STEPS = 24  # environment steps that the arrow of a push stays, which is over before one has seen it
NARROW = 0.8  # width over height of a window below which the panel covers its lower half, as on a phone
MISSING = 'the viewer in the browser needs the package viser: pip install "hasrl_jax[viewer]"; or use --native'


class Browser:
    """A page with a panel and a scene; opens on construction.

    Args:
      live: what is shown.
      port: 0 takes any free one.
      randomized: how the choice of the robot is set at first.
      host: address to listen on; beyond this machine, `url` has a token that is asked for.

    Raises:
      ConfigError: viser is missing, or the port is in use.
    """

    def __init__(self, live: Live, port: int, randomized: bool = False, host: str = HOST):
        require_viser()
        import viser

        port = free_port(port, host)
        token = None if is_loopback(host) else secrets.token_urlsafe(24)
        with contextlib.redirect_stdout(io.StringIO()), guarded(token):  # its banner; the command prints the address
            self._server = viser.ViserServer(host=host, port=port, label="hasrl_jax", verbose=False)
        name = socket.gethostname() if host == ANY_HOST else host
        self.url = f"http://{name}:{self._server.get_port()}{f'/?{PARAMETER}={token}' if token else ''}"
        self._lock = threading.Lock()  # viser calls back on threads of its own
        self._reset, self._push = False, False
        self._shown, self._episode, self._arrow_steps = 0, 0, 0
        self._origin = np.zeros(3)
        self._model, self._commands = live.model, live.commands
        self._build_panel(live, randomized)
        self._build_scene(live.model)

    def controls(self) -> Controls:
        """What the panel asks for now; a click counts once. Numbers typed beyond a slider's ends count as its ends."""
        with self._lock:
            reset, push = self._reset, self._push
            self._reset, self._push = False, False
        return Controls(
            command=tuple(_within(slider) for slider in self._sliders),
            paused=bool(self._paused.value),
            randomized=self._robot is not None and self._robot.value == "randomised",
            reset=reset,
            push=Push(_within(self._force), DIRECTIONS_DEG[self._direction.value]) if push else None,
        )

    def show(self, view: View, pace: float) -> None:
        """Moves the robot; now and then renews the readouts. `pace`: simulated per elapsed time."""
        pelvis = view.position[1]
        if self._follow.value:
            self._origin = np.array([pelvis[0], pelvis[1], 0.0])
        with self._server.atomic():
            # The camera stays where the person put it; the world moves under the robot.
            self._world.position = -self._origin
            self._floor.position = np.array([*np.round(pelvis[:2] / TILE_M) * TILE_M, FLOOR_M])
            for body, frame in self._bodies.items():
                frame.position, frame.wxyz = view.position[body], view.orientation[body]
            self._show_push(view, pelvis)
            if view.episodes != self._episode:
                self._episode = view.episodes
                self._show_ground()
        if self._shown % READOUT_EVERY == 0:
            rows = "".join(f"| {name} | {value} |\n" for name, value in readout(view, self._commands, pace))
            self._readout.content = "| | |\n|---|---|\n" + rows
        self._shown += 1

    def close(self) -> None:
        """Stops serving."""
        self._server.stop()

    def _build_panel(self, live: Live, randomized: bool) -> None:
        gui = self._server.gui
        gui.configure_theme(show_logo=False, show_share_button=False)
        self._sliders: list[viser.GuiSliderHandle[float]] = []
        if live.commands:
            with gui.add_folder("Command"):
                self._sliders = [self._slider(command) for command in live.commands]
        if live.can_push:
            with gui.add_folder("Push"):
                self._push_button = gui.add_button("push")
                self._push_button.on_click(self._ask_for_push)
                self._force = gui.add_slider("force N", *PUSH_N, step=10.0, initial_value=60.0)
                self._direction = gui.add_dropdown("direction", tuple(DIRECTIONS_DEG))
        self._readout = gui.add_markdown("")  # what one touches comes first: a phone shows half of the panel
        with gui.add_folder("Episode"):
            self._robot = None
            if live.can_randomize:
                robots = ("nominal", "randomised")
                hint = "takes effect at the next reset"
                self._robot = gui.add_dropdown("robot", robots, initial_value=robots[randomized], hint=hint)
            self._paused = gui.add_checkbox("pause", False)
            self._follow = gui.add_checkbox("camera follows", True)
            gui.add_button("reset").on_click(self._ask_for_reset)

    def _slider(self, command: Command) -> "viser.GuiSliderHandle[float]":
        """A slider over what the policy was trained for; a command that was never drawn stays where it was."""
        low, high = command.drawn
        name = f"{command.name.replace('_', ' ')} {command.unit}"
        step = min(command.step / 2, max(high - low, command.step) / 10)
        fixed = low == high
        slider = self._server.gui.add_slider(
            name, low, high + (step if fixed else 0.0), step=step, initial_value=min(max(command.default, low), high)
        )
        slider.disabled = fixed
        return slider

    def _ask_for_push(self, _: object) -> None:
        with self._lock:
            self._push = True

    def _ask_for_reset(self, _: object) -> None:
        with self._lock:
            self._reset = True

    def _build_scene(self, model: mujoco.MjModel) -> None:
        server, scene = self._server, self._server.scene
        scene.set_up_direction("+z")
        server.initial_camera.position, server.initial_camera.look_at = camera(1.0)
        server.on_client_connect(_place_camera)
        self._world = scene.add_frame("/world", show_axes=False)
        self._floor = scene.add_grid(
            "/world/floor", 40.0, 40.0, cell_size=TILE_M / 2, section_size=TILE_M, plane_opacity=0.4, fade_distance=25.0
        )
        self._bodies: dict[int, viser.FrameHandle] = {}
        for shape in shapes(model):
            path = f"/world/{model.body(shape.body).name}"
            if shape.body not in self._bodies:
                self._bodies[shape.body] = scene.add_frame(path, show_axes=False)
            scene.add_mesh_simple(
                f"{path}/{shape.name}",
                shape.vertices,
                shape.faces,
                color=shape.color,
                position=shape.position,
                wxyz=shape.orientation,
            )
        points = np.array([[[-1.0, 0.0, 0.0], [-0.25, 0.0, 0.0]]], np.float32)  # ends beside the robot
        self._arrow = scene.add_arrows(
            "/world/push", points, (220, 40, 40), shaft_radius=0.02, head_radius=0.05, head_length=0.12, visible=False
        )

    def _show_ground(self) -> None:
        """The boxes of an episode's ground, where there are any."""
        boxes = np.flatnonzero((self._model.geom_bodyid == 0) & (self._model.geom_type == mujoco.mjtGeom.mjGEOM_BOX))
        self._floor.visible = not len(boxes)
        for number, geom in enumerate(boxes):
            center, half = self._model.geom_pos[geom], np.minimum(self._model.geom_size[geom], SHOWN_GROUND_M)
            near = self._model.geom_size[geom][0] <= SHOWN_GROUND_M
            ahead = np.sign(center[0]) * (self._model.geom_size[geom][0] - half[0])
            self._server.scene.add_box(
                f"/world/ground/{number}",
                color=(200, 200, 200) if number % 2 else (235, 235, 235),
                dimensions=tuple(2 * half),
                wxyz=self._model.geom_quat[geom],
                position=center if near else center - np.array([ahead, 0.0, 0.0]),
            )

    def _show_push(self, view: View, pelvis: np.ndarray) -> None:
        self._arrow_steps = ARROW_STEPS if view.push else max(0, self._arrow_steps - 1)
        self._arrow.visible = self._arrow_steps > 0
        if view.push:
            half = math.radians(view.push.direction_deg) / 2
            self._arrow.position = pelvis
            self._arrow.wxyz = np.array([math.cos(half), 0.0, 0.0, math.sin(half)])


def _within(slider: "viser.GuiSliderHandle[float]") -> float:
    """The value of a slider; its box passes on what is typed as it is typed, and cuts it off only later."""
    return min(max(float(slider.value), float(slider.min)), float(slider.max))


def camera(aspect: float) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    """Where a visitor's camera stands and what it looks at, m, by the width over height of the window.

    In a narrow one it looks at the ground before the robot, which then stands in the upper part, above the panel.
    """
    return ((2.8, -2.8, 1.6), (1.46, -1.46, 0.03)) if aspect < NARROW else ((2.2, -2.2, 1.3), (0.0, 0.0, 0.65))


def _place_camera(client: "viser.ClientHandle") -> None:
    client.camera.position, client.camera.look_at = camera(client.camera.aspect)


def require_viser() -> None:
    """Says what is missing.

    Raises:
      ConfigError: viser cannot be imported.
    """
    try:
        import viser  # noqa: F401
    except ImportError as error:
        raise ConfigError(f"{MISSING} ({error})") from None


def free_port(port: int, host: str = HOST) -> int:
    """`port` if it can be opened on `host`; for 0, one that can.

    Raises:
      ConfigError: it cannot.
    """
    try:
        socket.getaddrinfo(host, None)
    except (OSError, UnicodeError) as error:
        raise ConfigError(f"--host: got {host}, which is no address of this machine ({error})") from None
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except (OSError, OverflowError) as error:
            raise ConfigError(f"--port: got {port}, not to be opened on {host} ({error}); 0 takes a free one") from None
        return int(probe.getsockname()[1])
