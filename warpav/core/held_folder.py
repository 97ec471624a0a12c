"""Folders that one process at a time writes to."""

from __future__ import annotations

import contextlib
import errno
import os
from collections.abc import Iterator
from pathlib import Path

_TAKEN = (errno.EAGAIN, errno.EACCES)


@contextlib.contextmanager
def held_folder(folder: Path) -> Iterator[bool]:
    """Hold a folder while the block runs; whether nobody else did.

    The system holds it for the process and lets go when that ends, however it ends: nothing is written, and nothing is
    left behind. Where a file system cannot hold folders, such as NFS, everybody may.

    Args:
        folder: It exists.
    """
    try:
        import fcntl
    except ImportError:  # no such thing on Windows
        yield True
        return
    handle = os.open(folder, os.O_RDONLY)
    is_free = True
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            is_free = error.errno not in _TAKEN
        yield is_free
    finally:
        os.close(handle)
