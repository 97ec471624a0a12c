"""How well a detector that nobody trained on these scenes recognises their traffic.

The measure: a camera of 90 degrees and 640 x 640 pixels, 1.8 m above the ground in the centre of the ego vehicle, looks
in four directions. Counted are vehicles whose visible box is at least 40 px high and that are at least 60 %
unoccluded inside the frame; recalled are those that a detection of confidence .25 or more meets with an IoU of .5. A
detection is of background when it meets nothing of a vehicle: less than .1 IoU with every visible box, however
small, and with their union.
"""

import itertools
from dataclasses import dataclass, field

import numpy as np

from warpav.detection.images import render_images
from warpav.detection.matching import iou_matrix
from warpav.raster.camera import CameraModel
from warpav.rig.rig import RigCamera
from warpav.scene.town.town import EYE_HEIGHT_M

SIZE_PX, HEIGHT_MIN_PX, UNOCCLUDED_MIN, IOU_MIN, CONFIDENCE_MIN = 640, 40, 0.6, 0.5, 0.25
BACKGROUND_IOU_MAX = 0.1
FIRST_UNSEEN_SEED = 70_000  # no shape, colour or layout was tuned on scenes from here on
DISTANCE_EDGES_M = (0.0, 6.0, 10.0, 15.0, 20.0, 40.0)


@dataclass(frozen=True)
class Counted:
    """A vehicle in an image that a detector should find."""

    kind: str
    distance_m: float
    is_recalled: bool


@dataclass
class Realism:
    """What a detector found."""

    vehicles: list[Counted] = field(default_factory=list)
    detection_count: int = 0
    background_count: int = 0

    def recall(self, kind=None, distance_m=(0.0, np.inf)):
        """Share of the vehicles that were found and their number; of one kind and a range of distances."""
        found = [
            one.is_recalled
            for one in self.vehicles
            if kind in (None, one.kind) and distance_m[0] <= one.distance_m < distance_m[1]
        ]
        return (float(np.mean(found)) if found else float("nan")), len(found)

    def table(self):
        """Lines of recall by kind and distance."""
        lines = [
            f"all {self.recall()[0]:.3f} of {len(self.vehicles)}; on background "
            f"{self.background_count} of {self.detection_count} detections"
        ]
        kinds = sorted({one.kind for one in self.vehicles})
        parts = [(kind, self.recall(kind)) for kind in kinds]
        lines.append("by kind: " + ", ".join(f"{name} {share:.2f} of {count}" for name, (share, count) in parts))
        ranges = list(itertools.pairwise(DISTANCE_EDGES_M))
        parts = [(f"{low:g}-{high:g} m", self.recall(distance_m=(low, high))) for low, high in ranges]
        lines.append("by distance: " + ", ".join(f"{name} {share:.2f} of {count}" for name, (share, count) in parts))
        return "\n".join(lines)


def _boxes(picture, count):
    """Visible boxes of all vehicles [vehicle, 4] (NaN: invisible) and which of them count."""
    boxes, counts = np.full((count, 4), np.nan), np.zeros(count, bool)
    for k in range(count):
        row, column = np.nonzero(picture.object_index == 2 + k)
        if len(row) == 0:
            continue
        boxes[k] = column.min(), row.min(), column.max() + 1, row.max() + 1
        unoccluded = picture.visible_area_px[k] >= UNOCCLUDED_MIN * picture.amodal_area_px[k]
        counts[k] = unoccluded and boxes[k, 3] - boxes[k, 1] >= HEIGHT_MIN_PX
    return boxes, counts


def _matched(truth, found):
    """Which truths are met: pairs of truth and detection, best IoU first, each used once."""
    overlap = iou_matrix(truth, found)
    is_met = np.zeros(len(truth), bool)
    while overlap.size and overlap.max() >= IOU_MIN:
        row, column = np.unravel_index(overlap.argmax(), overlap.shape)
        is_met[row] = True
        overlap[row, :] = 0.0
        overlap[:, column] = 0.0
    return is_met


def judge(detector, scenes, realism=None):
    """Look at scenes with a detector.

    Args:
        detector: An `OnnxDetector` of vehicles.
        scenes: Scenes of the town, direct or reconstructed.
        realism: Counts to add to.

    Returns:
        The counts.
    """
    realism = realism or Realism()
    for scene in scenes:
        position = np.array([scene.ego.bounds_m()[:, 0].mean(), 0.0, EYE_HEIGHT_M])
        cameras = [
            RigCamera(f"camera_{side}", position, 0.5 * np.pi * side, 0.0, 0.0, CameraModel(SIZE_PX, SIZE_PX))
            for side in range(4)
        ]
        pictures = render_images(scene, cameras, supersampling=2)
        for picture, found in zip(pictures, detector.detect([one.rgb for one in pictures]), strict=True):
            boxes, counts = _boxes(picture, len(scene.vehicles))
            met = _matched(boxes[counts], found.box_px)
            for k, is_met in zip(np.flatnonzero(counts), met, strict=True):
                vehicle = scene.vehicles[k]
                distance_m = float(np.linalg.norm(vehicle.box.center_m[:2] - position[:2]))
                realism.vehicles.append(Counted(vehicle.category, distance_m, bool(is_met)))
            seen = boxes[np.isfinite(boxes[:, 0])]
            overlap = iou_matrix(found.box_px, seen)
            inside = np.array([_share_of_vehicles(box, picture.object_index) for box in found.box_px])
            meets = (overlap.max(axis=1, initial=0.0) >= BACKGROUND_IOU_MAX) | (inside >= BACKGROUND_IOU_MAX)
            realism.detection_count += len(found.box_px)
            realism.background_count += int(np.count_nonzero(~meets))
    return realism


def _share_of_vehicles(box, object_index):
    """Share of a box's pixels that show vehicles, the ego vehicle too."""
    left, top, right, bottom = np.clip(np.round(box).astype(int), 0, SIZE_PX)
    part = object_index[top:bottom, left:right]
    return float(np.mean(part >= 1)) if part.size else 0.0
