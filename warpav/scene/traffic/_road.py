"""The ground of a recorded scene: lanes become one road with kerbs, pavements and markings.

What is lane, or where a vehicle stands, is road; gaps between lanes are closed. All else is land, one kerb higher. A
field of distances from the road's edge, on a grid of `CELL_M`, says which is which; its contours are the kerbs and the
ends of pavements, and one triangulation that holds all of them is the ground, so there are no gaps.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from warpav.raster.mesh import Mesh
from warpav.scene._scene import yaw_rotation
from warpav.scene.town._furniture import FOOTPRINT_M, furniture_mesh
from warpav.scene.town._houses import (
    HOUSE_DEPTH_M,
    KERB_HEIGHT_M,
    KERB_WIDTH_M,
    MARKING_HEIGHT_M,
    PAVEMENT_FADE,
    SceneryBuilder,
)
from warpav.scene.town._town_layout import Footprint, Occupied
from warpav.scene.traffic._road_users import body_mesh, drawn_kind
from warpav.scene.traffic.recording import Lanelet

if TYPE_CHECKING:
    from contourpy import ContourGenerator

CELL_M = 0.15
_ROAD_REACH_M = 85.0  # roads end at this distance from the ego vehicle in x and y, in front of a house
_LAND_M = 26.0  # around the roads
_CLOSED_GAP_M = 1.5  # between lanes
_ISLAND_MIN_M2 = 6.0  # of land inside the road
_SMOOTHING_M = 0.25
_PAVEMENT_M = (2.4, 4.0)
_CONTOUR_ERROR_M = 0.025
_CONTOUR_STEP_M = 4.0
_ROAD_STEP_M, _LAND_STEP_M = 3.5, 12.0
_SPLIT_ROUNDS = 12
_SUBPIXEL_BITS = 8
_LINE_HALF_WIDTH_M, _LINE_STEP_M = 0.06, 1.5
_BESIDE_M = 0.45  # of a border, where its neighbours are looked for
_EDGE_INSET_M = 0.2
_WHITE = 0.82
_GRASS_RGB = np.array([0.40, 0.47, 0.29])
_GRASS_SHARE = 0.5


@dataclass(frozen=True, eq=False)
class Road:
    """Road and land around the ego vehicle, in the ego frame."""

    low_m: np.ndarray  # corner of the area [m], shape [2]
    # Distance from the road's edge, negative on the road [m], float32 [row, column]; rows along y, columns along x, in
    # cells of `CELL_M`; point (row, column) lies at low_m + CELL_M * (column, row).
    field_m: np.ndarray
    pavement_m: float  # width of the pavements
    lanelets: tuple[Lanelet, ...]  # lanes and crossings
    coverage: np.ndarray  # how many lanes cover a point, uint8 [row, column]
    owner: np.ndarray  # index of the last of them, int16 [row, column]; -1 without
    walked: np.ndarray  # where somebody goes or rides beside the road, bool [row, column]

    @property
    def high_m(self) -> np.ndarray:
        """The opposite corner of the area [m], shape [2]."""
        return self.low_m + CELL_M * (np.array(self.field_m.shape[::-1]) - 1)

    def distance_m(self, point_m: np.ndarray) -> np.ndarray:
        """Distance of points from the road's edge, negative on the road [m]; [..., 2] gives [...]; outside is land."""
        row, column, is_inside = self._cells(point_m)
        return np.where(is_inside, self.field_m[row, column], 1e3)

    def height_m(self, point_m: np.ndarray) -> np.ndarray:
        """Height of the ground [m]; [..., 2] gives [...]."""
        return np.where(self.distance_m(point_m) > 0.0, KERB_HEIGHT_M, 0.0)

    def is_walked(self, point_m: np.ndarray) -> bool:
        """Whether somebody goes at any of some points [..., 2]."""
        row, column, is_inside = self._cells(point_m)
        return bool((self.walked[row, column] & is_inside).any())

    def contour_m(self, level_m: float) -> list[np.ndarray]:
        """Closed lines at a distance from the road, which lies to their right [m]; each [point, 2], first = last."""
        import cv2

        found = []
        for line in self._contours.lines(level_m):
            closed = np.asarray(line, np.float32)
            slim = cv2.approxPolyDP(closed[:-1, None], _CONTOUR_ERROR_M / CELL_M, True)[:, 0].astype(np.float64)
            if len(slim) < 3:
                continue
            point_m = self.low_m + CELL_M * np.concatenate([slim, slim[:1]])
            along = point_m[1] - point_m[0]
            middle = 0.5 * (point_m[0] + point_m[1])
            left = np.array([-along[1], along[0]]) / max(np.linalg.norm(along), 1e-9)
            is_right = self.distance_m(middle + 0.3 * left) > self.distance_m(middle - 0.3 * left)
            found.append(point_m if is_right else point_m[::-1])
        return found

    @cached_property
    def _contours(self) -> ContourGenerator:
        import contourpy

        return contourpy.contour_generator(z=self.field_m, line_type=contourpy.LineType.Separate)

    def _cells(self, point_m: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        cell = np.round((np.asarray(point_m) - self.low_m) / CELL_M).astype(np.int64)
        limit = np.array(self.field_m.shape[::-1]) - 1
        kept = np.clip(cell, 0, limit)
        return kept[..., 1], kept[..., 0], (cell == kept).all(axis=-1)

    def ground(self, builder: SceneryBuilder, rng: np.random.Generator) -> Mesh:
        """Road, kerbs, pavements and land as a mesh without gaps."""
        levels = (0.0, self.pavement_m)
        contours = [[subdivided(line, _CONTOUR_STEP_M) for line in self.contour_m(level)] for level in levels]
        point_m, triangle = self._triangulated(contours, rng)
        middle = self.distance_m(point_m[triangle].mean(axis=1))
        zone = np.digitize(middle, levels)
        asphalt = builder.asphalt_rgb
        pavement = builder.pavement_rgb
        land = _GRASS_RGB * rng.uniform(0.85, 1.1) if rng.random() < _GRASS_SHARE else 0.8 * pavement
        kerb = np.full(3, pavement[1] + 0.09)
        mottle = 0.006 * rng.standard_normal(len(point_m))[:, None]
        fade = np.clip(self.distance_m(point_m) / self.pavement_m, 0.0, 1.0)[:, None]
        colour = (asphalt + mottle, pavement * (1.0 - PAVEMENT_FADE * fade), land + 2.0 * mottle)
        vertices, triangles, colours = [], [], []
        first = 0
        for number in range(3):
            used, index = np.unique(triangle[zone == number], return_inverse=True)
            height = np.full(len(used), KERB_HEIGHT_M if number else 0.0)
            vertices.append(np.c_[point_m[used], height])
            triangles.append(first + index.reshape(-1, 3))
            colours.append(colour[number][used])
            first += len(used)
        for line in contours[0]:
            count = len(line)
            top = np.full(count, KERB_HEIGHT_M)
            over = top + MARKING_HEIGHT_M
            # the road lies to the right, which the wall faces; the stone is laid over the edge of the pavement
            for rows, shade in (
                ((np.c_[line, 0.0 * top], np.c_[line, over]), 0.72),
                ((np.c_[line, over], np.c_[line + KERB_WIDTH_M * _leftward(line), over]), 1.0),
            ):
                k = first + np.arange(count - 1)
                triangles += [np.stack([k, k + 1, k + count], 1), np.stack([k + 1, k + count + 1, k + count], 1)]
                vertices += rows
                colours.append(np.broadcast_to(shade * kerb, (2 * count, 3)))
                first += 2 * count
        rgb = np.round(255.0 * np.clip(np.concatenate(colours), 0.0, 1.0)).astype(np.uint8)
        return Mesh(np.concatenate(vertices).astype(np.float32), np.concatenate(triangles).astype(np.int32), rgb)

    def _triangulated(
        self, contours: list[list[np.ndarray]], rng: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray]:
        """Points [m], [point, 2], and anticlockwise triangles with all contours in them, halved as often as needed."""
        from scipy.spatial import Delaunay

        corner, segment = [np.zeros((0, 2))], [np.zeros((0, 2), np.int64)]
        first = 0
        for line in (line for lines in contours for line in lines):
            count = len(line) - 1
            k = np.arange(count)
            corner.append(line[:-1])
            segment.append(first + np.stack([k, (k + 1) % count], axis=1))
            first += count
        edge = np.concatenate(segment)
        # points along the border of the area
        (x_low, y_low), (x_high, y_high) = self.low_m, self.high_m
        counts = [max(2, int(extent / _LAND_STEP_M)) for extent in self.high_m - self.low_m]
        x, y = np.linspace(x_low, x_high, counts[0]), np.linspace(y_low, y_high, counts[1])
        sides = [np.c_[x, np.full_like(x, y_low)], np.c_[x, np.full_like(x, y_high)],
                 np.c_[np.full_like(y, x_low), y][1:-1], np.c_[np.full_like(y, x_high), y][1:-1]]  # fmt: skip
        point = np.concatenate([*corner, np.concatenate(sides), self._scattered(contours, rng)])
        triangle = np.zeros((0, 3), np.int32)
        for _ in range(_SPLIT_ROUNDS):
            triangle = Delaunay(point).simplices
            side = np.sort(np.stack([triangle, np.roll(triangle, -1, axis=1)], axis=-1).reshape(-1, 2), axis=1)
            there = side[:, 0].astype(np.int64) * len(point) + side[:, 1]
            wanted = np.sort(edge, axis=1)
            is_missing = ~np.isin(wanted[:, 0] * len(point) + wanted[:, 1], there)
            if not is_missing.any():
                break
            lacking = edge[is_missing]
            new = len(point) + np.arange(len(lacking))
            point = np.concatenate([point, point[lacking].mean(axis=1)])
            edge = np.concatenate(
                [edge[~is_missing], np.stack([lacking[:, 0], new], 1), np.stack([new, lacking[:, 1]], 1)]
            )
        a, b, c = np.moveaxis(point[triangle], 1, 0)
        turned = np.cross(np.c_[b - a, np.zeros(len(a))], np.c_[c - a, np.zeros(len(a))])[:, 2]
        triangle = np.where((turned < 0.0)[:, None], triangle[:, ::-1], triangle)
        return point, triangle[np.abs(turned) > 1e-9]

    def _scattered(self, contours: list[list[np.ndarray]], rng: np.random.Generator) -> np.ndarray:
        """Points inside road and land, not near contours."""
        kept = []
        for step_m, is_road in ((_ROAD_STEP_M, True), (_LAND_STEP_M, False)):
            x, y = (np.arange(low + step_m, high - 0.5 * step_m, step_m) for low, high in
                    zip(self.low_m, self.high_m, strict=True))  # fmt: skip
            point = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
            point = point + rng.uniform(-0.15, 0.15, point.shape) * step_m
            distance = self.distance_m(point)
            kept.append(point[(distance < -0.3 * step_m) if is_road else distance > self.pavement_m + 0.3 * step_m])
        return np.concatenate(kept)

    def add_markings(self, builder: SceneryBuilder) -> None:
        """Add lines between lanes and along the road's edge, and the stripes of crossings."""
        for number, lanelet in enumerate(self.lanelets):
            if lanelet.is_crosswalk:
                self._add_stripes(builder, lanelet)
            elif "intersection" not in lanelet.kinds:
                for line, side in ((lanelet.left_m, 1.0), (lanelet.right_m, -1.0)):
                    self._add_lines(builder, number, line, side)

    def _add_lines(self, builder: SceneryBuilder, number: int, line_m: np.ndarray, side: float) -> None:
        length = _length_m(line_m)
        point = _at_shares(line_m, np.linspace(0.0, 1.0, max(1, round(length / _LINE_STEP_M)) + 1))
        if len(point) < 3:
            return
        along = np.gradient(point, axis=0)
        along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9)
        outward = side * np.stack([-along[:, 1], along[:, 0]], axis=1)
        inner, outer = point - _BESIDE_M * outward, point + _BESIDE_M * outward
        row, column, is_inside = self._cells(outer)
        beyond, other = self.coverage[row, column], self.owner[row, column]
        row, column, is_inner_inside = self._cells(inner)
        own = is_inside & is_inner_inside & (self.coverage[row, column] == 1)
        is_edge = own & (beyond == 0)
        is_border = own & (beyond == 1) & (other >= 0) & (other != number)
        forward = np.array([self._headings[k] for k in np.maximum(other, 0)])
        is_opposite = is_border & (np.einsum("ij,ij->i", forward, along) < 0.0)
        is_same = is_border & ~is_opposite & (side > 0.0)
        is_dash = (np.arange(len(point)) // 2) % 2 == 0
        drawn = is_same & is_dash | (is_opposite & (number < other))
        for wanted, shift_m in ((drawn, 0.0), (is_edge, -_EDGE_INSET_M)):
            place = point + shift_m * outward
            use = wanted[:-1] & np.where(is_same[:-1], is_dash[:-1], wanted[1:])
            use &= (self.distance_m(place[:-1]) < -_LINE_HALF_WIDTH_M) & (
                self.distance_m(place[1:]) < -_LINE_HALF_WIDTH_M
            )
            normal = side * outward * _LINE_HALF_WIDTH_M
            corner = np.stack([place[:-1] - normal[:-1], place[1:] - normal[1:], place[1:] + normal[1:],
                               place[:-1] + normal[:-1]], axis=1)[use]  # fmt: skip
            _add_flat(builder, corner)

    @cached_property
    def _headings(self) -> np.ndarray:
        """Direction of every lane, float64 [lanelet, 2]."""
        return np.array([0.5 * ((each.left_m[-1] - each.left_m[0]) + (each.right_m[-1] - each.right_m[0]))
                         for each in self.lanelets])  # fmt: skip

    def _add_stripes(self, builder: SceneryBuilder, crossing: Lanelet) -> None:
        length_m = max(float(np.linalg.norm(np.diff(line, axis=0), axis=1).sum())
                       for line in (crossing.left_m, crossing.right_m))  # fmt: skip
        if not 0.5 < length_m < 100.0:
            return
        share = np.arange(0.25, length_m - 0.5, 1.0)[:, None] + [0.0, 0.5]
        left, right = (_at_shares(line, share / length_m) for line in (crossing.left_m, crossing.right_m))
        corner = np.stack([left[:, 0], right[:, 0], right[:, 1], left[:, 1]], axis=1)
        turn = np.cross(np.c_[corner[:, 1] - corner[:, 0], np.zeros(len(corner))],
                        np.c_[corner[:, 2] - corner[:, 0], np.zeros(len(corner))])[:, 2]  # fmt: skip
        corner = np.where((turn < 0.0)[:, None, None], corner[:, ::-1], corner)
        _add_flat(builder, corner[(self.distance_m(corner) < 0.0).all(axis=1)])


def road_of(
    lanelets: Sequence[Lanelet],
    heavy_m: Sequence[np.ndarray],
    light_m: Sequence[np.ndarray],
    driven: Sequence[tuple[np.ndarray, float]],
    walked: Sequence[tuple[np.ndarray, float]],
    pavement_m: float,
) -> Road:
    """The road of lanes, in the ego frame.

    Args:
        lanelets: Lanes and crossings.
        heavy_m: Outlines of vehicles [point, 2], below which there is road.
        light_m: Outlines of two-wheelers, below which there is road if it begins there.
        driven: Ways of vehicles, which are road: lines [point, 2] and how wide they are [m].
        walked: Ways of others, on which nothing stands.
        pavement_m: Width of the pavements.
    """
    import cv2

    lanes = [
        subdivided(line, _CONTOUR_STEP_M)
        for lanelet in lanelets
        if not lanelet.is_crosswalk
        for line in (lanelet.left_m, lanelet.right_m)
    ]
    inside = [line[(np.abs(line) <= _ROAD_REACH_M).all(axis=1)] for line in lanes]
    held = np.concatenate([*inside, *heavy_m, *light_m])
    low_m, high_m = held.min(axis=0) - _LAND_M, held.max(axis=0) + _LAND_M
    shape = tuple(int(extent / CELL_M) + 1 for extent in (high_m - low_m)[::-1])
    coverage, owner = np.zeros(shape, np.uint8), np.full(shape, -1, np.int16)

    def pixels(line: np.ndarray) -> np.ndarray:
        return np.round((line - low_m) / CELL_M * 2**_SUBPIXEL_BITS).astype(np.int32)[:, None]

    for number, lanelet in enumerate(lanelets):
        if lanelet.is_crosswalk:
            continue
        outline = lanelet.outline_m
        first = np.maximum(((outline.min(axis=0) - low_m) / CELL_M).astype(int) - 1, 0)
        last = np.minimum(((outline.max(axis=0) - low_m) / CELL_M).astype(int) + 2, shape[::-1])
        if (last <= first).any():
            continue
        part = np.zeros((last[1] - first[1], last[0] - first[0]), np.uint8)
        shifted = np.round((outline - low_m - CELL_M * first) / CELL_M * 2**_SUBPIXEL_BITS).astype(np.int32)[:, None]
        cv2.fillPoly(part, [shifted], 1, shift=_SUBPIXEL_BITS)
        window = np.s_[first[1] : last[1], first[0] : last[0]]
        coverage[window] += part
        owner[window][part > 0] = number
    mask = (coverage > 0).astype(np.uint8)
    y, x = (low + CELL_M * np.arange(count) for low, count in zip(low_m[::-1], shape, strict=True))
    mask[np.abs(y) > _ROAD_REACH_M] = 0
    mask[:, np.abs(x) > _ROAD_REACH_M] = 0
    gone = np.zeros(shape, np.uint8)
    for drawn, ways in ((mask, driven), (gone, walked)):
        for line, width_m in ways:
            cv2.polylines(drawn, [pixels(line)], False, 1, max(1, round(width_m / CELL_M)), shift=_SUBPIXEL_BITS)
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (round(_CLOSED_GAP_M / CELL_M) | 1,) * 2)
    mask = np.asarray(cv2.morphologyEx(mask, cv2.MORPH_CLOSE, disc), np.uint8)
    for outline in heavy_m:
        cv2.fillConvexPoly(mask, pixels(outline), 1, shift=_SUBPIXEL_BITS)
    for outline in light_m:
        below = np.zeros(shape, np.uint8)
        cv2.fillConvexPoly(below, pixels(outline), 1, shift=_SUBPIXEL_BITS)
        if mask[below > 0].any():
            mask |= below
    count, label, about, _ = cv2.connectedComponentsWithStats(1 - mask, connectivity=4)
    is_small = np.zeros(count, bool)
    is_small[1:] = about[1:, cv2.CC_STAT_AREA] * CELL_M**2 < _ISLAND_MIN_M2
    mask[np.take(is_small, np.asarray(label, np.int64))] = 1
    # distances are to the middles of the cells beyond the edge, half a cell too far
    away, within = (np.maximum(cv2.distanceTransform(part, cv2.DIST_L2, 5) - 0.5, 0.0) for part in (1 - mask, mask))
    field = CELL_M * (away - within)
    field = cv2.GaussianBlur(field, (0, 0), _SMOOTHING_M / CELL_M)
    return Road(low_m, field, pavement_m, tuple(lanelets), coverage, owner, gone > 0)


