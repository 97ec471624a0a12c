"""What a narrow and a wide camera module find far ahead on motorways: ``python docs/far_recall.py [NETWORK ...]``.

Each module looks straight ahead from above the front edge of the ego vehicle's roof; both give the network as many
pixels. Counted are the same vehicles for both: those within 13 degrees of straight ahead of which the narrow one sees
at least 60 %. Found are those that a detection of confidence .25 or more meets with an IoU of .5 of what the very
module sees of them.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from network_recall import CONFIDENCE_MIN, FIRST_UNSEEN_SEED, matched, visible_boxes
from warpav.detection import render_images
from warpav.rig import RigCamera, read_modules
from warpav.scene import Scene

if TYPE_CHECKING:
    from warpav.detection import Detector

MODULES = ("front_8mp_30", "front_8mp_120")
BEARING_MAX_DEG = 13.0
CAMERA_BACK_M, CAMERA_UP_M = 2.7, 0.07  # behind the front bumper, above the roof
DISTANCE_EDGES_M = (0.0, 50.0, 100.0, 150.0, 200.0)


@dataclass(frozen=True)
class FarVehicle:
    """A vehicle ahead.

    Attributes:
        distance_m: From the camera to the middle of its box, seen from above [m].
        height_px: Height of its visible box in each module's image [px], 0 where it has no pixel.
        is_found: Whether each detector finds it in each module's image, [detector][module].
    """

    distance_m: float
    height_px: tuple[float, ...]
    is_found: tuple[tuple[bool, ...], ...]


def far_vehicles(
    detectors: Sequence[Detector], scenes: Iterable[Scene], modules: Sequence[str] = MODULES
) -> list[FarVehicle]:
    """Look ahead with camera modules.

    Args:
        detectors: They find vehicles.
        scenes: Scenes of any source.
        modules: Names of modules of the shipped catalogue, the narrowest first.

    Returns:
        Every vehicle that counts.
    """
    catalogue = read_modules()
    found: list[FarVehicle] = []
    for scene in scenes:
        high_m = scene.ego.bounds_m()[1].astype(np.float64)
        position_m = np.array([high_m[0] - CAMERA_BACK_M, 0.0, high_m[2] + CAMERA_UP_M])
        cameras = [RigCamera(name, position_m, model=catalogue[name].camera_model()) for name in modules]
        images = render_images(scene, cameras, supersampling=2)
        seen = [visible_boxes(image, len(scene.vehicles)) for image in images]
        away_m = np.array([each.box.center_m[:2] - position_m[:2] for each in scene.vehicles]).reshape(-1, 2)
        bearing_deg = np.degrees(np.arctan2(away_m[:, 1], away_m[:, 0]))
        chosen = np.flatnonzero(seen[0][1] & (np.abs(bearing_deg) <= BEARING_MAX_DEG))
        met = np.zeros((len(detectors), len(images), len(chosen)), bool)
        for i, detector in enumerate(detectors):
            for k, (image, (box_px, _)) in enumerate(zip(images, seen, strict=True)):
                [detections] = detector.detect(image.rgb[None])
                met[i, k] = matched(np.nan_to_num(box_px[chosen]), detections.box_px)
        for j, vehicle in enumerate(chosen):
            height_px = tuple(float(np.nan_to_num(box_px[vehicle, 3] - box_px[vehicle, 1])) for box_px, _ in seen)
            is_found = tuple(tuple(map(bool, each)) for each in met[:, :, j])
            found.append(FarVehicle(math.hypot(*away_m[vehicle]), height_px, is_found))
    return found


def main(argv: Sequence[str] | None = None) -> None:
    """Print a table: a row for a detector and a module, the share that it finds at distances."""
    from warpav.detection import OnnxDetector
    from warpav.scene import level_scene

    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("networks", nargs="*", metavar="NETWORK", help="ONNX files; the shipped detector always")
    parser.add_argument("--scenes", type=int, default=40, help=f"motorways, from seed {FIRST_UNSEEN_SEED}")
    given = parser.parse_args(argv)
    names = ["builtin", *given.networks]
    detectors = [OnnxDetector(name, confidence_min=CONFIDENCE_MIN, targets=("vehicle",)) for name in names]
    seeds = range(FIRST_UNSEEN_SEED, FIRST_UNSEEN_SEED + given.scenes)
    vehicles = far_vehicles(detectors, (level_scene(seed, "motorway") for seed in seeds))
    bands = list(pairwise(DISTANCE_EDGES_M))
    inside = [[one for one in vehicles if low <= one.distance_m < high] for low, high in bands]
    headings = [f"{low:g} to {high:g} m, {len(ones)}" for (low, high), ones in zip(bands, inside, strict=True)]
    sys.stdout.write(f"| detector, module | {' | '.join(headings)} |\n" + "|---" * (len(bands) + 1) + "|\n")
    for k, module in enumerate(MODULES):
        height_px = [f"{np.median([one.height_px[k] for one in ones]):.0f} px" if ones else "" for ones in inside]
        sys.stdout.write(f"| median height, {module} | {' | '.join(height_px)} |\n")
    for i, name in enumerate(names):
        for k, module in enumerate(MODULES):
            share = [f"{np.mean([one.is_found[i][k] for one in ones]):.2f}" if ones else "" for ones in inside]
            sys.stdout.write(f"| {name.rsplit('/', 1)[-1].removesuffix('.onnx')}, {module} | {' | '.join(share)} |\n")


if __name__ == "__main__":
    main()
