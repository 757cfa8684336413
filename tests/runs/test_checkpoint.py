"""Checkpoints are exact, whole or refused, and a failed save harms nothing."""

import errno
import io
import json
import logging
import os
import resource
import shutil
import signal
import subprocess
import sys
import threading
import time
import zipfile
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from hasrl_jax.config.convert import from_dict
from hasrl_jax.errors import CheckpointError
from hasrl_jax.learn import ppo
from hasrl_jax.learn.ppo import LearnerState, init_learner
from hasrl_jax.runs import checkpoint

EXTRA = {"iteration": 2, "seconds": 0.1, "name": "ü"}
BLOBS = [b"", bytes(range(256)) * 40, b"\0"]


def make_learner(hidden_size: int = 8, seed: int = 0, action_size: int = 1) -> LearnerState:
    """A learner whose leaves hold arbitrary bits, which a lossy path would change."""
    config = from_dict({"network": {"hidden_size": hidden_size}})
    shapes = jax.eval_shape(lambda: init_learner(config, 3, action_size, None, jax.random.key(0)))
    rng = np.random.default_rng(seed)

    def arbitrary(leaf: jax.ShapeDtypeStruct) -> jax.Array:
        bits = rng.integers(0, 256, (*leaf.shape, leaf.dtype.itemsize), np.uint8)
        return jax.numpy.array(bits.view(leaf.dtype)[..., 0])

    return jax.tree.map(arbitrary, shapes)


@pytest.fixture(scope="module")
def learner() -> LearnerState:
    return make_learner()


@pytest.fixture(scope="module")
def second() -> LearnerState:
    return make_learner(seed=1)


@pytest.fixture(scope="module")
def two_steps(tmp_path_factory: pytest.TempPathFactory, learner: LearnerState, second: LearnerState) -> Path:
    directory = tmp_path_factory.mktemp("checkpoints")
    checkpoint.save(directory, 1, learner, EXTRA | {"iteration": 1}, BLOBS, keep=3)
    checkpoint.save(directory, 2, second, EXTRA, BLOBS, keep=3)
    return directory


@pytest.fixture
def directory(tmp_path: Path, two_steps: Path) -> Path:
    """A copy to damage."""
    return shutil.copytree(two_steps, tmp_path / "checkpoints")


def assert_equal(actual: LearnerState, expected: LearnerState) -> None:
    assert jax.tree.structure(actual) == jax.tree.structure(expected)
    for a, b in zip(jax.tree.leaves(actual), jax.tree.leaves(expected), strict=True):
        assert isinstance(a, jax.Array) and a.sharding == b.sharding
        assert (a.dtype, a.shape, np.asarray(a).tobytes()) == (b.dtype, b.shape, np.asarray(b).tobytes())


def test_round_trip_is_bit_exact(directory: Path, learner: LearnerState, second: LearnerState) -> None:
    loaded = checkpoint.load(directory, learner)
    assert loaded.step == 2 and loaded.extra == EXTRA and loaded.blobs == BLOBS
    assert_equal(loaded.learner, second)


def test_the_restored_learner_trains_on(directory: Path, second: LearnerState) -> None:
    """Donating the restored arrays is safe: nothing else owns their memory."""
    restored = checkpoint.load(directory, second).learner
    reverse = jax.jit(lambda leaves: [jax.numpy.flip(leaf) for leaf in leaves], donate_argnums=0)
    for actual, before in zip(reverse(jax.tree.leaves(restored)), jax.tree.leaves(second), strict=True):
        assert np.asarray(actual).tobytes() == np.flip(before).tobytes()


def test_placement_follows_the_template(directory: Path, second: LearnerState) -> None:
    replicated = jax.sharding.NamedSharding(ppo.make_mesh(), jax.sharding.PartitionSpec())
    template = jax.device_put(second, replicated)
    assert_equal(checkpoint.load(directory, template).learner, template)


def test_keeps_the_newest_and_replaces_a_step(tmp_path: Path, learner: LearnerState, second: LearnerState) -> None:
    assert checkpoint.steps(tmp_path / "missing") == []
    for step in (1, 2, 10):
        checkpoint.save(tmp_path, step, learner, {}, [], keep=2)
    assert checkpoint.steps(tmp_path) == [2, 10]
    checkpoint.save(tmp_path, 10, second, {"again": True}, [b""], keep=2)
    loaded = checkpoint.load(tmp_path, learner)
    assert (loaded.step, loaded.extra, loaded.blobs) == (10, {"again": True}, [b""])
    assert_equal(loaded.learner, second)
    checkpoint.save(tmp_path, 5, learner, {}, [], keep=2)  # the run went back: step 10 is not its future
    assert checkpoint.steps(tmp_path) == [2, 5]
    assert len(list(tmp_path.iterdir())) == 2