def pavement_width_m(rng: np.random.Generator) -> float:
    """A random width of pavements [m]; with two rows of houses there is room for it around the roads."""
    assert _PAVEMENT_M[1] + 2.0 * HOUSE_DEPTH_M < _LAND_M
    return float(rng.uniform(*_PAVEMENT_M))


def _at_distances(line_m: np.ndarray, distance_m: np.ndarray) -> np.ndarray:
    """Points of a line at distances along it [m], [...] gives [..., 2]."""
    return _at_shares(line_m, np.asarray(distance_m) / max(_length_m(line_m), 1e-9))


def _at_shares(line_m: np.ndarray, share: np.ndarray) -> np.ndarray:
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line_m, axis=0), axis=1))])
    where = np.clip(share, 0.0, 1.0) * along[-1]
    return np.stack([np.interp(where, along, line_m[:, axis]) for axis in range(2)], axis=-1)


def subdivided(line_m: np.ndarray, step_m: float) -> np.ndarray:
    """The line with no segment longer than a step."""
    way = np.diff(line_m, axis=0)
    count = np.maximum(np.ceil(np.hypot(*way.T) / step_m).astype(int), 1)
    segment = np.repeat(np.arange(len(way)), count)
    number = np.arange(len(segment)) - np.repeat(np.cumsum(count) - count, count)
    return np.concatenate([line_m[segment] + (number / count[segment])[:, None] * way[segment], line_m[-1:]])


