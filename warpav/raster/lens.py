"""Lenses: where the image of a direction lies, in focal lengths from the principal point, and back. Plain NumPy.

``x`` goes right, ``y`` down. A pinhole images the point (X, Y, Z) at (X / Z, Y / Z). The others, with OpenCV's
coefficients in OpenCV's order:

* Brown-Conrady: the pinhole's image, moved along the radius ``r`` to ``r (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 +
  k5 r^4 + k6 r^6)`` and sideways by ``p1`` and ``p2``;
* fisheye (Kannala-Brandt, KB4): a direction at the angle t from the optical axis at the radius ``t (1 + k1 t^2 +
  k2 t^4 + k3 t^6 + k4 t^8)``, also behind the camera;
* eucm (enhanced unified camera model, ``alpha beta``): a direction at the angle t at the radius ``sin t / (alpha d +
  (1 - alpha) cos t)`` with ``d^2 = beta sin^2 t + cos^2 t`` (Khomutenko, Garcia and Martinet 2016);
* double_sphere (``xi alpha``): at the radius ``sin t / (alpha d + (1 - alpha) c)`` with ``c = xi + cos t`` and
  ``d^2 = sin^2 t + c^2`` (Usenko, Demmel and Cremers 2018);
* panorama: a cylinder about the camera's y axis; x is the azimuth, y the tangent of the angle below the horizon;
* equirectangular: a sphere; x is the azimuth, y the angle below the horizon.

All but the last two grow along the radius only up to some angle. Beyond it the formula says nothing about the lens, so
directions beyond have no image, and places of the image beyond see nothing.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import cache, cached_property

import numpy as np

_MAX_TANGENT = 100.0  # a Brown-Conrady lens sees no farther from its axis than 89.4 degrees

_TABLE_ENTRIES = 4096  # entries of `image_table`

_NEARBY_RAD = 0.16  # how far from an entry of it a great circle may begin

_LAST_RAD = math.radians(175.0)  # from the axis: beyond, a fisheye's image of a point is a circle
_TURN_SHARE = 0.995  # of the place where the radius stops growing: just before it the image has no width
_RADIUS_STEPS = 60  # halvings of a bracket end below float64's resolution
_PLACE_STEPS = 12
_PLACE_TOLERANCE = 1e-4


class Lens(StrEnum):
    """How directions become places in the image."""

    PINHOLE = "pinhole"
    BROWN_CONRADY = "brown_conrady"
    FISHEYE = "fisheye"
    EUCM = "eucm"
    DOUBLE_SPHERE = "double_sphere"
    PANORAMA = "panorama"
    EQUIRECTANGULAR = "equirectangular"


COEFFICIENT_COUNTS = {
    Lens.PINHOLE: (0,),
    Lens.BROWN_CONRADY: (0, 4, 5, 8),
    Lens.FISHEYE: (0, 4),
    Lens.EUCM: (2,),
    Lens.DOUBLE_SPHERE: (2,),
    Lens.PANORAMA: (0,),
    Lens.EQUIRECTANGULAR: (0,),
}
"""How many coefficients each lens may have."""


@dataclass(frozen=True)
class LensShape:
    """A lens without its focal length."""

    lens: Lens  # which kind
    # Coefficients: ``k1 k2 p1 p2 [k3 [k4 k5 k6]]`` of Brown-Conrady, ``k1 k2 k3 k4`` of a fisheye, in OpenCV's order
    # (none counts as zeros); ``alpha beta`` of eucm, ``xi alpha`` of double_sphere
    distortion: tuple[float, ...] = ()

    @property
    def is_radial(self) -> bool:
        """Whether the image lies on a radius that depends on the angle from the optical axis."""
        return not self.is_panorama

    @property
    def is_panorama(self) -> bool:
        return self.lens in (Lens.PANORAMA, Lens.EQUIRECTANGULAR)

    @property
    def is_by_angle(self) -> bool:
        """Whether the radius is a function of the angle from the optical axis itself, also behind the camera."""
        return self.lens in (Lens.FISHEYE, Lens.EUCM, Lens.DOUBLE_SPHERE)

    @property
    def has_unit_rays(self) -> bool:
        """Whether depths are distances from the camera's centre; else they lie along the optical axis."""
        return self.is_by_angle or self.is_panorama

    @cached_property
    def coefficients(self) -> np.ndarray:
        """Always eight numbers: the distortion, filled up with zeros."""
        return np.pad(np.asarray(self.distortion, np.float64), (0, 8 - len(self.distortion)))

    @cached_property
    def limit(self) -> float:
        """The angle from the axis [rad] up to which the image grows, at most pi; its tangent where z is the depth."""
        if self.lens in (Lens.EUCM, Lens.DOUBLE_SPHERE):
            return self._two_spheres_limit_rad
        growth = _polynomial([1.0])
        end = _MAX_TANGENT
        if self.lens is Lens.BROWN_CONRADY:
            above, below = self._fraction
            squared = _polynomial([0.0, 2.0])
            growth = (above + squared * above.deriv()) * below - squared * above * below.deriv()
            growth *= below  # a pole ends it as well
        elif self.lens is Lens.FISHEYE:
            growth = _polynomial([1.0, *(self.coefficients[:4] * [3.0, 5.0, 7.0, 9.0])])
            end = math.pi
        # as reciprocals, so that a minute term of high degree spoils only the roots far away
        reciprocal = _polynomial(growth.coef[::-1]).roots()
        reciprocal = reciprocal.real[np.abs(reciprocal.imag) < 1e-9 * np.maximum(1.0, np.abs(reciprocal))]
        turns = reciprocal[reciprocal > end**-2.0] ** -0.5
        return min([end, *(_TURN_SHARE * turns)])

    @property
    def limit_rad(self) -> float:
        """The angle from the axis up to which the lens sees [rad]; pi where nothing ends it."""
        if self.is_panorama:
            return math.pi
        return self.limit if self.is_by_angle else math.atan(self.limit)

    @property
    def _two_spheres_limit_rad(self) -> float:
        """Where an image by eucm or double_sphere stops growing, or has no end."""
        if self.lens is Lens.EUCM:
            alpha, beta = self.distortion
            ratio = min(alpha, 1.0 - alpha) / max(alpha, 1.0 - alpha)
            return _TURN_SHARE * (math.pi - math.atan(math.sqrt((1.0 - ratio**2) / beta) / max(ratio, 1e-300)))
        xi, alpha = self.distortion
        ratio = min(alpha, 1.0 - alpha) / max(alpha, 1.0 - alpha)
        half = xi * (1.0 - ratio**2)
        cosine = -half - math.sqrt(max(half**2 - xi**2 + ratio**2 * (1.0 + xi**2), 0.0))
        return _TURN_SHARE * math.acos(max(cosine, -1.0))

    @cached_property
    def edge(self) -> float:
        """Radius of the image at the limit, in focal lengths."""
        return float(self.radius(np.array(self.limit))[0])

    @cached_property
    def _fraction(self) -> tuple[np.polynomial.Polynomial, np.polynomial.Polynomial]:
        """Polynomials in the squared radius: a Brown-Conrady radius grows by the first over the second."""
        k1, k2, _, _, k3, k4, k5, k6 = self.coefficients
        return _polynomial([1.0, k1, k2, k3]), _polynomial([1.0, k4, k5, k6])

    def radius(self, angle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Radius of the image and its growth, at an angle from the axis (fisheye) or at its tangent (else)."""
        squared = angle * angle
        if self.lens is Lens.BROWN_CONRADY:
            above, below = self._fraction
            factor = above(squared) / below(squared)
            slope = (above.deriv()(squared) - factor * below.deriv()(squared)) / below(squared)
        elif self.lens is Lens.FISHEYE:
            series = _polynomial([1.0, *self.coefficients[:4]])
            factor, slope = series(squared), series.deriv()(squared)
        elif self.is_by_angle:
            return self._two_spheres_radius(angle)
        else:
            factor, slope = np.ones_like(angle), np.zeros_like(angle)
        return factor * angle, factor + 2.0 * squared * slope

    def _two_spheres_radius(self, angle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        sine, cosine = np.sin(angle), np.cos(angle)
        if self.lens is Lens.EUCM:
            alpha, beta = self.distortion
            across = np.sqrt(beta * sine**2 + cosine**2)
            below = alpha * across + (1.0 - alpha) * cosine
            return sine / below, (alpha * cosine / across + 1.0 - alpha) / below**2
        xi, alpha = self.distortion
        across = np.sqrt(sine**2 + (xi + cosine) ** 2)
        below = alpha * across + (1.0 - alpha) * (xi + cosine)
        return sine / below, (1.0 + xi * cosine) * (alpha * (cosine + xi) / across + 1.0 - alpha) / below**2

    @cached_property
    def growth_on_axis(self) -> float:
        """How much longer the image is near the optical axis than a pinhole's of the same focal length."""
        return float(self.radius(np.array(0.0))[1])

    def angle(self, radius: np.ndarray) -> np.ndarray:
        """The inverse of `radius`, at most `limit`: Newton's steps, halvings where these do not settle."""
        radius = np.minimum(radius, self.edge)
        low, high = np.zeros_like(radius), np.full_like(radius, self.limit)
        angle, last = np.minimum(radius, high), np.full_like(radius, self.limit)
        for _ in range(_RADIUS_STEPS):
            reached, growth = self.radius(angle)
            low, high = np.where(reached <= radius, angle, low), np.where(reached <= radius, high, angle)
            newton = angle - (reached - radius) / growth
            # where a step is more than half as long as the last one, Newton's may go to and fro for ever
            settles = (newton >= low) & (newton <= high) & (np.abs(newton - angle) <= 0.5 * last)
            old, angle = angle, np.where(settles, newton, 0.5 * (low + high))
            last = np.abs(angle - old)
            if np.all(last <= 1e-15):
                break
        return angle

    def place(self, point: np.ndarray) -> np.ndarray:
        """Image of points in camera coordinates, [..., 3] -> [..., 2]; NaN where there is none."""
        x, y, z = np.moveaxis(np.asarray(point, np.float64), -1, 0)
        with np.errstate(divide="ignore", invalid="ignore"):
            if self.is_panorama:
                level = np.hypot(x, z)
                row = y / level if self.lens is Lens.PANORAMA else np.arctan2(y, level)
                found, seen = np.stack([np.arctan2(x, z), row], axis=-1), level > 0.0
            elif self.is_by_angle:
                across = np.hypot(x, y)
                angle = np.arctan2(across, z)
                factor = np.where(across > 0.0, self.radius(angle)[0] / across, self.growth_on_axis / z)
                found = np.stack([factor * x, factor * y], axis=-1)
                seen = (angle <= self.limit) & ((across > 0.0) | (z > 0.0))
            else:
                found, seen = np.stack([x / z, y / z], axis=-1), z > 0.0
                if self.lens is not Lens.PINHOLE:
                    found, seen = self._moved(found)[0], seen & (np.hypot(x, y) <= self.limit * z)
        return np.where(seen[..., None], found, np.nan)

    def ray(self, place: np.ndarray) -> np.ndarray:
        """Directions that have their image at places, [..., 2] -> [..., 3]; NaN where nothing is seen.

        Their z is 1 for pinhole and Brown-Conrady lenses; the others' have unit length.
        """
        place = np.asarray(place, np.float64)
        x, y = np.moveaxis(place, -1, 0)
        if self.lens is Lens.PINHOLE:
            return np.stack([x, y, np.ones_like(x)], axis=-1)
        if self.lens is Lens.EQUIRECTANGULAR:
            ray = np.stack([np.sin(x) * np.cos(y), np.sin(y), np.cos(x) * np.cos(y)], axis=-1)
            return np.where((np.abs(y) <= 0.5 * math.pi)[..., None], ray, np.nan)
        if self.lens is Lens.PANORAMA:
            ray = np.stack([np.sin(x), y, np.cos(x)], axis=-1)
            return ray / np.linalg.norm(ray, axis=-1, keepdims=True)
        radius = np.hypot(x, y)
        angle = self.angle(radius)
        if self.is_by_angle:
            share = np.where(radius > 0.0, np.sin(angle) / np.maximum(radius, 1e-300), 1.0)
            ray = np.stack([share * x, share * y, np.cos(angle)], axis=-1)
            return np.where((radius <= self.edge)[..., None], ray, np.nan)
        share = np.where(radius > 0.0, angle / np.maximum(radius, 1e-300), 1.0)
        pinhole = share[..., None] * place
        with np.errstate(all="ignore"):  # places that see nothing may run away
            for _ in range(_PLACE_STEPS):
                reached, slope = self._moved(pinhole)
                excess = reached - place
                turn = slope[..., 0, 0] * slope[..., 1, 1] - slope[..., 0, 1] * slope[..., 1, 0]
                step_x = slope[..., 1, 1] * excess[..., 0] - slope[..., 0, 1] * excess[..., 1]
                step_y = slope[..., 0, 0] * excess[..., 1] - slope[..., 1, 0] * excess[..., 0]
                pinhole = pinhole - np.stack([step_x, step_y], axis=-1) / turn[..., None]
            error = np.linalg.norm(self._moved(pinhole)[0] - place, axis=-1)
            seen = (error < _PLACE_TOLERANCE) & (np.linalg.norm(pinhole, axis=-1) <= self.limit)
        ray = np.concatenate([pinhole, np.ones_like(x)[..., None]], axis=-1)
        return np.where(seen[..., None], ray, np.nan)

    def _moved(self, pinhole: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Brown-Conrady image of a pinhole's image, [..., 2], and its Jacobian, [..., 2, 2]."""
        x, y = np.moveaxis(pinhole, -1, 0)
        squared = x * x + y * y
        above, below = self._fraction
        factor = above(squared) / below(squared)
        slope = (above.deriv()(squared) - factor * below.deriv()(squared)) / below(squared)
        p1, p2 = self.coefficients[2:4] if self.lens is Lens.BROWN_CONRADY else (0.0, 0.0)
        moved = [
            factor * x + 2.0 * p1 * x * y + p2 * (squared + 2.0 * x * x),
            factor * y + p1 * (squared + 2.0 * y * y) + 2.0 * p2 * x * y,
        ]
        mixed = 2.0 * slope * x * y + 2.0 * p1 * x + 2.0 * p2 * y
        along_x = factor + 2.0 * slope * x * x + 2.0 * p1 * y + 6.0 * p2 * x
        along_y = factor + 2.0 * slope * y * y + 6.0 * p1 * y + 2.0 * p2 * x
        jacobian = [np.stack([along_x, mixed], axis=-1), np.stack([mixed, along_y], axis=-1)]
        return np.stack(moved, axis=-1), np.stack(jacobian, axis=-2)


def checked_distortion(lens: Lens, distortion: Sequence[float]) -> tuple[float, ...]:
    """The coefficients as a tuple of floats."""
    counts = COEFFICIENT_COUNTS[lens]
    if len(distortion) not in counts:
        wanted = " or ".join(str(count) for count in counts)
        raise ValueError(f"a {lens} lens has {wanted} distortion coefficients, got {len(distortion)}")
    for i, value in enumerate(distortion):
        if not math.isfinite(value):
            raise ValueError(f"distortion[{i}] must be finite, got {value}")
    ranges = {
        Lens.EUCM: (("alpha", 0.0, 1.0), ("beta", 1e-3, 1e3)),
        Lens.DOUBLE_SPHERE: (("xi", -0.99, 0.99), ("alpha", 0.0, 1.0)),
    }.get(lens, ())
    for (name, low, high), value in zip(ranges, distortion, strict=False):
        if not low <= value <= high:
            raise ValueError(f"{name} of a {lens} lens must lie between {low:g} and {high:g}, got {value}")
    return tuple(float(value) for value in distortion)


def _polynomial(coefficient: Sequence[float] | np.ndarray) -> np.polynomial.Polynomial:
    return np.polynomial.Polynomial(np.asarray(coefficient, np.float64))


@cache
def image_table(shape: LensShape, reach_rad: float) -> np.ndarray:
    """Where the image of a direction lies, roughly, and how a radial lens bends great circles, over the whole sphere.

    The radius over the sine of the angle t from the axis [focal lengths], and the greatest curvature of the image of a
    great circle within `_NEARBY_RAD` [focal lengths/rad^2], float32 [entry, 2], evenly over ``(1 - cos t) / 2``. Beyond
    the lens's limit the radius goes on growing as it did there. Of a panorama zeros.
    """
    if not shape.is_radial:
        return np.zeros((_TABLE_ENTRIES, 2), np.float32)
    angle = np.arccos(np.clip(1.0 - 2.0 * np.linspace(0.0, 1.0, _TABLE_ENTRIES), -1.0, 1.0))
    sine = np.maximum(np.sin(angle), 1e-3)
    share = np.where(
        angle > 1e-4,
        _radius_beyond(shape, reach_rad, np.maximum(angle, 1e-4)) / np.maximum(sine, 1e-4),
        shape.growth_on_axis,
    )
    # second differences along great circles in several directions
    at, step = np.linspace(0.0, math.pi, 721), 0.01
    direction = np.stack([np.sin(at), np.zeros_like(at), np.cos(at)], axis=-1)
    curvature = np.zeros_like(at)
    for turn in np.linspace(0.0, 0.5 * math.pi, 10):
        ahead = np.stack([math.cos(turn) * np.cos(at), np.full_like(at, math.sin(turn)), -math.cos(turn) * np.sin(at)])
        place = [
            _place_beyond(shape, reach_rad, math.cos(s) * direction + math.sin(s) * ahead.T) for s in (-step, 0.0, step)
        ]
        second = np.linalg.norm(place[0] - 2.0 * place[1] + place[2], axis=-1) / step**2
        curvature = np.maximum(curvature, second)
    reach = math.ceil(_NEARBY_RAD / (at[1] - at[0]))
    padded = np.pad(curvature, reach, mode="edge")
    greatest = np.lib.stride_tricks.sliding_window_view(padded, 2 * reach + 1).max(axis=-1)
    return np.stack([share, 1.1 * np.interp(angle, at, greatest)], axis=-1).astype(np.float32)


def _radius_beyond(shape: LensShape, reach_rad: float, angle: np.ndarray) -> np.ndarray:
    """Radius at an angle from the axis [rad], beyond the limit as well."""
    limit_rad = min(shape.limit_rad, reach_rad, _LAST_RAD)
    inside = np.minimum(angle, limit_rad)
    tangent = inside if shape.is_by_angle else np.tan(inside)
    radius, growth = shape.radius(tangent)
    if not shape.is_by_angle:
        growth = growth * (1.0 + tangent * tangent)
    return radius + growth * (angle - inside)


def _place_beyond(shape: LensShape, reach_rad: float, direction: np.ndarray) -> np.ndarray:
    across = np.hypot(direction[..., 0], direction[..., 1])
    radius = _radius_beyond(shape, reach_rad, np.arctan2(across, direction[..., 2]))
    return direction[..., :2] * (radius / np.maximum(across, 1e-12))[..., None]
