"""What a search by a pool has proven: how good the best rig of the pool's cameras can be at most."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any


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
