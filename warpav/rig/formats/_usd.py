"""USD (extra ``usd``): a rig as an Xform with a ``UsdGeom.Camera`` for every camera, on its vehicle if that is given.

USD's cameras look along -z with y up. They are pinholes of one focal length: pixels that are not square become another
vertical aperture, a principal point beside the middle becomes aperture offsets. Apertures count in tenths of the
stage's unit, the metre, as USD has it; the sensor's size is not known, and its width is taken to be 36 mm.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from warpav.core.bounded_files import usd_library
from warpav.raster.lens import Lens
from warpav.raster.mesh import Mesh
from warpav.rig.formats._format import Losses, PlacedCamera, RigFormat

_CAMERA_FROM_USD = np.diag([1.0, -1.0, -1.0, 1.0])
_APERTURE = 0.36  # tenths of a metre
_FAR_M = 1000.0


def _write(
    cameras: Sequence[PlacedCamera], target: Path, losses: Losses, vehicle: Mesh | None = None
) -> dict[Path, bytes]:
    """The stage, as text or as ``usdc``; everything in it has an identifier for a name, its own is the display name."""
    pxr = usd_library()

    with tempfile.TemporaryDirectory(prefix="warpav-") as folder:
        stage = pxr.Usd.Stage.CreateNew(str(Path(folder) / f"rig{target.suffix.lower() or '.usda'}"))
        pxr.UsdGeom.SetStageMetersPerUnit(stage, 1.0)
        pxr.UsdGeom.SetStageUpAxis(stage, pxr.UsdGeom.Tokens.z)
        root = "/vehicle" if vehicle is not None else ""
        if vehicle is not None:
            pxr.UsdGeom.Xform.Define(stage, root)
            _define_mesh(pxr.UsdGeom.Mesh.Define(stage, f"{root}/body"), vehicle)
        rig = pxr.UsdGeom.Xform.Define(stage, f"{root}/rig")
        stage.SetDefaultPrim(stage.GetPrimAtPath(root or "/rig"))
        for camera in cameras:
            name = pxr.Tf.MakeValidIdentifier(camera.name)
            while stage.GetPrimAtPath(f"{rig.GetPath()}/{name}"):
                name += "_"
            prim = pxr.UsdGeom.Camera.Define(stage, f"{rig.GetPath()}/{name}")
            prim.GetPrim().SetDisplayName(camera.name)
            _define_camera(prim, camera, losses)
            size = pxr.Gf.Vec2i(int(camera.model.width_px), int(camera.model.height_px))
            prim.GetPrim().CreateAttribute("warpav:imageSize", pxr.Sdf.ValueTypeNames.Int2).Set(size)
            if camera.model.lens is not Lens.PINHOLE:
                prim.GetPrim().CreateAttribute("warpav:lens", pxr.Sdf.ValueTypeNames.Token).Set(str(camera.model.lens))
                values = [float(each) for each in camera.model.distortion]
                prim.GetPrim().CreateAttribute("warpav:distortion", pxr.Sdf.ValueTypeNames.DoubleArray).Set(values)
        stage.GetRootLayer().Save()
        return {target: Path(stage.GetRootLayer().realPath).read_bytes()}


def _define_camera(prim, camera: PlacedCamera, losses: Losses) -> None:  # noqa: ANN001 (usd-core has no type hints)
    pxr = usd_library()

    model = camera.model
    if model.shape.is_panorama:
        raise losses.unsupported(camera.name, f"a {model.lens} lens")
    if model.lens is not Lens.PINHOLE:
        losses.notes.append(
            f"camera {camera.name!r}: warning: USD's camera is a pinhole; the {model.lens} lens stands beside it in "
            "warpav:lens and warpav:distortion, which renderers do not read"
        )
    (fx, _, cx), (_, fy, cy), _ = model.intrinsics.tolist()
    focal = _APERTURE * fx / model.width_px
    prim.MakeMatrixXform().Set(pxr.Gf.Matrix4d((camera.file_from_camera @ _CAMERA_FROM_USD).T.tolist()))
    prim.CreateProjectionAttr("perspective")
    prim.CreateFocalLengthAttr(focal)
    prim.CreateHorizontalApertureAttr(_APERTURE)
    prim.CreateVerticalApertureAttr(focal * model.height_px / fy)
    prim.CreateHorizontalApertureOffsetAttr(focal * (0.5 * model.width_px - cx) / fx)
    prim.CreateVerticalApertureOffsetAttr(focal * (cy - 0.5 * model.height_px) / fy)
    prim.CreateClippingRangeAttr(pxr.Gf.Vec2f(model.near_m, max(_FAR_M, 2.0 * model.near_m)))
    prim.CreateFStopAttr(0.0)


def _define_mesh(prim, mesh: Mesh) -> None:  # noqa: ANN001
    pxr = usd_library()

    value = mesh.vertex_rgb / 255.0
    light = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
    prim.CreatePointsAttr(pxr.Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(mesh.vertex_m, np.float32)))
    prim.CreateFaceVertexIndicesAttr(pxr.Vt.IntArray.FromNumpy(mesh.triangle.astype(np.int32).reshape(-1)))
    prim.CreateFaceVertexCountsAttr(pxr.Vt.IntArray.FromNumpy(np.full(len(mesh.triangle), 3, np.int32)))
    prim.CreateSubdivisionSchemeAttr(pxr.UsdGeom.Tokens.none)
    prim.CreateDoubleSidedAttr(True)
    prim.CreateExtentAttr(pxr.Vt.Vec3fArray.FromNumpy(mesh.bounds_m().astype(np.float32)))
    colour = prim.CreateDisplayColorPrimvar(pxr.UsdGeom.Tokens.vertex)
    colour.Set(pxr.Vt.Vec3fArray.FromNumpy(light.astype(np.float32)))


FORMATS = (
    RigFormat(
        "usd",
        frame="camera to rig, rig x forward, y left, z up, right-handed, metres; cameras look along -z, y up",
        origin="on the ground below the centre of the rear axle, as warpav's",
        is_ego_origin=True,
        files=("rig.usda",),
        suffixes=(".usda", ".usdc", ".usd"),
        read=None,
        write=_write,
        holds_vehicle=True,
    ),
)
