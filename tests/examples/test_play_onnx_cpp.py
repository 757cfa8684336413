"""The loop in C++ goes where the one in Python goes; skipped where the headers of ONNX Runtime are not installed."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from hasrl_jax.cli import export as command_line

FOLDER = Path(__file__).parents[2] / "examples" / "deploy"


@pytest.fixture(scope="module")
def program(tmp_path_factory):
    if not shutil.which("cmake"):
        pytest.skip("cmake is not installed")
    build = tmp_path_factory.mktemp("build")
    configure = ["cmake", "-S", FOLDER / "cpp", "-B", build, f"-DPython3_EXECUTABLE={sys.executable}"]
    if "ONNXRUNTIME_INCLUDE_DIR" in os.environ:
        configure.append(f"-DONNXRUNTIME_INCLUDE_DIR={os.environ['ONNXRUNTIME_INCLUDE_DIR']}")
    configured = subprocess.run(configure, capture_output=True, text=True, timeout=120)
    for missing in ("ONNXRUNTIME_INCLUDE_DIR was not found", "CMAKE_CXX_COMPILER"):
        if configured.returncode and missing in configured.stderr:
            pytest.skip(f"{missing}: no headers, or no compiler")
    assert configured.returncode == 0, configured.stderr
    built = subprocess.run(["cmake", "--build", build], capture_output=True, text=True, timeout=300)
    assert built.returncode == 0 and "warning" not in built.stderr, built.stdout + built.stderr
    return build / "play_onnx"


@pytest.mark.parametrize(
    ("policy", "command"),
    [
        ("released", ["forward=1.5", "lateral=0.05"]),
        ("released-steer", ["forward=0.6", "yaw_rate=0.6", "height=0.8"]),
        ("released-steer", []),
        ("released-fast", ["forward=2.5", "yaw_rate=0.3"]),
    ],
)
def test_it_goes_where_the_python_loop_goes(tmp_path, program, policy, command):
    onnx, xml = str(tmp_path / "policy.onnx"), str(tmp_path / "cassie.xml")
    assert command_line.main(["--policy", policy, "--format", "onnx", "--out", onnx, "--model", xml]) == 0
    in_cpp = subprocess.run([program, onnx, xml, "3", *command], capture_output=True, text=True, timeout=120)
    loop = [sys.executable, FOLDER / "play_onnx.py", onnx, xml, "--seconds", "3", "--command", *command]
    in_python = subprocess.run(loop, capture_output=True, text=True, timeout=120)
    assert (in_cpp.returncode, in_cpp.stderr) == (0, "")
    where, inference = in_cpp.stdout.splitlines()
    assert where.startswith("3.00 s: x ") and where == in_python.stdout.splitlines()[0]
    assert inference.startswith("inference: median ")
    for wrong, line in (
        (["3", "sideways=1"], "got sideways=1; it is no NAME=VALUE of a command"),
        (["3", "forward=fast"], "got forward=fast; expected a number"),
        (["0"], "got SECONDS 0; expected one step of the policy or more"),
        (["long"], "got SECONDS long; expected a number"),
    ):
        refused = subprocess.run([program, onnx, xml, *wrong], capture_output=True, text=True, timeout=120)
        assert (refused.returncode, refused.stderr) == (1, f"error: {line}\n")
