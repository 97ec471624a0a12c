"""Images of a scene from given cameras, as NumPy arrays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp

from warpav.core.warp_setup import checked_device
from warpav.raster.areas import AMODAL_AREA, VISIBLE_AREA
from warpav.raster.decide import Occlusion
from warpav.raster.renderer import Renderer
from warpav.rig import Rig, RigCamera
from warpav.scene import DeviceScene, Scene, object_index_of


@dataclass(frozen=True)
class CameraImage:
    """What one camera sees.

    Attributes:
        rgb: uint8 [row, column, 3].
        depth_m: Depth [m] along the optical axis, for a fisheye or a panorama the distance; +inf where nothing is hit,
            float32 [row, column].
        object_index: -1 nothing, 0 environment, 1 ego vehicle, 2 + k vehicle k of the scene, int32 [row, column].
    """

    rgb: np.ndarray
    depth_m: np.ndarray
    object_index: np.ndarray
    visible_area_px: np.ndarray
    amodal_area_px: np.ndarray


def render(rig: Rig, scene: Scene, *, supersampling: int = 1, device: str = "cpu") -> dict[str, CameraImage]:
    """What every camera of a rig sees of a scene; without gradients, for which there is `warpav.raster`.

    Args:
        rig: Cameras of any lens and image size.
        scene: The scene.
        supersampling: As of `render_images`.
        device: Warp device.

    Returns:
        Images by the camera's name.

    Raises:
        InputError: The device is not there.
    """
    images = render_images(scene, rig.cameras, supersampling=supersampling, device=checked_device(device))
    return {camera.name: image for camera, image in zip(rig.cameras, images, strict=True)}


def render_images(
    scene: Scene | DeviceScene,
    cameras: Sequence[RigCamera],
    *,
    supersampling: int = 1,
    device: str = "cpu",
    thread_count: int | None = None,
) -> list[CameraImage]:
    """Images of a scene from each camera, with exact occlusion."""
    packed = scene if isinstance(scene, DeviceScene) else DeviceScene.pack(scene, device=device)
    image_of: dict[int, CameraImage] = {}
    kinds = [(camera.model.width_px, camera.model.height_px, camera.behind_glass) for camera in cameras]
    for kind in dict.fromkeys(kinds):
        group = [i for i, each in enumerate(kinds) if each == kind]
        renderer = Renderer(
            [cameras[i].model for i in group],
            supersampling=supersampling,
            occlusion=Occlusion.EXACT,
            device=device,
            thread_count=thread_count,
        )
        transform = np.stack([cameras[i].ego_from_camera for i in group])
        frame = renderer.render(
            packed.raster.through(kind[2]),
            wp.array(transform[:, :3, 3].astype(np.float32), dtype=wp.vec3, device=device),
            wp.array(transform[:, :3, :3].transpose(0, 2, 1).astype(np.float32), dtype=wp.mat33, device=device),
        )
        rgb = (frame.rgb.numpy() * 255.0 + 0.5).astype(np.uint8)
        depth_m, object_index = frame.depth_m.numpy(), object_index_of(frame.object_id.numpy())
        value = frame.measure().value.numpy()
        for k, i in enumerate(group):
            image_of[i] = CameraImage(
                rgb[k], depth_m[k], object_index[k], value[k, :, VISIBLE_AREA], value[k, :, AMODAL_AREA]
            )
    return [image_of[i] for i in range(len(cameras))]
