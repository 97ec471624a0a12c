"""The cameras of some views, from calibration matrices."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from warpav.core.errors import InputError
from warpav.raster.camera import CameraModel
from warpav.raster.lens import Lens


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
