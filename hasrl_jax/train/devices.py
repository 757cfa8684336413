"""Settings of JAX that must be made before it first touches a device."""

import logging
import os
from pathlib import Path

import jax

from hasrl_jax.config.schema import Config

log = logging.getLogger("hasrl_jax")


def prepare_jax(config: Config) -> None:
    """Settings that must be made before JAX first touches a device."""
    if config.backend == "mjx":
        # XLA's thread pool on few CPU cores can wait for itself for ever in batched matrix factorisations.
        os.environ.setdefault("NPROC", "1")
    if config.compilation_cache:
        cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "hasrl_jax" / "compiled"
        try:
            cache.mkdir(parents=True, exist_ok=True)
            jax.config.update("jax_compilation_cache_dir", str(cache))
        except OSError as error:
            log.warning("%s: programs are compiled anew at every start (%s)", cache, error.strerror)
    if config.backend == "mjx" and jax.default_backend() == "cpu":
        log.warning(
            "the mjx backend has no accelerator here: one CPU core runs about 530 environment steps/s with MJX and "
            "about 4,000 with --backend=cpu_pool; NPROC=%s keeps XLA from hanging on few cores",
            os.environ["NPROC"],
        )
