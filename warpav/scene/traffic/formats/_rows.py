"""Tables with a row for a road user at a moment, as most data sets have them: CSV, feather and Parquet."""

from __future__ import annotations

import codecs
import csv
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from itertools import islice
from pathlib import Path

import numpy as np

from warpav.core.bounded_files import STREAM_NODES_MAX, read_arrow, read_parts, refuse_nodes
from warpav.core.errors import InputError
from warpav.scene.traffic.recording import RecordedUser

USUAL_SIZE_M = {
    "car": (4.7, 1.9, 1.6), "bus": (12.0, 2.6, 3.1), "motorcycle": (2.2, 0.8, 1.6), "bicycle": (1.8, 0.6, 1.7),
    "pedestrian": (0.6, 0.6, 1.7),
}  # fmt: skip
"""Length, width and height of a class [m], where none were recorded; riders are on their machines."""
_CSV = "a table (CSV)"
_CHUNK_ROWS = 20_000
_TEXT_MAX, _LINE_MAX = 200, 1_000_000  # characters of a value, which ends there, and of a line
_NOMINAL_SIZE_M = {"pedestrian": (0.5, 0.6), "bicycle": (1.8, 0.6), "motorcycle": (2.1, 0.8)}
_HEADING_FROM_M_S = 0.3  # a slower velocity gives no heading


class Columns(dict[str, np.ndarray]):
    """Columns of a table by name; ``unread`` are the names of those that are neither asked for nor harmless."""

    unread: Sequence[str] = ()


def read_columns(
    file: Path, numbers: Sequence[str], texts: Sequence[str] = (), *, optional: Sequence[str] = (), harmless: str = ""
) -> Columns:
    """Columns of a table by name: numbers as float64 or as whole numbers, NaN where one is empty; texts as they are.

    Those of ``optional`` that are not there are left out; ``harmless`` is a pattern of names. Raises
    `InputError` with file and row where a column is missing or a value is no number.
    """
    names = [*numbers, *texts, *optional]
    found = _of_csv(file, names, texts) if file.suffix == ".csv" else _of_arrow(file, names)
    missing = [name for name in names if name not in found and name not in optional]
    if missing:
        raise InputError(f"{file}: expected a column {missing[0]}, got {', '.join([*found][:30])[:300] or 'none'}")
    columns = Columns(
        (name, column if name in texts else _numbers(column, f"{file}", name))
        for name, column in found.items()
        if name in names
    )
    columns.unread = [name for name in found if name not in names and name and not re.fullmatch(harmless, name)]
    return columns


def _of_csv(file: Path, names: Sequence[str], texts: Sequence[str]) -> dict[str, np.ndarray]:
    """Columns of a CSV file; those without these names are empty."""
    lines = csv.reader(_lines(file))
    try:
        head = [name.strip() for name in next(lines, [])]
        place = {name: head.index(name) for name in head if name in names}
        chunks: dict[str, list[np.ndarray]] = {name: [np.zeros(0, str if name in texts else float)] for name in place}
        number = 2  # of the first line of a chunk
        while rows := list(islice(lines, _CHUNK_ROWS)):
            for k, row in enumerate(rows):
                if row and len(row) != len(head):
                    expected = f"expected {len(head)} columns as the head has"
                    raise InputError(f"{file}:{number + k}: {expected}, got {len(row)}; is it cut off?")
            for name, k in place.items():
                words = [row[k].strip()[:_TEXT_MAX] for row in rows if row]
                chunks[name].append(np.array(words, str) if name in texts else _numbers(words, f"{file}", name, number))
            number += len(rows)
            if number * len(place) > STREAM_NODES_MAX:
                refuse_nodes(f"{file}", STREAM_NODES_MAX)
    except (csv.Error, UnicodeDecodeError) as error:
        reason = "not UTF-8 text" if isinstance(error, UnicodeDecodeError) else error
        raise InputError(f"{file}:{lines.line_num + 1}: expected {_CSV}, got: {reason}") from None
    return dict.fromkeys(head, np.zeros(0)) | {name: np.concatenate(each) for name, each in chunks.items()}


def _lines(file: Path) -> Iterator[str]:
    rest = ""
    for text in codecs.iterdecode(read_parts(file, _CSV), "utf-8-sig"):
        *whole, rest = (rest + text).split("\n")
        if len(rest) > _LINE_MAX:
            raise InputError(f"{file}: expected {_CSV}, got a line of more than {_LINE_MAX:,} characters")
        yield from whole
    yield rest


def _of_arrow(file: Path, names: Sequence[str]) -> dict[str, np.ndarray]:
    table = read_arrow(file, "a table")
    found = dict.fromkeys(table.column_names, np.zeros(0))
    return found | {
        name: np.asarray(table[name].to_numpy(zero_copy_only=False)) for name in names if name in table.column_names
    }


