"""USD: usd-core's own cameras project points to warpav's pixels, and the vehicle stands with its rig."""

import math

import numpy as np
import pytest

import warpav as wa
from warpav.cli.app import main
from warpav.core.errors import InputError
from warpav.rig import export_rig_with_notes
from warpav.scene import ego_vehicle, read_vehicle

PARTS_OF_USD = ("Gf", "Usd", "UsdGeom")
Gf, Usd, UsdGeom = (pytest.importorskip(f"pxr.{name}") for name in PARTS_OF_USD)

SHIFTED = {"focal_px": (1300.0, 1345.0), "centre_px": (810.0, 441.0)}
MODELS = {
    "plain": wa.CameraModel(1920, 1080, math.radians(100.0), near_m=0.2),
    "shifted": wa.CameraModel(1600, 900, **SHIFTED),
    "wide": wa.CameraModel(8000, 6000, focal_px=(1500.0, 1502.0), centre_px=(5000.0, 2000.0)),
    "brown": wa.CameraModel(1600, 900, lens="brown_conrady", **SHIFTED, distortion=(-0.2, 0.05, 1e-3, -2e-3, 0.01)),
}
ORIGIN = {"origin_m": (1.2, 0.1, 0.4), "origin_rpy_deg": (1.0, 2.0, 30.0)}


def rig_of(*names):
    at = np.array([1.7, 0.5, 1.6])
    return wa.Rig([wa.Camera(name, at, 0.4 + k, 0.1, -0.05, MODELS[name]) for k, name in enumerate(names)])


@pytest.mark.parametrize("suffix", ["usda", "usdc"])
@pytest.mark.parametrize("place", [{}, ORIGIN])
def test_usd_core_projects_points_to_our_pixels(tmp_path, rng, suffix, place):
    rig = rig_of(*MODELS)
    (path,), notes = export_rig_with_notes(rig, "usd", tmp_path / f"rig.{suffix}", **place)
    stage = Usd.Stage.Open(str(path))
    assert (UsdGeom.GetStageMetersPerUnit(stage), UsdGeom.GetStageUpAxis(stage)) == (1.0, "Z")
    assert stage.GetDefaultPrim().GetTypeName() == "Xform"
    assert ["lens stands beside it" in note for note in notes].count(True) == 1
    for camera in rig.cameras:
        model, prim = camera.model, stage.GetPrimAtPath(f"/rig/{camera.name}")
        seen = UsdGeom.Camera(prim).GetCamera(Usd.TimeCode.Default())
        matrix = seen.frustum.ComputeViewMatrix() * seen.frustum.ComputeProjectionMatrix()
        pixel = rng.uniform([0, 0], [model.width_px, model.height_px], (50, 2))
        ray = np.column_stack([(pixel - model.intrinsics[:2, 2]) / model.intrinsics.diagonal()[:2], np.ones(50)])
        point_m = ray * rng.uniform(1.0, 80.0, (50, 1))
        place_of = np.eye(4)
        if place:
            turn = Gf.Matrix4d(1.0)  # about fixed axes, x first: Gf's rows are vectors
            for axis, angle in zip(np.eye(3), place["origin_rpy_deg"], strict=True):
                turn *= Gf.Matrix4d(Gf.Rotation(Gf.Vec3d(*axis), angle), Gf.Vec3d(0))
            place_of[:3, :3], place_of[:3, 3] = np.array(turn)[:3, :3].T, place["origin_m"]
        ego_m = point_m @ camera.ego_from_camera[:3, :3].T + camera.position_m
        file_m = (ego_m - place_of[:3, 3]) @ place_of[:3, :3]
        clip = np.array([matrix.Transform(Gf.Vec3d(*each)) for each in file_m])
        size = np.array(prim.GetAttribute("warpav:imageSize").Get())
        found = (clip[:, :2] * [0.5, -0.5] + 0.5) * size
        np.testing.assert_allclose(found, pixel, atol=0.01)  # worst seen 0.0006 px: apertures are single precision
        assert (seen.clippingRange.min, seen.clippingRange.max) == pytest.approx((model.near_m, 1000.0))
        if model.distortion:
            assert prim.GetAttribute("warpav:lens").Get() == "brown_conrady"
            np.testing.assert_array_equal(prim.GetAttribute("warpav:distortion").Get(), model.distortion)


def test_the_vehicle_stands_with_its_rig(tmp_path):
    car = ego_vehicle()
    (path,) = wa.export_rig(rig_of("plain"), "usd", tmp_path / "car.usda", vehicle=car)
    read = read_vehicle(path)  # the cameras beside it are no part of it
    np.testing.assert_array_equal(read.vertex_m[read.triangle], car.vertex_m[car.triangle])
    np.testing.assert_array_equal(read.vertex_rgb[read.triangle], car.vertex_rgb[car.triangle])
    assert UsdGeom.Camera(Usd.Stage.Open(str(path)).GetPrimAtPath("/vehicle/rig/plain"))


def test_the_command_writes_the_vehicle_of_the_options(tmp_path, capsys):
    out = tmp_path / "cross.usda"
    assert main(["rig", "export", "cross", "--format", "usd", "--with-vehicle", "--out", str(out)]) == 0
    stage = Usd.Stage.Open(str(out))
    assert len([prim for prim in stage.Traverse() if prim.IsA(UsdGeom.Camera)]) >= 4
    assert stage.GetPrimAtPath("/vehicle/body").IsA(UsdGeom.Mesh)
    assert (
        main(["rig", "export", "cross", "--format", "urdf", "--with-vehicle", "--out", str(tmp_path / "a.urdf")]) == 2
    )
    assert "(--with-vehicle): expected the format usd" in capsys.readouterr().err
    assert main(["rig", "export", "cross", "scenes.ego=bus", "--format", "usd", "--out", str(tmp_path / "b.usda")]) == 2
    assert "add it" in capsys.readouterr().err


def test_what_usd_cannot_hold_is_refused(tmp_path):
    panorama = wa.CameraModel(512, 128, 2.0 * math.pi, lens="equirectangular")
    with pytest.raises(InputError, match="camera 'a': usd cannot represent a equirectangular lens"):
        wa.export_rig(wa.Rig([wa.Camera("a", np.zeros(3), 0, 0, 0, panorama)]), "usd", tmp_path / "a.usda")
    with pytest.raises(InputError, match="usd is for export only"):
        wa.import_rig(tmp_path / "a.usda", "usd")
