"""Tables with a row for a road user at a moment, as most data sets have them: CSV, feather and Parquet."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from warpav.core.bounded_files import DATA_SET_BYTES_MAX, DATA_SET_NODES_MAX, read_arrow, read_text, refuse_nodes
from warpav.core.errors import InputError
from warpav.scene.traffic.recording import RecordedUser


def read_columns(
    file: Path, numbers: Sequence[str], texts: Sequence[str] = (), *, optional: Sequence[str] = ()
) -> dict[str, np.ndarray]:
    """Columns of a table by name: numbers as float64 or as whole numbers, NaN where one is empty; texts as they are.

    Those of ``optional`` that are not there are left out. Raises `InputError` with file and row where a column is
    missing or a value is no number.
    """
    names = [*numbers, *texts, *optional]
    found = _of_csv(file, names) if file.suffix == ".csv" else _of_arrow(file, names)
    missing = [name for name in names if name not in found and name not in optional]
    if missing:
        raise InputError(f"{file}: expected a column {missing[0]}, got {', '.join(found)}")
    return {
        name: column if name in texts else _numbers(column, f"{file}", name)
        for name, column in found.items()
        if name in names
    }


def _of_csv(file: Path, names: Sequence[str]) -> dict[str, np.ndarray]:
    lines = csv.reader(read_text(file, "a table (CSV)", bytes_max=DATA_SET_BYTES_MAX).splitlines())
    head = [name.strip() for name in next(lines, [])]
    wanted = [k for k, name in enumerate(head) if name in names]
    rows: list[list[str]] = []
    for row in lines:
        if len(row) != len(head):
            raise InputError(f"{file}:{lines.line_num}: expected {len(head)} columns as the head has, got {len(row)}")
        rows.append([row[k] for k in wanted])
        if len(rows) * len(wanted) > DATA_SET_NODES_MAX:
            refuse_nodes(str(file), DATA_SET_NODES_MAX)
    columns = dict.fromkeys(head, np.zeros(0))
    return columns | {head[k]: np.array([row[n] for row in rows], str) for n, k in enumerate(wanted)}


def _of_arrow(file: Path, names: Sequence[str]) -> dict[str, np.ndarray]:
    table = read_arrow(file, "a table")
    found = dict.fromkeys(table.column_names, np.zeros(0))
    return found | {
        name: np.asarray(table[name].to_numpy(zero_copy_only=False)) for name in names if name in table.column_names
    }


def _numbers(column: np.ndarray, place: str, name: str) -> np.ndarray:
    if column.dtype.kind in "iufb":
        return column
    if column.dtype.kind == "U":
        column = np.where(column == "", "nan", column)
    try:
        return column.astype(np.float64)
    except (ValueError, TypeError):
        for number, value in enumerate(column.tolist(), start=2):  # the head is line 1
            try:
                float(value)
            except (ValueError, TypeError):
                raise InputError(f"{place}:{number}: {name}: expected a number, got {value!r}") from None
        raise


def steps_of(time_s: np.ndarray, place: str) -> tuple[np.ndarray, float]:
    """The step of every time, from the first on, int64 [row], and the time between two steps [s]."""
    times = np.unique(time_s)
    if len(times) < 2 or not np.isfinite(times).all():
        raise InputError(f"{place}: expected finite times of two moments or more, got {len(times)}")
    step_s = float(np.median(np.diff(times)))
    return np.round((time_s - times[0]) / step_s).astype(np.int64), step_s


def grouped(key: np.ndarray, step: np.ndarray) -> Iterator[np.ndarray]:
    """The rows of every key, each in the order of its steps."""
    _, number = np.unique(key, return_inverse=True)
    order = np.lexsort((step, number))
    yield from np.split(order, np.flatnonzero(np.diff(number[order])) + 1)


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
