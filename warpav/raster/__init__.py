"""The rasteriser: meshes and cameras in; object ids, depths, colours, areas and their derivatives out.

It needs no vehicle, rig or traffic: ``scene = Scene({"cube": Mesh(vertices, faces, rgb)})``, ``frame = render(scene,
Cameras(intrinsics, width_px=640, height_px=480), camera_from_world)``, ``frame.areas().visible``.
"""

from warpav.core.face import face_of

__all__, __getattr__ = face_of(__name__)  # pyright: ignore[reportUnsupportedDunderAll]
