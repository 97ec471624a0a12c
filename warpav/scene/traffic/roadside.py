"""What stands beside a recorded road: houses, parked cars in front of some plots, furniture along the kerb.

Nothing of it was recorded. Everything stands on the land, clear of the road and of everybody who was recorded.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from warpav.raster.mesh import Mesh
from warpav.scene.town.furniture import FOOTPRINT_M, furniture_mesh
from warpav.scene.town.houses import HOUSE_DEPTH_M, KERB_HEIGHT_M, MARKING_HEIGHT_M, SceneryBuilder
from warpav.scene.town.street_life import Footprint
from warpav.scene.traffic.road import Road, at_distances
from warpav.scene.traffic.road_users import body_mesh, drawn_kind

_HOUSE_M = (8.0, 15.0)
_HOUSE_STEP_M = 1.5  # along the kerb, where a house does not fit
_BEHIND_M = 1.0  # between a house and the row behind it
_INTO_PAVEMENT_M = 0.5  # by which a corner of a house may reach over the end of the pavement, in bends
_YARD_SHARE = 0.16  # of the plots
_BAY_M, _BAY_DEPTH_M, _BAY_COUNT = 2.9, 5.4, (2, 5)
_FREE_BAY_SHARE = 0.3
_CAR_M = ((3.8, 4.8), (1.70, 1.90))
_KERB_CLEAR_M = 0.6  # between the road and furniture
_LAMP_SPACING_M = 19.0
_PIECES = (("sign", 26.0), ("bin", 40.0), ("bench", 55.0), ("bollard", 60.0), ("bus_shelter", 160.0))
"""Furniture, and the length of kerb that one piece comes on [m], in the mean."""
_CLEAR_M = 0.35


@dataclass(frozen=True, eq=False)
class ParkedCar:
    """A car on a plot."""

    kind: str  # category
    mesh: Mesh  # in its own frame
    footprint: Footprint  # where it stands, in the ego frame


class Roadside:
    """Collects what stands on the land, clear of everything else."""

    def __init__(self, road: Road, taken: Sequence[Footprint], rng: np.random.Generator) -> None:
        """Nothing yet."""
        self._road = road
        self._rng = rng
        self._taken = list(taken)
        self.parked: list[ParkedCar] = []
        self.furniture: list[Mesh] = []

    def build(self, builder: SceneryBuilder) -> None:
        """Houses and yards behind the pavements, houses behind their gaps, then furniture on the pavements."""
        for distance_m in (self._road.pavement_m, self._road.pavement_m + HOUSE_DEPTH_M + _BEHIND_M):
            for line in self._road.contour_m(distance_m):
                self._build_row(builder, line, distance_m)
        for line in self._road.contour_m(_KERB_CLEAR_M):
            self._furnish(line)

    def _build_row(self, builder: SceneryBuilder, line_m: np.ndarray, distance_m: float) -> None:
        length = _length_m(line_m)
        at = 0.0
        while at < length - 1.0:
            width = float(self._rng.uniform(*_HOUSE_M))
            is_yard = self._rng.random() < _YARD_SHARE and distance_m <= self._road.pavement_m
            count = int(self._rng.integers(*_BAY_COUNT))
            for extent in (count * _BAY_M,) if is_yard else (width, 0.7 * _HOUSE_M[0]):
                start, end = at_distances(line_m, np.array([at, min(at + extent, length)]))
                chord = float(np.linalg.norm(end - start))
                if chord < 0.9 * extent:
                    continue
                along = (end - start) / chord
                plot = _behind(start, along, chord, _BAY_DEPTH_M if is_yard else HOUSE_DEPTH_M)
                if not self._is_free(plot, distance_m - _INTO_PAVEMENT_M):
                    continue
                self._taken.append(plot)
                if is_yard:
                    self._pave(builder, plot)
                    self._park(start, along, count)
                else:
                    builder.add_house(start, along, chord, is_free_standing=True)
                at += extent
                break
            else:
                at += _HOUSE_STEP_M

    def _pave(self, builder: SceneryBuilder, plot: Footprint) -> None:
        corner = np.c_[plot.corners_m(), np.full(4, KERB_HEIGHT_M + MARKING_HEIGHT_M)]
        builder.add_quads(corner[None], builder.asphalt_grey * np.array([1.0, 1.0, 1.015]))

    def _park(self, start: np.ndarray, along: np.ndarray, count: int) -> None:
        inward = np.array([-along[1], along[0]])
        for bay in range(count):
            if self._rng.random() < _FREE_BAY_SHARE:
                continue
            length, width = (float(self._rng.uniform(*extent)) for extent in _CAR_M)
            size = (length, width, math.nan)
            kind = drawn_kind("car", size, self._rng)
            mesh = body_mesh(kind, size, self._rng)
            yaw = math.atan2(inward[1], inward[0]) + (math.pi if self._rng.random() < 0.4 else 0.0)
            x, y = start + (bay + 0.5) * _BAY_M * along + (0.5 * size[0] + 0.25) * inward
            yaw = math.atan2(math.sin(yaw), math.cos(yaw))
            self.parked.append(ParkedCar(kind, mesh, Footprint(float(x), float(y), yaw, size[0], size[1])))

    def _furnish(self, line_m: np.ndarray) -> None:
        length = _length_m(line_m)
        rng = self._rng
        wanted = [("lamp_post", at) for at in np.arange(rng.uniform(0.0, _LAMP_SPACING_M), length, _LAMP_SPACING_M)]
        for kind, spacing in _PIECES:
            wanted += [(kind, at) for at in rng.uniform(0.0, length, rng.poisson(length / spacing))]
        for kind, at in wanted:
            before, place, after = at_distances(line_m, np.clip([at - 0.5, at, at + 0.5], 0.0, length))
            along = (after - before) / max(float(np.linalg.norm(after - before)), 1e-9)
            inward = np.array([-along[1], along[0]])
            extent = FOOTPRINT_M[kind]
            x, y = place + max(0.5 * extent[1] - 0.2, 0.0) * inward
            yaw = math.atan2(along[1], along[0])
            footprint = Footprint(float(x), float(y), yaw, *extent)
            mesh = furniture_mesh(kind, rng)
            if self._is_free(footprint, 0.2):
                self._taken.append(footprint)
                self.furniture.append(turned(mesh, yaw, np.array([x, y, KERB_HEIGHT_M])))

    def _is_free(self, footprint: Footprint, distance_m: float) -> bool:
        """Whether a rectangle lies on the land, at a distance from the road, and clear of all that stands."""
        share = np.stack(np.meshgrid(np.linspace(-0.5, 0.5, 9), np.linspace(-0.5, 0.5, 9)), axis=-1).reshape(-1, 2)
        c, s = math.cos(footprint.yaw_rad), math.sin(footprint.yaw_rad)
        point = share * [footprint.length_m, footprint.width_m] @ np.array([[c, s], [-s, c]])
        point = point + np.array([footprint.x_m, footprint.y_m])
        if not ((point >= self._road.low_m) & (point <= self._road.high_m)).all():
            return False
        if self._road.distance_m(point).min() < distance_m:
            return False
        return not any(footprint.nearer(other, 0.0 if _is_plot(other) else _CLEAR_M) for other in self._taken)


def turned(mesh: Mesh, yaw_rad: float, place_m: np.ndarray) -> Mesh:
    """A mesh turned about z and moved to a place [m], [3]."""
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)
    return mesh.transformed(np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]), place_m)


def _behind(start: np.ndarray, along: np.ndarray, width_m: float, depth_m: float) -> Footprint:
    """The rectangle to the left of a front, a hand narrower so that rows of houses touch."""
    inward = np.array([-along[1], along[0]])
    centre = start + 0.5 * width_m * along + 0.5 * depth_m * inward
    return Footprint(float(centre[0]), float(centre[1]), math.atan2(along[1], along[0]), width_m - 0.1, depth_m - 0.1)


def _is_plot(footprint: Footprint) -> bool:
    return min(footprint.length_m, footprint.width_m) > 4.0


def _length_m(line_m: np.ndarray) -> float:
    return float(np.linalg.norm(np.diff(line_m, axis=0), axis=1).sum())
