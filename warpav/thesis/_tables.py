"""The thesis's own tables, printed next to ours."""

from __future__ import annotations

import json
from functools import cache
from importlib import resources
from typing import Any

TABLES = ("I", "II", "III", "IV", "V")
WARNING = (
    "The thesis used other scenes, another vehicle and another detector: compare the trends of the two rows, not the "
    "values."
)


@cache
def _document() -> dict[str, Any]:
    return json.loads(resources.files("warpav.thesis").joinpath("tables.json").read_text())


def thesis_table(number: str) -> dict[str, Any]:
    """One of `TABLES`: ``caption`` as printed, ``note``, and ``rows`` in the order of the thesis."""
    if number not in TABLES:
        raise ValueError(f"number must be one of {', '.join(TABLES)}, got {number!r}")
    return _document()["tables"][number]
