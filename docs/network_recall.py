"""How well networks that know only photographs recognise traffic: ``python docs/network_recall.py NETWORK [...]``.

A camera of 90 degrees and 640 x 640 pixels, 1.8 m above the ground in the middle of the ego vehicle, looks in four
directions. Counted are vehicles within 40 m of which at least 98 % of what lies inside the frame is visible, and whose
visible box is at least 20 px high (and, in rows of their own, 40 px); recalled are those that a detection of confidence
.25 or more meets with an IoU of .5. Motorcycles count apart: such networks box rider and machine each for itself. A
detection is of background when it meets nothing of a vehicle: less than .1 IoU with every visible box, however small,
and less than a tenth of its pixels.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from warpav.detection import CameraImage, render_images
from warpav.detection._matching import iou_matrix
from warpav.raster.camera import CameraModel
from warpav.rig import RigCamera
from warpav.scene import Scene
from warpav.scene.town._town import EYE_HEIGHT_M

if TYPE_CHECKING:
    from warpav.detection import Detector
    from warpav.scene import Fleet

SIZE_PX, VISIBLE_MIN, IOU_MIN, CONFIDENCE_MIN = 640, 0.6, 0.5, 0.25
HEIGHTS_PX = (20, 40)
UNOCCLUDED = 0.98  # visible share from which on a vehicle is unoccluded: posts and bins may stand before it
BACKGROUND_IOU_MAX = 0.1
FIRST_UNSEEN_SEED = 70_000  # no shape, colour or layout was tuned on scenes from here on
REACH_M = 40.0
DISTANCE_EDGES_M = (0.0, 6.0, 10.0, 15.0, 20.0, REACH_M)
LEVELS = ("easy", "urban", "dense", "motorway")


@dataclass(frozen=True)
class Counted:
    """A vehicle in an image that a detector should find.

    Attributes:
        kind: Its category.
        distance_m: From the camera to the middle of its box, seen from above [m].
        height_px: Height of its visible box [px].
        visible_share: Share of its area inside the frame that nothing hides, `VISIBLE_MIN` to 1.
        is_cut: Whether an edge of the image cuts that box.
        is_recalled: Whether a detection meets it.
    """

    kind: str
    distance_m: float
    height_px: float
    visible_share: float
    is_cut: bool
    is_recalled: bool


@dataclass
class Recall:
    """What a detector found."""

    vehicles: list[Counted] = field(default_factory=list)
    detection_count: int = 0
    background_count: int = 0

    def of(self, chosen: Callable[[Counted], bool] = lambda one: True) -> tuple[float, int]:
        """Share of the chosen vehicles that were found, NaN of none, and their number."""
        found = [one.is_recalled for one in self.vehicles if chosen(one)]
        return (float(np.mean(found)) if found else math.nan), len(found)

    def where(self, chosen: Callable[[Counted], bool]) -> Recall:
        """The same of the chosen vehicles alone."""
        return Recall([one for one in self.vehicles if chosen(one)], self.detection_count, self.background_count)

    def lines(self) -> list[str]:
        """Recall by kind, distance and whether the image cuts the vehicle, as text."""

        def line(title: str, parts: Iterable[tuple[str, tuple[float, int]]]) -> str:
            return f"{title}: " + ", ".join(f"{name} {share:.2f} of {count}" for name, (share, count) in parts if count)

        kinds = sorted({one.kind for one in self.vehicles})
        return [
            f"all {self.of()[0]:.3f} of {len(self.vehicles)}; on background "
            f"{self.background_count} of {self.detection_count} detections",
            line("by kind", ((kind, self.of(lambda one, kind=kind: one.kind == kind)) for kind in kinds)),
            line(
                "by distance",
                (
                    (f"{low:g}-{high:g} m", self.of(lambda one, low=low, high=high: low <= one.distance_m < high))
                    for low, high in pairwise((*DISTANCE_EDGES_M, math.inf))
                ),
            ),
            line(
                "by the edges of the image",
                (("cut", self.of(lambda one: one.is_cut)), ("whole", self.of(lambda one: not one.is_cut))),
            ),
        ]


def judge(detectors: Sequence[Detector], scenes: Iterable[Scene]) -> list[Recall]:
    """Look at scenes with detectors.

    Args:
        detectors: They find vehicles.
        scenes: Scenes of any source.

    Returns:
        What each of them found.
    """
    found_by = [Recall() for _ in detectors]
    for scene in scenes:
        position_m = np.array([scene.ego.bounds_m()[:, 0].mean(), 0.0, EYE_HEIGHT_M])
        cameras = [
            RigCamera(f"camera_{side}", position_m, 0.5 * np.pi * side, 0.0, 0.0, CameraModel(SIZE_PX, SIZE_PX))
            for side in range(4)
        ]
        images = render_images(scene, cameras, supersampling=2)
        for detector, recall in zip(detectors, found_by, strict=True):
            detections = detector.detect(np.stack([image.rgb for image in images]))
            for image, found in zip(images, detections, strict=True):
                _count(image, found.box_px, scene, position_m, recall)
    return found_by


def _count(image: CameraImage, box_px: np.ndarray, scene: Scene, position_m: np.ndarray, recall: Recall) -> None:
    """Add what detections in an image are of."""
    boxes, counts = visible_boxes(image, len(scene.vehicles))
    met = matched(boxes[counts], box_px)
    for k, is_met in zip(np.flatnonzero(counts), met, strict=True):
        vehicle = scene.vehicles[k]
        distance_m = float(np.linalg.norm(vehicle.box.center_m[:2] - position_m[:2]))
        x0, y0, x1, y1 = boxes[k]
        is_cut = bool(min(x0, y0) <= 0 or max(x1, y1) >= SIZE_PX)
        share = float(image.visible_area_px[k] / image.amodal_area_px[k])
        recall.vehicles.append(Counted(vehicle.category, distance_m, float(y1 - y0), share, is_cut, bool(is_met)))
    seen = boxes[np.isfinite(boxes[:, 0])]
    overlap = iou_matrix(box_px, seen)
    inside = np.array([_share_of_vehicles(box, image.object_index) for box in box_px])
    meets = (overlap.max(axis=1, initial=0.0) >= BACKGROUND_IOU_MAX) | (inside >= BACKGROUND_IOU_MAX)
    recall.detection_count += len(box_px)
    recall.background_count += int(np.count_nonzero(~meets))


def visible_boxes(image: CameraImage, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Visible boxes of all vehicles [vehicle, 4] (NaN: invisible) and which of them count."""
    boxes, counts = np.full((count, 4), np.nan), np.zeros(count, bool)
    for k in range(count):
        row, column = np.nonzero(image.object_index == 2 + k)
        if len(row) == 0:
            continue
        boxes[k] = column.min(), row.min(), column.max() + 1, row.max() + 1
        is_visible = image.visible_area_px[k] >= VISIBLE_MIN * image.amodal_area_px[k]
        counts[k] = is_visible and boxes[k, 3] - boxes[k, 1] >= HEIGHTS_PX[0]
    return boxes, counts


