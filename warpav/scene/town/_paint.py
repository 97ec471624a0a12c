"""Materials of vehicles, people and furniture, and the light that is baked into their colours.

Light is sky, an overhead sun, and reflections.
"""

from __future__ import annotations

import enum
from collections.abc import Mapping

import numpy as np

from warpav.raster.mesh import Mesh
from warpav.scene._scene import triangle_caster
from warpav.scene.town._surface_builder import Surface


class Material(enum.IntEnum):
    """What a part is made of: number, linear albedo, mirror strength; of paint and clothes defaults."""

    albedo: tuple[float, float, float]
    mirror: float

    def __new__(cls, number: int, red: float, green: float, blue: float, mirror: float) -> Material:
        one = int.__new__(cls, number)
        one._value_ = number
        one.albedo, one.mirror = (red, green, blue), mirror
        return one

    PAINT = 0, 0.5, 0.5, 0.5, 0.13
    GLASS = 1, 0.012, 0.014, 0.016, 0.12
    BLACK_PLASTIC = 2, 0.026, 0.026, 0.028, 0.03
    TYRE = 3, 0.05, 0.05, 0.052, 0.0
    RIM = 4, 0.45, 0.46, 0.48, 0.1
    HEADLAMP = 5, 0.8, 0.82, 0.85, 0.25
    TAIL_LAMP = 6, 0.5, 0.01, 0.008, 0.07
    PLATE = 7, 0.85, 0.85, 0.83, 0.02
    REAR_PLATE = 8, 0.8, 0.62, 0.08, 0.02
    DARK = 9, 0.006, 0.006, 0.006, 0.0
    CHROME = 10, 0.58, 0.58, 0.6, 0.45
    SEAM = 11, 0.028, 0.028, 0.028, 0.0
    UNDERBODY = 12, 0.012, 0.012, 0.012, 0.0
    CARGO = 13, 0.9, 0.9, 0.88, 0.03
    CARGO_FRAME = 14, 0.3, 0.31, 0.32, 0.06
    INDICATOR = 15, 0.75, 0.28, 0.02, 0.08
    MARKER_YELLOW = 16, 0.8, 0.58, 0.04, 0.03
    REFLECTOR = 17, 0.62, 0.03, 0.02, 0.02
    LIFT = 18, 0.16, 0.17, 0.18, 0.05
    SKIN = 19, 0.5, 0.3, 0.2, 0.02
    HAIR = 20, 0.03, 0.02, 0.015, 0.02
    TOP = 21, 0.3, 0.3, 0.3, 0.0
    LEGWEAR = 22, 0.05, 0.05, 0.06, 0.0
    SHOE = 23, 0.03, 0.028, 0.026, 0.03
    BAG = 24, 0.1, 0.08, 0.06, 0.02
    HELMET = 25, 0.6, 0.6, 0.6, 0.08
    METAL = 26, 0.22, 0.23, 0.24, 0.08
    WOOD = 27, 0.2, 0.11, 0.055, 0.0
    PANE = 28, 0.1, 0.125, 0.13, 0.2
    CONE = 29, 0.7, 0.13, 0.01, 0.02
    SAND = 30, 0.42, 0.31, 0.17, 0.0
    STONE = 31, 0.3, 0.29, 0.27, 0.0
    GO = 32, 0.02, 0.22, 0.1, 0.08


_ALBEDO = np.array([material.albedo for material in Material])
_MIRROR = np.array([material.mirror for material in Material])
_PAINT_COLOURS = np.array(
    [(0.70, 0.70, 0.70), (0.64, 0.65, 0.67), (0.52, 0.53, 0.55), (0.34, 0.35, 0.37), (0.19, 0.21, 0.23),
     (0.080, 0.085, 0.095), (0.035, 0.035, 0.040), (0.030, 0.065, 0.21), (0.10, 0.21, 0.40), (0.40, 0.025, 0.025),
     (0.26, 0.03, 0.04), (0.05, 0.15, 0.10), (0.68, 0.65, 0.58), (0.55, 0.25, 0.05)]
)  # fmt: skip
_BUS_COLOURS = np.array(
    [(0.55, 0.03, 0.025), (0.62, 0.42, 0.03), (0.03, 0.11, 0.36), (0.05, 0.24, 0.10),
     (0.70, 0.70, 0.68), (0.60, 0.19, 0.02)]
)  # fmt: skip
_PAINT_SHARES = np.array([20, 8, 14, 10, 9, 7, 11, 6, 5, 5, 2, 2, 3, 1]) / 103.0
_SKY_LIGHT, _SUN_LIGHT, _BOUNCE_LIGHT = 0.62, 0.34, 0.04
_GROUND_ALBEDO = 0.18  # an occlusion ray that ends on the road still brings this share of the light
_TURN = np.arange(64)
_Z = 1.0 - (2.0 * _TURN + 1.0) / 64
_AZIMUTH = _TURN * np.pi * (3.0 - np.sqrt(5.0))
_DIRECTIONS = np.stack([np.sqrt(1.0 - _Z * _Z) * np.cos(_AZIMUTH), np.sqrt(1.0 - _Z * _Z) * np.sin(_AZIMUTH), _Z], 1)
"""Directions of rays for ambient occlusion, spread evenly over the sphere along a spiral."""
_OCCLUSION_STEPS = 64  # occlusion is kept on this grid, so that the last bit of a ray caster does not matter
_RAY_OFFSET_M = 0.03
_GAMMA = 2.2
_REFLECTED_TINT = np.array([0.87, 0.93, 1.0])
# What a glossy surface mirrors, by the sine of the mirrored ray's elevation: road, house fronts, sky.
_ENVIRONMENT_ELEVATION = [-1.0, -0.25, -0.04, 0.04, 0.30, 0.55, 1.0]
_ENVIRONMENT_LIGHT = [0.10, 0.13, 0.16, 0.22, 0.45, 0.95, 1.0]


