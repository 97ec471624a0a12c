"""Cache folders that do not grow without end."""

from __future__ import annotations

import contextlib
import shutil
import time
from pathlib import Path

from warpav.core.atomic_write import DRAFT

IN_USE_S = 3600.0
"""Other runs may still be using a file that was used so short a time ago; nobody writes one for so long."""
FREE_MIN = 0.1
"""Share of the disk that has to be free for what is in use to stay beyond the capacity."""


def remove_oldest(folder: Path, pattern: str, *, capacity_bytes: int) -> None:
    """Remove the files that were not used for the longest time, until the others fit.

    What was used within the last hour goes only where the disk is nearly full: runs side by side would take away each
    other's scenes and make them again and again. What `atomic_write` left behind because its process was killed goes as
    well.

    Args:
        folder: The cache folder; it may not exist.
        pattern: Of the files that count, as `Path.glob` takes it.
        capacity_bytes: What they may hold together.
    """
    with contextlib.suppress(OSError):  # another process removes as well
        now = time.time()
        for draft in folder.glob(f"{DRAFT}*"):
            if now - draft.stat().st_mtime > IN_USE_S:
                draft.unlink()
        found = [(file.stat(), file) for file in folder.glob(pattern)]
        left = sum(status.st_size for status, _ in found)
        for status, file in sorted(found, key=lambda each: each[0].st_mtime):
            if left <= capacity_bytes or (now - status.st_mtime < IN_USE_S and _has_room(folder)):
                break
            file.unlink()
            left -= status.st_size


def _has_room(folder: Path) -> bool:
    disk = shutil.disk_usage(folder)
    return disk.free > FREE_MIN * disk.total
