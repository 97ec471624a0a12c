"""The thesis's own tables, to be printed beside ours."""

from __future__ import annotations

import json
from functools import cache
from importlib import resources
from typing import Any

TABLES = ("I", "II", "III", "IV", "V")
WARNING = (
    "The thesis's scenes, vehicle and detector are not these, so the two columns say whether things behave alike, "
    "not which is better."
)


@cache
def _document() -> dict[str, Any]:
    return json.loads(resources.files("warpav.experiments").joinpath("thesis_tables.json").read_text())


def thesis_table(number: str) -> dict[str, Any]:
    """One of `TABLES`: ``caption`` as printed, ``note``, and ``rows`` in the order of the thesis.

    Raises:
        ValueError: There is no such table.
    """
    if number not in TABLES:
        raise ValueError(f"number must be one of {', '.join(TABLES)}, got {number!r}")
    return _document()["tables"][number]