def _leftward(line_m: np.ndarray) -> np.ndarray:
    """Unit vectors to the left of a closed line at its points, [point, 2]."""
    step = np.diff(line_m, axis=0)
    step /= np.maximum(np.linalg.norm(step, axis=1, keepdims=True), 1e-9)
    along = step + np.roll(step, 1, axis=0)
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9)
    left = np.stack([-along[:, 1], along[:, 0]], axis=1)
    return np.concatenate([left, left[:1]])


def _add_flat(builder: SceneryBuilder, corner_m: np.ndarray) -> None:
    """Add painted quads [quad, 4, 2], anticlockwise."""
    if len(corner_m):
        height = np.full((*corner_m.shape[:2], 1), MARKING_HEIGHT_M)
        builder.add_quads(np.concatenate([corner_m, height], axis=-1), np.full(3, _WHITE))


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
class Body:
    """A road user in the ego frame."""

    kind: str  # category
    mesh: Mesh  # in its own frame
    footprint: Footprint  # where it is
    velocity_m_s: np.ndarray  # how fast over ground, in the recording's frame [m/s], shape [2]


class Roadside:
    """Collects what stands on the land, clear of everything else."""

    def __init__(self, road: Road, taken: Sequence[Footprint], rng: np.random.Generator) -> None:
        self._road = road
        self._rng = rng
        self._taken = Occupied(taken)  # what furniture keeps clear of
        self._plots = Occupied()  # houses and yards
        self.parked: list[Body] = []
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
                start, end = _at_distances(line_m, np.array([at, min(at + extent, length)]))
                chord = float(np.linalg.norm(end - start))
                if chord < 0.9 * extent:
                    continue
                along = (end - start) / chord
                # a hand narrower than the front, so that rows of houses touch
                depth_m = _BAY_DEPTH_M if is_yard else HOUSE_DEPTH_M
                inward = np.array([-along[1], along[0]])
                centre = start + 0.5 * chord * along + 0.5 * depth_m * inward
                plot = Footprint(
                    float(centre[0]), float(centre[1]), math.atan2(along[1], along[0]), chord - 0.1, depth_m - 0.1
                )
                if not self._is_free(plot, distance_m - _INTO_PAVEMENT_M):
                    continue
                self._plots.add(plot)
                if is_yard:
                    corner = np.c_[plot.corners_m(), np.full(4, KERB_HEIGHT_M + MARKING_HEIGHT_M)]
                    builder.add_quads(corner[None], builder.asphalt_rgb)
                    self._park(start, along, count)
                else:
                    builder.add_house(start, along, chord, is_free_standing=True)
                at += extent
                break
            else:
                at += _HOUSE_STEP_M

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
            centre = start + (bay + 0.5) * _BAY_M * along + (0.5 * size[0] + 0.25) * inward
            yaw = math.atan2(math.sin(yaw), math.cos(yaw))
            footprint = Footprint(float(centre[0]), float(centre[1]), yaw, size[0], size[1])
            self.parked.append(Body(kind, mesh, footprint, np.zeros(2)))

    def _furnish(self, line_m: np.ndarray) -> None:
        length = _length_m(line_m)
        rng = self._rng
        wanted = [("lamp_post", at) for at in np.arange(rng.uniform(0.0, _LAMP_SPACING_M), length, _LAMP_SPACING_M)]
        for kind, spacing in _PIECES:
            wanted += [(kind, at) for at in rng.uniform(0.0, length, rng.poisson(length / spacing))]
        for kind, at in wanted:
            before, place, after = _at_distances(line_m, np.clip([at - 0.5, at, at + 0.5], 0.0, length))
            along = (after - before) / max(float(np.linalg.norm(after - before)), 1e-9)
            inward = np.array([-along[1], along[0]])
            extent = FOOTPRINT_M[kind]
            x, y = place + max(0.5 * extent[1] - 0.2, 0.0) * inward
            yaw = math.atan2(along[1], along[0])
            footprint = Footprint(float(x), float(y), yaw, *extent)
            mesh = furniture_mesh(kind, rng)
            if self._is_free(footprint, 0.2):
                self._taken.add(footprint)
                self.furniture.append(mesh.transformed(yaw_rotation(yaw), np.array([x, y, KERB_HEIGHT_M])))

    def _is_free(self, footprint: Footprint, distance_m: float) -> bool:
        """Whether a rectangle lies on the land, at a distance from the road, and clear of all that stands."""
        c, s = math.cos(footprint.yaw_rad), math.sin(footprint.yaw_rad)
        point = _SAMPLE * [footprint.length_m, footprint.width_m] @ np.array([[c, s], [-s, c]])
        point = point + np.array([footprint.x_m, footprint.y_m])
        if not ((point >= self._road.low_m) & (point <= self._road.high_m)).all():
            return False
        if self._road.distance_m(point).min() < distance_m or self._road.is_walked(point):
            return False
        return self._plots.is_free(footprint, 0.0) and self._taken.is_free(footprint, _CLEAR_M)


_SAMPLE = np.stack(np.meshgrid(np.linspace(-0.5, 0.5, 9), np.linspace(-0.5, 0.5, 9)), axis=-1).reshape(-1, 2)


def _length_m(line_m: np.ndarray) -> float:
    return float(np.linalg.norm(np.diff(line_m, axis=0), axis=1).sum())
