"""The camera model: image size, lens, focal lengths, principal point; and the cameras of some views."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from warpav.core.errors import InputError
from warpav.raster.beams import Beams
from warpav.raster.lens import Lens, LensShape, checked_distortion

MAX_IMAGE_PX = 16384
"""Maximum image width and height [px]: no detector reads larger images, so a larger size is a typing error."""

_SAME_ANGLE_RAD = 1e-6


@dataclass(frozen=True)
class CameraModel:
    """A camera without skew. Give its field of view, or its focal lengths as a calibration found them.

    A panorama all round has a seam at its left and right edge. The areas of an object across it, and their gradients,
    are those of both its parts; it reaches from the left edge to the right.

    Attributes:
        width_px: Image width [px], at least 8.
        height_px: Image height [px], at least 8.
        fov_rad: Horizontal field of view [rad]: in (0, pi), of a fisheye in (0, 2 pi), of a panorama in (0, 2 pi]. It
            gives the focal length of a camera with square pixels and the principal point in the middle. Where
            ``focal_px`` is given, leave it out (None): it becomes the angle along the principal point's row. Default:
            pi / 2.
        near_m: Surfaces nearer than this are cut away [m], positive: along the optical axis for pinhole and
            Brown-Conrady lenses, by distance for a fisheye or a panorama.
        lens: A `Lens` or its name.
        focal_px: Focal lengths (fx, fy) [px]; None: what ``fov_rad`` says.
        centre_px: Principal point (cx, cy) [px], from the image's upper left corner: pixel centres lie at +0.5, so it
            is OpenCV's plus 0.5. Only together with ``focal_px``; None: the middle.
        distortion: Coefficients in OpenCV's order: of a Brown-Conrady lens ``k1 k2 p1 p2``, also with ``k3`` or with
            ``k3 k4 k5 k6``; of a fisheye (Kannala-Brandt) ``k1 k2 k3 k4``; ``alpha beta`` of eucm, ``xi alpha`` of
            double_sphere.
        beams: Those of a LiDAR or a radar, whose panorama the image is, see `of_beams`; None: a camera.

    Raises:
        ValueError: A number out of its range, or numbers that contradict each other.
    """

    width_px: int = 256
    height_px: int = 256
    fov_rad: float = None  # pyright: ignore[reportAssignmentType]  # pi / 2, or what focal_px says
    near_m: float = 0.1
    lens: Lens = Lens.PINHOLE
    focal_px: tuple[float, float] | None = None
    centre_px: tuple[float, float] | None = None
    distortion: tuple[float, ...] = ()
    beams: Beams | None = None

    @classmethod
    def of_beams(cls, beams: Beams, near_m: float) -> CameraModel:
        """The panorama of a LiDAR's beams; ``near_m``: its least range [m]."""
        width_px, height_px, focal_px, centre_px = beams.panorama
        lens = Lens.EQUIRECTANGULAR
        return cls(width_px, height_px, near_m=near_m, lens=lens, focal_px=focal_px, centre_px=centre_px, beams=beams)

    def __post_init__(self) -> None:
        if not all(size == int(size) and size >= 8 for size in (self.width_px, self.height_px)):
            raise ValueError(f"an image needs at least 8 x 8 whole pixels, got {self.width_px} x {self.height_px}")
        if not 0.0 < self.near_m < math.inf:
            raise ValueError(f"near_m must be positive and finite, got {self.near_m}")
        if self.lens not in list(Lens):
            raise ValueError(f"lens must be one of {', '.join(Lens)}, got {self.lens!r}")
        self._set("lens", Lens(self.lens))
        self._set("distortion", checked_distortion(self.lens, self.distortion))
        if self.focal_px is None:
            if self.centre_px is not None:
                raise ValueError(f"centre_px needs focal_px, got centre_px {self.centre_px} alone")
            if self.fov_rad is None:
                self._set("fov_rad", 0.5 * math.pi)
            self._check_fov()
        else:
            focal_px = tuple(float(value) for value in self.focal_px)
            centre_px = tuple(float(value) for value in self.centre_px or self._middle_px)
            self._set("focal_px", focal_px)
            self._set("centre_px", centre_px)
            self._check_calibration(focal_px, centre_px)

    def _set(self, name: str, value: object) -> None:
        object.__setattr__(self, name, value)

    def _check_fov(self) -> None:
        widest_rad = 2.0 * math.pi if self.shape.has_unit_rays else math.pi
        is_within = 0.0 < self.fov_rad < widest_rad or (self.shape.is_panorama and self.fov_rad == widest_rad)
        if not is_within:
            widest = f"{2 if self.shape.has_unit_rays else ''} pi".strip()
            raise ValueError(f"fov_rad of a {self.lens} lens must lie between 0 and {widest}, got {self.fov_rad}")
        if (self.lens is Lens.BROWN_CONRADY or self.shape.is_by_angle) and 0.5 * self.fov_rad > self.shape.limit_rad:
            raise ValueError(
                f"fov_rad must be at most {2.0 * self.shape.limit_rad:.4f} for these distortion coefficients, beyond "
                f"which the image does not grow, got {self.fov_rad}"
            )

    def _check_calibration(self, focal_px: tuple[float, ...], centre_px: tuple[float, ...]) -> None:
        for name, pair in (("focal_px", focal_px), ("centre_px", centre_px)):
            if len(pair) != 2 or not all(math.isfinite(value) for value in pair):
                raise ValueError(f"{name} must be two finite numbers, got {pair}")
        if min(focal_px) <= 0.0:
            raise ValueError(f"focal_px must be positive, got {focal_px}")
        seen_rad = self._seen_angle_rad()
        if seen_rad <= 0.0:
            raise ValueError(f"centre_px {centre_px} lies so far from the image that nothing is seen in it")
        if self.shape.is_panorama and seen_rad > 2.0 * math.pi + _SAME_ANGLE_RAD:
            least_px = 0.5 * self.width_px / math.pi
            raise ValueError(
                f"a panorama {self.width_px} px wide has a focal length of at least {least_px:.3f} px, got focal_px[0] "
                f"= {focal_px[0]}"
            )
        if self.fov_rad is not None and not abs(self.fov_rad - seen_rad) <= _SAME_ANGLE_RAD:
            raise ValueError(f"fov_rad {self.fov_rad} contradicts focal_px, which gives {seen_rad:.6f}; leave one out")
        self._set("fov_rad", min(seen_rad, 2.0 * math.pi))

    def _seen_angle_rad(self) -> float:
        """Angle along the principal point's row between the image's left and right edge."""
        fx, _, cx, _ = self._lens_px
        left, right = -cx / fx, (self.width_px - cx) / fx
        if self.shape.is_panorama:
            return right - left
        angle = np.sign([left, right]) * self.shape.angle(np.abs([left, right]))
        if not self.shape.is_by_angle:
            angle = np.arctan(angle)
        return float(angle[1] - angle[0])

    @property
    def size_text(self) -> str:
        """Columns and rows of the image, or the lines of a LiDAR, as tables have it."""
        if self.beams is None:
            return f"{self.width_px} x {self.height_px}"
        radar = self.beams.radar
        return f"{len(self.beams.elevation_rad)} lines" if radar is None else f"{max(radar.range_m):g} m"

    @property
    def lens_text(self) -> str:
        return self.beams.kind if self.beams else str(self.lens)

    @property
    def half_field(self) -> tuple[float, float]:
        """Half the width and half the height of an image around the optical axis [focal lengths]."""
        return self._radius_at(0.5 * self.fov_rad), 0.5 * self.height_px / self._lens_px[1]

    def _radius_at(self, angle_rad: float) -> float:
        """Radius of the image at an angle from the optical axis [focal lengths]."""
        half = angle_rad if self.shape.has_unit_rays else math.tan(angle_rad)
        return float(self.shape.radius(np.array(half))[0])

    @property
    def _middle_px(self) -> tuple[float, float]:
        return 0.5 * self.width_px, 0.5 * self.height_px

    @property
    def _lens_px(self) -> tuple[float, float, float, float]:
        """fx, fy, cx, cy [px]."""
        if self.focal_px is not None and self.centre_px is not None:
            return (*self.focal_px, *self.centre_px)
        focal = 0.5 * self.width_px / self._radius_at(0.5 * self.fov_rad)
        return (focal, focal, *self._middle_px)

    @cached_property
    def shape(self) -> LensShape:
        """The lens without its focal length."""
        return LensShape(self.lens, self.distortion)

    @cached_property
    def intrinsics(self) -> np.ndarray:
        """fx, fy, cx, cy [px] as OpenCV's 3 x 3 matrix; pixel centres lie at +0.5.

        For a pinhole it maps camera coordinates to homogeneous pixels; for any lens the principal point and the scale
        of the image about it.
        """
        fx, fy, cx, cy = self._lens_px
        return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])

    def project(self, point_m: np.ndarray) -> np.ndarray:
        """Image of points in camera coordinates, whether or not it lies inside the image.

        Args:
            point_m: Points (x right, y down, z forward), [..., 3]; only their direction matters.

        Returns:
            Column and row [px], float64 [..., 2]; NaN for points that the lens does not see. A panorama's columns are
            those of the turn nearest to the image's middle.
        """
        fx, fy, cx, cy = self._lens_px
        place = self.shape.place(point_m)
        if self.shape.is_panorama:
            middle = (0.5 * self.width_px - cx) / fx
            place[..., 0] = middle + (place[..., 0] - middle + math.pi) % (2.0 * math.pi) - math.pi
        return place * [fx, fy] + [cx, cy]

    def rays(self, place_px: np.ndarray) -> np.ndarray:
        """Directions in camera coordinates that have their image at places; `depth` times ray is a point.

        Args:
            place_px: Column and row [px], [..., 2].

        Returns:
            float64 [..., 3]: with z = 1 for pinhole and Brown-Conrady lenses, of unit length for the others; NaN at
            places that see nothing.
        """
        fx, fy, cx, cy = self._lens_px
        return self.shape.ray((np.asarray(place_px, np.float64) - [cx, cy]) / [fx, fy])

    def zoomed(self, log_zoom: float) -> CameraModel:
        """The same camera with focal lengths that are ``exp(log_zoom)`` times as long, and its field of view.

        Raises:
            ValueError: The lens cannot see that wide.
        """
        if log_zoom == 0.0:
            return self
        fx, fy, _, _ = self._lens_px
        focal_px = (fx * math.exp(log_zoom), fy * math.exp(log_zoom))
        zoomed = dataclasses.replace(self, fov_rad=None, focal_px=focal_px)  # pyright: ignore[reportArgumentType]
        return zoomed if self.focal_px is not None else dataclasses.replace(self, fov_rad=zoomed.fov_rad)

    def log_zoom_to(self, fov_rad: float) -> float:
        """The zoom that gives this camera another field of view; see `zoomed`.

        Of a calibrated camera it is that of an image around the optical axis.

        Args:
            fov_rad: Horizontal field of view [rad].

        Raises:
            ValueError: The lens cannot have it.
        """
        dataclasses.replace(self, fov_rad=fov_rad, focal_px=None, centre_px=None)
        return math.log(self._radius_at(0.5 * self.fov_rad) / self._radius_at(0.5 * fov_rad))

    def log_zoom_over(self, other: CameraModel) -> float:
        """Logarithm of the focal length over another camera's."""
        return 0.0 if self == other else math.log(self._lens_px[0] / other._lens_px[0])

    def is_zoom_of(self, other: CameraModel) -> bool:
        """Whether nothing but the zoom tells this camera from another."""
        kept = ("width_px", "height_px", "near_m", "lens", "distortion")
        if any(getattr(self, name) != getattr(other, name) for name in kept):
            return False
        own, others = self._lens_px, other._lens_px
        return own[2:] == others[2:] and math.isclose(own[0] * others[1], own[1] * others[0], rel_tol=1e-9)

    def fits_beside(self, other: CameraModel) -> bool:
        """Whether both can be cameras of one rig that is optimised: the same, or of one lens at different zooms."""
        return self == other or self.is_zoom_of(other)

    def resized(self, width_px: int, height_px: int) -> CameraModel:
        """The same camera with another number of pixels: calibrated focal lengths and principal point grow with it."""
        grow_x, grow_y = width_px / self.width_px, height_px / self.height_px
        if self.focal_px is None or self.centre_px is None:
            return dataclasses.replace(self, width_px=width_px, height_px=height_px)
        return dataclasses.replace(
            self,
            width_px=width_px,
            height_px=height_px,
            focal_px=(self.focal_px[0] * grow_x, self.focal_px[1] * grow_y),
            centre_px=(self.centre_px[0] * grow_x, self.centre_px[1] * grow_y),
        )

    def with_pixels(self, count: float) -> CameraModel:
        """The same camera with about this many pixels: its proportions stay, as near as whole pixels allow."""
        grow = math.sqrt(count / (self.width_px * self.height_px))
        return self.resized(max(round(self.width_px * grow), 8), max(round(self.height_px * grow), 8))


