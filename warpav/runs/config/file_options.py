"""What options that name files take."""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from pathlib import Path

from warpav.core.section import mistake


def read_path(value: object) -> object:
    """A path, the user's folder in full; what is no text stays as it is."""
    if isinstance(value, str):
        if not value.strip():
            mistake(f"expected a path, got {value!r}")
        return Path(value).expanduser()
    return value


def existing_file(value: str, expected: str, candidates: Sequence[str], words: Sequence[str]) -> None:
    """Reject a path at which there is no file.

    Args:
        value: What was written.
        expected: What it should be, in words.
        candidates: Where the file may lie.
        words: Names that may have been meant instead.
    """
    if any(Path(candidate).expanduser().is_file() for candidate in candidates):
        return
    near = difflib.get_close_matches(value, words, 1, 0.6)
    hint = f"did you mean {near[0]}?" if near else "no such file"
    mistake(f"expected {expected}, got {value!r}; {hint}")
