"""Loads Ray, and starts it on this machine or joins a cluster."""

import logging
import os
import secrets
import signal
import socket
import sys
import threading
import warnings
from pathlib import Path
from typing import Any

import psutil

from hasrl_jax.config.schema import RayConfig
from hasrl_jax.errors import ConfigError, WorkerError
from hasrl_jax.policy.blas import ONE_THREAD, blas_variables

ANSWER_TIMEOUT_S = 10.0
TOKEN_FILE = Path("~/.ray/auth_token")  # where Ray looks for it
SPARE_BYTES = 2**27  # of the object store, beyond the data of two iterations


def environment(settings: RayConfig) -> dict[str, dict[str, str]]:
    """Ray's `runtime_env` of every worker; the nodes of a cluster may have other CPUs than this one."""
    blas = {} if settings.address else {n: v for n, v in blas_variables().items() if n not in os.environ}
    return {"env_vars": blas | ONE_THREAD}


def import_ray(settings: RayConfig) -> Any:
    """The module, told before it is loaded to keep to itself.

    Raises:
      ConfigError: it is not installed, or there is no token for a cluster that is joined.
    """
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    if settings.address:
        _require_token(settings.address)
    if not settings.address and "ray" not in sys.modules:
        # Read when Ray is loaded: its servers listen on the loopback interface only, as they do on other systems ...
        os.environ.setdefault("RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER", "0")
        # ... and answer only to this run. Ray would otherwise write a token to the home directory, or need none.
        os.environ.setdefault("RAY_AUTH_MODE", "token")
        os.environ.setdefault("RAY_AUTH_TOKEN", secrets.token_hex(32))
    try:
        import ray
    except ImportError as error:
        advice = 'pip install "ray>=2.52", or another backend'
        raise ConfigError(f"backend: ray cannot be loaded ({error}); expected {advice}") from None
    return ray


def _require_token(address: str) -> None:
    """Whoever reaches the ports of a cluster without a token can run any code on it, and on those who join it.

    Raises:
      ConfigError: there is no token, and RAY_AUTH_MODE does not say that there need be none.
    """
    if os.environ.setdefault("RAY_AUTH_MODE", "token") != "token":
        return
    given = os.environ.get("RAY_AUTH_TOKEN") or os.environ.get("RAY_AUTH_TOKEN_PATH")
    if not given and not TOKEN_FILE.expanduser().is_file():
        raise ConfigError(
            f"ray.address: {address} is joined with its token; expected it in {TOKEN_FILE} or RAY_AUTH_TOKEN, or "
            "RAY_AUTH_MODE=disabled for a cluster without one"
        )


def connect(ray: Any, settings: RayConfig, num_workers: int, bytes_per_worker: int) -> bool:
    """Starts Ray on this machine or joins a cluster; False if this process is connected already.

    Raises:
      WorkerError: there is no such cluster, or Ray does not start.
    """
    if ray.is_initialized():
        return False
    # Its messages would repeat what the pool says itself.
    quiet = {"log_to_driver": False, "logging_level": logging.ERROR, "runtime_env": environment(settings)}
    if settings.address:
        _require_answer(settings.address)
    where: dict[str, Any] = {"address": settings.address or "local"}
    if not settings.address:
        store = SPARE_BYTES + 2 * num_workers * bytes_per_worker
        where |= {"num_cpus": num_workers, "include_dashboard": False, "object_store_memory": store}
    handler = signal.getsignal(signal.SIGTERM)
    try:
        with warnings.catch_warnings():
            # Ray forks, and JAX warns of it; but the children only set their signals before they become programs.
            warnings.filterwarnings("ignore", "os.fork", RuntimeWarning)
            ray.init(**where, **quiet)
    except Exception as error:  # of a start that takes too long Ray says so with a bare one
        reason = " ".join(str(error).split())[:300]
        place = f"ray.address: {settings.address} cannot be joined" if settings.address else "Ray does not start here"
        raise WorkerError(f"{place} ({reason})") from None
    finally:
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGTERM, handler)  # Ray takes it, but the training loop decides
    return True


def _require_answer(address: str) -> None:
    """Ray itself would try for ever to reach a cluster that is not there."""
    host, _, port = address.rpartition(":")
    try:
        socket.create_connection((host, int(port)), ANSWER_TIMEOUT_S).close()
    except OSError as error:
        raise WorkerError(f"ray.address: {address} cannot be joined ({error.strerror or error})") from None


def find_raylet(ray: Any) -> psutil.Process | None:
    """Ray's own process on this node; None where it cannot be seen."""
    node = ray.get_runtime_context().get_node_id()
    for process in psutil.process_iter(["name", "cmdline"]):
        if process.info["name"] == "raylet" and any(node in part for part in process.info["cmdline"] or ()):
            return process
    return None


def has_ended(process: psutil.Process) -> bool:
    """Also of a process that waits for its parent to notice."""
    try:
        return process.status() == psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return True
