"""Runs every test on the CPU with eight simulated devices; must act before JAX is imported."""

import os

_DEVICES = "--xla_force_host_platform_device_count=8"

os.environ["JAX_PLATFORMS"] = "cpu"
os.environ.setdefault("NPROC", "1")  # with more threads on few cores, the matrix factorisations of MJX can hang
if _DEVICES not in os.environ.get("XLA_FLAGS", ""):
    os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {_DEVICES}".strip()
