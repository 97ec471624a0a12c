"""The tables of ``warpav bench``: this run, embree in this run, and other renderers as measured elsewhere."""

from __future__ import annotations

import json
from collections.abc import Mapping
from importlib.resources import files
from typing import Any

from warpav.experiments.bench._scores import gradient_scores
from warpav.experiments.bench._workload import Truth
from warpav.runs import TerminalTable

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