def _numbers(column: np.ndarray | list[str], place: str, name: str, first: int = 2) -> np.ndarray:
    """A column as numbers; its first value stands in line ``first``, as the head does in line 1."""
    if isinstance(column, np.ndarray) and column.dtype.kind in "iufb":
        return column
    try:
        return np.array(column, np.float64)
    except (ValueError, TypeError):
        values = [math.nan if isinstance(value, str) and not value else value for value in column]
    for number, value in enumerate(values, start=first):
        try:
            float(value)
        except (ValueError, TypeError):
            raise InputError(f"{place}:{number}: {name}: expected a number, got {value!r}") from None
    return np.array(values, np.float64)


def steps_of(time_s: np.ndarray, place: str) -> tuple[np.ndarray, float]:
    """The step of every time, from the first on, int64 [row], and the time between two steps [s]."""
    times = np.unique(time_s)
    if not np.isfinite(times).all():
        raise InputError(f"{place}: expected a finite time in every row, got {times[~np.isfinite(times)][0]}")
    if len(times) < 2:
        raise InputError(f"{place}: expected times of two moments or more, got {len(times)}")
    step_s = float(np.median(np.diff(times)))
    # gap by gap, as the steps of real sensors are not all alike, and what they are off by would add up
    step = np.r_[0, np.round(np.clip(np.diff(times) / step_s, 0.0, 2.0**40)).cumsum()].astype(np.int64)
    return step[np.searchsorted(times, time_s)], step_s


def grouped(key: np.ndarray, step: np.ndarray) -> Iterator[np.ndarray]:
    """The rows of every key, each in the order of its steps."""
    _, number = np.unique(key, return_inverse=True)
    order = np.lexsort((step, number))
    yield from np.split(order, np.flatnonzero(np.diff(number[order])) + 1) if len(order) else ()


def users_of(
    rows: Mapping[str, np.ndarray], category: Mapping[str, str], speed_m_s: np.ndarray | None = None
) -> tuple[list[RecordedUser], list[str]]:
    """Road users of rows, and the words of those that are none.

    Args:
        rows: Columns ``id``, ``type``, ``step``, ``x_m``, ``y_m``, ``yaw_rad``, ``length_m``, ``width_m`` and, where
            they are known, ``height_m``; sizes are the medians over a road user's rows.
        category: The class of every type that is a road user.
        speed_m_s: Speed along the yaw, float64 [row].
    """
    users, others = [], []
    height = rows.get("height_m")
    for row in grouped(rows["id"], rows["step"]):
        word = str(rows["type"][row[0]])
        if word not in category:
            others.append(word)
            continue
        size = [float(np.median(rows[name][row])) for name in ("length_m", "width_m")]
        pose = np.stack([rows[name][row] for name in ("x_m", "y_m", "yaw_rad")], axis=1).astype(np.float64)
        users.append(
            RecordedUser(
                str(rows["id"][row[0]]), category[word],
                (size[0], size[1], math.nan if height is None else float(np.median(height[row]))),
                rows["step"][row].astype(np.int64), pose, None if speed_m_s is None else speed_m_s[row],
            )
        )  # fmt: skip
    return users, others


def speed_along(yaw_rad: np.ndarray, velocity_m_s: np.ndarray) -> np.ndarray:
    """Speed of velocities [row, 2], negative backwards; its size tells nothing of a wrong yaw, which others find."""
    x, y = velocity_m_s.T
    return np.copysign(np.hypot(x, y), x * np.cos(yaw_rad) + y * np.sin(yaw_rad))


def stamp_of(file: Path) -> tuple[int, int]:
    """Time of change and size of a file, while which its content is the same."""
    try:
        about = file.stat()
    except OSError as error:
        raise InputError(f"{file}: expected recorded traffic, got: {error.strerror}") from None
    return about.st_mtime_ns, about.st_size


def with_people(
    rows: dict[str, np.ndarray], category: Mapping[str, str], velocity_m_s: np.ndarray
) -> tuple[list[RecordedUser], list[str]]:
    """The same with velocities over ground [m/s], float64 [row, 2], of data sets that do not measure who is small.

    Two-wheelers and people without a size get the usual one, and the heading of their motion.
    """
    for row in grouped(rows["id"], rows["step"]):
        size_m = _NOMINAL_SIZE_M.get(category.get(str(rows["type"][row[0]]), ""))
        if size_m is None or (rows["length_m"][row] > 0.0).any():
            continue
        rows["length_m"][row], rows["width_m"][row] = size_m
        moving = np.flatnonzero(np.linalg.norm(velocity_m_s[row], axis=1) > _HEADING_FROM_M_S)
        if len(moving):  # whoever stands keeps the heading of before or, at first, has that of after
            last = moving[np.maximum(np.searchsorted(moving, np.arange(len(row)), side="right") - 1, 0)]
            rows["yaw_rad"][row] = np.arctan2(*velocity_m_s[row[last]].T[::-1])
        else:
            rows["yaw_rad"][row] = np.nan_to_num(rows["yaw_rad"][row])
    along = np.stack([np.cos(rows["yaw_rad"]), np.sin(rows["yaw_rad"])], axis=1)
    return users_of(rows, category, (velocity_m_s * along).sum(axis=1))
