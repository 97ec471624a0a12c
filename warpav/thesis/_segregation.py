"""Which camera answers for which vehicle, and which scenes make a batch (thesis section III.B)."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import warp as wp

from warpav.core.frames import FLU_FROM_RDF, rotation_from_yaw_pitch_roll
from warpav.optimisation import AssignedScene
from warpav.raster.areas import AMODAL_AREA
from warpav.raster.buffers import Content
from warpav.raster.camera import CameraModel
from warpav.raster.renderer import Renderer
from warpav.raster.scene import Scene
from warpav.rig import Rig


@dataclass(frozen=True)
class Segregation:
    """Orientations that share the vehicles among the cameras."""

    yaw_rad: np.ndarray  # orientation of every camera, ascending in 0..2 pi, float64 [camera]
    rotation: np.ndarray  # its index among those that were to choose from, int64 [camera]
    seen_instances: int  # vehicles of the scenes that at least one orientation sees
    duplicates: int  # how often a vehicle is seen by more orientations than one, summed


def areas_around(
    scenes: Sequence[Scene], yaw_rad: np.ndarray, viewpoint_ego_m: np.ndarray, camera: CameraModel, *, device: str
) -> list[np.ndarray]:
    """Area of every vehicle alone [px^2] from one point in several directions, one [vehicle, direction] per scene."""
    renderer = Renderer([camera] * len(yaw_rad), device=device)
    rotation = np.stack([(rotation_from_yaw_pitch_roll(yaw, 0.0, 0.0) @ FLU_FROM_RDF).T for yaw in yaw_rad])
    camera_from_ego = wp.array(rotation.astype(np.float32), dtype=wp.mat33, device=device)
    place = np.tile(np.asarray(viewpoint_ego_m, np.float32), (len(yaw_rad), 1))
    position_ego_m = wp.array(place, dtype=wp.vec3, device=device)
    areas = []
    for scene in scenes:
        frame = renderer.render(scene, position_ego_m, camera_from_ego, content=Content.OBJECTS)
        areas.append(frame.measure().value.numpy()[:, :, AMODAL_AREA].T)
    return areas


def choose_orientations(
    areas: Sequence[np.ndarray], camera_count: int, rotation_count: int, rng: np.random.Generator
) -> Segregation:
    """The set of orientations that sees most vehicles. ``areas`` [vehicle, rotation].

    Among sets that see as many, the one with the fewest duplicates; among those, one at random.
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
    """Informed batches: every camera gets scenes with a vehicle of its own."""

    def __init__(self, scenes: Sequence[AssignedScene], camera_count: int, rng: np.random.Generator) -> None:
        """Chooser over ``scenes``; cameras without any vehicle in any scene are left out."""
        self.waiting: list[int] = []  # scenes of the order that is not used up; always none here
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


def cameras_of(area: np.ndarray) -> np.ndarray:
    """The camera whose orientation sees most of a vehicle, -1 where none sees it, int32 [vehicle].

    ``area`` [vehicle, camera].
    """
    found = np.where((area > 0.0).any(axis=1), area.argmax(axis=1), -1) if len(area) else np.zeros(0)
    return found.astype(np.int32)


def assign_to_nearest_cameras(scenes: Sequence[AssignedScene], yaw_rad: np.ndarray, rig: Rig) -> list[AssignedScene]:
    """Scenes whose vehicles belong to the camera that looks the way of their orientation. ``yaw_rad`` [orientation].

    Segregation gives every vehicle an orientation; a rig from elsewhere lists its cameras in its own order.
    Orientations and cameras are paired so that the sum of the squared angles between them is smallest. (Without the
    squares many pairings are equally good, and rounding would choose.)
    """
    camera_of_orientation = nearest_cameras(yaw_rad, rig)
    return [AssignedScene(each.scene, partial(_renamed, each, camera_of_orientation)) for each in scenes]


def _renamed(assigned: AssignedScene, camera_of_orientation: np.ndarray) -> np.ndarray:
    """The cameras of a scene's vehicles by the orientations' cameras, int32 [vehicle]."""
    orientation = assigned.assigned_camera
    return np.where(orientation >= 0, camera_of_orientation[np.maximum(orientation, 0)], -1).astype(np.int32)


def nearest_cameras(yaw_rad: np.ndarray, rig: Rig) -> np.ndarray:
    """The camera of a rig that each orientation is paired with, int [orientation]; see `assign_to_nearest_cameras`."""
    from scipy.optimize import linear_sum_assignment

    camera_yaw_rad = np.array([camera.yaw_rad for camera in rig.cameras])
    difference = np.asarray(yaw_rad)[:, None] - camera_yaw_rad[None, :]
    _, camera_of_orientation = linear_sum_assignment(np.angle(np.exp(1j * difference)) ** 2)
    return camera_of_orientation
