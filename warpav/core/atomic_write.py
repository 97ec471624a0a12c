"""Writing files that appear whole or not at all."""

from __future__ import annotations

import contextlib
import os
import secrets
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator

DRAFT = ".draft-"
"""How the names of files begin that are not whole yet."""


@contextlib.contextmanager
def atomic_write(file: Path) -> Iterator[Path]:
    """A path of its own to write to; the file takes its place in one step when the block ends well, else it is removed.

    Raises:
        OSError: The file cannot be replaced, such as where a folder has its name.
    """
    draft = file.with_name(f"{DRAFT}{secrets.token_hex(4)}-{file.name}")
    try:
        yield draft
        os.replace(draft, file)
    finally:
        with contextlib.suppress(OSError):  # what went wrong before matters more
            draft.unlink()
