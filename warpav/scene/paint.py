"""Materials of vehicles, people and furniture, and the light that is baked into their colours.

Light is sky, an overhead sun, and reflections.
"""

from __future__ import annotations

import enum
from collections.abc import Mapping
from functools import cache

import numpy as np

from warpav.geometry.mesh import Mesh
from warpav.scene.surface_builder import Surface


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


# Linear albedo and mirror strength of each material, in the order of Material.
_ALBEDO = np.array(
    [
        (0.50, 0.50, 0.50),
        (0.012, 0.014, 0.016),
        (0.026, 0.026, 0.028),
        (0.050, 0.050, 0.052),
        (0.45, 0.46, 0.48),
        (0.80, 0.82, 0.85),
        (0.50, 0.010, 0.008),
        (0.85, 0.85, 0.83),
        (0.80, 0.62, 0.08),
        (0.006, 0.006, 0.006),
        (0.58, 0.58, 0.60),
        (0.028, 0.028, 0.028),
        (0.012, 0.012, 0.012),
        (0.90, 0.90, 0.88),
        (0.30, 0.31, 0.32),
        (0.75, 0.28, 0.02),
        (0.80, 0.58, 0.04),
        (0.62, 0.03, 0.02),
        (0.16, 0.17, 0.18),
        (0.50, 0.30, 0.20),
        (0.03, 0.02, 0.015),
        (0.30, 0.30, 0.30),
        (0.05, 0.05, 0.06),
        (0.03, 0.028, 0.026),
        (0.10, 0.08, 0.06),
        (0.60, 0.60, 0.60),
    ]
)
_MIRROR = np.array(
    [
        0.13,
        0.12,
        0.03,
        0.0,
        0.10,
        0.25,
        0.07,
        0.02,
        0.02,
        0.0,
        0.45,
        0.0,
        0.0,
        0.03,
        0.06,
        0.08,
        0.03,
        0.02,
        0.05,
        0.02,
        0.02,
        0.0,
        0.0,
        0.03,
        0.02,
        0.08,
    ]
)
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
PAINT_SHARES = np.array([20, 8, 14, 10, 9, 7, 11, 6, 5, 5, 2, 2, 3, 1]) / 103.0

SKY_LIGHT, SUN_LIGHT, BOUNCE_LIGHT = 0.62, 0.34, 0.04
GROUND_ALBEDO = 0.18  # an occlusion ray that ends on the road still brings this share of the light
OCCLUSION_RAYS = 64
OCCLUSION_STEPS = 64  # occlusion is kept on this grid, so that the last bit of a ray caster does not matter
_RAY_OFFSET_M = 0.03
_GAMMA = 2.2
_REFLECTED_TINT = np.array([0.87, 0.93, 1.0])
# What a glossy surface mirrors, by the sine of the mirrored ray's elevation: road, house fronts, sky.
_ENVIRONMENT_ELEVATION = [-1.0, -0.25, -0.04, 0.04, 0.30, 0.55, 1.0]
_ENVIRONMENT_LIGHT = [0.10, 0.13, 0.16, 0.22, 0.45, 0.95, 1.0]


def linear_to_srgb(linear: np.ndarray) -> np.ndarray:
    """Colours 0..255 (uint8) of linear light 0..1 (clipped)."""
    return np.round(255.0 * np.clip(linear, 0.0, 1.0) ** (1.0 / _GAMMA)).astype(np.uint8)


def sky_share(surface: Surface) -> np.ndarray:
    """Share of the sky's light that reaches each vertex, 0..1, shape [vertex].

    Cosine weighted; the surface itself and the ground (z = 0) take light away. This is ambient occlusion.
    """
    from embreex.mesh_construction import TriangleMesh
    from embreex.rtcore_scene import EmbreeScene

    caster = EmbreeScene()
    TriangleMesh(caster, surface.vertex_m[surface.triangle].astype(np.float32))
    origin = (surface.vertex_m + _RAY_OFFSET_M * surface.normal).astype(np.float32)
    light = np.zeros(len(origin))
    weight = np.zeros(len(origin))
    for direction in _sphere_directions(OCCLUSION_RAYS):
        cosine = surface.normal[:, 0] * direction[0]
        cosine += surface.normal[:, 1] * direction[1] + surface.normal[:, 2] * direction[2]
        lit = np.nonzero(cosine > 0.02)[0]
        ray = np.broadcast_to(direction.astype(np.float32), (len(lit), 3))
        free = caster.run(origin[lit], np.ascontiguousarray(ray), query="OCCLUDED") < 0
        light[lit] += cosine[lit] * free * (1.0 if direction[2] > 0.0 else GROUND_ALBEDO)
        weight[lit] += cosine[lit]
    return np.round(light / np.maximum(weight, 1e-6) * OCCLUSION_STEPS) / OCCLUSION_STEPS


def painted_mesh(surface: Surface, sky: np.ndarray, own_albedo: Mapping[Material, np.ndarray]) -> Mesh:
    """The surface as a mesh with the light baked into its colours.

    Args:
        surface: The surface, z up, the ground at z = 0.
        sky: The result of `sky_share`, shape [vertex].
        own_albedo: Linear albedo of what the individual has its own colour of, 0..1, shape [3] each.

    Returns:
        Mesh in the frame of the surface.
    """
    up = surface.normal[:, 2]
    irradiance = SKY_LIGHT * sky + SUN_LIGHT * np.maximum(up, 0.0) * np.minimum(2.0 * sky, 1.0) + BOUNCE_LIGHT
    albedo = _ALBEDO.copy()
    for material, colour in own_albedo.items():
        albedo[material] = colour
    # A level line of sight that meets a surface tilted up by phi leaves it at an elevation of 2 phi.
    mirrored = np.where(up > 0.7, 1.0, 2.0 * up * np.sqrt(np.maximum(1.0 - up * up, 0.0)))
    reflected = np.interp(mirrored, _ENVIRONMENT_ELEVATION, _ENVIRONMENT_LIGHT) * np.minimum(0.35 + sky, 1.0)
    linear = albedo[surface.material] * irradiance[:, None]
    linear += (_MIRROR[surface.material] * reflected)[:, None] * _REFLECTED_TINT
    return Mesh(surface.vertex_m.astype(np.float32), surface.triangle, linear_to_srgb(linear))


@cache
def _sphere_directions(count: int) -> np.ndarray:
    """Unit vectors spread evenly over the sphere along a spiral, shape [count, 3]."""
    index = np.arange(count)
    z = 1.0 - (2.0 * index + 1.0) / count
    azimuth = index * np.pi * (3.0 - np.sqrt(5.0))
    radius = np.sqrt(1.0 - z * z)
    return np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), z], axis=1)
