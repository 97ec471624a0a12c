"""Check whether a rig meets requirements: how much of each, where not, and how many cameras see every point."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from warpav.core.errors import one_line
from warpav.core.table import aligned
from warpav.raster.mesh import Mesh
from warpav.rig import Rig
from warpav.sight._read import read_requirements
from warpav.sight._requirement import SECTORS, Body, Ghosts, Requirement
from warpav.sight._visibility import RENDER_WIDTH_PX, GhostWorld, Visibility, poses_of

if TYPE_CHECKING:
    from warpav.raster.pane import Pane
    from warpav.scene import Scene

_WORST_COUNT = 5  # points of a requirement that a table and JSON name

_SCHEMA = "warpav-requirements/1"


@dataclass(frozen=True)
class WorstPoint:
    """A point that is not met, or the one that is met most narrowly."""

    position_m: tuple[float, float]
    cameras: int
    visible_share: float
    pixels: float  # the largest area that one camera sees [px^2]
    camera: str | None


@dataclass(frozen=True)
class Gap:
    """Neighbouring points that are not met."""

    sector: str
    area_m2: float

    @classmethod
    def largest(cls, point_m: np.ndarray, spacing_m: float, middle_m: np.ndarray) -> Gap | None:
        """The largest of unmet points of a grid [point, 2], by sector around a middle [m]; None without points."""
        from scipy import ndimage

        if not len(point_m):
            return None
        cell = np.rint((point_m - point_m.min(axis=0)) / spacing_m).astype(int)
        is_unmet = np.zeros(cell.max(axis=0) + 1, bool)
        is_unmet[tuple(cell.T)] = True
        labels = np.zeros(is_unmet.shape, np.int32)
        ndimage.label(is_unmet, np.ones((3, 3)), output=labels)
        label = labels[tuple(cell.T)]
        largest = int(np.bincount(label).argmax())
        x, y = point_m[label == largest].mean(axis=0) - middle_m
        sector = round(math.atan2(y, x) / (2.0 * math.pi) * len(SECTORS)) % len(SECTORS)
        return cls(SECTORS[sector], float((label == largest).sum() * spacing_m**2))


@dataclass(frozen=True)
class RequirementOutcome:
    """How well a rig meets one requirement."""

    requirement: Requirement
    points: int
    met: int
    worst: tuple[WorstPoint, ...]
    gap: Gap | None

    @property
    def share(self) -> float:
        """Share of its points that are met, 0..1."""
        return self.met / self.points

    @property
    def is_met(self) -> bool:
        """Whether as many points are met as it asks for; where it asks for none, always."""
        asked = self.requirement.share
        return asked is None or self.met >= asked * self.points - 1e-9

    def to_json(self) -> dict[str, Any]:
        """As a JSON file has it."""
        requirement = self.requirement
        return {
            "name": requirement.name,
            "hard": requirement.is_hard,
            "weight": requirement.weight,
            "need": {
                "object": requirement.test_object.kind,
                "visible_share": requirement.visible_share,
                "pixels": requirement.pixels,
                "cameras": requirement.cameras,
                "share": requirement.share,
            },
            "points": self.points,
            "met": self.met,
            "share": self.share,
            "is_met": self.is_met,
            "gap": None if self.gap is None else asdict(self.gap),
            "worst": [{**asdict(point), "position_m": list(point.position_m)} for point in self.worst],
        }


@dataclass(frozen=True, eq=False)
class RequirementResult:
    """What a rig meets of some requirements, point by point."""

    camera_names: tuple[str, ...]
    ghosts: Ghosts
    body: Body
    visibility: Visibility

    @cached_property
    def meets(self) -> np.ndarray:
        """Whether each camera sees enough of each test object, bool [camera, ghost]."""
        return self.visibility.meets(self.ghosts)

    @property
    def camera_count(self) -> np.ndarray:
        """How many cameras see enough of each test object, int [ghost]."""
        return self.meets.sum(axis=0)

    @property
    def is_point_met(self) -> np.ndarray:
        """Whether enough cameras do, bool [ghost]."""
        return self.camera_count >= self.ghosts.of_each("cameras")

    @cached_property
    def outcomes(self) -> tuple[RequirementOutcome, ...]:
        """One for each requirement, in order."""
        return tuple(self._outcome(r) for r in range(len(self.ghosts.requirements)))

    @property
    def is_met(self) -> bool:
        """Whether every requirement is met, hard ones and others."""
        return all(each.is_met for each in self.outcomes)

    @property
    def shortfall(self) -> str | None:
        """In words, which requirements are not met, how far, and where; None where all are."""
        lines = [
            f"{each.requirement.name} is met at {100.0 * each.share:.1f} % of {each.points} points, "
            f"asked {100.0 * (each.requirement.share or 0.0):g} %; worst at {_worst_text(each.worst)}"
            for each in self.outcomes
            if not each.is_met
        ]
        return "; ".join(lines) or None

    @property
    def cost(self) -> float:
        """Sum over the requirements that have a weight: the weight times the share of points that are not met."""
        return sum(
            each.requirement.weight * (1.0 - each.share)
            for each in self.outcomes
            if each.requirement.weight is not None
        )

    def _outcome(self, r: int) -> RequirementOutcome:
        requirement = self.ghosts.requirements[r]
        ghost = np.flatnonzero(self.ghosts.requirement == r)
        closeness = self.visibility.closeness(self.ghosts)[:, ghost]
        # a point is as close as the last camera that it still needs
        k = min(requirement.cameras, len(closeness))
        last = np.sort(closeness, axis=0)[-k] if len(closeness) >= requirement.cameras else np.zeros(len(ghost))
        is_met = self.is_point_met[ghost]
        order = np.argsort(last, kind="stable")
        worst = [int(ghost[i]) for i in order if not is_met[i]][:_WORST_COUNT]
        unmet_m = self.ghosts.position_m[ghost[~is_met]]
        gap = Gap.largest(unmet_m, requirement.grid_m, self.body.centre_m)
        return RequirementOutcome(requirement, len(ghost), int(is_met.sum()), tuple(map(self._point, worst)), gap)

    def _point(self, ghost: int) -> WorstPoint:
        share, pixels = self.visibility.visible_share[:, ghost], self.visibility.pixels[:, ghost]
        x, y = self.ghosts.position_m[ghost].tolist()
        closest = int(np.argmax(self.visibility.closeness(self.ghosts)[:, ghost]))
        return WorstPoint(
            (x, y),
            int(self.camera_count[ghost]),
            float(share.max()),
            float(pixels.max()),
            self.camera_names[closest] if share.max() > 0.0 else None,
        )

    def table(self) -> str:
        """What is required, what of it is met, and where it is furthest from that, as plain text."""
        rows = [("requirement", "needs", "points", "met", "", "worst point")]
        for each in self.outcomes:
            weight = each.requirement.weight
            rows.append(
                (
                    one_line(each.requirement.name),
                    each.requirement.need(),
                    str(each.points),
                    f"{100.0 * each.share:.1f} %",
                    "hard" if weight is None else f"weight {weight:g}",
                    _worst_text(each.worst),
                )
            )
        return "\n".join(aligned(rows, left=(0, 1, 4, 5)))

    def to_json(self) -> dict[str, Any]:
        """As a JSON file has it: outcomes, and for every point its position and how many cameras see it."""
        return {
            "schema": _SCHEMA,
            "met": self.is_met,
            "cost": self.cost,
            "cameras": list(self.camera_names),
            "requirements": [
                {
                    **outcome.to_json(),
                    "position_m": np.round(self.ghosts.position_m[self.ghosts.requirement == r], 4).tolist(),
                    "camera_count": self.camera_count[self.ghosts.requirement == r].tolist(),
                }
                for r, outcome in enumerate(self.outcomes)
            ],
        }


def _worst_text(worst: Sequence[WorstPoint]) -> str:
    if not worst:
        return ""
    point = worst[0]
    x, y = point.position_m
    seen = "no camera sees it" if point.camera is None else f"{point.camera} {100.0 * point.visible_share:.0f} %"
    if point.camera is not None:
        seen += f", {point.pixels:.0f} px"
    return f"({x:.1f}, {y:.1f}) m: {seen}"


def check_requirements(
    rig: Rig,
    ego: Mesh | Scene,
    requirements: str | Path | Sequence[Requirement],
    *,
    render_width_px: int = RENDER_WIDTH_PX,
    supersampling: int = 1,
    device: str = "cpu",
) -> RequirementResult:
    """Check whether a rig meets requirements on a vehicle.

    Each test object stands alone on flat ground; only the vehicle's body hides it, without the pane that a camera
    stands behind.

    Args:
        rig: Cameras of any lenses and sizes.
        ego: The vehicle in the ego frame, or a scene, of which the vehicle counts alone.
        requirements: Of `read_requirements`, or what that reads: a YAML file, or a template's name.
        render_width_px: Wider images are drawn this wide.
        supersampling: Samples per pixel of the drawn images along each axis.
        device: Warp device.

    Raises:
        InputError: The requirements cannot be read or used, or the device is not there.
    """
    if isinstance(requirements, (str, Path)):
        requirements = read_requirements(requirements)
    ego = ego if isinstance(ego, Mesh) else ego.ego
    world = GhostWorld(Ghosts.of(requirements, ego), ego, render_width_px, supersampling, device)
    return check_rigs({"": rig}, world)[""]


def check_rigs(rigs: Mapping[str, Rig], world: GhostWorld) -> dict[str, RequirementResult]:
    """As `check_requirements` for several rigs, by name, each among the test objects of a vehicle's world."""
    ghosts, body = world.ghosts, Body.of(world.ego)
    worlds: dict[Pane | None, GhostWorld] = {None: world}
    results = {}
    for name, rig in rigs.items():
        pose, models = poses_of(rig)
        panes = [camera.behind_glass for camera in rig.cameras]
        share, pixels = np.zeros((2, len(panes), len(ghosts)))
        for pane in dict.fromkeys(panes):
            if pane is not None and pane not in worlds:
                worlds[pane] = replace(world, ego=pane.opened(world.ego))
            group = [k for k, each in enumerate(panes) if each == pane]
            seen = worlds[pane].visibility(pose[group], [models[k] for k in group])
            share[group], pixels[group] = seen.visible_share, seen.pixels
        names = tuple(camera.name for camera in rig.cameras)
        results[name] = RequirementResult(names, ghosts, body, Visibility(share, pixels))
    return results
