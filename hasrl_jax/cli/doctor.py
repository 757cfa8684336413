"""Says whether this machine can do the work: `python -m hasrl_jax.doctor`.

One line per check; exit status 1 when one of them fails.
"""

import importlib.metadata
import os
import platform
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Literal, NamedTuple

from hasrl_jax.cli.options import OneLineParser
from hasrl_jax.visualize import opengl

PACKAGES = ("jax", "jaxlib", "flax", "optax", "orbax-checkpoint", "numpy", "gymnasium")
OLDEST_PYTHON = (3, 11)
LOW_MEMORY_GIB = 2.0  # less is enough for a small run only
SLOW_START_S = 5.0
LARGE_WORKER_MIB = 400.0
NVIDIA_DRIVER = Path("/proc/driver/nvidia/version")
NO_CUDA = '; there is an NVIDIA GPU that JAX does not use: pip install "hasrl_jax[cuda]", or in a checkout ".[cuda]"'


class Check(NamedTuple):
    """The outcome of one check."""

    name: str
    status: Literal["ok", "warn", "fail"]
    text: str


def check_python() -> Iterator[Check]:
    """The interpreter."""
    status: Literal["ok", "fail"] = "ok" if sys.version_info >= OLDEST_PYTHON else "fail"
    yield Check("python", status, f"{platform.python_version()} ({platform.system()} {platform.machine()})")


def check_packages() -> Iterator[Check]:
    """The libraries, and that the two halves of MuJoCo belong together."""
    for name in PACKAGES:
        version = _version(name)
        yield Check(name, "ok" if version else "fail", version or "not installed")
    missing = 'not installed; only --backend=ray needs it: pip install "ray>=2.52"'
    yield Check("ray", "ok", _version("ray") or missing)
    mujoco, mjx = _version("mujoco"), _version("mujoco-mjx")
    if not mujoco or not mjx:
        yield Check("mujoco", "fail", f"mujoco {mujoco or 'not installed'}, mujoco-mjx {mjx or 'not installed'}")
    elif mujoco != mjx:
        text = f"mujoco {mujoco} but mujoco-mjx {mjx}; they are made for each other only where the versions are equal"
        yield Check("mujoco", "fail", text)
    else:
        yield Check("mujoco", "ok", f"{mujoco}, mujoco-mjx {mjx}")


def check_devices() -> Iterator[Check]:
    """What JAX computes on, and whether it overlooks a GPU."""
    import jax

    devices = jax.devices()
    names = ", ".join(f"{device.platform}:{device.id} {device.device_kind}" for device in devices)
    overlooked = all(device.platform == "cpu" for device in devices) and has_nvidia_gpu()
    yield Check("devices", "warn" if overlooked else "ok", names + NO_CUDA * overlooked)


def has_nvidia_gpu() -> bool:
    """Whether the driver of an NVIDIA GPU is there."""
    return NVIDIA_DRIVER.exists() or shutil.which("nvidia-smi") is not None


def check_cores_and_memory() -> Iterator[Check]:
    """Cores this process may use, and free memory."""
    import psutil

    from hasrl_jax.config.schema import available_cores

    yield Check("cores", "ok" if available_cores() > 1 else "warn", f"{available_cores()} of {os.cpu_count()} usable")
    memory = psutil.virtual_memory()
    free = memory.available / 2**30
    status: Literal["ok", "warn"] = "ok" if free >= LOW_MEMORY_GIB else "warn"
    yield Check("memory", status, f"{free:.1f} GiB free of {memory.total / 2**30:.1f} GiB")


def check_shared_memory() -> Iterator[Check]:
    """Reserves what a default Cassie run shares with its workers."""
    from hasrl_jax.collect import shared_memory
    from hasrl_jax.collect.plan import make_plan
    from hasrl_jax.config.files import shipped
    from hasrl_jax.envs.registry import make_task

    config = shipped("cassie_walk")
    task = make_task(config)
    block = shared_memory.open_block(config, make_plan(config), task.observation_size, task.action_size)
    size = os.fstat(block.descriptor).st_size
    block.close()
    yield Check("shared memory", "ok", f"{size / 2**20:.1f} MiB reserved, as the default run does")


def check_opengl() -> Iterator[Check]:
    """Which OpenGL libraries render without a display; only films need one."""
    working = [backend for backend in opengl.candidates() if opengl.works(backend)]
    if working:
        yield Check("opengl", "ok", ", ".join(working))
    else:
        yield Check("opengl", "warn", opengl.MISSING)


def check_working_directory() -> Iterator[Check]:
    """Runs are written below the working directory."""
    with tempfile.TemporaryFile(dir=Path.cwd()) as file:
        file.write(b"\0")
    yield Check("working directory", "ok", f"{Path.cwd()} can be written")


def check_worker() -> Iterator[Check]:
    """Starts one worker process of the pool."""
    import psutil

    from hasrl_jax.collect.plan import make_plan
    from hasrl_jax.collect.supervisor import CpuPool
    from hasrl_jax.config.convert import from_dict
    from hasrl_jax.envs.registry import make_task

    config = from_dict({"collect": {"num_workers": 1, "env_steps_per_iteration": 2048}})
    started = time.monotonic()
    with CpuPool(config, make_plan(config), make_task(config)) as pool:
        seconds = time.monotonic() - started
        resident = psutil.Process(pool.process_ids[0]).memory_info().rss / 2**20
    status: Literal["ok", "warn"] = "ok" if seconds <= SLOW_START_S and resident <= LARGE_WORKER_MIB else "warn"
    yield Check("worker", status, f"started in {seconds:.1f} s, {resident:.0f} MiB resident")


CHECKS: tuple[tuple[str, Callable[[], Iterator[Check]]], ...] = (
    ("python", check_python),
    ("packages", check_packages),
    ("devices", check_devices),
    ("cores and memory", check_cores_and_memory),
    ("shared memory", check_shared_memory),
    ("opengl", check_opengl),
    ("working directory", check_working_directory),
    ("worker", check_worker),
)


def examine() -> Iterator[Check]:
    """All checks in order; one that raises becomes a fail and the rest go on."""
    for name, check in CHECKS:
        try:
            yield from check()
        except Exception as error:  # whatever is broken here is what the doctor is asked about
            yield Check(name, "fail", f"{type(error).__name__}: {' '.join(str(error).split())}")


def _version(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def main(argv: list[str] | None = None) -> int:
    """Entry point; returns the exit status."""
    description = "Says whether this machine can do the work, one line per check."
    OneLineParser(prog="python -m hasrl_jax.doctor", description=description, allow_abbrev=False).parse_args(argv)
    failed = False
    for check in examine():
        print(f"{check.status:4s}  {check.name:18s} {check.text}", flush=True)
        failed |= check.status == "fail"
    return 1 if failed else 0
