"""Materials of vehicles, people and furniture, and the light that is baked into their colours.

Light is sky, an overhead sun, and reflections.
"""

from __future__ import annotations

import enum
from collections.abc import Mapping
from functools import cache

import numpy as np

from warpav.raster.mesh import Mesh
from warpav.scene.town.surface_builder import Surface


class Material(enum.IntEnum):
    """What a part is made of; ``PAINT`` and people's clothes take the colours of the individual."""

    PAINT = 0
    GLASS = 1
    BLACK_PLASTIC = 2
    TYRE = 3
    RIM = 4
    HEADLAMP = 5
    TAIL_LAMP = 6
    PLATE = 7
    REAR_PLATE = 8
    DARK = 9
    CHROME = 10
    SEAM = 11
    UNDERBODY = 12
    CARGO = 13
    CARGO_FRAME = 14
    INDICATOR = 15
    MARKER_YELLOW = 16
    REFLECTOR = 17
    LIFT = 18
    SKIN = 19
    HAIR = 20
    TOP = 21
    LEGWEAR = 22
    SHOE = 23
    BAG = 24
    HELMET = 25
    METAL = 26
    WOOD = 27
    PANE = 28
    CONE = 29
    SAND = 30
    STONE = 31
    GO = 32


# Linear albedo (red, green, blue) and mirror strength of each material.
_OPTICS = {
    Material.PAINT: (0.5, 0.5, 0.5, 0.13),
    Material.GLASS: (0.012, 0.014, 0.016, 0.12),
    Material.BLACK_PLASTIC: (0.026, 0.026, 0.028, 0.03),
    Material.TYRE: (0.05, 0.05, 0.052, 0.0),
    Material.RIM: (0.45, 0.46, 0.48, 0.1),
    Material.HEADLAMP: (0.8, 0.82, 0.85, 0.25),
    Material.TAIL_LAMP: (0.5, 0.01, 0.008, 0.07),
    Material.PLATE: (0.85, 0.85, 0.83, 0.02),
    Material.REAR_PLATE: (0.8, 0.62, 0.08, 0.02),
    Material.DARK: (0.006, 0.006, 0.006, 0.0),
    Material.CHROME: (0.58, 0.58, 0.6, 0.45),
    Material.SEAM: (0.028, 0.028, 0.028, 0.0),
    Material.UNDERBODY: (0.012, 0.012, 0.012, 0.0),
    Material.CARGO: (0.9, 0.9, 0.88, 0.03),
    Material.CARGO_FRAME: (0.3, 0.31, 0.32, 0.06),
    Material.INDICATOR: (0.75, 0.28, 0.02, 0.08),
    Material.MARKER_YELLOW: (0.8, 0.58, 0.04, 0.03),
    Material.REFLECTOR: (0.62, 0.03, 0.02, 0.02),
    Material.LIFT: (0.16, 0.17, 0.18, 0.05),
    Material.SKIN: (0.5, 0.3, 0.2, 0.02),
    Material.HAIR: (0.03, 0.02, 0.015, 0.02),
    Material.TOP: (0.3, 0.3, 0.3, 0.0),
    Material.LEGWEAR: (0.05, 0.05, 0.06, 0.0),
    Material.SHOE: (0.03, 0.028, 0.026, 0.03),
    Material.BAG: (0.1, 0.08, 0.06, 0.02),
    Material.HELMET: (0.6, 0.6, 0.6, 0.08),
    Material.METAL: (0.22, 0.23, 0.24, 0.08),
    Material.WOOD: (0.2, 0.11, 0.055, 0.0),
    Material.PANE: (0.1, 0.125, 0.13, 0.2),
    Material.CONE: (0.7, 0.13, 0.01, 0.02),
    Material.SAND: (0.42, 0.31, 0.17, 0.0),
    Material.STONE: (0.3, 0.29, 0.27, 0.0),
    Material.GO: (0.02, 0.22, 0.1, 0.08),
}
_ALBEDO, _MIRROR = np.split(np.array([_OPTICS[material] for material in Material]), [3], axis=1)
PAINT_COLOURS = np.array(
    [
        (0.70, 0.70, 0.70),
        (0.64, 0.65, 0.67),
        (0.52, 0.53, 0.55),
        (0.34, 0.35, 0.37),
        (0.19, 0.21, 0.23),
        (0.080, 0.085, 0.095),
        (0.035, 0.035, 0.040),
        (0.030, 0.065, 0.21),
        (0.10, 0.21, 0.40),
        (0.40, 0.025, 0.025),
        (0.26, 0.03, 0.04),
        (0.05, 0.15, 0.10),
        (0.68, 0.65, 0.58),
        (0.55, 0.25, 0.05),
    ]
)
_BUS_COLOURS = np.array(
    [
        (0.55, 0.03, 0.025),
        (0.62, 0.42, 0.03),
        (0.03, 0.11, 0.36),
        (0.05, 0.24, 0.10),
        (0.70, 0.70, 0.68),
        (0.60, 0.19, 0.02),
    ]
)
_PAINT_SHARES = np.array([20, 8, 14, 10, 9, 7, 11, 6, 5, 5, 2, 2, 3, 1]) / 103.0

