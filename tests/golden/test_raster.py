"""Areas, their gradients and depths of the rasteriser on its own, by lens and number of samples; to 1e-5."""

import numpy as np
import pytest

from warpav import raster

CUBE = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)], np.float32)
FACES = np.array(
    [
        *([0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1]),
        *([2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]),
    ],
    np.int32,
)
GREY = np.full((8, 3), 128, np.uint8)
LENSES = ["pinhole", "fisheye", "panorama", "equirectangular"]


@pytest.mark.parametrize("samples", [1, 4])
def test_areas_and_gradients(golden, samples):
    near = raster.Mesh(CUBE + np.float32([0.3, 0.1, 4.0]), FACES, GREY)
    far = raster.Mesh(CUBE * 2 + np.float32([-0.4, 0.0, 8.0]), FACES, GREY)
    scene = raster.Scene({"near": near, "far": far})
    intrinsics = np.array([[[48.0, 0, 32], [0, 48, 24], [0, 0, 1]]] * 2)
    cameras = raster.Cameras(intrinsics, width_px=64, height_px=48)
    pose = np.stack([np.eye(4), np.eye(4)])
    pose[1, :3, 3] = [0.2, -0.1, 0.5]
    frame = raster.render(scene, cameras, pose, samples=samples)
    areas = frame.areas()
    golden(
        f"raster_{samples}",
        {
            "visible": areas.visible.numpy() if hasattr(areas.visible, "numpy") else areas.visible,
            "amodal": areas.amodal.numpy() if hasattr(areas.amodal, "numpy") else areas.amodal,
            "jacobian": areas.jacobian.numpy() if hasattr(areas.jacobian, "numpy") else areas.jacobian,
            "objects": np.unique(frame.object_id.numpy(), return_counts=True),
            "depth": frame.depth_m.numpy()[np.isfinite(frame.depth_m.numpy())][::37],
        },
        rtol=1e-5,
        atol=1e-5,
    )
