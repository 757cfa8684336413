"""Gives finished files their names so that a loss of power leaves the old content or the new, never a part of it."""

import errno
import os
from pathlib import Path

_CANNOT = (errno.EINVAL, errno.ENOTSUP)  # some file systems do not force directories


def replace(partial: Path, path: Path) -> None:
    """Renames a file or directory, with all that is below it on the disk before and its new name after.

    Args:
      partial: closed and complete.
      path: a file there is replaced; a directory must not exist.

    Raises:
      OSError: the disk does not take it.
    """
    if partial.is_dir():
        for place, _, files in os.walk(partial):
            for name in files:
                _force(Path(place, name))
            _force(Path(place))
    else:
        _force(partial)
    os.replace(partial, path)
    _force(path.parent)


def _force(path: Path) -> None:
    """Waits until a file, or the list of names in a directory, is on the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno not in _CANNOT or not path.is_dir():
            raise
    finally:
        os.close(descriptor)
