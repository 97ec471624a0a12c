"""How far results are from the truth; plain NumPy."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from warpav.experiments.bench._workload import WEIGHT_NAMES, Truth

PARTS = {"xz": [0, 1], "xzyaw": [0, 1, 2]}


def gradient_scores(
    gradient: Mapping[str, np.ndarray], truth: Mapping[str, np.ndarray]
) -> dict[str, dict[str, dict[str, float | None]]]:
    """Angle and relative error of gradients to x, z, yaw at every pose, [pose, 3], by weight and part."""
    result: dict[str, dict[str, dict[str, float | None]]] = {}
    for name in WEIGHT_NAMES:
        result[name] = {}
        for part, columns in PARTS.items():
            ours, expected = gradient[name][:, columns], truth[name][:, columns]
            length = np.linalg.norm(expected, axis=1)
            kept = length > 0
            error = np.linalg.norm(ours - expected, axis=1)[kept] / length[kept]
            own_length = np.linalg.norm(ours, axis=1)[kept]
            cosine = (ours * expected).sum(axis=1)[kept] / np.maximum(own_length * length[kept], np.finfo(float).tiny)
            total = np.linalg.norm(expected)
            result[name][part] = {
                "cos_median": _statistic(np.median, cosine),
                "cos_min": _statistic(np.min, cosine),
                "rel_median": _statistic(np.median, error),
                "rel_p90": _statistic(lambda values: np.percentile(values, 90), error),
                "rel_max": _statistic(np.max, error),
                "rel_all": float(np.linalg.norm(ours - expected) / total) if total > 0 else None,
            }
    return result


class ImageScores:
    """Compares objects and depths with the truth, some views at a time."""

    def __init__(self, truth: Truth) -> None:
        self._truth = truth
        self._same = 0
        self._pixel_count = 0
        self._depth_error_m: list[np.ndarray] = []

    def add(self, first_view: int, object_index: np.ndarray, depth_m: np.ndarray) -> None:
        """Compare consecutive views by objects (-1: none) and depths [m], both [view, row, column]."""
        for row, view in enumerate(self._truth.object_view):
            i = int(view) - first_view
            if not 0 <= i < len(object_index):
                continue
            same = object_index[i] == self._truth.object_index[row]
            self._same += int(same.sum())
            self._pixel_count += same.size
            seen = same & (self._truth.object_index[row] >= 0)
            error = depth_m[i][seen].astype(np.float64) - self._truth.depth_m[row][seen]
            self._depth_error_m.append(np.abs(error).astype(np.float32))

    def result(self) -> dict[str, Any]:
        """Share of pixels with the same object, and errors of the depth [m] where it is the same; None: no pixels."""
        error = np.concatenate([np.zeros(0, np.float32), *self._depth_error_m])
        return {
            "id_share": self._same / self._pixel_count if self._pixel_count else None,
            "depth_median_m": _statistic(np.median, error),
            "depth_p999_m": _statistic(lambda values: np.percentile(values, 99.9), error),
            "depth_max_m": _statistic(np.max, error),
        }


def _statistic(of: Any, values: np.ndarray) -> float | None:  # noqa: ANN401 (a function of an array)
    return float(of(values)) if len(values) else None
