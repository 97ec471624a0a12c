"""What stands beside and on a street: lamp posts, signs, benches, shelters, kiosks, and what closes road works off.

Frame: x along the street, y away from the road, z up, metres; the origin lies on the ground below the centre. Whatever
stands on a grade stays upright: its foot reaches below the ground.
"""

from __future__ import annotations

from functools import cache

import numpy as np

from warpav.raster.mesh import Mesh
from warpav.scene.town._paint import Material, painted_mesh, sky_share
from warpav.scene.town._surface_builder import Surface, SurfaceBuilder

_FOOT_M = -0.12  # how deep a foot reaches

# Linear albedos that a piece draws its own colour from.
_COLOURS = np.array(
    [(0.05, 0.14, 0.09), (0.04, 0.08, 0.20), (0.32, 0.05, 0.04), (0.40, 0.38, 0.33), (0.10, 0.11, 0.12)]
)
_SIGN_COLOURS = np.array([(0.50, 0.02, 0.02), (0.02, 0.08, 0.35), (0.75, 0.55, 0.04)])


def _post(builder: SurfaceBuilder, x: float, y: float, height: float, radius: float, material: int) -> None:
    path = np.array([(x, y, _FOOT_M), (x, y, height)])
    builder.add_tube(path, np.array([[radius, radius], [0.75 * radius, 0.75 * radius]]), material, sides=6, cap=0.1)


def _disc(builder: SurfaceBuilder, centre: tuple[float, float, float], radius: float, y: float, material: int) -> None:
    """A thin disc that faces along y, up to ``y`` in front of its centre."""
    path = np.array([(centre[0], centre[1] + y, centre[2]), (centre[0], centre[1] + 0.01, centre[2])])
    builder.add_tube(path, radius, material, sides=12, cap=0.0)


def _lamp_post(builder: SurfaceBuilder) -> None:
    _post(builder, 0.0, 0.0, 6.4, 0.075, Material.METAL)
    builder.add_tube([(0.0, 0.0, 0.0), (0.0, 0.0, 0.9)], 0.11, Material.METAL, sides=6)
    builder.add_box((-0.04, -1.5, 6.30), (0.04, 0.04, 6.38), Material.METAL)
    builder.add_box((-0.14, -1.75, 6.24), (0.14, -1.05, 6.36), Material.METAL)
    builder.add_box((-0.11, -1.70, 6.21), (0.11, -1.10, 6.25), Material.PLATE)


def _bollard(builder: SurfaceBuilder) -> None:
    _post(builder, 0.0, 0.0, 0.95, 0.075, Material.DARK)
    builder.add_tube([(0.0, 0.0, 0.74), (0.0, 0.0, 0.84)], 0.078, Material.PLATE, sides=8, cap=0.0)


def _bin(builder: SurfaceBuilder) -> None:
    path = np.array([(0.0, 0.0, _FOOT_M), (0.0, 0.0, 0.78), (0.0, 0.0, 0.80), (0.0, 0.0, 0.92)])
    radius = np.array([[0.20, 0.20], [0.24, 0.24], [0.27, 0.27], [0.22, 0.22]])
    builder.add_tube(path, radius, Material.PAINT, sides=10, cap=0.2)
    builder.add_box((-0.16, -0.272, 0.60), (0.16, -0.10, 0.73), Material.DARK)


def _sign(builder: SurfaceBuilder) -> None:
    _post(builder, 0.0, 0.03, 2.75, 0.035, Material.METAL)
    _disc(builder, (0.0, -0.02, 2.40), 0.32, 0.03, Material.METAL)
    _disc(builder, (0.0, -0.03, 2.40), 0.31, 0.00, Material.PAINT)
    builder.add_box((-0.20, -0.047, 2.355), (0.20, -0.03, 2.445), Material.PLATE)


def _traffic_light(builder: SurfaceBuilder) -> None:
    _post(builder, 0.0, 0.0, 3.35, 0.06, Material.DARK)
    for front in (-1.0, 1.0):
        x = 0.11 * front
        builder.add_box((x - 0.10, -0.16, 2.35), (x + 0.10, 0.16, 3.30), Material.BLACK_PLASTIC)
        for z, material in ((3.12, Material.TAIL_LAMP), (2.83, Material.INDICATOR), (2.54, Material.GO)):
            path = np.array([(x, 0.0, z), (x + 0.135 * front, 0.0, z)])
            builder.add_tube(path, 0.10, material, sides=10, cap=0.0)
            builder.add_box((min(x, x + 0.2 * front), -0.11, z + 0.10), (max(x, x + 0.2 * front), 0.11, z + 0.125),
                            Material.BLACK_PLASTIC)  # fmt: skip