class Cameras:
    """One camera for each view, all of one image size; without poses.

    Attributes:
        models: Camera model of every view.
    """

    def __init__(
        self,
        intrinsics: object,
        *,
        width_px: int,
        height_px: int,
        lens: str | Lens = Lens.PINHOLE,
        distortion: Sequence[float] | np.ndarray = (),
        near_m: float = 0.1,
    ) -> None:
        """Cameras from their calibration.

        Args:
            intrinsics: Matrices ``[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]`` [px], [view, 3, 3], from the image's upper
                left corner: pixel centres lie at +0.5. For a fisheye and a panorama fx and fy are pixels per radian.
            width_px: Image width, at least 8.
            height_px: Image height, at least 8.
            lens: ``pinhole``, ``brown_conrady``, ``fisheye`` (Kannala-Brandt) or ``panorama``; one for all views.
            distortion: Coefficients as `CameraModel` takes them: [coefficient] for all views, or [view, coefficient].
            near_m: Surfaces nearer than this are cut away [m], positive.

        Raises:
            InputError: Another shape, numbers that are not finite, a singular matrix or one with a skew, or numbers
                that contradict each other.
            TypeError: No numbers.
        """
        matrix = _floats(intrinsics, "intrinsics")
        if matrix.ndim != 3 or matrix.shape[1:] != (3, 3) or len(matrix) == 0:
            raise InputError(
                f"intrinsics: expected matrices [view, 3, 3] of at least one view, got {list(matrix.shape)}"
            )
        coefficients = _floats(distortion, "distortion")
        if coefficients.ndim not in (1, 2) or (coefficients.ndim == 2 and len(coefficients) != len(matrix)):
            raise InputError(
                f"distortion: expected [coefficient] or [{len(matrix)}, coefficient], got {list(coefficients.shape)}"
            )
        coefficients = np.broadcast_to(coefficients, (len(matrix), coefficients.shape[-1]))
        for name, value in (("width_px", width_px), ("height_px", height_px)):
            if isinstance(value, bool) or not isinstance(value, int | np.integer):
                raise TypeError(f"{name}: expected a whole number of pixels, got {value!r}")
        self.models = [
            _model(v, *pair, width_px=int(width_px), height_px=int(height_px), lens=lens, near_m=near_m)
            for v, pair in enumerate(zip(matrix, coefficients, strict=True))
        ]

    def __len__(self) -> int:
        """Number of views."""
        return len(self.models)