def drawn_paint(kind: str, rng: np.random.Generator) -> np.ndarray:
    """A random paint of a kind of vehicle, linear albedo, shape [3]."""
    paint = _PAINT_COLOURS[int(rng.choice(len(_PAINT_COLOURS), p=_PAINT_SHARES))] * rng.uniform(0.9, 1.1)
    return _BUS_COLOURS[int(rng.integers(len(_BUS_COLOURS)))] if kind == "bus" else paint


def sky_share(surface: Surface) -> np.ndarray:
    """Share of the sky's light that reaches each vertex, see `sky_share_at`, shape [vertex]."""
    return sky_share_at(surface.vertex_m[surface.triangle], surface.vertex_m, surface.normal)


def sky_share_at(corner_m: np.ndarray, point_m: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Share of the sky's light that reaches points of a surface, 0..1, shape [point].

    Cosine weighted; the surface itself and the ground (z = 0) take light away. This is ambient occlusion.

    Shapes: ``corner_m`` [triangle, 3, 3], ``point_m`` [point, 3], ``normal`` [point, 3].
    """
    caster = triangle_caster(corner_m)
    origin = (point_m + _RAY_OFFSET_M * normal).astype(np.float32)
    light = np.zeros(len(origin))
    weight = np.zeros(len(origin))
    for direction in _DIRECTIONS:
        cosine = normal[:, 0] * direction[0]
        cosine += normal[:, 1] * direction[1] + normal[:, 2] * direction[2]
        lit = np.nonzero(cosine > 0.02)[0]
        ray = np.broadcast_to(direction.astype(np.float32), (len(lit), 3))
        free = caster.run(origin[lit], np.ascontiguousarray(ray), query="OCCLUDED") < 0
        light[lit] += cosine[lit] * free * (1.0 if direction[2] > 0.0 else _GROUND_ALBEDO)
        weight[lit] += cosine[lit]
    return np.round(light / np.maximum(weight, 1e-6) * _OCCLUSION_STEPS) / _OCCLUSION_STEPS


def painted_mesh(surface: Surface, sky: np.ndarray, own_albedo: Mapping[Material, np.ndarray]) -> Mesh:
    """The surface as a mesh with the light baked into its colours; ``sky`` [vertex], ``own_albedo`` [3]."""
    albedo = _ALBEDO.copy()
    for material, colour in own_albedo.items():
        albedo[material] = colour
    rgb = lit_rgb(surface.normal, sky, albedo[surface.material], _MIRROR[surface.material])
    return Mesh(surface.vertex_m.astype(np.float32), surface.triangle, rgb)


def lit_rgb(normal: np.ndarray, sky: np.ndarray, albedo: np.ndarray, mirror: np.ndarray) -> np.ndarray:
    """Colours of a surface in the light of the town, uint8 [vertex, 3]; ``sky`` [vertex], ``mirror`` [vertex]."""
    up = normal[:, 2]
    irradiance = _SKY_LIGHT * sky + _SUN_LIGHT * np.maximum(up, 0.0) * np.minimum(2.0 * sky, 1.0) + _BOUNCE_LIGHT
    # A level line of sight that meets a surface tilted up by phi leaves it at an elevation of 2 phi.
    mirrored = np.where(up > 0.7, 1.0, 2.0 * up * np.sqrt(np.maximum(1.0 - up * up, 0.0)))
    reflected = np.interp(mirrored, _ENVIRONMENT_ELEVATION, _ENVIRONMENT_LIGHT) * np.minimum(0.35 + sky, 1.0)
    linear = albedo * irradiance[:, None]
    linear += mirror[:, None] * reflected[:, None] * _REFLECTED_TINT
    return np.round(255.0 * np.clip(linear, 0.0, 1.0) ** (1.0 / _GAMMA)).astype(np.uint8)
