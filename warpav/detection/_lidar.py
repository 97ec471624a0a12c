"""What a LiDAR finds: expected points on an object as a weighted silhouette area, and a curve from points to finding.

A radar is the same with other numbers: of an object's box the visible share in percent stands for points, weighted by
solid angle, with a steep curve, a range for each road user, and cells in which objects merge.

No network is claimed. The curve is stated, monotone in the points that return, and can be changed or fitted to a
table of a user's own (`fit_lidar_curve`).
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from warpav.core.bounded_files import read_text
from warpav.core.errors import InputError
from warpav.core.frames import FLU_FROM_RDF
from warpav.core.warp_setup import checked_device
from warpav.detection._detector import ROAD_USERS
from warpav.detection._images import render_images
from warpav.detection._probability import whole_solid_angle
from warpav.raster.areas import Measures
from warpav.raster.beams import Beams
from warpav.raster.buffers import Content
from warpav.raster.frame import Frame
from warpav.rig import Rig
from warpav.scene import DeviceScene, Scene, road_user_of
from warpav_kernels.detection import lidar_probability as kernels

_LEAST_ROWS = 20
_LARGEST_STEEPNESS = 20.0
_LEAST_SR = 1e-12
_RADAR_STEEPNESS = 12.0
"""Of the curve of a radar: .93 of its probability at a quarter more than its share, .04 at a quarter less."""


@dataclass(frozen=True)
class LidarCurve:
    """How many points on an object it takes to find it.

    With n returned points the probability is ``(1 - exp(-n)) q / (1 + q)``, ``q = ((1 + n) / (1 + h))^k``.

    Attributes:
        points_for_half: h, the points that give an even chance, positive, of each road user; others as vehicles. The
            usual 5 are the least of which the public benchmarks count a labelled box as one that can be found.
        steepness: k, positive.
        by_incidence: Whether a point counts by the cosine of its incidence, as diffuse surfaces return power; else 1.
    """

    points_for_half: Mapping[str, float] = field(default_factory=lambda: dict.fromkeys(ROAD_USERS, 5.0))
    steepness: float = 2.7
    by_incidence: bool = False

    def of(self, points: np.ndarray, road_user: str = "vehicle") -> np.ndarray:
        """The probability for numbers of points that return, float64."""
        n = np.asarray(points, np.float64)
        q = ((1.0 + n) / (1.0 + self._half(road_user))) ** self.steepness
        return -np.expm1(-n) * q / (1.0 + q)

    def _half(self, road_user: str) -> float:
        return self.points_for_half.get(road_user, self.points_for_half.get("vehicle", 5.0))

    @property
    def halves(self) -> np.ndarray:
        """H of each of `ROAD_USERS`, float32."""
        return np.array([self._half(name) for name in ROAD_USERS], np.float32)


def fit_lidar_curve(
    points: np.ndarray, road_user: np.ndarray, found: np.ndarray, start: LidarCurve | None = None
) -> LidarCurve:
    """The curve of greatest likelihood for what a detector found.

    Args:
        points: That returned from each object, [object].
        road_user: Its kind, out of `ROAD_USERS`, [object].
        found: Whether the detector found it, bool [object].
        start: Where kinds are taken from of which there are fewer than 20 rows; None: the usual curve.

    Raises:
        InputError: Too few rows, or all found, or none.
    """
    from scipy.optimize import minimize

    start = start or LidarCurve()
    kinds = [name for name in ROAD_USERS if np.count_nonzero(road_user == name) >= _LEAST_ROWS]
    if not kinds or found.all() or not found.any():
        expected = f"at least {_LEAST_ROWS} objects of a road user, some found and some not"
        raise InputError(f"table: expected {expected}, got {len(found)} rows, {int(found.sum())} found")

    def curve(numbers: np.ndarray) -> LidarCurve:
        halves = dict(zip(kinds, np.exp(numbers[1:]).tolist(), strict=True))
        return LidarCurve({**start.points_for_half, **halves}, float(np.exp(numbers[0])), start.by_incidence)

    def loss(numbers: np.ndarray) -> float:
        model, total = curve(numbers), 0.0
        for name in kinds:
            own = road_user == name
            p = np.clip(model.of(points[own], name), 1e-9, 1.0 - 1e-9)
            total -= float(np.where(found[own], np.log(p), np.log1p(-p)).sum())
        return total

    first = np.log([start.steepness, *(start.points_for_half.get(name, 5.0) for name in kinds)])
    bounds = [(np.log(0.2), np.log(_LARGEST_STEEPNESS)), *((np.log(0.1), np.log(1e4)) for _ in kinds)]
    return curve(minimize(loss, first, bounds=bounds, method="L-BFGS-B").x)


def read_findings(file: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A table of what a LiDAR's detector found: what `fit_lidar_curve` takes.

    A CSV file with the columns points, class (a road user or a category, such as lorry) and found (0 or 1), and no
    others but range_m, which is not used: points are those that returned.

    Raises:
        InputError: The file cannot be read or holds something else; the text names the row.
    """
    rows = list(csv.reader(io.StringIO(read_text(file, "a table of findings"))))
    names = [name.strip() for name in rows[0]] if rows else []
    needed, strange = {"points", "class", "found"}, set(names) - {"points", "class", "found", "range_m"}
    if needed - set(names) or strange or len(set(names)) < len(names):
        raise InputError(
            f"{file}:1: expected the columns points, class, found and maybe range_m, got {', '.join(names)}"
        )
    points, kinds, found = [], [], []
    for number, row in enumerate(rows[1:], 2):
        if len(row) != len(names):
            raise InputError(f"{file}:{number}: expected {len(names)} values, got {len(row)}")
        value = dict(zip(names, (each.strip() for each in row), strict=True))
        try:
            count = float(value["points"])
        except ValueError:
            count = math.nan
        if not 0.0 <= count < math.inf:
            raise InputError(f"{file}:{number}: points: expected a number from 0 on, got {value['points']!r}")
        if value["found"] not in ("0", "1"):
            raise InputError(f"{file}:{number}: found: expected 0 or 1, got {value['found']!r}")
        name = value["class"]
        points.append(count)
        kinds.append(name if name in ROAD_USERS else road_user_of(name))
        found.append(value["found"] == "1")
    return np.array(points), np.array(kinds, object), np.array(found, bool)


