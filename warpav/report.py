"""The report of a run: one HTML file that needs nothing else, neither network nor neighbours."""

from __future__ import annotations

import base64
import html
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from string import Template
from typing import Any

from warpav.errors import InputError
from warpav.results import ARM_ROWS, RunFolder, recall_rows
from warpav.yaml_file import read_yaml

CAPTIONS = {
    "rig": "The optimised rig in a test scene",
    "rig_top_view": "From above: where the cameras started, how they moved, where they ended",
    "detections": "A test scene through the cameras, before and after",
    "loss_curves": "Loss, loss terms, multipliers and the smallest camera distance over the iterations",
}
"""Figures of a run in the order of the report; others follow by name."""

_PAGE = Template("""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>warpav: $name</title>
<style>
  :root { --ink: #1d2733; --muted: #66727f; --line: #dde2e8; --paper: #ffffff; --good: #1a7f4b; --bad: #b3261e; }
  * { box-sizing: border-box; }
  body { font: 15px/1.5 system-ui, sans-serif; color: var(--ink); background: #f4f6f8; margin: 0; }
  main { max-width: 1180px; margin: 0 auto; padding: 40px 28px 64px; background: var(--paper); }
  h1 { font-size: 26px; margin: 0; } h2 { font-size: 18px; margin: 40px 0 12px; }
  p.lead { color: var(--muted); margin: 4px 0 0; } .good { color: var(--good); } .bad { color: var(--bad); }
  .wide { overflow-x: auto; }
  table { border-collapse: collapse; width: 100%; font-size: 12.5px; font-variant-numeric: tabular-nums; }
  th, td { padding: 6px 8px; text-align: right; border-bottom: 1px solid var(--line); white-space: nowrap; }
  th { color: var(--muted); font-weight: 600; } th:first-child, td:first-child { text-align: left; }
  td.first { font-weight: 600; background: #f0f6ff; } table.numbers { width: auto; min-width: 60%; }
  tbody + tbody tr:first-child td { border-top: 2px solid var(--line); }
  p.note { color: var(--muted); font-size: 13px; margin: 6px 0 0; max-width: 70em; }
  table.options td { text-align: left; white-space: normal; overflow-wrap: anywhere; }
  .cards { display: flex; flex-wrap: wrap; gap: 12px; margin-top: 24px; }
  .card { flex: 1 1 200px; border: 1px solid var(--line); border-radius: 8px; padding: 12px 16px; }
  .card b { display: block; font-size: 22px; font-variant-numeric: tabular-nums; } .card span { color: var(--muted); }
  figure { margin: 0 0 28px; } figcaption { color: var(--muted); margin-bottom: 6px; }
  img { max-width: 100%; border: 1px solid var(--line); border-radius: 8px; }
  details { margin-top: 12px; } summary { cursor: pointer; color: var(--muted); }
  code { font-size: 13px; }
</style>
</head>
<body><main>
<h1>$name</h1>
<p class="lead">$lead</p>
$body
</main></body>
</html>
""")


def write_report(folder: RunFolder) -> Path:
    """Write ``report.html`` of a run, from what its folder holds so far.

    Args:
        folder: The run folder, finished or stopped.

    Returns:
        The file.

    Raises:
        InputError: The folder holds no iteration and no evaluation yet, or a file of it cannot be read.
    """
    events, evaluation = folder.events(), folder.evaluation()
    if not events and evaluation is None:
        raise InputError(f"{folder.path}: run folder: expected at least one iteration to report on, got none")
    environment = folder.environment()
    options = _options(read_yaml(folder.path / "config.yaml")[0])
    body = [
        _cards(events, evaluation),
        _arms(evaluation),
        _recall(evaluation),
        _paired(evaluation),
        _figures(folder.figures()),
        _details("Configuration", options),
        _details("Environment", _options({key: environment[key] for key in environment if key != "seeds"})),
    ]
    lead = f"{options.get('method', '')} method, {len(events)} iterations on {environment.get('device', '')}, "
    lead += f"warpav {environment.get('warpav', '')}, started {environment.get('started', '')}"
    if evaluation is None:
        lead += " (stopped before the evaluation)"
    return folder.write_report(
        _PAGE.substitute(name=html.escape(folder.path.resolve().name), lead=html.escape(lead), body="\n".join(body))
    )


