"""Cache folders that do not grow without end."""

from __future__ import annotations

import contextlib
import time
from pathlib import Path

from warpav.core.atomic_write import DRAFT

_ABANDONED_S = 3600.0  # nobody writes a file for so long


def remove_oldest(folder: Path, pattern: str, *, capacity_bytes: int) -> None:
    """Remove the files that were not used for the longest time, until the others fit.

    What `atomic_write` left behind because its process was killed goes as well.

    Args:
        folder: The cache folder; it may not exist.
        pattern: Of the files that count, as `Path.glob` takes it.
        capacity_bytes: What they may hold together.
    """
    with contextlib.suppress(OSError):  # another process removes as well
        for draft in folder.glob(f"{DRAFT}*"):
            if time.time() - draft.stat().st_mtime > _ABANDONED_S:
                draft.unlink()
        found = [(file.stat(), file) for file in folder.glob(pattern)]
        left = sum(status.st_size for status, _ in found)
        for status, file in sorted(found, key=lambda each: each[0].st_mtime):
            if left <= capacity_bytes:
                break
            file.unlink()
            left -= status.st_size
