"""Checkpoints of a training run, and the single file of a released policy.

A checkpoint step is one directory, written beside its place and renamed when it is complete and on the disk, so that
a kill, a full disk, a lost permission or a loss of power never harms what was saved before. The storage library does
not notice every damaged byte: a step carries SHA-256 digests of its files, checked before they are parsed, and of its
arrays, checked after.
"""

import contextlib
import errno
import hashlib
import json
import logging
import math
import os
import re
import shutil
import tempfile
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp

from hasrl_jax.errors import CheckpointError
from hasrl_jax.learn.ppo import LearnerState
from hasrl_jax.runs import durable
from hasrl_jax.runs.storage import open_storage

log = logging.getLogger("hasrl_jax")

# "000000040", and "000000040.1" for a step that was saved again: the new one is complete before the old one goes.
_STEP_NAME = re.compile(r"(\d{9,})(?:\.(\d+))?")
_PARTIAL = ".partial"
_SET_ASIDE = ".damaged"  # ends the name of a step that was found damaged
# What the machine lacks at present, and says nothing about the files.
_PASSING = (errno.EACCES, errno.EPERM, errno.EIO, errno.EMFILE, errno.ENFILE, errno.ENOMEM, errno.ESTALE)
_FILES_DIGEST = "files.sha256"
_POLICY_METADATA, _POLICY_DIGEST = "__metadata__", "__sha256__"
LARGEST_POLICY = 2**30  # bytes of a policy file once unpacked; the released ones have 0.3 MB

Signature = dict[str, tuple[str, tuple[int, ...]]]  # name -> (dtype, shape)


class _DamagedError(Exception):
    """What was read is not what was written."""


class Loaded(NamedTuple):
    """A restored checkpoint."""

    step: int
    learner: LearnerState
    extra: dict[str, Any]
    blobs: list[bytes]


def save(
    directory: Path, step: int, learner: LearnerState, extra: dict[str, Any], blobs: list[bytes], keep: int
) -> None:
    """Writes a step, then removes all but the newest `keep`; returns when it is on disk.

    A step that exists is replaced. Steps after it are removed: they are damaged, or belong to a run that went back.

    Args:
      directory: holds one directory per step; created when missing.
      step: number of the step, 0 or more.
      learner: the state to save.
      extra: JSON-able values.
      blobs: opaque data, for example the workers' environments; may be empty, as may each of them.
      keep: steps that remain, at least 1.

    Raises:
      CheckpointError: it cannot be written (disk full, no permission); the steps saved before are untouched.
    """
    arrays = {name: np.asarray(leaf) for name, leaf in _named_leaves(jax.device_get(learner)).items()}
    # Storage refuses arrays without elements; an empty blob exists only as its size.
    blob_arrays = {f"{i:05d}": np.frombuffer(blob, np.uint8) for i, blob in enumerate(blobs) if blob}
    record = {
        "step": step,
        "extra": extra,
        "leaves": _signature(arrays),
        "blob_sizes": [len(blob) for blob in blobs],
        "sha256": _digest(arrays, blob_arrays),
    }
    items: dict[str, Any] = {"learner": ocp.args.PyTreeSave(arrays), "record": ocp.args.JsonSave(record)}
    if blob_arrays:
        items["blobs"] = ocp.args.PyTreeSave(blob_arrays)
    partial = directory / _PARTIAL
    try:
        directory.mkdir(parents=True, exist_ok=True)
        _remove_unfinished(directory)
        _require_space(directory, sum(array.nbytes for array in [*arrays.values(), *blob_arrays.values()]))
        attempts = [attempt for number, attempt, _ in _saved(directory) if number == step]
        path = directory / (f"{step:09d}.{max(attempts) + 1}" if attempts else f"{step:09d}")
        with open_storage() as checkpointer:
            checkpointer.save(partial.absolute(), args=ocp.args.Composite(**items))
        (partial / _FILES_DIGEST).write_text(_digest_of_files(partial))
        durable.replace(partial, path)
    except Exception as error:
        _remove_unfinished(directory)
        raise CheckpointError(f"{directory}: cannot save step {step}: {_reason(error)}") from error
    _prune(directory, step, path, keep)


def load(directory: Path, template: LearnerState, set_aside: bool = False) -> Loaded:
    """The newest step that is whole; a damaged one is passed over with a warning.

    Args:
      directory: as given to `save`.
      template: a learner of the configured sizes; the result has its structure, dtypes and placement.
      set_aside: rename a damaged step, so that no later save removes it.

    Raises:
      CheckpointError: there is no step, none is whole, it is of another network, or it cannot be read at present.
    """
    try:
        candidates = list(reversed(_saved(directory)))
    except OSError as error:
        raise CheckpointError(f"{directory}: cannot be read: {_reason(error)}") from error
    if not candidates:
        raise CheckpointError(f"{directory}: there is no checkpoint")
    for step, _, path in candidates:
        try:
            return _restore(path, step, template)
        except CheckpointError:
            raise
        except Exception as error:  # storage raises many kinds for damaged files
            if _is_passing(error):
                raise CheckpointError(f"{path}: cannot be read at present: {_reason(error)}") from error
            log.warning("checkpoint %s is damaged and passed over: %s", path, _reason(error))
            if set_aside:
                with contextlib.suppress(OSError):
                    path.rename(path.with_name(f"{path.name}{_SET_ASIDE}"))
    raise CheckpointError(f"{directory}: every checkpoint is damaged; the newest is {candidates[0][2].name}")


