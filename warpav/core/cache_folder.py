"""Cache folders that do not grow without end."""

from __future__ import annotations

import contextlib
from pathlib import Path


def remove_oldest(folder: Path, pattern: str, *, capacity_bytes: int) -> None:
    """Remove the files that were not used for the longest time, until the others fit.

    Args:
        folder: The cache folder; it may not exist.
        pattern: Of the files that count, as `Path.glob` takes it.
        capacity_bytes: What they may hold together.
    """
    with contextlib.suppress(OSError):  # another process removes as well
        found = [(file.stat(), file) for file in folder.glob(pattern)]
        left = sum(status.st_size for status, _ in found)
        for status, file in sorted(found, key=lambda each: each[0].st_mtime):
            if left <= capacity_bytes:
                break
            file.unlink()
            left -= status.st_size
