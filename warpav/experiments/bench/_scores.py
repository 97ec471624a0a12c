"""How far results are from the truth; plain NumPy."""

from __future__ import annotations

import json
from collections.abc import Mapping
from importlib.resources import files
from typing import Any

import numpy as np

from warpav.experiments.bench._workload import WEIGHT_NAMES, Truth
from warpav.runs import TerminalTable

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


_TITLES = {"w1": "W1 gradient", "w2": "W2 depth, object", "w3": "W3 colour"}
_ERROR_HEADING = "error of x, z, yaw"
_SMALL_ERROR_HEADING = "of x, z"
_ELSEWHERE = "measured elsewhere"


def bench_table(content: Mapping[str, Any], *, with_peers: bool) -> TerminalTable:
    """One row for this run's figure of every item, and below it what to compare it with."""
    work, device = content["workload"], content["device"]
    table = TerminalTable(
        f"{work['file']}: {work['faces']} triangles, {work['views']} views of {work['res']} x {work['res']} px, "
        f"{content['options']['lens']}"
    )
    for heading in ("item", "renderer", "where"):
        table.add_column(heading, justify="left")
    for heading in ("median ms", "threads", "peak MiB", _ERROR_HEADING, _SMALL_ERROR_HEADING):
        table.add_column(heading, justify="right")
    peers = _peers()["rows"] if with_peers else []
    reference = content.get("reference", {}).get("embreex", {})
    for item, entry in content["items"].items():
        scores = content["scores"].get(item)
        name = f"warpav x{content['options']['supersample']}" if item == "w1" else "warpav"
        errors = _gradient_errors(scores) if item == "w1" else (_image_errors(scores) if item == "w2" else "", "")
        cells = (_milliseconds(entry["median_ms"]), str(entry["threads"]), _mebibytes(entry), *errors)
        table.add_row(_TITLES[item], name, f"this run, {device['kind']}", *cells, style="bold")
        if item in reference:
            median_ms = _milliseconds(reference[item]["median_ms"])
            ratio = f"warpav / embreex = {reference[item]['ratio']:.2f}"
            table.add_row("", "embreex", "this run, cpu", median_ms, str(reference["threads"]), "", ratio, "")
        for peer in (row for row in peers if row["item"] == item):
            cells = (_milliseconds(peer["median_ms"]), str(peer.get("threads", "")), _mebibytes(peer))
            where = f"{_ELSEWHERE}, {peer['device']}"
            table.add_row("", peer["peer"], where, *cells, *_gradient_errors(peer.get("accuracy")), style="dim")
        table.add_section()
    return table


def peer_note() -> str:
    """What the figures of other renderers are."""
    peers = _peers()
    devices = "; ".join(f"{kind}: {name}" for kind, name in peers["devices"].items())
    return (
        f"{_ELSEWHERE}: on {peers['measured']}, {devices}\n"
        "error: relative error of the gradient, smooth / white weights, over all scored poses; m: median over the poses"
    )


def sweep_table(content: Mapping[str, Any], truth: Truth | None) -> TerminalTable:
    """Time and accuracy of W1 for every supersampling."""
    table = TerminalTable("W1 by supersampling")
    for heading in ("supersampling", "median ms", "min ms", "peak MiB", _ERROR_HEADING, _SMALL_ERROR_HEADING):
        table.add_column(heading, justify="right")
    for row in content["sweep"]:
        errors = _gradient_errors(row["scores"].get("w1"))
        times = [_milliseconds(row[name]) for name in ("median_ms", "min_ms")]
        table.add_row(f"x{row['supersample']}", *times, _mebibytes(row), *errors)
    if truth is not None:
        own = gradient_scores(truth.check_gradient, truth.gradient)
        table.add_section()
        table.add_row("the truth's own", "", "", "", *_gradient_errors(own))
    return table


def _peers() -> dict[str, Any]:
    text = files("warpav.experiments.bench").joinpath("data", "peers.json").read_text(encoding="utf-8")
    return json.loads(text)


def _gradient_errors(scores: Mapping[str, Any] | None) -> tuple[str, str]:
    """Relative errors of (x, z, yaw) and of (x, z), each for smooth and for white weights."""
    if not scores:
        return "", ""
    return tuple(  # pyright: ignore[reportReturnType]
        " / ".join(
            f"{score['rel_all']:.4f}"
            if score.get("rel_all") is not None
            else "-"
            if score.get("rel_median") is None
            else f"{score['rel_median']:.2f} m"
            for score in (scores[weight][part] for weight in ("smooth", "white"))
        )
        for part in ("xzyaw", "xz")
    )


def _image_errors(scores: Mapping[str, float | None] | None) -> str:
    if not scores or scores["id_share"] is None:
        return "-" if scores else ""
    text = f"objects {100.0 * scores['id_share']:.4f} %"
    if scores["depth_p999_m"] is not None:
        text += f", depth 99.9 %: {scores['depth_p999_m']:.1e} m"
    return text


def _milliseconds(value: float) -> str:
    return f"{value:.2f}" if value < 10 else f"{value:.1f}" if value < 1000 else f"{value:,.0f}"


def _mebibytes(entry: Mapping[str, Any]) -> str:
    value = entry.get("peak_rss_mib", entry.get("peak_device_mib"))
    return "" if value is None else f"{value:.0f}"