def test_quiet_and_without_leftover_threads(
    tmp_path: Path, learner: LearnerState, capfd: pytest.CaptureFixture
) -> None:
    before = set(threading.enumerate())
    checkpoint.save(tmp_path, 1, learner, {}, [b"x"], keep=1)
    checkpoint.load(tmp_path, learner)
    for thread in set(threading.enumerate()) - before:
        thread.join(timeout=5)  # helpers of the save that are just ending
    assert set(threading.enumerate()) == before
    assert capfd.readouterr() == ("", "")


def data_files(step: Path) -> list[Path]:
    return sorted(path for path in step.rglob("*") if path.is_file() and path.stat().st_size)


def flip_a_byte(path: Path, position: int) -> None:
    data = bytearray(path.read_bytes())
    data[position] ^= 0xFF
    path.write_bytes(data)


def test_a_flipped_byte_in_any_file_falls_back(
    directory: Path, learner: LearnerState, caplog: pytest.LogCaptureFixture
) -> None:
    newest = directory / "000000002"
    for file in data_files(newest):
        original = file.read_bytes()
        flip_a_byte(file, len(original) * 2 // 3)
        caplog.clear()
        loaded = checkpoint.load(directory, learner)
        assert loaded.step == 1 and loaded.extra["iteration"] == 1 and loaded.blobs == BLOBS
        assert_equal(loaded.learner, learner)
        assert len(caplog.records) == 1 and str(newest) in caplog.text
        file.write_bytes(original)
    assert checkpoint.load(directory, learner).step == 2


def test_restored_arrays_are_compared_with_what_was_saved(
    directory: Path, learner: LearnerState, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The second check, for a storage library that reads whole files wrongly."""
    monkeypatch.setattr(checkpoint, "_digest", lambda *groups: "other")
    with pytest.raises(CheckpointError, match="every checkpoint is damaged"):
        checkpoint.load(directory, learner)


@pytest.mark.parametrize("damage", ["truncated", "empty_files", "empty_directory", "a_file", "no_record"])
def test_damaged_newest_step_falls_back(
    directory: Path, learner: LearnerState, damage: str, caplog: pytest.LogCaptureFixture
) -> None:
    newest = directory / "000000002"
    if damage in ("truncated", "empty_files"):
        for file in data_files(newest):
            os.truncate(file, file.stat().st_size // 2 if damage == "truncated" else 0)
    elif damage == "no_record":
        shutil.rmtree(newest / "record")
    else:
        shutil.rmtree(newest)
        newest.mkdir() if damage == "empty_directory" else newest.write_text("")
    with caplog.at_level(logging.WARNING, logger="hasrl_jax"):
        loaded = checkpoint.load(directory, learner)
    assert loaded.step == 1
    assert_equal(loaded.learner, learner)
    assert len(caplog.records) == 1 and str(newest) in caplog.text


def test_every_step_damaged(directory: Path, learner: LearnerState) -> None:
    for name in ("000000001", "000000002"):
        flip_a_byte(directory / name / "record" / "metadata", 100)
    with pytest.raises(CheckpointError, match=f"{directory}: every checkpoint is damaged"):
        checkpoint.load(directory, learner)


def test_no_checkpoint(tmp_path: Path, learner: LearnerState) -> None:
    for directory in (tmp_path, tmp_path / "missing"):
        with pytest.raises(CheckpointError, match=f"{directory}: there is no checkpoint"):
            checkpoint.load(directory, learner)


def test_other_network(directory: Path) -> None:
    with pytest.raises(CheckpointError) as error:
        checkpoint.load(directory, make_learner(hidden_size=16))
    message = str(error.value)
    assert "policy_params.lstm_0_bias is float32 (32,) in the checkpoint but float32 (64,) here" in message
    assert "set network.hidden_size to 8" in message and str(directory) in message and "\n" not in message
    with pytest.raises(CheckpointError, match="another task; check the field task"):
        checkpoint.load(directory, make_learner(action_size=2))


def test_disk_full(directory: Path, learner: LearnerState, second: LearnerState) -> None:
    """A limit on file size stands in for the disk."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    noise = np.random.default_rng(0).bytes(200_000)
    resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, hard))
    try:
        with pytest.raises(CheckpointError) as error:
            checkpoint.save(directory, 3, learner, {}, [noise], keep=1)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert str(error.value) == f"{directory}: cannot save step 3: File too large"
    assert sorted(path.name for path in directory.iterdir()) == ["000000001", "000000002"]
    assert_equal(checkpoint.load(directory, learner).learner, second)


def test_directory_that_cannot_be_made(tmp_path: Path, learner: LearnerState) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(CheckpointError, match=f"{tmp_path}/file/checkpoints: cannot save step 1: Not a directory"):
        checkpoint.save(tmp_path / "file" / "checkpoints", 1, learner, {}, [], keep=1)