@dataclass(frozen=True, eq=False)
class LidarProbability:
    """How likely a LiDAR is to find an object: of its points by a curve; or a radar, by its own numbers."""

    beams: Beams
    curve: LidarCurve = field(default_factory=LidarCurve)

    @property
    def identity(self) -> tuple[object, ...]:
        """All that the probabilities depend on."""
        return (
            self.beams.kind,
            repr(self.beams),
            self.curve.halves.tobytes(),
            self.curve.steepness,
            self.curve.by_incidence,
        )

    @cached_property
    def _weight(self) -> dict[str, wp.array]:
        return {}

    def __getstate__(self) -> dict[str, Any]:
        """As it travels to another process: without what is on a device."""
        return {"beams": self.beams, "curve": self.curve}

    def points(self, frame: Frame) -> Measures:
        """Expected beams on every object in every view, [view, object, 1], whether or not they return; of a radar [sr].

        `frame`: a render of the LiDAR's panorama, `CameraModel.of_beams`, with `content`. The Jacobian of points by
        incidence holds the incidence fixed.
        """
        return frame.weighted_area(self._weight_in(frame))

    @property
    def content(self) -> Content:
        """What renders must hold for `points`."""
        return Content.ALL if self.curve.by_incidence and self.beams.radar is None else Content.MEASURES

    def _weight_in(self, frame: Frame) -> wp.array:
        """Beams a pixel, by incidence those of every view."""
        device = frame.device
        if device.alias not in self._weight:
            self._weight[device.alias] = wp.array(self.beams.density(), dtype=float, device=device)
        weight = self._weight[device.alias]
        if self.content is Content.MEASURES:
            return weight
        return wp.array(frame.incidence().numpy() * weight.numpy(), dtype=float, device=device)

    def detected(
        self, frame: Frame, scene: DeviceScene, position_ego_m: wp.array, camera_from_ego: wp.array
    ) -> wp.array:
        """The probability that each view finds each object, nothing taped; float [view, object].

        ``frame``: a render for `Frame.weighted_coverage`. However it is turned, an object counts as it does.
        """
        return self.returned(frame, scene, position_ego_m)[1]

    def returned(self, frame: Frame, scene: DeviceScene, position_ego_m: wp.array) -> tuple[wp.array, wp.array]:
        """What `of_points` gives for a render."""
        distance_m, direction = away_from(scene, position_ego_m.numpy())
        points = frame.weighted_coverage(self._weight_in(frame))
        whole = None
        if self.beams.radar is not None:
            whole = whole_solid_angle(position_ego_m, scene.upright_box, vehicle_count=scene.vehicle_count).numpy()
            shown = 100.0 * points.numpy() / np.maximum(whole[..., None], _LEAST_SR)
            points = wp.array(shown, dtype=float, device=points.device)
        most = self.most(points.numpy(), whole, distance_m, direction)
        return self.of_points(points, distance_m, scene.road_user_index, most)

    def most(
        self, points: np.ndarray, whole_sr: np.ndarray | None, distance_m: np.ndarray, direction: np.ndarray
    ) -> np.ndarray:
        """The greatest probability of every object, float [view, object]; a radar's is 0 of what merges into another.

        Of points as of `of_points`, solid angles of boxes (None: of a LiDAR), and what `away_from` gives.
        """
        radar, found = self.beams.radar, np.ones(distance_m.shape)
        if radar is None or whole_sr is None:
            return found
        azimuth = np.arctan2(direction[..., 1], direction[..., 0])
        apart = np.abs(np.angle(np.exp(1j * (azimuth[:, :, None] - azimuth[:, None]))))
        is_one = (apart < self.beams.step_rad) & (np.abs(distance_m[:, :, None] - distance_m[:, None]) < radar.cell_m)
        shown = points[..., 0] * whole_sr
        found[(is_one & (shown[:, None] > shown[:, :, None])).any(axis=2)] = 0.0
        return radar.probability * found

    def _curve_of(self, road_user_index: np.ndarray) -> tuple[np.ndarray, float, np.ndarray]:
        """Points for an even chance of each object, steepness, and range of each [m]."""
        radar, count = self.beams.radar, len(road_user_index)
        if radar is not None:
            half, range_m = np.full(count, 100.0 * radar.visible_share), np.array(radar.range_m)[road_user_index]
            return half, _RADAR_STEEPNESS, range_m
        return self.curve.halves[road_user_index], self.curve.steepness, np.full(count, self.beams.range_m[0])

    def of_points(
        self,
        points: wp.array,
        distance_m: wp.array | np.ndarray,
        road_user_index: np.ndarray,
        most: np.ndarray | None = None,
    ) -> tuple[wp.array, wp.array]:
        """Points that return, and the probability to find each object, recorded on the active tape.

        Args:
            points: Expected beams, of a radar percent of boxes, float [view, object, 1]; gradients flow to them.
            distance_m: Of every object from every view [m], float [view, object]; gradients flow to an array of Warp.
            road_user_index: Kind of every object, index into `ROAD_USERS`, int [object].
            most: As `most` gives it; None: 1.

        Returns:
            Both float [view, object].
        """
        device, shape = points.device, points.shape[:2]
        returned, probability = (wp.zeros(shape, dtype=float, device=device, requires_grad=True) for _ in range(2))
        if not isinstance(distance_m, wp.array):
            distance_m = wp.array(distance_m, dtype=float, device=device)
        half, steepness, range_m = self._curve_of(road_user_index)
        greatest = np.ones(shape) if most is None else most
        on_device = [wp.array(each, dtype=float, device=device) for each in (half, range_m, greatest)]
        wp.launch(
            kernels.lidar_probability_kernel,
            dim=shape,
            inputs=[points, distance_m, on_device[0], steepness, *on_device[1:]],
            outputs=[returned, probability],
            device=device,
        )
        return returned, probability