SKY_LIGHT, SUN_LIGHT, BOUNCE_LIGHT = 0.62, 0.34, 0.04
_GROUND_ALBEDO = 0.18  # an occlusion ray that ends on the road still brings this share of the light
_OCCLUSION_RAYS = 64
_OCCLUSION_STEPS = 64  # occlusion is kept on this grid, so that the last bit of a ray caster does not matter
_RAY_OFFSET_M = 0.03
_GAMMA = 2.2
_REFLECTED_TINT = np.array([0.87, 0.93, 1.0])
# What a glossy surface mirrors, by the sine of the mirrored ray's elevation: road, house fronts, sky.
_ENVIRONMENT_ELEVATION = [-1.0, -0.25, -0.04, 0.04, 0.30, 0.55, 1.0]
_ENVIRONMENT_LIGHT = [0.10, 0.13, 0.16, 0.22, 0.45, 0.95, 1.0]


def drawn_paint(kind: str, rng: np.random.Generator) -> np.ndarray:
    """A random paint of a kind of vehicle, linear albedo, shape [3]."""
    paint = PAINT_COLOURS[int(rng.choice(len(PAINT_COLOURS), p=_PAINT_SHARES))] * rng.uniform(0.9, 1.1)
    return _BUS_COLOURS[int(rng.integers(len(_BUS_COLOURS)))] if kind == "bus" else paint


def _linear_to_srgb(linear: np.ndarray) -> np.ndarray:
    """Colours 0..255 (uint8) of linear light 0..1 (clipped)."""
    return np.round(255.0 * np.clip(linear, 0.0, 1.0) ** (1.0 / _GAMMA)).astype(np.uint8)


def sky_share(surface: Surface) -> np.ndarray:
    """Share of the sky's light that reaches each vertex, 0..1, shape [vertex].

    Cosine weighted; the surface itself and the ground (z = 0) take light away. This is ambient occlusion.
    """
    return sky_share_at(surface.vertex_m[surface.triangle], surface.vertex_m, surface.normal)


def sky_share_at(corner_m: np.ndarray, point_m: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """The same at points of any surface, shape [point].

    Shapes: ``corner_m`` [triangle, 3, 3], ``point_m`` [point, 3], ``normal`` [point, 3].
    """
    from embreex.mesh_construction import TriangleMesh
    from embreex.rtcore_scene import EmbreeScene

    caster = EmbreeScene()
    TriangleMesh(caster, corner_m.astype(np.float32))
    origin = (point_m + _RAY_OFFSET_M * normal).astype(np.float32)
    light = np.zeros(len(origin))
    weight = np.zeros(len(origin))
    for direction in _sphere_directions(_OCCLUSION_RAYS):
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
    rgb = lit_rgb(surface.normal, sky, albedo[surface.material], _MIRROR[surface.material][:, 0])
    return Mesh(surface.vertex_m.astype(np.float32), surface.triangle, rgb)


def lit_rgb(normal: np.ndarray, sky: np.ndarray, albedo: np.ndarray, mirror: np.ndarray) -> np.ndarray:
    """Colours of a surface in the light of the town, uint8 [vertex, 3]; ``sky`` [vertex], ``mirror`` [vertex]."""
    up = normal[:, 2]
    irradiance = SKY_LIGHT * sky + SUN_LIGHT * np.maximum(up, 0.0) * np.minimum(2.0 * sky, 1.0) + BOUNCE_LIGHT
    # A level line of sight that meets a surface tilted up by phi leaves it at an elevation of 2 phi.
    mirrored = np.where(up > 0.7, 1.0, 2.0 * up * np.sqrt(np.maximum(1.0 - up * up, 0.0)))
    reflected = np.interp(mirrored, _ENVIRONMENT_ELEVATION, _ENVIRONMENT_LIGHT) * np.minimum(0.35 + sky, 1.0)
    linear = albedo * irradiance[:, None]
    linear += mirror[:, None] * reflected[:, None] * _REFLECTED_TINT
    return _linear_to_srgb(linear)


@cache
def _sphere_directions(count: int) -> np.ndarray:
    """Unit vectors spread evenly over the sphere along a spiral, shape [count, 3]."""
    index = np.arange(count)
    z = 1.0 - (2.0 * index + 1.0) / count
    azimuth = index * np.pi * (3.0 - np.sqrt(5.0))
    radius = np.sqrt(1.0 - z * z)
    return np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), z], axis=1)