def _cards(events: Sequence[Mapping[str, Any]], evaluation: Mapping[str, Any] | None) -> str:
    cards: list[tuple[str, str, str]] = []
    if evaluation:
        name, arm = next(iter(evaluation["arms"].items()))
        violation = arm["constraint_violation"]
        cards.append(
            ("constraints met", "yes", "good")
            if violation == 0.0
            else ("constraint violation", f"{_number(violation)} m", "bad")
        )
        training = evaluation.get("training_objective")
        if training and training["start"]:
            change = (training["optimised"] - training["start"]) / training["start"]
            cards.append(("objective, training scenes", f"{change:+.1%}", "good" if change < 0.0 else "bad"))
        cards.append((f"AP50 pooled, {name}", _number(arm["ap50_pooled"]), ""))
        cards.append((f"recall of the rig, {name}", _number(arm["tp_detection_rate"]), ""))
        cards.append((f"false alarms a frame, {name}", _number(arm.get("false_alarms_per_frame")), ""))
    elif events:
        cards.append(("last loss", _number(events[-1]["loss"]), ""))
    inner = "".join(
        f'<div class="card"><b class="{tone}">{html.escape(value)}</b><span>{html.escape(label)}</span></div>'
        for label, value, tone in cards
    )
    return f'<div class="cards">{inner}</div>'


def _arms(evaluation: Mapping[str, Any] | None) -> str:
    if not evaluation:
        return ""
    arms = evaluation["arms"]
    rows = [[heading, *(_number(arm.get(field)) for arm in arms.values())] for field, heading in ARM_ROWS.items()]
    count = evaluation["scenes"]["test"]
    note = (
        '<p class="note">An object counts once, however many cameras see it. Visible: some camera sees enough of it '
        "for a ground-truth box. False alarms: detections that fit no object, and second ones of the same object.</p>"
    )
    return f"<h2>On {count} test scenes</h2>" + _table(["", *arms], [rows], first=1) + note


def _recall(evaluation: Mapping[str, Any] | None) -> str:
    blocks = recall_rows(evaluation["arms"]) if evaluation else []
    if not evaluation or not blocks:
        return ""
    headings = ["", "objects", *evaluation["arms"]]
    note = (
        '<p class="note">Distances and sectors of 45 degrees are those of the middle of an object seen from the middle '
        "of the vehicle that carries the cameras.</p>"
    )
    return "<h2>Recall of the rig by distance, sector and class</h2>" + _table(headings, blocks, first=2) + note


def _paired(evaluation: Mapping[str, Any] | None) -> str:
    if not evaluation or not evaluation.get("paired"):
        return ""
    first = next(iter(evaluation["arms"]))
    paired = evaluation["paired"]
    metrics = [metric for metric in ARM_ROWS if metric in next(iter(paired.values()))]
    rows = [
        [ARM_ROWS[metric], *(_interval(differences[metric]) for differences in paired.values())] for metric in metrics
    ]
    headings = ["difference, scene by scene", *(f"{first} - {other}" for other in paired)]
    return "<h2>Paired differences with 95 % intervals</h2>" + _table(headings, [rows])


def _figures(files: Sequence[Path]) -> str:
    order = list(CAPTIONS)
    files = sorted(files, key=lambda file: (order.index(file.stem) if file.stem in order else len(order), file.stem))
    parts = []
    for file in files:
        data = base64.b64encode(file.read_bytes()).decode()
        caption = html.escape(CAPTIONS.get(file.stem, file.stem))
        image = f'<img alt="{caption}" src="data:image/png;base64,{data}">'
        parts.append(f"<figure><figcaption>{caption}</figcaption>{image}</figure>")
    return "<h2>Figures</h2>" + "\n".join(parts) if parts else ""


def _details(title: str, options: Mapping[str, str]) -> str:
    rows = "".join(
        f"<tr><td><code>{html.escape(name)}</code></td><td>{html.escape(value)}</td></tr>"
        for name, value in options.items()
    )
    return f'<details><summary>{title}</summary><table class="options">{rows}</table></details>'


def _options(data: Mapping[str, Any], prefix: str = "") -> dict[str, str]:
    options: dict[str, str] = {}
    for name, value in data.items():
        if isinstance(value, dict):
            options |= _options(value, f"{prefix}{name}.")
        else:
            options[prefix + name] = "" if value is None else str(value)
    return options


def _table(headings: Sequence[str], blocks: Iterable[Iterable[Sequence[str]]], *, first: int | None = None) -> str:
    """A table of blocks of rows; ``first`` is the column to stress."""

    def line(tag: str, row: Sequence[str]) -> str:
        marks = (' class="first"' if column == first else "" for column in range(len(row)))
        cells = (f"<{tag}{mark}>{html.escape(cell)}</{tag}>" for mark, cell in zip(marks, row, strict=True))
        return f"<tr>{''.join(cells)}</tr>"

    body = ("<tbody>" + "".join(line("td", row) for row in block) + "</tbody>" for block in blocks)
    table = f"<thead>{line('th', headings)}</thead>" + "".join(body)
    return f'<div class="wide"><table class="numbers">{table}</table></div>'


def _interval(difference: Mapping[str, Any]) -> str:
    if difference["mean"] is None:
        return "-"
    if difference["low"] is None:
        return f"{difference['mean']:+.3f}"
    return f"{difference['mean']:+.3f} [{difference['low']:+.3f}, {difference['high']:+.3f}]"


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.4f}"