def matched(truth_px: np.ndarray, found_px: np.ndarray) -> np.ndarray:
    """Which truths are met: pairs of truth and detection, best IoU first, each used once."""
    overlap = iou_matrix(truth_px, found_px)
    is_met = np.zeros(len(truth_px), bool)
    while overlap.size and overlap.max() >= IOU_MIN:
        row, column = np.unravel_index(overlap.argmax(), overlap.shape)
        is_met[row] = True
        overlap[row, :] = 0.0
        overlap[:, column] = 0.0
    return is_met


def _share_of_vehicles(box_px: np.ndarray, object_index: np.ndarray) -> float:
    """Share of a box's pixels that show vehicles, the ego vehicle too."""
    left, top, right, bottom = np.clip(np.round(box_px).astype(int), 0, SIZE_PX)
    part = object_index[top:bottom, left:right]
    return float(np.mean(part >= 1)) if part.size else 0.0


def _scenes(source: str, count: int, fleet: Fleet | None) -> Iterable[Scene]:
    """Scenes of a level, of the recordings that ship, or of other recordings."""
    from warpav.scene import ego_vehicle, level_scene
    from warpav.scene.traffic.files import recordings_in, shipped_recordings
    from warpav.scene.traffic.moments import moment_of, moments_of
    from warpav.scene.traffic.traffic_scene import TrafficSource

    seeds = range(FIRST_UNSEEN_SEED, FIRST_UNSEEN_SEED + count)
    if source in LEVELS:
        return (level_scene(seed, source, fleet) for seed in seeds)
    files = shipped_recordings() if source == "traffic" else recordings_in([Path(source)])
    moments = moments_of(files, ego_vehicle().bounds_m())
    return (TrafficSource(moment_of(moments, seed), seed, fleet).scene() for seed in seeds)


def main(argv: Sequence[str] | None = None) -> None:
    """Print a table: a row for a network, its recall in scenes of each source."""
    from warpav.detection import OnnxDetector
    from warpav.scene import USUAL_SHARE, fleet_of

    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("networks", nargs="+", type=Path, metavar="NETWORK", help="ONNX files")
    parser.add_argument(
        "--sources",
        nargs="+",
        default=[*LEVELS, "traffic"],
        help="levels, traffic (SinD), or files and folders of recordings",
    )
    parser.add_argument("--scenes", type=int, default=30, help=f"of each source, from seed {FIRST_UNSEEN_SEED}")
    parser.add_argument("--vehicles", nargs="+", default=[], help="vehicles of other makers: shipped, or meshes")
    parser.add_argument("--share", type=float, default=USUAL_SHARE, help="of the vehicles that are exchanged")
    given = parser.parse_args(argv)
    detectors = [OnnxDetector(file, confidence_min=CONFIDENCE_MIN, targets=("vehicle",)) for file in given.networks]
    fleet = fleet_of(given.vehicles, given.share) if given.vehicles else None
    rows: dict[str, list[str]] = {}
    for source in given.sources:
        found_by = judge(detectors, _scenes(source, given.scenes, fleet))
        for file, found in zip(given.networks, found_by, strict=True):
            near = found.where(lambda one: one.distance_m < REACH_M and one.visible_share >= UNOCCLUDED)
            cars = near.where(lambda one: one.kind != "motorcycle")
            sys.stdout.write(f"{file.stem}, {Path(source).name}: " + "\n    ".join(cars.lines()) + "\n")
            whole = cars.where(lambda one: not one.is_cut)
            motorcycles = near.where(lambda one: one.kind == "motorcycle")
            for title, group in (("", cars), (", not cut by edges", whole), (", motorcycles", motorcycles)):
                for height_px in HEIGHTS_PX:
                    share, count = group.of(lambda one, least=height_px: one.height_px >= least)
                    cell = f"{share:.3f}".removeprefix("0") + f" of {count}" if count else "none"
                    rows.setdefault(f"{file.stem}, from {height_px} px{title}", []).append(cell)
    sys.stdout.write(f"\n| recall | {' | '.join(Path(source).name for source in given.sources)} |\n")
    sys.stdout.write("|---" * (len(given.sources) + 1) + "|\n")
    for name, row in rows.items():
        if set(row) != {"none"}:
            sys.stdout.write(f"| {name} | {' | '.join(row)} |\n")


if __name__ == "__main__":
    main()