@pytest.mark.parametrize("number", [errno.EACCES, errno.EIO, errno.EMFILE, errno.ENOMEM])
def test_what_cannot_be_read_at_present_is_not_taken_for_damaged(
    directory: Path, learner: LearnerState, number: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    read = Path.read_bytes

    def fail(path: Path) -> bytes:
        if "000000002" in str(path):
            raise OSError(number, os.strerror(number))
        return read(path)

    with monkeypatch.context() as patched:
        patched.setattr(Path, "read_bytes", fail)
        with pytest.raises(CheckpointError, match=f"000000002: cannot be read at present: {os.strerror(number)}$"):
            checkpoint.load(directory, learner, set_aside=True)
    assert checkpoint.load(directory, learner).step == 2


def test_a_damaged_step_is_set_aside_and_no_save_removes_it(directory: Path, learner: LearnerState) -> None:
    newest = directory / "000000002"
    digest = newest / "files.sha256"
    digest.write_text("0" * 64)
    assert checkpoint.load(directory, learner).step == 1
    assert newest.is_dir(), "reading alone changes nothing"
    assert checkpoint.load(directory, learner, set_aside=True).step == 1
    checkpoint.save(directory, 2, learner, {}, [], keep=1)
    names = sorted(path.name for path in directory.iterdir())
    assert names == ["000000002", "000000002.damaged"]


def test_without_fallocate_the_space_is_asked_for(
    tmp_path: Path, learner: LearnerState, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delattr(os, "posix_fallocate", raising=False)
    checkpoint.save(tmp_path, 1, learner, {}, [], keep=1)
    assert checkpoint.load(tmp_path, learner).step == 1
    monkeypatch.setattr(shutil, "disk_usage", lambda _: shutil._ntuple_diskusage(100, 99, 1))
    with pytest.raises(CheckpointError, match="cannot save step 2: No space left on device"):
        checkpoint.save(tmp_path, 2, learner, {}, [], keep=1)


SAVE_FOR_EVER = """
import sys, pathlib
sys.path.insert(0, "tests/runs")
from test_checkpoint import checkpoint, make_learner
learner, directory = make_learner(), pathlib.Path(sys.argv[1])
for step in range(3, 1000):
    print(step, flush=True)
    checkpoint.save(directory, step, learner, {"iteration": step}, [bytes(1_000_000)], keep=2)
"""


class Disk:
    """What would be left after a loss of power: files and lists of names as they were when they were forced to it."""

    def __init__(self, root: Path):
        self.root = root
        self.files: dict[int, bytes] = {}  # inode -> content
        self.names: dict[int, dict[str, int]] = {}  # inode of a directory -> name -> inode
        self.moments: list[tuple[dict[int, bytes], dict[int, dict[str, int]]]] = []

    def force(self, descriptor: int) -> None:
        """Takes the place of os.fsync."""
        path, inode = Path(os.readlink(f"/proc/self/fd/{descriptor}")), os.fstat(descriptor).st_ino
        if path.is_dir():
            self.names = self.names | {inode: {entry.name: entry.inode() for entry in os.scandir(path)}}
        else:
            self.files = self.files | {inode: path.read_bytes()}
        self.moments.append((self.files, self.names))

    def restore(self, moment: int, path: Path) -> None:
        """Writes what was left at a moment to `path`."""
        files, names = self.moments[moment]

        def write(inode: int, place: Path) -> None:
            if inode in names:
                place.mkdir()
                for name, child in names[inode].items():
                    write(child, place / name)
            elif inode in files:
                place.write_bytes(files[inode])

        write(self.root.stat().st_ino, path)


def test_a_loss_of_power_at_any_moment_leaves_a_whole_checkpoint(
    tmp_path: Path, learner: LearnerState, second: LearnerState, monkeypatch: pytest.MonkeyPatch
) -> None:
    directory, left = tmp_path / "checkpoints", tmp_path / "left"
    directory.mkdir()
    disk = Disk(directory)
    monkeypatch.setattr(os, "fsync", disk.force)
    checkpoint.save(directory, 1, learner, EXTRA | {"iteration": 1}, BLOBS, keep=1)
    first = len(disk.moments) - 1
    checkpoint.save(directory, 2, second, EXTRA, BLOBS, keep=1)
    assert len(disk.moments) > first + 5
    for moment in (first, *range(first + 1, len(disk.moments), 4), len(disk.moments) - 1):
        disk.restore(moment, left)
        is_last = moment == len(disk.moments) - 1
        assert checkpoint.steps(left) == ([1, 2] if is_last else [1])
        loaded = checkpoint.load(left, learner)
        assert_equal(loaded.learner, second if is_last else learner)
        assert loaded.blobs == BLOBS
        shutil.rmtree(left)


def test_killed_while_saving(directory: Path, learner: LearnerState) -> None:
    environment = os.environ | {"JAX_PLATFORMS": "cpu"}
    root = Path(__file__).parents[2]
    command = [sys.executable, "-c", SAVE_FOR_EVER, str(directory)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, cwd=root, env=environment)
    assert process.stdout is not None
    for line in process.stdout:
        step = int(line)
        if step == 6:
            time.sleep(0.03)
            process.send_signal(signal.SIGKILL)
            break
    process.wait()
    process.stdout.close()
    loaded = checkpoint.load(directory, learner)
    assert loaded.step in (5, 6) and loaded.extra == {"iteration": loaded.step}
    checkpoint.save(directory, 7, learner, {}, [], keep=1)
    assert [path.name for path in directory.iterdir()] == ["000000007"]  # what the kill left is gone


def test_policy_round_trip(tmp_path: Path, learner: LearnerState) -> None:
    path = tmp_path / "policy.npz"
    parameters, metadata = ppo.export_parameters(learner), {"config": {"task": "cartpole"}, "score": 1.5}
    checkpoint.save_policy(path, parameters, metadata)
    restored, restored_metadata = checkpoint.load_policy(path)
    assert restored_metadata == metadata and list(restored) == list(parameters)
    for name, array in parameters.items():
        assert (restored[name].dtype, restored[name].tobytes()) == (array.dtype, array.tobytes())
    assert [file.name for file in tmp_path.iterdir()] == ["policy.npz"]


def test_released_policy_is_small(tmp_path: Path) -> None:
    learner = jax.eval_shape(lambda: init_learner(from_dict({}), 50, 10, None, jax.random.key(0)))
    flat = checkpoint._named_leaves((learner.policy_params, learner.value_params))
    rng = np.random.default_rng(0)
    parameters = {name: rng.standard_normal(leaf.shape, np.float32) for name, leaf in flat.items()}
    checkpoint.save_policy(tmp_path / "policy.npz", parameters, {})
    assert (tmp_path / "policy.npz").stat().st_size < 5_000_000


def test_damaged_policy(tmp_path: Path, learner: LearnerState) -> None:
    path = tmp_path / "policy.npz"
    with pytest.raises(CheckpointError, match=f"{path}: there is no such file; expected a policy file"):
        checkpoint.load_policy(path)
    checkpoint.save_policy(path, ppo.export_parameters(learner), {})
    good = path.read_bytes()
    for data in (b"", good[: len(good) // 2], b"not a policy", None):
        path.write_bytes(good if data is None else data)
        if data is None:
            flip_a_byte(path, len(good) // 2)
        with pytest.raises(CheckpointError, match=f"{path}: not a policy file, or damaged"):
            checkpoint.load_policy(path)
    arrays: dict[str, Any] = {"policy/a": np.zeros(3), "__sha256__": "0", "__metadata__": json.dumps({})}
    np.savez(path, **arrays)  # a whole archive with another digest
    with pytest.raises(CheckpointError, match="SHA-256"):
        checkpoint.load_policy(path)


def test_a_policy_file_that_would_fill_the_memory_is_not_unpacked(
    tmp_path: Path, learner: LearnerState, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, header = tmp_path / "policy.npz", io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f4", "fortran_order": False, "shape": (2**40,)})
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("policy/log_std.npy", header.getvalue())  # says 4 TiB, and has none of it
    monkeypatch.setattr(np, "load", lambda *_, **__: pytest.fail("it was unpacked"))
    with pytest.raises(CheckpointError, match=f"it would unpack to {2**42} bytes; expected at most {2**30}"):
        checkpoint.load_policy(path)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("policy/log_std.npy", bytes(10**6))
    monkeypatch.setattr(checkpoint, "LARGEST_POLICY", 10**6 - 1)
    with pytest.raises(CheckpointError, match=f"it would unpack to {10**6} bytes"):
        checkpoint.load_policy(path)


def test_a_policy_file_that_is_none_of_ours(tmp_path: Path) -> None:
    path = tmp_path / "policy.npz"
    os.mkfifo(path)
    with pytest.raises(CheckpointError, match="there is no such file"):  # and no wait for somebody who writes
        checkpoint.load_policy(path)
    path.unlink()
    fields = [(f"field_{number}_" + "x" * 40, "<f4") for number in range(400)]  # a header that NumPy calls unsafe
    for array in (np.array([print], object), np.zeros(1, fields)):
        np.savez(path, array)
        with pytest.raises(CheckpointError, match=r"damaged: it holds more than plain arrays of numbers$"):
            checkpoint.load_policy(path)


def test_policy_that_cannot_be_written(tmp_path: Path, learner: LearnerState) -> None:
    with pytest.raises(CheckpointError, match="cannot save the policy: No such file or directory"):
        checkpoint.save_policy(tmp_path / "missing" / "policy.npz", ppo.export_parameters(learner), {})
