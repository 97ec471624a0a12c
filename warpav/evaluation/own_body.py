"""The own vehicle in the images: what share of each it covers, rendered alone and so independent of traffic."""

from __future__ import annotations

import numpy as np
import warp as wp

from warpav.raster.buffers import Content
from warpav.raster.mesh import Mesh
from warpav.raster.pane import Pane
from warpav.raster.renderer import Renderer
from warpav.raster.scene import BACKGROUND_ID
from warpav.raster.scene import Scene as RasterScene
from warpav.rig.rig import Rig
from warpav.scene.device_scene import DeviceScene


def body_shares(rig: Rig, scene: DeviceScene) -> dict[str, float]:
    """Share of the image of every camera that the body of the own vehicle covers.

    The vehicle is drawn alone, so nothing of the scene counts but its ego vehicle. Pixels whose centres show it are
    counted over all pixels of the image, those included in which the lens sees nothing. Surfaces nearer than a camera's
    ``near_m`` are cut away, as in every render, and so is a pane that a camera stands behind.
    """
    share: dict[str, float] = {}
    kinds = [(camera.model.width_px, camera.model.height_px, camera.behind_glass) for camera in rig.cameras]
    for kind in dict.fromkeys(kinds):
        group = [camera for camera, each in zip(rig.cameras, kinds, strict=True) if each == kind]
        body = _body_alone(scene, kind[2])
        transform = np.stack([camera.ego_from_camera for camera in group])
        renderer = Renderer([camera.model for camera in group], device=str(body.device))
        frame = renderer.render(
            body,
            wp.array(transform[:, :3, 3].astype(np.float32), dtype=wp.vec3, device=body.device),
            wp.array(transform[:, :3, :3].transpose(0, 2, 1).astype(np.float32), dtype=wp.mat33, device=body.device),
            content=Content.IMAGES,
        )
        covered = (frame.object_id.numpy() != BACKGROUND_ID).mean(axis=(1, 2), dtype=np.float64)
        share |= {camera.name: float(value) for camera, value in zip(group, covered, strict=True)}
    return {camera.name: share[camera.name] for camera in rig.cameras}


def _body_alone(scene: DeviceScene, pane: Pane | None) -> RasterScene:
    """The ego vehicle of a scene as cameras behind a pane see it, and nothing else, on the scene's device."""
    raster = scene.raster.through(pane)
    body = raster.layer_body.numpy()[raster.foreground_layer]
    triangles = raster.triangles
    triangle = triangles.triangle.numpy()[triangles.triangle_body.numpy() == body]
    used, triangle = np.unique(triangle, return_inverse=True)
    vertex_rgb = np.zeros((len(used), 3), np.uint8)  # only ids are read
    mesh = Mesh(triangles.vertex_world_m.numpy()[used], triangle.reshape(-1, 3).astype(np.int32), vertex_rgb)
    return RasterScene(occluders=[mesh], device=raster.device)
