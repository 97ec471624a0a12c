"""Writing files that appear whole or not at all."""

from __future__ import annotations

import contextlib
import os
import secrets
import shutil
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator

DRAFT = ".draft-"
"""How the names of files begin that are not whole yet."""


def sync(path: Path) -> None:
    """Wait until a file, or the list of files of a folder, is on the disk; a file that does not exist is none.

    Raises:
        OSError: It cannot be written there.
    """
    with contextlib.suppress(FileNotFoundError):
        handle = os.open(path, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


@contextlib.contextmanager
def atomic_write(file: Path, *, is_durable: bool = False) -> Iterator[Path]:
    """A path of its own to write to; the file takes its place in one step when the block ends well, else it is removed.

    A device or a pipe, such as ``/dev/null`` or ``/dev/stdout``, stays what it is and is given the content.

    Args:
        file: The file.
        is_durable: Whether it is on the disk when this returns, whatever happens to the machine afterwards.

    Raises:
        OSError: The file cannot be replaced, such as where a folder has its name.
    """
    name = f"{DRAFT}{secrets.token_hex(4)}-{file.name}"
    if file.exists() and not (file.is_file() or file.is_dir()):
        with tempfile.TemporaryDirectory() as folder:
            yield Path(folder) / name
            with (Path(folder) / name).open("rb") as draft_stream, file.open("wb") as stream:
                shutil.copyfileobj(draft_stream, stream)
        return
    draft = file.with_name(name)
    try:
        yield draft
        if is_durable:
            sync(draft)
        os.replace(draft, file)
        if is_durable:
            sync(file.parent)
    finally:
        with contextlib.suppress(OSError):  # what went wrong before matters more
            draft.unlink()
