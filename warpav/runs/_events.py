"""The iterations of a run, as ``events.jsonl`` has them: read, checked, made a trajectory or a certificate."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import BaseModel, ConfigDict, Field

from warpav.core.bounded_files import DATA_SET_BYTES_MAX, parse_json, read_bytes
from warpav.core.errors import InputError
from warpav.core.records import read_record

if TYPE_CHECKING:
    import numpy as np

_MEND_EVENTS = "remove the line, or the file to go without the iterations"

_Number = float | None
_Place = tuple[float, float, float]


class Event(BaseModel):
    """An iteration, see `warpav.optimisation._records.IterationRecord`; older versions did not write all of it."""

    model_config = ConfigDict(frozen=True, allow_inf_nan=False)

    iteration: int
    loss: _Number
    positions_m: Annotated[list[_Place], Field(min_length=1)]
    yaw_deg: list[float]
    terms: dict[str, _Number] = {}
    multipliers: dict[str, _Number | list[_Number]] = {}
    gradient: dict[str, list[float] | list[tuple[float, float]]] = {}
    free: dict[str, list[float]] = {}
    training_objective: _Number = None
    seconds: dict[str, float] = {}
    stage: str | None = None
    bound: _Number = None
    camera_renders: int | None = None
    pool_cameras: int | None = None
    modules: list[str] = []

    def mistake(self, camera_count: int | None) -> str | None:
        """Which of its lists does not speak of every camera; ``camera_count`` of the lines before, if they agree."""
        count = len(self.positions_m)
        if camera_count not in (None, count):
            return f"positions_m: expected {camera_count} cameras as in the lines before, got {count}"
        lists: dict[str, Sequence[Any]] = {"yaw_deg": self.yaw_deg}
        lists |= {f"gradient.{name}": values for name, values in self.gradient.items()}
        lists |= {f"free.{name}": values for name, values in self.free.items()}
        for name, values in lists.items():
            if len(values) != count:
                return f"{name}: expected a number for each of {count} cameras, got {str(values)[:40]}"
        return None


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
            place = f"{file}:{number}"
            try:
                wrong = read_record(Event, event, place).mistake(count)
            except InputError as error:
                raise InputError(f"{error}; {_MEND_EVENTS}") from None
            if wrong:
                raise InputError(f"{place}: {wrong}; {_MEND_EVENTS}")
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


def flat_numbers(event: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """The numbers of an event by dotted name; lists are left to ``events.jsonl``."""
    row: dict[str, Any] = {}
    for name, value in event.items():
        if isinstance(value, dict):
            row |= flat_numbers(value, f"{prefix}{name}.")
        elif not isinstance(value, (list, str)):
            row[prefix + name] = value
    return row


@dataclass(frozen=True)
class Bound:
    """What a selection has proven."""

    bound: float
    pool_cameras: int
    camera_renders: int


@dataclass(frozen=True)
class Certificate:
    """How far a rig is from the best rig of a pool of cameras, on the scenes of the search and on no others.

    Attributes:
        scenes: How many scenes the search has seen; None: unknown.
    """

    objective: float
    bounds: tuple[Bound, ...]
    scenes: int | None = None

    @classmethod
    def of(cls, events: Sequence[Mapping[str, Any]], *, scenes: int | None = None) -> Certificate | None:
        """That of a run's iterations, as ``events.jsonl`` has them; None where none of them was a selection."""
        bounds = tuple(
            Bound(event["bound"], event["pool_cameras"], event["camera_renders"])
            for event in events
            if event.get("stage") == "selection"
            and None not in map(event.get, ("bound", "pool_cameras", "camera_renders"))
        )
        objective = events[-1].get("training_objective") if bounds else None
        return None if objective is None else cls(objective, bounds, scenes)

    @property
    def bound(self) -> float:
        """The last one."""
        return self.bounds[-1].bound

    @property
    def pool_cameras(self) -> int:
        """Cameras that it is over."""
        return self.bounds[-1].pool_cameras

    @property
    def gap(self) -> float:
        """Objective less bound; negative where the polish went below what the pool's cameras can reach."""
        return self.objective - self.bound

    def to_json(self) -> dict[str, Any]:
        """As ``evaluation.json`` has it."""
        return {
            "objective": self.objective,
            "bound": self.bound,
            "gap": self.gap,
            "pool_cameras": self.pool_cameras,
            "scenes": self.scenes,
            "bounds": [asdict(each) for each in self.bounds],
        }
