"""Vehicles that ship with warpav, one GLB file each, as egos and in traffic; ``README.md`` says their source."""

from __future__ import annotations

import difflib
from dataclasses import dataclass
from pathlib import Path

SHIPPED = "shipped"  # what stands for all of them in traffic
_FOLDER = Path(__file__).parent


@dataclass(frozen=True)
class _VehicleAbout:
    """What a shipped vehicle is."""

    title: str  # in words
    source: str  # where its mesh comes from
    licence: str  # under which it stands


def vehicle_names() -> list[str]:
    """Names of the shipped vehicles, sorted, such as ``bus``."""
    return sorted(file.stem for file in _FOLDER.glob("*.glb"))


def vehicle_folder() -> Path:
    return _FOLDER


def vehicle_file(name: str | Path) -> Path | None:
    """The file of the shipped vehicle of this name; None if there is none."""
    return _FOLDER / f"{name}.glb" if str(name) in vehicle_names() else None


def file_of(path: str | Path) -> Path:
    """The mesh file that a user means: of the shipped vehicle of this name, else of this path, such as ``./bus``."""
    return vehicle_file(path) or Path(path).expanduser()


def nearest_name(name: str) -> str | None:
    """The shipped vehicle that a misspelt name may mean; None without one."""
    return next(iter(difflib.get_close_matches(name.lower(), vehicle_names(), 1, 0.6)), None)


def vehicle_about(name: str) -> _VehicleAbout:
    """What the row of a shipped vehicle in ``README.md`` says; ``name`` is one of `vehicle_names`."""
    for line in (_FOLDER / "README.md").read_text(encoding="utf-8").splitlines():
        cell = [each.strip().replace("`", "") for each in line.strip().strip("|").split("|")]
        if cell[0] == name:
            return _VehicleAbout(cell[1], cell[3], cell[4])
    raise AssertionError(f"README.md has no row for {name}")