def _bench(builder: SurfaceBuilder) -> None:
    for y in (-0.24, -0.09, 0.06):
        builder.add_box((-0.90, y, 0.43), (0.90, y + 0.12, 0.47), Material.WOOD)
    for z in (0.58, 0.76):
        builder.add_box((-0.90, 0.22, z), (0.90, 0.26, z + 0.13), Material.WOOD)
    for x in (-0.72, 0.66):
        builder.add_box((x, -0.25, _FOOT_M), (x + 0.06, -0.17, 0.44), Material.DARK)
        builder.add_box((x, 0.17, _FOOT_M), (x + 0.06, 0.23, 0.88), Material.DARK)
        builder.add_box((x, -0.25, 0.38), (x + 0.06, 0.22, 0.435), Material.DARK)


def _bus_shelter(builder: SurfaceBuilder) -> None:
    builder.add_box((-1.95, -0.75, 2.38), (1.95, 0.72, 2.50), Material.DARK)
    builder.add_box((-1.90, -0.78, 2.40), (1.90, -0.74, 2.48), Material.PAINT)
    for x in (-1.85, 1.79):
        for y in (-0.60, 0.58):
            builder.add_box((x, y, _FOOT_M), (x + 0.06, y + 0.06, 2.40), Material.METAL)
    # Three panes at the back with posts between them, one at the upstream end, a poster at the other.
    for low, high in ((-1.79, -0.63), (-0.57, 0.57), (0.63, 1.79)):
        builder.add_box((low, 0.60, 0.22), (high, 0.62, 2.30), Material.PANE)
    for x in (-0.63, 0.57):
        builder.add_box((x, 0.58, _FOOT_M), (x + 0.06, 0.64, 2.40), Material.METAL)
    builder.add_box((-1.83, -0.54, 0.22), (-1.81, 0.58, 2.30), Material.PANE)
    builder.add_box((1.72, -0.62, 0.25), (1.92, 0.60, 2.25), Material.DARK)
    for x in (1.71, 1.905):
        builder.add_box((x, -0.54, 0.40), (x + 0.025, 0.52, 2.10), Material.PAINT)
        builder.add_box((x - 0.003, -0.40, 1.35), (x + 0.028, 0.38, 1.75), Material.PLATE)
    builder.add_box((-1.3, 0.22, 0.45), (1.0, 0.52, 0.50), Material.WOOD)
    for x in (-1.1, 0.8):
        builder.add_box((x, 0.32, _FOOT_M), (x + 0.06, 0.40, 0.46), Material.METAL)


def _kiosk(builder: SurfaceBuilder) -> None:
    builder.add_box((-1.40, -1.10, _FOOT_M), (1.40, 1.10, 2.55), Material.PAINT)
    builder.add_box((-1.44, -1.14, _FOOT_M), (1.44, 1.14, 0.16), Material.DARK)
    builder.add_box((-1.52, -1.22, 2.52), (1.52, 1.22, 2.70), Material.METAL)
    builder.add_box((-1.30, -1.16, 2.22), (1.30, -1.05, 2.46), Material.PLATE)
    # A counter below an opening, newspapers beside it, an awning of stripes above.
    builder.add_box((-0.65, -1.125, 1.02), (1.20, -1.05, 1.98), Material.DARK)
    builder.add_box((-0.75, -1.36, 0.96), (1.30, -1.05, 1.02), Material.WOOD)
    for row in range(3):
        for column in range(2):
            x, z = -1.28 + 0.27 * column, 0.55 + 0.42 * row
            material = (Material.PLATE, Material.REFLECTOR, Material.MARKER_YELLOW)[(row + column) % 3]
            builder.add_box((x, -1.15, z), (x + 0.22, -1.05, z + 0.32), material)
    for stripe in range(8):
        x = -1.36 + 0.34 * stripe
        material = Material.REFLECTOR if stripe % 2 == 0 else Material.PLATE
        corner = np.array([(-1.80, 2.02), (-1.80, 2.06), (-1.08, 2.24), (-1.08, 2.20)])
        _add_prism(builder, x, x + 0.34, corner, material)
    for x, material in ((-1.41, Material.PLATE), (1.39, Material.PLATE)):
        builder.add_box((x, -0.6, 0.9), (x + 0.02, 0.7, 2.0), material)


def _add_prism(builder: SurfaceBuilder, low_x: float, high_x: float, corner_yz: np.ndarray, material: int) -> None:
    """A solid between two x with a convex outline of (y, z) corners, clockwise seen from +x."""
    loop = np.concatenate([corner_yz, corner_yz[:1]])
    side = np.stack([np.c_[np.full(len(loop), x), loop] for x in (low_x, high_x)], axis=1)
    centre = corner_yz.mean(axis=0)
    caps = [np.broadcast_to([x, *centre], (len(loop), 1, 3)) for x in (low_x, high_x)]
    builder.add_grid(np.concatenate([caps[0], side, caps[1]], axis=1)[::-1], material)


def _barrier(builder: SurfaceBuilder) -> None:
    for x in (-0.85, 0.79):
        builder.add_box((x, -0.28, _FOOT_M), (x + 0.06, 0.28, 0.06), Material.DARK)
        builder.add_box((x, -0.02, 0.0), (x + 0.06, 0.02, 1.12), Material.METAL)
    for z in (0.34, 0.82):
        for field in range(8):
            material = Material.REFLECTOR if field % 2 == 0 else Material.PLATE
            builder.add_box((-1.0 + 0.25 * field, -0.04, z), (-0.75 + 0.25 * field, -0.005, z + 0.22), material)
    builder.add_tube([(0.82, 0.0, 1.10), (0.82, 0.0, 1.30)], 0.085, Material.INDICATOR, sides=8)


