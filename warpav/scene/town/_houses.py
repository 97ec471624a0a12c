"""Flat-coloured street scenery in vertex colours: asphalt, markings, kerbs, pavements, houses, contact shadows."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from warpav.raster.mesh import Mesh
from warpav.scene.town._surface_builder import StreetGround
from warpav.scene.town._town_layout import Block, Footprint, Layout, Marking, Rectangle, sides_of

KERB_HEIGHT_M = 0.13
KERB_WIDTH_M = 0.16
MARKING_HEIGHT_M = 0.004
_SHADOW_HEIGHT_M = 0.008
SHADOW_SEGMENTS = 24
MIRRORS_M = 0.25  # by which they make the outline of a vehicle wider
_FOOT_SHADOW = 0.5  # strength of a person's shadow
PAVEMENT_FADE = 0.14  # light that the houses take from the pavement in front of them
_FOOT_HEIGHT_M = 0.3  # what is lower belongs to the ground, or to the foot of a wall that stands on it
# How far each ring of a contact shadow lies outside the vehicle's outline [m], and the light that is left there.
_SHADOW_RINGS = ((-0.50, 0.16), (-0.12, 0.20), (0.03, 0.45), (0.16, 0.74), (0.36, 1.0))
_GROUND_CELL_M, _YARD_CELL_M = 3.0, 16.0
_CORNER_POINTS = 6
HOUSE_DEPTH_M = 9.0
_GROUND_FLOOR_M, _FLOOR_M = 3.5, 3.1
_WALL_COLOURS = np.array(
    [(0.66, 0.59, 0.50), (0.74, 0.70, 0.62), (0.58, 0.43, 0.36), (0.63, 0.63, 0.63),
     (0.78, 0.76, 0.71), (0.52, 0.46, 0.41), (0.70, 0.62, 0.46), (0.57, 0.60, 0.62)]
)  # fmt: skip
_ROOF_COLOURS = np.array([(0.44, 0.32, 0.28), (0.38, 0.38, 0.40), (0.48, 0.37, 0.30)])


class SceneryBuilder:
    """Collects coloured quads; colours are sRGB 0..1."""

    def __init__(
        self, rng: np.random.Generator, ground: StreetGround, *, detailed_within_m: float | None = None
    ) -> None:
        self._detailed_within_m = detailed_within_m
        self._rng = rng
        self._ground = ground
        self._quad: list[np.ndarray] = []
        self._colour: list[np.ndarray] = []
        self._house_x_m = np.nan  # houses are level: they stand on the ground of their centre
        self.asphalt_grey = float(rng.uniform(0.33, 0.41))
        self._pavement_grey = float(rng.uniform(0.52, 0.60))

    def add_quads(self, corner_m: np.ndarray, colour: np.ndarray) -> None:
        """Add quads [quad, 4, 3], counter-clockwise seen from outside; colours broadcast to the same shape."""
        if not self._ground.is_level:
            follows = (corner_m[..., 2] < _FOOT_HEIGHT_M) | np.isnan(self._house_x_m)
            x = np.where(follows, corner_m[..., 0], self._house_x_m)
            corner_m = corner_m + self._ground.height_m(x)[..., None] * np.array([0.0, 0.0, 1.0])
        self._quad.append(corner_m)
        self._colour.append(np.broadcast_to(colour, corner_m.shape))

    def add_ground(
        self, rectangle_m: Rectangle, height_m: float, colour: np.ndarray, mottle: float, cell_m: float = _GROUND_CELL_M
    ) -> None:
        """Add a level rectangle in cells of a few metres whose brightness varies by ``mottle``."""
        x_low, y_low, x_high, y_high = rectangle_m
        columns, rows = (max(1, round(extent / cell_m)) for extent in (x_high - x_low, y_high - y_low))
        x, y = np.meshgrid(self._columns(x_low, x_high, columns), np.linspace(y_low, y_high, rows + 1), indexing="ij")
        point = np.stack([x, y, np.full_like(x, height_m)], axis=-1)
        shade = colour + mottle * self._rng.standard_normal(x.shape)[..., None]
        self._add_sheet(point, shade)

    def _columns(self, low_m: float, high_m: float, count: int) -> np.ndarray:
        """X of the grid lines from low to high: ``count`` cells, or cells that end where the ground bends."""
        if self._ground.is_level:
            return np.linspace(low_m, high_m, count + 1)
        return np.r_[low_m, self._ground.knots_m(low_m, high_m), high_m]

    def add_box(
        self,
        low_m: tuple[float, float, float],
        high_m: tuple[float, float, float],
        colour: np.ndarray,
        *,
        steps: int = 1,
    ) -> None:
        """Add a box without a bottom that follows the ground; x is cut into steps, and where the ground bends."""
        (x_low, y_low, z_low), (x_high, y_high, z_high) = low_m, high_m
        x = self._columns(x_low, x_high, steps)
        yz = [(y_low, z_low), (y_high, z_low), (y_high, z_high), (y_low, z_high)]
        for k, shade in ((1, 0.8), (2, 1.0), (3, 0.8)):
            edge = np.array([[yz[k], yz[(k + 1) % 4]]])
            point = np.stack([np.stack([x, np.full_like(x, y), np.full_like(x, z)], axis=-1) for y, z in edge[0]], 1)
            self._add_sheet(point, colour * shade)
        ends = np.array([[(x_low, *corner) for corner in yz[::-1]], [(x_high, *corner) for corner in yz]])
        self.add_quads(ends, colour * 0.75)

    def add_level_box(
        self, low_m: tuple[float, float, float], high_m: tuple[float, float, float], colour: np.ndarray
    ) -> None:
        """Add a closed box that is level: heights are above the ground below its middle; see `add_box`."""
        self._house_x_m = 0.5 * (low_m[0] + high_m[0])
        (x0, y0, z0), (x1, y1, z1) = low_m, high_m
        corner = np.array([(x, y, z) for x in (x0, x1) for y in (y0, y1) for z in (z0, z1)])
        quad = np.array([(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)])
        shade = np.array([0.75, 0.75, 0.8, 0.8, 0.55, 1.0])[:, None, None]
        self.add_quads(corner[quad], shade * colour)
        self._house_x_m = np.nan

    def add_plan(self, layout: Layout, markings: Iterable[Marking]) -> None:
        for rectangle in layout.asphalt_m:
            self.add_asphalt(rectangle)
        for marking in (*layout.markings, *markings):
            self.add_marking(marking)
        for block in layout.blocks:
            self.add_block(block)

    def add_asphalt(self, rectangle_m: Rectangle, cell_m: float = _GROUND_CELL_M) -> None:
        self.add_ground(rectangle_m, 0.0, self.asphalt_rgb, 0.006, cell_m)

    def add_marking(self, marking: Marking) -> None:
        x_low, y_low, x_high, y_high = marking.rectangle_m
        along = self._columns(x_low, x_high, max(1, round((x_high - x_low) / 16.0)))
        x, y = np.meshgrid(along, [y_low, y_high], indexing="ij")
        point = np.stack([x, y, np.full_like(x, MARKING_HEIGHT_M)], axis=-1)
        self._add_sheet(point, np.full(3, marking.brightness))

    @property
    def asphalt_rgb(self) -> np.ndarray:
        """Colour of roads, sRGB 0..1, shape [3]."""
        return self.asphalt_grey * np.array([1.0, 1.0, 1.015])

    @property
    def pavement_rgb(self) -> np.ndarray:
        """Colour of pavements, sRGB 0..1, shape [3]."""
        return self._pavement_grey * np.array([1.02, 1.0, 0.97])

    def add_shadow(
        self,
        place: Footprint,
        index: int,
        pavement_share: float | None = None,
        *,
        mirrors_m: float = MIRRORS_M,
        height_m: float = 0.0,
        segments: int = SHADOW_SEGMENTS,
    ) -> None:
        """Add the shadow of a vehicle or, with a share of a pavement (below 0 on the road), of a person."""
        strength, grey, width_m = 1.0, self.asphalt_rgb, place.width_m - mirrors_m
        if pavement_share is not None:
            strength, width_m = _FOOT_SHADOW, place.width_m
            if pavement_share >= 0.0:
                height_m, grey = KERB_HEIGHT_M, self.pavement_rgb * (1.0 - PAVEMENT_FADE * pavement_share)
        height_m += _SHADOW_HEIGHT_M + 0.0004 * index
        angle = np.linspace(0.0, 2.0 * np.pi, segments + 1)
        cosine, sine = np.cos(angle), np.sin(angle)
        # A superellipse: a rectangle with rounded corners.
        unit = np.stack([np.sign(cosine) * np.abs(cosine) ** 0.35, np.sign(sine) * np.abs(sine) ** 0.35], axis=-1)
        half = 0.5 * np.array([place.length_m, width_m])
        rings = [unit * np.maximum(half + strength * grow, 0.02) for grow, _ in _SHADOW_RINGS]
        local = np.stack([0.0 * unit, *rings])
        light = np.array([_SHADOW_RINGS[0][1], *(light for _, light in _SHADOW_RINGS)])
        c, s = np.cos(place.yaw_rad), np.sin(place.yaw_rad)
        x = place.x_m + c * local[..., 0] - s * local[..., 1]
        y = place.y_m + s * local[..., 0] + c * local[..., 1]
        point = np.stack([x, y, np.full_like(x, height_m + self._ground.bulge_m(x.min(), x.max()))], axis=-1)
        shade = (1.0 - strength * (1.0 - light))[:, None, None] * grey
        self._add_sheet(point, np.broadcast_to(shade, point.shape))

    def add_block(self, block: Block) -> None:
        rng = self._rng
        x_low, y_low, x_high, y_high = block.rectangle_m
        kerb_colour = np.full(3, self._pavement_grey + 0.09)
        pavement = self.pavement_rgb
        knots = self._ground.knots_m(x_low, x_high)
        outer, edge, inner = (_rounded_loop(block, inset, knots) for inset in (0.0, KERB_WIDTH_M, block.pavement_m))
        low, high = np.zeros(len(outer)), np.full(len(outer), KERB_HEIGHT_M)
        self._add_sheet(np.stack([np.c_[outer, low], np.c_[outer, high]], axis=1), np.stack([kerb_colour * 0.72] * 2))
        self._add_sheet(np.stack([np.c_[outer, high], np.c_[edge, high]], axis=1), kerb_colour)
        wall = np.minimum(1.0, 1.0 + 0.015 * rng.standard_normal((len(outer), 1, 1)))
        shade = np.stack([pavement, pavement * (1.0 - PAVEMENT_FADE)]) * wall
        self._add_sheet(np.stack([np.c_[edge, high], np.c_[inner, high]], axis=1), shade)
        if block.corner_m > 0.0:
            for x, y in ((x_low, y_low), (x_high - block.corner_m, y_low), (x_low, y_high - block.corner_m),
                         (x_high - block.corner_m, y_high - block.corner_m)):  # fmt: skip
                self.add_asphalt((x, y, x + block.corner_m, y + block.corner_m))
        gap = block.pavement_m
        x_low, y_low, x_high, y_high = x_low + gap, y_low + gap, x_high - gap, y_high - gap
        self.add_ground((x_low, y_low, x_high, y_high), KERB_HEIGHT_M, pavement * 0.8, 0.0, cell_m=_YARD_CELL_M)
        # A side that faces no road has no pavement: houses reach the edge.
        sides = sides_of((x_low, y_low, x_high, y_high))
        crossed = not {"south", "north"}.isdisjoint(block.fronts)
        for front in block.fronts:
            self._add_row(*sides[front], HOUSE_DEPTH_M if crossed and front in ("east", "west") else 0.0)

    def _add_row(self, start: np.ndarray, direction: np.ndarray, length: float, inset: float) -> None:
        """A row of houses along a street, from the left end as seen from the street."""
        at, end = inset, length - inset
        while end - at > 1.0:
            width = self._rng.uniform(8.0, 15.0)
            if end - at - width < 7.0:
                width = end - at
            ends = (at == inset, at + width > length - inset - 1.0)
            self.add_house(start + direction * at, direction, width, ends=ends)
            at += width

    def add_house(
        self,
        left: np.ndarray,
        direction: np.ndarray,
        width: float,
        *,
        ends: tuple[bool, bool] = (True, True),
        is_free_standing: bool = False,
    ) -> None:
        """Add a house of two to four floors, `HOUSE_DEPTH_M` deep; ``left`` [2], ``direction`` [2]."""
        rng = self._rng
        self._house_x_m = float(left[0] + 0.5 * width * direction[0])
        outward = np.array([direction[1], -direction[0]])
        floors = int(rng.integers(2, 5))
        height = _GROUND_FLOOR_M + floors * _FLOOR_M - 0.2
        wall = _WALL_COLOURS[rng.integers(len(_WALL_COLOURS))] * rng.uniform(0.90, 1.06)
        roof = _ROOF_COLOURS[rng.integers(len(_ROOF_COLOURS))] * rng.uniform(0.9, 1.1)
        right, depth = left + direction * width, -outward * HOUSE_DEPTH_M
        self._add_front(left, direction, width, height, wall)
        # Both flanks look like plain walls, or like fronts where they stand at a corner of the block: seldom in view.
        for corner, facing, is_end in ((right, -outward, ends[1]), (left + depth, outward, ends[0])):
            if self._detailed_within_m is None or is_end:
                self._add_front(corner, facing, HOUSE_DEPTH_M, height, wall * 0.95)
            else:
                ends_m = np.stack([corner, corner + HOUSE_DEPTH_M * facing])[[0, 1, 1, 0]]
                self.add_quads(np.c_[ends_m, [0.0, 0.0, height, height]][None], wall * 0.9)
        if is_free_standing:
            self._add_front(right + depth, -direction, width, height, wall * 0.95)
        corner = np.stack([left, right, right + depth, left + depth])
        top = np.c_[corner, np.full(4, height)]
        if rng.random() < 0.55:
            ridge = 0.5 * (top[[0, 1]] + top[[3, 2]]) + [0.0, 0.0, rng.uniform(2.0, 3.2)]
            slope = np.stack([[top[0], top[1], ridge[1], ridge[0]], [top[2], top[3], ridge[0], ridge[1]]])
            self.add_quads(slope, roof)
            gable = np.stack([[top[1], top[2], ridge[1], ridge[1]], [top[3], top[0], ridge[0], ridge[0]]])
            self.add_quads(gable, wall * 0.95)
        else:
            self.add_quads(top[None], roof)
        self._house_x_m = np.nan

    def _add_front(
        self, left: np.ndarray, direction: np.ndarray, width: float, height: float, wall: np.ndarray
    ) -> None:
        """One wall with a darker base, a cornice, windows and doors; light fades towards the ground."""
        rng = self._rng

        parts: list[tuple[np.ndarray, np.ndarray, float, np.ndarray, np.ndarray]] = []

        def rectangles(u: np.ndarray, z: np.ndarray, proud: float, low: np.ndarray, high: np.ndarray) -> None:
            """Rectangles [n, 2] along the wall and upwards, with colours at their lower and upper edges."""
            parts.append((u, z, proud, low, high))

        def strip(low: float, high: float, proud: float, below: np.ndarray, above: np.ndarray) -> None:
            rectangles(np.array([[0.0, width]]), np.array([[low, high]]), proud, below, above)

        ground = wall * rng.uniform(0.80, 0.95)
        strip(0.0, 1.2, 0.0, ground * 0.62, ground * 0.78)
        strip(1.2, _GROUND_FLOOR_M, 0.0, ground * 0.78, ground * 0.90)
        strip(_GROUND_FLOOR_M, height, 0.0, wall * 0.90, wall)
        strip(_GROUND_FLOOR_M - 0.18, _GROUND_FLOOR_M + 0.10, 0.10, wall * 0.92, wall * 1.05)
        strip(height - 0.35, height, 0.14, wall * 0.85, wall * 1.06)

        middle = left + 0.5 * width * direction
        has_frames = self._detailed_within_m is None or np.hypot(*middle) < self._detailed_within_m
        count = max(2, int(width / rng.uniform(2.3, 3.2)))
        pitch = width / count
        share = rng.uniform(0.20, 0.26)
        u, z = [], []
        shop = rng.random() < 0.4 and width > 6.0
        door = int(rng.integers(count))
        for bay in range(count):
            for floor in range(int((height - 1.0) / _FLOOR_M)):
                base = 0.95 if floor == 0 else _GROUND_FLOOR_M + 0.75 + (floor - 1) * _FLOOR_M
                low, high = share, 1.0 - share
                top = base + (1.45 if floor == 0 else 1.65)
                if floor == 0 and bay == door:
                    base, top, low, high = 0.14, 2.5, 0.5 - 0.55 / pitch, 0.5 + 0.55 / pitch
                elif floor == 0 and shop:
                    base, top, low, high = 0.55, 2.85, 0.08, 0.92
                u.append((pitch * (bay + low), pitch * (bay + high)))
                z.append((base, top))
        u, z = np.array(u), np.array(z)
        margin = np.array([-0.09, 0.09])
        trim = np.minimum(wall * 1.12, 0.92)
        if has_frames:
            rectangles(u + margin, z + margin, 0.02, trim * 0.9, trim)
        dark = rng.uniform(0.10, 0.26, (len(u), 1)) * np.array([1.0, 1.02, 1.07])
        rectangles(u, z, 0.035, dark, dark + np.array([0.13, 0.16, 0.20]))
        centre = u.mean(axis=1, keepdims=True) + np.array([-0.035, 0.035])
        if has_frames:
            rectangles(centre, z, 0.05, trim * 0.92, trim * 0.98)
        counts = [len(part[0]) for part in parts]
        u, z = (np.concatenate([part[k] for part in parts]) for k in (0, 1))
        proud = np.repeat([part[2] for part in parts], counts)[:, None, None]
        shades = [np.empty((len(u), 3)) for _ in range(2)]
        ends = np.cumsum(counts)
        for part, end, count in zip(parts, ends, counts, strict=True):
            for shade, colour in zip(shades, part[3:], strict=True):
                shade[end - count : end] = colour
        position = left + np.array([direction[1], -direction[0]]) * proud + u[:, [0, 1, 1, 0], None] * direction
        corner = np.concatenate([position, z[:, [0, 0, 1, 1], None]], axis=-1)
        self.add_quads(corner, np.stack(shades, axis=1)[:, [0, 0, 1, 1]])

    def finish(self) -> Mesh:
        """All quads as one mesh; degenerate triangles are left out."""
        corner = np.concatenate(self._quad)
        colour = np.concatenate(self._colour)
        first = 4 * np.arange(len(corner))[:, None]
        triangle = (first[:, :, None] + np.array([[0, 1, 2], [0, 2, 3]])).reshape(-1, 3)
        vertex = corner.reshape(-1, 3)
        edge = vertex[triangle[:, 1:]] - vertex[triangle[:, :1]]
        solid = np.linalg.norm(np.cross(edge[:, 0], edge[:, 1]), axis=1) > 1e-8
        rgb = np.round(255.0 * np.clip(colour.reshape(-1, 3), 0.0, 1.0)).astype(np.uint8)
        return Mesh(vertex.astype(np.float32), triangle[solid].astype(np.int32), rgb)

    def _add_sheet(self, point: np.ndarray, colour: np.ndarray) -> None:
        """Quads of a grid [a, b, 3] whose outside is d/d(first) x d/d(second)."""
        colour = np.broadcast_to(colour, point.shape)
        self.add_quads(cells_of(point), cells_of(colour))


def cells_of(grid: np.ndarray) -> np.ndarray:
    """The four corners of every cell of a grid [a, b, 3], shape [cell, 4, 3]."""
    return np.stack([grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]], axis=2).reshape(-1, 4, 3)


def _rounded_loop(block: Block, inset_m: float, knots_m: np.ndarray) -> np.ndarray:
    """Closed outline of a block, counter-clockwise, moved inwards; points where the ground bends, always as many."""
    x_low, y_low, x_high, y_high = block.rectangle_m
    radius = max(block.corner_m - inset_m, 0.0)
    points = []
    corners = ((x_high, y_low, -90.0), (x_high, y_high, 0.0), (x_low, y_high, 90.0), (x_low, y_low, 180.0))
    for x, y, start in corners:
        toward = np.array([1.0 if x == x_low else -1.0, 1.0 if y == y_low else -1.0])
        center = np.array([x, y]) + toward * (inset_m + radius)
        angle = np.radians(start + np.linspace(0.0, 90.0, _CORNER_POINTS))
        points.append(center + radius * np.stack([np.cos(angle), np.sin(angle)], axis=-1))
    loop = []
    for index, arc in enumerate(points):
        following = points[(index + 1) % 4][0]
        pieces = max(1, round((y_high - y_low if index % 2 == 0 else x_high - x_low) / 6.0))
        share = np.linspace(0.0, 1.0, pieces + 1)[1:-1]
        if index % 2 == 1 and len(knots_m):
            share = np.clip((knots_m - arc[-1, 0]) / (following[0] - arc[-1, 0]), 0.0, 1.0)
            share.sort()
        loop += [arc, arc[-1] + share[:, None] * (following - arc[-1])]
    loop.append(points[0][:1])
    return np.concatenate(loop)
