"""Which camera answers for which vehicle, and which scenes make a batch (thesis section III.B)."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp

from warpav.core.frames import FLU_FROM_RDF, rotation_from_yaw_pitch_roll
from warpav.optimisation.assignment import AssignedScene
from warpav.raster.areas import AMODAL_AREA
from warpav.raster.buffers import Content
from warpav.raster.camera import CameraModel
from warpav.raster.renderer import Renderer
from warpav.scene.device_scene import DeviceScene


@dataclass(frozen=True)
class Segregation:
    """Orientations that share the vehicles among the cameras.

    Attributes:
        yaw_rad: Orientation of every camera, ascending in 0..2 pi, float64 [camera].
        rotation: Its index among those that were to choose from, int64 [camera].
        seen_instances: Vehicles of the scenes that at least one orientation sees.
        duplicates: How often a vehicle is seen by more orientations than one, summed.
    """

    yaw_rad: np.ndarray
    rotation: np.ndarray
    seen_instances: int
    duplicates: int


def areas_around(
    scenes: Sequence[DeviceScene], yaw_rad: np.ndarray, viewpoint_ego_m: np.ndarray, camera: CameraModel, *, device: str
) -> list[np.ndarray]:
    """Area of every vehicle alone [px^2] from one point in several directions, one [vehicle, direction] per scene."""
    renderer = Renderer([camera] * len(yaw_rad), device=device)
    rotation = np.stack([(rotation_from_yaw_pitch_roll(yaw, 0.0, 0.0) @ FLU_FROM_RDF).T for yaw in yaw_rad])
    camera_from_ego = wp.array(rotation.astype(np.float32), dtype=wp.mat33, device=device)
    place = np.tile(np.asarray(viewpoint_ego_m, np.float32), (len(yaw_rad), 1))
    position_ego_m = wp.array(place, dtype=wp.vec3, device=device)
    areas = []
    for scene in scenes:
        frame = renderer.render(scene.raster, position_ego_m, camera_from_ego, content=Content.OBJECTS)
        areas.append(frame.measure().value.numpy()[:, :, AMODAL_AREA].T)
    return areas


def choose_orientations(
    areas: Sequence[np.ndarray], camera_count: int, rotation_count: int, rng: np.random.Generator
) -> Segregation:
    """The set of orientations that sees most vehicles.

    Among sets that see as many, the one with the fewest duplicates; among those, one at random.

    Args:
        areas: Area of every vehicle in every orientation, one [vehicle, rotation] per scene.
        camera_count: Number of orientations to choose, at most ``rotation_count``.
        rotation_count: Orientations to choose from, evenly spread from yaw 0.
        rng: Breaks the last ties.
    """
    visible = np.concatenate([np.asarray(area) > 0.0 for area in areas]).astype(np.float32)
    best_seen, best_duplicates, ties = -1, 0, []
    # every set is a 0/1 row; chunks keep the products small
    combinations = itertools.combinations(range(rotation_count), camera_count)
    while chunk := list(itertools.islice(combinations, 4096)):
        chosen = np.zeros((len(chunk), rotation_count), np.float32)
        np.put_along_axis(chosen, np.array(chunk), 1.0, axis=1)
        times_seen = chosen @ visible.T
        seen = (times_seen > 0.0).sum(axis=1)
        duplicates = np.maximum(times_seen - 1.0, 0.0).sum(axis=1).astype(int)
        for k in np.flatnonzero(seen == seen.max()):
            key = (int(seen[k]), -int(duplicates[k]))
            if key > (best_seen, -best_duplicates) or best_seen < 0:
                best_seen, best_duplicates, ties = key[0], -key[1], [chunk[k]]
            elif key == (best_seen, -best_duplicates):
                ties.append(chunk[k])
    winner = np.array(ties[rng.integers(len(ties))])
    return Segregation(winner * (2.0 * math.pi / rotation_count), winner, best_seen, best_duplicates)


class BatchChooser:
    """Informed batches: every camera gets scenes with a vehicle of its own.

    Attributes:
        waiting: Scenes of the order that is not used up; always none here.
    """

    def __init__(self, scenes: Sequence[AssignedScene], camera_count: int, rng: np.random.Generator) -> None:
        """Chooser over ``scenes``; cameras without any vehicle in any scene are left out."""
        self.waiting: list[int] = []
        self._scenes = scenes
        self._rng = rng
        self._scenes_of_camera = [
            [k for k, scene in enumerate(scenes) if np.any(scene.assigned_camera == camera)]
            for camera in range(camera_count)
        ]
        self._cameras = [camera for camera in range(camera_count) if self._scenes_of_camera[camera]]

    def choose(self, batch_size: int) -> list[int]:
        """Indices of the scenes of the next batch.

        If the batch holds as many scenes as there are cameras, every camera gets one of its scenes, and what is left
        over goes to random cameras; otherwise all of it does.
        """
        if not self._cameras:
            return [int(k) for k in self._rng.integers(len(self._scenes), size=batch_size)]
        cameras = list(self._cameras) if batch_size >= len(self._cameras) else []
        while len(cameras) < batch_size:
            cameras.append(self._cameras[self._rng.integers(len(self._cameras))])
        return [int(self._rng.choice(self._scenes_of_camera[camera])) for camera in cameras]


class ShuffledBatches:
    """Batches that go through all scenes in random order before any comes again.

    Attributes:
        waiting: Scenes of the present order that are still to come.
    """

    def __init__(self, scenes: Sequence[AssignedScene], camera_count: int, rng: np.random.Generator) -> None:
        """Chooser over ``scenes``; which camera answers for what does not matter."""
        del camera_count
        self._count = len(scenes)
        self._rng = rng
        self.waiting: list[int] = []

    def choose(self, batch_size: int) -> list[int]:
        """Indices of the scenes of the next batch."""
        while len(self.waiting) < batch_size:
            self.waiting += [int(k) for k in self._rng.permutation(self._count)]
        batch, self.waiting = self.waiting[:batch_size], self.waiting[batch_size:]
        return batch