def _floats(values: object, name: str) -> np.ndarray:
    try:
        return np.asarray(values, np.float64)
    except (TypeError, ValueError) as error:
        raise TypeError(f"{name}: expected numbers, got {type(values).__name__}") from error


def _model(
    v: int,
    matrix: np.ndarray,
    distortion: np.ndarray,
    *,
    width_px: int,
    height_px: int,
    lens: str | Lens,
    near_m: float,
) -> CameraModel:
    if not np.isfinite(matrix).all():
        raise InputError(f"intrinsics: expected finite numbers, got {matrix.tolist()} in view {v}")
    if np.linalg.matrix_rank(matrix) < 3:
        raise InputError(f"intrinsics: expected a matrix with an inverse, got {matrix.tolist()} in view {v}")
    bare = np.array([[matrix[0, 0], 0.0, matrix[0, 2]], [0.0, matrix[1, 1], matrix[1, 2]], [0.0, 0.0, 1.0]])
    if not np.array_equal(matrix, bare):
        raise InputError(
            "intrinsics: expected [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] without skew, got "
            f"{matrix.tolist()} in view {v}"
        )
    try:
        return CameraModel(
            width_px,
            height_px,
            near_m=near_m,
            lens=lens,  # pyright: ignore[reportArgumentType]  # a lens or its name
            focal_px=(float(matrix[0, 0]), float(matrix[1, 1])),
            centre_px=(float(matrix[0, 2]), float(matrix[1, 2])),
            distortion=tuple(distortion.tolist()),
        )
    except ValueError as error:
        raise InputError(f"cameras: view {v}: {error}") from None


def rotational_additions(fov_rad: float) -> tuple[int, float]:
    """How often, and by what angle, a camera turns to look all round.

    ``2 pi mod F = 0`` cannot be tested in floating point; rounding alone gives the same value there. A field of view
    that is not near a divisor of the circle leaves blind seams or overlaps, as in the thesis.

    Equation: 2 (same value: rounding alone covers both cases)

    Args:
        fov_rad: Horizontal field of view F [rad], in (0, 2 pi].

    Returns:
        Number of additions, and ``F_closest`` [rad] between neighbours. The number is at least 2, but 1 for a camera
        that sees all round at once. Halves are rounded to even.
    """
    turns = round(2.0 * math.pi / fov_rad, 6)  # 48 degrees: 7.5, not the 7.499999999999999 of floats
    count = 1 if turns <= 1.0 else max(round(turns), 2)
    return count, 2.0 * math.pi / count
