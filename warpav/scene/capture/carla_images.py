"""What CARLA's cameras send, as depths and codes; and which cameras it has."""

from __future__ import annotations

import numpy as np

from warpav.raster.camera import CameraModel
from warpav.raster.lens import Lens

DEPTH_RANGE_M = 1000.0
"""Where the depth camera's 24 bits end [m]."""
_SKY_M = 0.999 * DEPTH_RANGE_M  # the sky's dome is drawn somewhere beyond the range, so its depth is cut there


def depth_from_bgra(bgra: np.ndarray) -> np.ndarray:
    """Metres from what CARLA's depth camera sends: 24 bits, red the lowest, over the range of 1 km.

    Shapes: ``bgra`` [row, column, 4], returns [row, column].
    """
    blue, green, red = (bgra[..., channel].astype(np.int64) for channel in range(3))
    depth_m = (red + 256 * green + 65536 * blue) * (DEPTH_RANGE_M / (2**24 - 1))
    return np.where(depth_m < _SKY_M, depth_m, np.inf).astype(np.float32)


def code_from_bgra(bgra: np.ndarray) -> np.ndarray:
    """One number per pixel from what CARLA's instance camera sends: semantic tag + 256 G + 65536 B.

    Green and blue are the low and the high byte of a number that the server gives the object. That is the actor's id
    on small maps and the engine's own number on large ones, so only the whole colour is compared.

    Shapes: ``bgra`` [row, column, 4], returns [row, column].
    """
    blue, green, red = (bgra[..., channel].astype(np.int32) for channel in range(3))
    return red + 256 * green + 65536 * blue


def check_pinhole(model: CameraModel) -> None:
    """Raise a ValueError for a camera that CARLA does not have."""
    centred = CameraModel(model.width_px, model.height_px, model.fov_rad)
    if model.lens is not Lens.PINHOLE or not np.allclose(model.intrinsics, centred.intrinsics, rtol=0.0, atol=1e-3):
        raise ValueError(
            "CARLA's cameras are pinholes with square pixels and the principal point in the centre, got a "
            f"{model.lens} lens with intrinsics {model.intrinsics.round(2).tolist()}"
        )
