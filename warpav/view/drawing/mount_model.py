"""Housings and frustums of a rig on its vehicle as a GLB file, for CAD and viewers that take meshes."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from warpav.raster.mesh import Mesh
from warpav.scene.glb import GLTF_FROM_EGO, ROOT_NODE, add_node
from warpav.view.drawing.mount_table import Mount, angles_deg
from warpav.view.frustum import frustum_points
from warpav.view.palette import camera_rgb

if TYPE_CHECKING:
    from warpav.rig.module import Housing, Module
    from warpav.rig.rig import RigCamera

FRUSTUM_DEPTH_M = 1.0
"""How far frustums reach [m]."""

_BOX = ((0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1), (2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4),
        (1, 5, 7), (1, 7, 3))  # fmt: skip


def housing_corners_m(camera: RigCamera, housing: Housing) -> np.ndarray:
    """The corners of a camera's housing in the ego frame [m], float64 [8, 3]."""
    signs = np.array(list(itertools.product((-0.5, 0.5), repeat=3)))
    corner_camera_m = signs * np.asarray(housing.size_m) + np.asarray(housing.offset_m)
    transform = camera.ego_from_camera
    return corner_camera_m @ transform[:3, :3].T + transform[:3, 3]


def mount_glb(mounts: Sequence[Mount], ego: Mesh | None, modules: Mapping[str, Module]) -> bytes:
    """A rig as GLB: the node ``vehicle``, and for each camera ``<name>/frustum`` and, of a module, ``<name>/housing``.

    Vertices are in the ego frame [m] below one node that turns it into glTF's axes, as in scene files. Extras of a
    frustum hold the numbers of its camera. The same input gives the same bytes.
    """
    import trimesh

    file = trimesh.Scene(base_frame="world")
    file.metadata = {
        "frame": "ego: ISO 8855, x forward, y left, z up, origin on the ground below the rear axle's centre"
    }
    file.graph.update(frame_from="world", frame_to=ROOT_NODE, matrix=GLTF_FROM_EGO)
    if ego is not None:
        add_node(file, "vehicle", ego, {})
    for index, mount in enumerate(mounts):
        camera, colour = mount.camera, camera_rgb(index)
        yaw_deg, pitch_deg, roll_deg = angles_deg(camera)
        numbers = {
            "position_m": [float(value) for value in camera.position_m],
            "yaw_deg": yaw_deg,
            "pitch_deg": pitch_deg,
            "roll_deg": roll_deg,
        }
        sides = [[0, 2, 1], [0, 3, 2], [0, 4, 3], [0, 1, 4], [1, 2, 3], [1, 3, 4]]
        point_m = frustum_points(camera, depth_m=FRUSTUM_DEPTH_M)
        add_node(file, f"{camera.name}/frustum", Mesh.create(point_m, sides, colour), numbers)
        module = modules.get(camera.module or "")
        if module is not None:
            corner_m = housing_corners_m(camera, module.housing)
            add_node(file, f"{camera.name}/housing", Mesh.create(corner_m, _BOX, colour), {"module": module.name})
    data = file.export(file_type="glb")
    assert isinstance(data, bytes)
    return data