def steps(directory: Path) -> list[int]:
    """Numbers of the saved steps, ascending; whether they are whole shows only when they are loaded."""
    return sorted({step for step, _, _ in _saved(directory)})


def save_policy(path: Path, parameters: Mapping[str, np.ndarray], metadata: dict[str, Any]) -> None:
    """Writes the parameters of a policy and JSON-able metadata to one .npz file, atomically.

    Args:
      path: the file; replaced when it exists.
      parameters: what `ppo.export_parameters` returns.
      metadata: for example the resolved configuration.

    Raises:
      CheckpointError: it cannot be written; a file that was there before is untouched.
    """
    text = np.array(json.dumps(metadata))
    digest = _digest(parameters, {_POLICY_METADATA: text})
    arrays: dict[str, Any] = {_POLICY_METADATA: text, _POLICY_DIGEST: digest, **parameters}
    partial = path.with_name(f"{path.name}.{os.getpid()}.partial")
    try:
        with open(partial, "wb") as file:
            np.savez_compressed(file, **arrays)
        durable.replace(partial, path)
    except OSError as error:
        with contextlib.suppress(OSError):
            partial.unlink(missing_ok=True)
        raise CheckpointError(f"{path}: cannot save the policy: {_reason(error)}") from error


def load_policy(path: Path, expected: str = "a policy file") -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """What `save_policy` wrote: (parameters, metadata).

    Args:
      path: the file.
      expected: what to say where there is none.

    Raises:
      CheckpointError: missing, not a policy file, damaged, or larger than LARGEST_POLICY.
    """
    if not path.is_file():  # nor anything else that has a name: opening a pipe would wait for ever
        raise CheckpointError(f"{path}: there is no such file; expected {expected}")
    try:
        with open(path, "rb") as file:
            _require_moderate_size(file)
            with np.load(file, allow_pickle=False) as archive:
                arrays = dict(archive)
        text, digest = arrays.pop(_POLICY_METADATA), arrays.pop(_POLICY_DIGEST)
        if str(digest) != _digest(arrays, {_POLICY_METADATA: text}):
            raise _DamagedError("its contents do not match their SHA-256 digest")
        return arrays, json.loads(str(text))
    except Exception as error:  # zip and NumPy raise many kinds for damaged files
        reason = _reason(error)
        if "pickle" in reason:  # NumPy's advice how to load it nevertheless
            reason = "it holds more than plain arrays of numbers"
        raise CheckpointError(f"{path}: not a policy file, or damaged: {reason}") from error


def _require_moderate_size(file: BinaryIO) -> None:
    """Looks at what a zip file says of itself before anything of it is unpacked, and at what its arrays say.

    Raises:
      _DamagedError: it would take too much memory.
    """
    with zipfile.ZipFile(file) as archive:
        size = sum(entry.file_size for entry in archive.infolist())
        if size <= LARGEST_POLICY:
            size = sum(_array_size(archive, entry) for entry in archive.infolist())
    file.seek(0)
    if size > LARGEST_POLICY:
        raise _DamagedError(f"it would unpack to {size} bytes; expected at most {LARGEST_POLICY}")


