"""The iterations of a run, as ``events.jsonl`` has them: read, checked, made a trajectory or numbers."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from warpav.core.bounded_files import DATA_SET_BYTES_MAX, parse_json, read_bytes
from warpav.core.errors import InputError

if TYPE_CHECKING:
    import numpy as np

_MEND_EVENTS = "remove the line, or the file to go without the iterations"


def read_events(file: Path, *, least: int = 0) -> list[dict[str, Any]]:
    """The iterations in a file; a line that was cut off in the middle of being written is left out."""
    if not file.exists():
        return []
    lines = read_bytes(file, "the iterations of a run", bytes_max=DATA_SET_BYTES_MAX).split(b"\n")
    events: list[dict[str, Any]] = []
    for number, line in enumerate(lines, start=1):
        try:
            event = parse_json(line, "", "an iteration") if line.strip() else None
        except InputError as error:
            if number == len(lines):
                break
            shown = line[:40].decode(errors="backslashreplace")
            raise InputError(
                f"{file}:{number}: expected one JSON object per line, got {shown!r} ({error}); {_MEND_EVENTS}"
            ) from None
        if event is not None:
            # of modules a rig may have more than another
            count = len(events[0]["positions_m"]) if events and not events[0].get("modules") else None
            wrong = _event_mistake(event, camera_count=count)
            if wrong:
                raise InputError(f"{file}:{number}: {wrong}; {_MEND_EVENTS}")
            events.append(event)
    if len(events) < least:
        raise InputError(
            f"{file}: expected the {least} iterations of a run that has ended, got {len(events)}; was it cut off?"
        )
    return events


def trajectory(events: Sequence[Mapping[str, Any]]) -> np.ndarray | None:
    """Camera positions over the iterations [m], shape [iteration, camera, 3]; None for fewer than two iterations."""
    import numpy as np

    evaluated = [event for event in events if event.get("training_objective") is not None]
    best = min(evaluated, key=lambda event: event["training_objective"], default=None)
    if best is not None:
        events = [event for event in events if event.get("descent") == best.get("descent")]
        events = of_modules(events, best.get("modules"))
    path = [event["positions_m"] for event in events]
    return np.array(path) if len(path) > 1 else None


def of_modules(events: Sequence[Mapping[str, Any]], modules: Sequence[str | None] | None) -> list[Mapping[str, Any]]:
    """The iterations whose rigs have the modules of another, camera by camera; without modules all of them."""
    wanted = [] if modules is None else [each for each in modules if each is not None]
    return [event for event in events if not event.get("modules") or list(event["modules"]) == wanted]


def _event_mistake(event: object, *, camera_count: int | None) -> str | None:
    """What keeps a line of ``events.jsonl`` from being an iteration of a run of so many cameras; None: nothing."""
    if not isinstance(event, dict):
        return f"expected one JSON object per line, got {str(event)[:40]!r}"
    missing = [name for name in ("iteration", "loss", "positions_m", "yaw_deg") if name not in event]
    if missing:
        return f"expected an iteration of a run with {missing[0]}, got {', '.join(list(event)[:5]) or 'no field'}"
    places, yaws = event["positions_m"], event["yaw_deg"]
    if not (isinstance(places, list) and places and all(_are_finite(place, 3) for place in places)):
        return f"positions_m: expected [x, y, z] of every camera, got {str(places)[:40]}"
    if camera_count not in (None, len(places)):
        return f"positions_m: expected {camera_count} cameras as in the lines before, got {len(places)}"
    if not _are_finite(yaws, len(places)):
        return f"yaw_deg: expected a number for each of {len(places)} cameras, got {str(yaws)[:40]}"
    for name in ("loss", "training_objective", "bound", "pool_cameras", "camera_renders"):
        if not _is_number_or_none(event.get(name)):
            return f"{name}: expected a number or null, got {str(event[name])[:40]!r}"
    return _part_mistake(event, len(places))


def _part_mistake(event: Mapping[str, Any], camera_count: int) -> str | None:
    """The same for what is under a name: terms, multipliers, gradient and free, where they are there."""
    for name in ("terms", "multipliers", "gradient", "free"):
        if not isinstance(event.get(name, {}), dict):
            return f"{name}: expected values by name, got {str(event[name])[:40]}"
    for name in ("terms", "multipliers"):
        for key, value in event.get(name, {}).items():
            is_list = name == "multipliers" and isinstance(value, list)
            if not all(_is_number_or_none(each) for each in (value if is_list else [value])):
                return f"{name}.{key}: expected a number or null, got {str(value)[:40]!r}"
    gradient = event.get("gradient")
    if gradient:
        slopes = gradient.get("position_per_m")
        has_slopes = isinstance(slopes, list) and len(slopes) == camera_count
        if not has_slopes or not all(_are_finite(slope, 2) for slope in slopes):
            return f"gradient.position_per_m: expected [x, y] of {camera_count} cameras, got {str(slopes)[:40]}"
    turns = {"gradient.yaw_per_rad": gradient.get("yaw_per_rad")} if gradient else {}
    for name, values in {**turns, **{f"free.{key}": value for key, value in event.get("free", {}).items()}}.items():
        if not _are_finite(values, camera_count):
            return f"{name}: expected a number for each of {camera_count} cameras, got {str(values)[:40]}"
    return None


def _is_number_or_none(value: object) -> bool:
    return value is None or (isinstance(value, (int, float)) and math.isfinite(value))


def _are_finite(numbers: object, count: int) -> bool:
    return (
        isinstance(numbers, list)
        and len(numbers) == count
        and all(isinstance(number, (int, float)) and math.isfinite(number) for number in numbers)
    )


def flat_numbers(event: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """The numbers of an event by dotted name; lists are left to ``events.jsonl``."""
    row: dict[str, Any] = {}
    for name, value in event.items():
        if isinstance(value, dict):
            row |= flat_numbers(value, f"{prefix}{name}.")
        elif not isinstance(value, (list, str)):
            row[prefix + name] = value
    return row
