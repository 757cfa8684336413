"""Which OpenGL library can render without a display. Imports nothing heavy: MuJoCo chooses when it is imported."""

import os
import platform
import subprocess
import sys

BACKENDS = {"Linux": ("egl", "osmesa", "glfw"), "Darwin": ("cgl",), "Windows": ("wgl",)}
MISSING = (
    "no OpenGL library can render here; training does not need one. On Debian or Ubuntu: "
    "apt-get install libegl1 libgl1-mesa-dri (EGL) or apt-get install libosmesa6 (OSMesa)"
)
PROBE = """
import mujoco
model = mujoco.MjModel.from_xml_string("<mujoco><worldbody><geom size='1'/></worldbody></mujoco>")
renderer = mujoco.Renderer(model, 16, 16)
data = mujoco.MjData(model)
mujoco.mj_forward(model, data)
renderer.update_scene(data)
renderer.render()
renderer.close()
"""


def works(backend: str) -> bool:
    """Whether MuJoCo renders with MUJOCO_GL=`backend`; tried in a process of its own, because failing may be fatal."""
    try:
        process = subprocess.run(
            [sys.executable, "-c", PROBE],
            env=os.environ | {"MUJOCO_GL": backend},
            stdin=subprocess.DEVNULL,
            capture_output=True,
            timeout=60,
        )
    except subprocess.TimeoutExpired:
        return False
    return process.returncode == 0


def candidates() -> list[str]:
    """What to try on this system: MUJOCO_GL as it is set, then EGL and OSMesa, then a window system."""
    chosen = os.environ.get("MUJOCO_GL", "").strip().lower()
    others = BACKENDS.get(platform.system(), ("glfw",))
    return list(dict.fromkeys([chosen, *others] if chosen else others))


def choose() -> str | None:
    """The first candidate that works, or None."""
    return next((backend for backend in candidates() if works(backend)), None)
