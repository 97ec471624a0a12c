"""Values in users' files with their location, so that every message can name it."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeGuard

import numpy as np

from warpav.core.bounded_files import NODES_MAX, read_json
from warpav.core.errors import InputError
from warpav.core.frames import rotation_from_quaternion
from warpav.core.records import nearest
from warpav.core.yaml_file import Location, dotted, read_yaml

_ROTATION_TOLERANCE = 1e-3  # files round to four decimals


class Record:
    """A value, and where it stands."""

    def __init__(
        self,
        file: Path | str,
        value: Any,  # noqa: ANN401
        location: Location = (),
        line_of: Mapping[Location, int] | None = None,
    ) -> None:
        """The value at ``location`` of a file; ``line_of`` knows the lines of values, as `read_yaml` gives them."""
        self.value = value
        self._file = file
        self._location = location
        self._line_of = line_of or {}

    @property
    def location(self) -> str:
        """File, line where it is known, and field."""
        line = next((self._line_of[part] for part in self._outwards() if part in self._line_of), None)
        file = f"{self._file}" if line is None or not self._location else f"{self._file}:{line}"
        return f"{file}: {dotted(self._location)}" if self._location else file

    def _outwards(self) -> Iterator[Location]:
        return (self._location[:n] for n in range(len(self._location), -1, -1))

    def error(self, expected: str, got: str | None = None) -> InputError:
        """The error that states what was expected here and what was given."""
        text = repr(self.value)
        shown = got or ("nothing" if self.value is None else text if len(text) <= 60 else f"{text:.60}...")
        return InputError(f"{self.location}: expected {expected}, got {shown}")

    def at(self, key: str | int) -> Record:
        """The value of a key or index; of None where there is none."""
        value = None
        if isinstance(self.value, dict):
            value = self.value.get(key)
        elif isinstance(self.value, list) and isinstance(key, int) and key < len(self.value):
            value = self.value[key]
        return Record(self._file, value, (*self._location, str(key)), self._line_of)

    def first_of(self, *keys: str) -> Record:
        """The value of the first key that is there; of None, by the first key, where none is."""
        return self.at(next((key for key in keys if self.at(key).value is not None), keys[0]))

    def mapping(self, expected: str = "a mapping") -> dict[str, Record]:
        """The records of a mapping, in the file's order."""
        if not isinstance(self.value, dict):
            raise self.error(expected)
        return {key: self.at(key) for key in self.value}

    def items(self, expected: str = "a list") -> list[Record]:
        """The records of a list."""
        if not isinstance(self.value, list):
            raise self.error(expected)
        return [self.at(i) for i in range(len(self.value))]

    def text(self, default: str | None = None) -> str:
        """A text that is not empty."""
        if self.value is None and default is not None:
            return default
        if not isinstance(self.value, str) or not self.value.strip():
            raise self.error("a text")
        return self.value.strip()

    def one_of(self, words: Iterable[str]) -> str:
        """One of some words."""
        known = list(words)
        if not isinstance(self.value, str) or self.value not in known:
            got = f"{self.value!r}{nearest(self.value, known)}" if isinstance(self.value, str) else None
            raise self.error(f"one of {', '.join(known)}", got)
        return self.value

    def number(self, default: float | None = None) -> float:
        """A finite number."""
        if self.value is None and default is not None:
            return default
        if not is_number(self.value):
            raise self.error("a finite number")
        return float(self.value)

    def whole(self, default: int | None = None) -> int:
        """A whole number, also where it is written with a point."""
        value = self.value
        if value is None and default is not None:
            return default
        if not is_number(value) or float(value) != int(value):
            raise self.error("a whole number")
        return int(value)

    def numbers(self, *counts: int) -> list[float]:
        """A list of finite numbers, as many as one of ``counts`` says (any, if none is given)."""
        value = self.value
        is_fit = isinstance(value, list) and all(map(is_number, value)) and (not counts or len(value) in counts)
        if not is_fit:
            wanted = f"{' or '.join(map(str, counts))} " if counts else ""
            raise self.error(f"a list of {wanted}finite numbers")
        return [float(number) for number in value]

    def matrix(self, rows: int, columns: int) -> list[list[float]]:
        """A matrix of finite numbers: a list of rows, or of all numbers row by row."""
        value = self.value
        if isinstance(value, list) and len(value) == rows and all(isinstance(row, list) for row in value):
            value = [number for row in value for number in row] if {len(row) for row in value} == {columns} else None
        if not isinstance(value, list) or len(value) != rows * columns or not all(map(is_number, value)):
            raise self.error(f"a {rows} x {columns} matrix of finite numbers")
        return [[float(number) for number in value[i : i + columns]] for i in range(0, rows * columns, columns)]

    def transform(self, rows: int = 4) -> np.ndarray:
        """A rigid transform that the file writes as 3 x 4 or 4 x 4 matrix, [4, 4]."""
        matrix = np.array(self.matrix(rows, 4))
        if rows == 4 and not np.allclose(matrix[3], [0.0, 0.0, 0.0, 1.0], rtol=0.0, atol=1e-6):
            raise self.error("a transform whose last row is 0, 0, 0, 1", f"{matrix[3].tolist()}")
        return rigid_transform(matrix[:3, :3], matrix[:3, 3], self)

    def unit_quaternion(self, quaternion: Sequence[float]) -> np.ndarray:
        """The rotation of a quaternion ``w, x, y, z`` that the file holds here, [3, 3]."""
        length = math.hypot(*quaternion)
        if abs(length - 1.0) > _ROTATION_TOLERANCE:
            raise self.error("a quaternion of length 1", f"{list(quaternion)} of length {length:.6g}")
        return rotation_from_quaternion(np.array(quaternion))


def is_number(value: object) -> TypeGuard[int | float]:
    """Whether it is a finite number of a size that can mean something."""
    return isinstance(value, int | float) and not isinstance(value, bool) and -1e9 < value < 1e9


def rigid_transform(rotation: np.ndarray, position_m: np.ndarray | Sequence[float], record: Record) -> np.ndarray:
    """The transform of a rotation and a position, [4, 4].

    Args:
        rotation: Shape [3, 3]; what rounding has left of it, it is made orthonormal.
        position_m: Shape [3].
    """
    rotation = np.asarray(rotation, dtype=np.float64)
    error = float(np.abs(rotation.T @ rotation - np.eye(3)).max())
    if error > _ROTATION_TOLERANCE:
        raise record.error("a rotation, whose columns are orthonormal", f"one that is off by {error:.2g}")
    if np.linalg.det(rotation) < 0.0:
        raise record.error("a rotation", "one with a mirror; is the file left-handed?")
    left, _, right = np.linalg.svd(rotation)
    transform = np.eye(4)
    transform[:3, :3] = rotation if error < 1e-12 else left @ right
    transform[:3, 3] = position_m
    return transform


def read_json_record(file: Path, kind: str, *, nodes_max: int = NODES_MAX) -> Record:
    """The data of a JSON file."""
    return Record(file, read_json(file, kind, nodes_max=nodes_max))


def read_yaml_record(file: Path) -> Record:
    """The data of a YAML file, with lines."""
    data, line_of = read_yaml(file)
    return Record(file, data, (), line_of)