def away_from(scene: DeviceScene, position_ego_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distances of the objects' boxes from places [m], [place, object], and their slopes to the places [..., 3]."""
    centre_m = scene.upright_box.centre_ego_m.numpy()[: scene.vehicle_count]
    away_m = position_ego_m[:, None].astype(np.float64) - centre_m
    distance_m = np.maximum(np.linalg.norm(away_m, axis=2), 1e-6)
    return distance_m, away_m / distance_m[..., None]


@dataclass(frozen=True)
class Scan:
    """One scan of a LiDAR.

    Attributes:
        point_m: What returns in the ego frame [m], float64 [point, 3].
        object_index: What each is on: 0 environment, 1 ego vehicle, 2 + k vehicle k of the scene, int32 [point].
    """

    point_m: np.ndarray
    object_index: np.ndarray


def scan(rig: Rig, scene: Scene, *, device: str = "cpu") -> dict[str, Scan]:
    """One scan of every LiDAR of a rig: each beam in the middle of its cell, without noise, up to the greater range.

    For pictures: distances are those of the panorama's pixels. Expected points are `LidarProbability.points`.

    Args:
        rig: LiDARs, and cameras and radars, which are left out.
        scene: The scene.
        device: Warp device.

    Returns:
        Scans by the LiDAR's name.

    Raises:
        InputError: The device is not there.
    """
    lidars = [each for each in rig.cameras if each.model.beams is not None and each.model.beams.radar is None]
    scans = {}
    for lidar, image in zip(lidars, render_images(scene, lidars, device=checked_device(device)), strict=True):
        beams = lidar.model.beams
        assert beams is not None
        direction, row, column = beams.shots()
        distance_m, index = image.depth_m[row, column], image.object_index[row, column]
        returns = distance_m <= beams.range_m[1]
        turn = lidar.ego_from_camera[:3, :3] @ FLU_FROM_RDF.T
        point_m = lidar.position_m + (distance_m[returns, None] * direction[returns]) @ turn.T
        scans[lidar.name] = Scan(point_m, index[returns])
    return scans