def _cone(builder: SurfaceBuilder) -> None:
    builder.add_box((-0.19, -0.19, _FOOT_M), (0.19, 0.19, 0.035), Material.DARK)
    height = np.array([0.02, 0.26, 0.44, 0.54, 0.75])
    radius = np.interp(height, [0.0, 0.75], [0.145, 0.028])
    path = np.stack([0.0 * height, 0.0 * height, height], axis=1)
    orange, white = Material.CONE, Material.PLATE
    builder.add_tube(path, np.stack([radius, radius], axis=1), np.array([orange, orange, white, orange, white, orange]),
                     sides=9, cap=0.2)  # fmt: skip


def _works_sign(builder: SurfaceBuilder) -> None:
    for x in (-0.28, 0.24):
        builder.add_box((x, -0.02, _FOOT_M), (x + 0.04, 0.02, 0.75), Material.METAL)
        builder.add_box((x, -0.32, _FOOT_M), (x + 0.04, 0.32, 0.04), Material.DARK)
    for size, depth, material in ((0.52, 0.030, Material.REFLECTOR), (0.36, 0.042, Material.PLATE)):
        low = 1.02 - 0.577 * size
        corner = np.array([(-size, low), (0.0, low + 1.732 * size), (size, low)])
        loop = np.concatenate([corner, corner[:1]])
        front, back = (np.stack([loop[:, 0], np.full(len(loop), y), loop[:, 1]], axis=1) for y in (-depth, 0.01))
        centre = corner.mean(axis=0)
        caps = [np.broadcast_to([centre[0], y, centre[1]], (len(loop), 1, 3)) for y in (-depth, 0.01)]
        grid = np.concatenate([caps[0], front[:, None], back[:, None], caps[1]], axis=1)
        builder.add_grid(grid, material)
    builder.add_box((-0.10, -0.052, 0.86), (0.10, -0.02, 0.94), Material.DARK)
    builder.add_box((-0.03, -0.052, 0.90), (0.03, -0.02, 1.12), Material.DARK)


def _sand_heap(builder: SurfaceBuilder) -> None:
    height = np.array([_FOOT_M, 0.0, 0.18, 0.38, 0.55, 0.64])
    path = np.stack([0.04 * np.sin(9.0 * np.maximum(height, 0.1)), 0.0 * height, height], axis=1)
    share = np.array([1.0, 1.0, 0.80, 0.52, 0.26, 0.10])
    builder.add_tube(path, share[:, None] * np.array([0.95, 0.70]), Material.SAND, sides=12, cap=0.05)


def _pallet(builder: SurfaceBuilder) -> None:
    for y in (-0.42, -0.05, 0.32):
        builder.add_box((-0.58, y, _FOOT_M), (0.58, y + 0.10, 0.12), Material.WOOD)
    builder.add_box((-0.60, -0.45, 0.10), (0.60, 0.45, 0.15), Material.WOOD)
    for layer in range(3):
        for column in range(3):
            x, z = -0.54 + 0.37 * column, 0.155 + 0.19 * layer
            builder.add_box((x, -0.40, z), (x + 0.34, 0.40, z + 0.18), Material.STONE)


_PIECES = {  # length and width [m], and what builds it
    "lamp_post": (0.3, 0.3, _lamp_post),
    "bollard": (0.25, 0.25, _bollard),
    "bin": (0.6, 0.6, _bin),
    "sign": (0.7, 0.3, _sign),
    "traffic_light": (0.7, 0.4, _traffic_light),
    "bench": (1.9, 0.7, _bench),
    "bus_shelter": (3.9, 1.6, _bus_shelter),
    "kiosk": (3.1, 3.6, _kiosk),
    "barrier": (2.2, 0.6, _barrier),
    "cone": (0.4, 0.4, _cone),
    "works_sign": (1.1, 0.7, _works_sign),
    "sand_heap": (2.0, 1.5, _sand_heap),
    "pallet": (1.2, 1.0, _pallet),
}
FOOTPRINT_M = {kind: (length, width) for kind, (length, width, _) in _PIECES.items()}  # length and width of every kind


@cache
def _baked(kind: str) -> tuple[Surface, np.ndarray]:
    builder = SurfaceBuilder()
    _PIECES[kind][2](builder)
    surface = builder.finish()
    return surface, sky_share(surface)


def furniture_mesh(kind: str, rng: np.random.Generator) -> Mesh:
    """One piece with its light baked in."""
    if kind not in _PIECES:
        raise ValueError(f"no furniture {kind!r}; kinds: {', '.join(_PIECES)}")
    colours = _SIGN_COLOURS if kind == "sign" else _COLOURS
    surface, sky = _baked(kind)
    return painted_mesh(surface, sky, {Material.PAINT: colours[int(rng.integers(len(colours)))]})