def _array_size(archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> int:
    """Bytes that an array asks for before it is read, whatever follows."""
    with archive.open(entry) as file:
        version = np.lib.format.read_magic(file)
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, _, dtype = read(file)
    return math.prod(shape) * dtype.itemsize


def _restore(path: Path, step: int, template: LearnerState) -> Loaded:
    """The step in `path`, verified."""
    if (path / _FILES_DIGEST).read_text() != _digest_of_files(path):
        raise _DamagedError("its files do not match their SHA-256 digest")
    wanted = _named_leaves(template)
    with open_storage() as checkpointer:
        record = checkpointer.restore(path.absolute(), args=ocp.args.Composite(record=ocp.args.JsonRestore())).record
        saved = {name: (dtype, tuple(shape)) for name, (dtype, shape) in record["leaves"].items()}
        _check_same_network(path, saved, _signature(wanted))
        sizes = record["blob_sizes"]
        items = {"learner": ocp.args.PyTreeRestore()} | ({"blobs": ocp.args.PyTreeRestore()} if any(sizes) else {})
        restored = checkpointer.restore(path.absolute(), args=ocp.args.Composite(**items))
    arrays, blobs = restored["learner"], restored["blobs"] if any(sizes) else {}
    if record["step"] != step or record["sha256"] != _digest(arrays, blobs):
        raise _DamagedError("its arrays do not match their SHA-256 digest")
    leaves = [_place(arrays[name], leaf) for name, leaf in wanted.items()]
    learner = jax.tree.unflatten(jax.tree.structure(template), leaves)
    blob_list = [blobs[f"{i:05d}"].tobytes() if size else b"" for i, size in enumerate(sizes)]
    return Loaded(step, learner, record["extra"], blob_list)


def _place(array: np.ndarray, like: jax.Array) -> jax.Array:
    """`array` on the devices of `like`; copied, since the learner's arrays are donated."""
    placed = jnp.array(array, dtype=like.dtype)
    return jax.device_put(placed, like.sharding) if getattr(like, "committed", False) else placed


def _check_same_network(path: Path, saved: Signature, wanted: Signature) -> None:
    """Raises CheckpointError, with the field to change, when the parameters differ in name, type or shape."""
    for name in wanted | saved:
        there, here = (" ".join(map(str, signature.get(name, ["missing"]))) for signature in (saved, wanted))
        if there != here:
            advice = _advice(saved, wanted)
            raise CheckpointError(f"{path}: {name} is {there} in the checkpoint but {here} here; {advice}")


def _advice(saved: Signature, wanted: Signature) -> str:
    """Which configuration field makes the sizes agree."""
    width = "policy_params.mean_kernel"
    if set(saved) != set(wanted):
        return "it is of another network; check the fields network and ppo"
    if saved[width][1][0] != wanted[width][1][0]:
        return f"set network.hidden_size to {saved[width][1][0]}, or use another run directory"
    return "its observation or action sizes are those of another task; check the field task"


def _named_leaves(tree: Any) -> dict[str, Any]:
    """Leaves by dotted path, in the order of the tree."""
    leaves = jax.tree_util.tree_flatten_with_path(tree)[0]
    return {jax.tree_util.keystr(path, simple=True, separator="."): leaf for path, leaf in leaves}


def _signature(leaves: Mapping[str, Any]) -> Signature:
    return {name: (str(leaf.dtype), tuple(leaf.shape)) for name, leaf in leaves.items()}


def _digest(*groups: Mapping[str, np.ndarray]) -> str:
    """SHA-256 over name, dtype, shape and bytes of every array, group by group, by name."""
    total = hashlib.sha256()
    for group in groups:
        total.update(json.dumps(len(group)).encode())
        for name in sorted(group):
            array = group[name]
            total.update(json.dumps([name, str(array.dtype), list(array.shape)]).encode())
            total.update(array.tobytes())
    return total.hexdigest()


def _digest_of_files(path: Path) -> str:
    """SHA-256 over the name and bytes of every file below `path`, except the one that holds the digest."""
    total = hashlib.sha256()
    for file in sorted(path.rglob("*")):
        if file.is_file() and file.name != _FILES_DIGEST:
            data = file.read_bytes()
            total.update(json.dumps([file.relative_to(path).as_posix(), len(data)]).encode())
            total.update(data)
    return total.hexdigest()


def _saved(directory: Path) -> list[tuple[int, int, Path]]:
    """(step, attempt, path) of every complete step, oldest first."""
    paths = directory.iterdir() if directory.is_dir() else ()
    found = [(match, path) for path in paths if (match := _STEP_NAME.fullmatch(path.name))]
    return sorted((int(match[1]), int(match[2] or 0), path) for match, path in found)


def _prune(directory: Path, step: int, path: Path, keep: int) -> None:
    """Removes what a finished save of `step` at `path` makes superfluous."""
    kept = [number for number in steps(directory) if number <= step][-keep:]
    for number, _, other in _saved(directory):
        if number not in kept or (number == step and other != path):
            shutil.rmtree(other, ignore_errors=True)


def _is_passing(error: BaseException | None) -> bool:
    """Whether an error, or what caused it, may be gone the next time: then the files are not to blame."""
    while error is not None:
        if isinstance(error, MemoryError) or (isinstance(error, OSError) and error.errno in _PASSING):
            return True
        error = error.__cause__ or error.__context__
    return False


def _require_space(directory: Path, size: int) -> None:
    """Fails before the storage library starts, whose many writers cannot be stopped cleanly by a full disk."""
    needed = size + size // 4 + 2**20
    if not hasattr(os, "posix_fallocate"):  # not Linux
        free = shutil.disk_usage(directory).free
        if free < needed:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return
    with tempfile.TemporaryFile(dir=directory) as file:
        os.posix_fallocate(file.fileno(), 0, needed)


def _remove_unfinished(directory: Path) -> None:
    for path in directory.glob(f"{_PARTIAL}*"):
        shutil.rmtree(path, ignore_errors=True)


def _reason(error: BaseException) -> str:
    """One line on what went wrong."""
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    text = " ".join(str(error).split())
    return text if isinstance(error, _DamagedError) else f"{type(error).__name__}: {text[:200]}"
