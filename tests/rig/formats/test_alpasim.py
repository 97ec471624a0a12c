"""AlpaSim's cameras: lenses as NVIDIA's NCore projects them, f-theta, what is refused."""

import math

import numpy as np
import pytest
import yaml

from tests.rig.formats.known_pose import ALPASIM, POSITION_M, write_sample
from warpav.core.errors import InputError
from warpav.raster.camera import CameraModel
from warpav.rig import ImportOptions, Rig, RigCamera, export_rig_with_notes, import_rig_with_notes
from warpav.rig.formats._alpasim import WRITE_PX
from warpav.rig.formats._format import READ_PX

PINHOLE = CameraModel(640, 480, focal_px=(500.0, 501.0), centre_px=(310.0, 240.0))
BROWN = {"lens": "brown_conrady", "focal_px": (1300.0, 1310.0), "centre_px": (810.0, 441.0)}
FISHEYE = {"lens": "fisheye", "focal_px": (400.0, 401.0), "centre_px": (645.0, 470.0)}
EXACT = {
    "pinhole": PINHOLE,
    "brown_conrady_5": CameraModel(1600, 900, **BROWN, distortion=(-0.2, 0.05, 1e-3, -2e-3, 0.01)),
    "brown_conrady_8": CameraModel(1600, 900, **BROWN, distortion=(-0.1, 0.05, 1e-3, -2e-3, 0.01, 0.02, 0.03, 0.004)),
    "fisheye": CameraModel(1280, 960, **FISHEYE, distortion=(0.02, -0.01, 0.002, -0.0003)),
    "equidistant": CameraModel(1280, 960, math.radians(190.0), lens="fisheye"),
    "zoomed": CameraModel(1280, 960, math.radians(90.0)).zoomed(0.3),
}
FITTED = {
    "eucm": CameraModel(1280, 960, lens="eucm", focal_px=(500.0, 501.0), distortion=(0.6, 1.1)),
    "double_sphere": CameraModel(1280, 960, lens="double_sphere", focal_px=(400.0, 400.0), distortion=(-0.2, 0.58)),
}
# a real camera, from tests of projects that use NCore: even powers and a little skew
FTHETA = """\
      model: ftheta
      ftheta:
        principal_point: [477.8616638183594, 371.405029296875]
        reference_poly: angle_to_pixel
        angle_to_pixeldist: [0.0, 473.61334228515625, -9.587550163269043, 24.94717788696289, -42.338558197021484,
          15.140613555908203]
        pixeldist_to_angle: [0.0, 0.002108694054186344, 1.4248414004214283e-07, -8.064807710539412e-10,
          2.485065538765374e-12, -1.7939406081105393e-15]
        max_angle: 1.3461724520632263
        linear_cde: {linear_c: 0.9997570514678955, linear_d: 6.27807603450492e-05, linear_e: -0.00010061755892820726}
    resolution_hw: [768, 960]
    shutter_type: GLOBAL
"""


def rig_of(model, name="camera_front_wide_120fov"):
    return Rig([RigCamera(name, np.array([1.7, 0.5, 1.6]), 0.3, 0.1, 0.02, model)])


def ftheta_file(folder, text=FTHETA):
    file = write_sample("alpasim", folder)
    head = ALPASIM[: ALPASIM.index("      model:")]
    file.write_text(head + text)
    return file


def written(model, folder):
    (file,), notes = export_rig_with_notes(rig_of(model), "alpasim", folder / "rig.yaml", overwrite=True)
    return yaml.safe_load(file.read_text())["runtime"]["extra_cameras"][0], notes


@pytest.mark.parametrize("name", EXACT)
def test_the_same_camera_comes_back(tmp_path, name):
    before = rig_of(EXACT[name]).cameras[0]
    written(before.model, tmp_path)
    after = import_rig_with_notes(tmp_path / "rig.yaml", "alpasim")[0].cameras[0]
    np.testing.assert_allclose(after.ego_from_camera, before.ego_from_camera, rtol=0, atol=1e-9)
    assert (after.model.width_px, after.model.height_px) == (before.model.width_px, before.model.height_px)
    np.testing.assert_allclose(after.model.intrinsics, before.model.intrinsics, rtol=1e-12)
    assert (after.model.lens, after.model.distortion) == (before.model.lens, before.model.distortion)


def test_it_is_written_as_alpasim_has_it(tmp_path):
    rig = import_rig_with_notes(write_sample("alpasim", tmp_path), "alpasim")[0]
    files, notes = export_rig_with_notes(rig, "alpasim", tmp_path / "out")
    assert [file.name for file in files] == ["alpasim.yaml"]
    text = files[0].read_text()
    assert text.startswith("# @package _global_\n")
    found, expected = yaml.safe_load(text)["runtime"], yaml.safe_load(ALPASIM)["runtime"]
    (camera,), (sample,) = found["extra_cameras"], expected["extra_cameras"]
    turn = np.array(camera["rig_to_camera"].pop("rotation_xyzw"))
    given = np.array(sample["rig_to_camera"].pop("rotation_xyzw"))
    np.testing.assert_allclose(turn * np.sign(turn @ given), given, atol=1e-6)
    assert camera["rig_to_camera"]["translation_m"] == pytest.approx(POSITION_M, abs=1e-12)
    own, others = (each["intrinsics"].pop("opencv_pinhole") for each in (camera, sample))
    assert list(own) == list(others)
    for key, values in others.items():
        assert own[key] == pytest.approx(values, abs=1e-9)
    assert (camera["intrinsics"], camera["resolution_hw"]) == ({"model": "opencv_pinhole"}, [480, 640])
    assert camera["shutter_type"] == "GLOBAL"
    assert found["simulation_config"] == {"cameras": [{"logical_id": "front_left", "height": 480, "width": 640}]}
    assert any("rejects other names, such as 'front_left'" in note for note in notes)
    assert not any("rejects" in note for note in written(PINHOLE, tmp_path)[1])
    assert any("shutter" in note for note in import_rig_with_notes(tmp_path / "alpasim.yaml", "alpasim")[1])


def test_rig_to_camera_is_the_pose_of_the_camera(tmp_path):
    """Numbers of AlpaSim's own configurations: cameras to the left, ahead, to the right and behind."""
    poses = {
        "camera_cross_left_120fov": ([1.646354, 0.143369, 1.521469], [0.679354, -0.207915, 0.215233, -0.670018], 55),
        "camera_front_wide_120fov": ([1.670100, -0.025875, 1.522623], [0.509222, -0.503331, 0.495086, -0.492180], 0),
        "camera_cross_right_120fov": ([1.626168, -0.161517, 1.526269], [0.205424, -0.674057, 0.676355, -0.214458], -55),
        "camera_rear_left_70fov": ([-0.486641, -0.000595, 1.486321], [0.503851, 0.497823, -0.499723, -0.498582], 180),
    }
    rows = [
        {"logical_id": name, "rig_to_camera": {"translation_m": position, "rotation_xyzw": turn}}
        for name, (position, turn, _) in poses.items()
    ]
    file = tmp_path / "user-config.yaml"
    file.write_text(yaml.safe_dump({"extra_cameras": rows}))  # the runtime's own file has no runtime above it
    options = ImportOptions(width_px=1600, height_px=900, fov_deg=64.0, accept_mirrored=True)
    rig, _ = import_rig_with_notes(file, "alpasim", options)
    for camera, (position, _, yaw_deg) in zip(rig.cameras, poses.values(), strict=True):
        assert camera.position_m == pytest.approx(position)
        off_deg = math.remainder(math.degrees(camera.yaw_rad) - yaw_deg, 360.0)
        assert abs(off_deg) < 2.0
        assert abs(camera.pitch_rad) < math.radians(2.0)
        assert abs(camera.roll_rad) < math.radians(2.0)
    with pytest.raises(InputError, match=r"give `width_px`, `height_px` and `fov_deg`"):
        import_rig_with_notes(file, "alpasim", ImportOptions(accept_mirrored=True))


# ------------------------------------------------------------------------------------------- as NCore projects it


def ncore_model(row):
    """NVIDIA's camera model of a row of the file; in double precision, but its parameters are single."""
    types = pytest.importorskip("ncore.data")
    sensors = pytest.importorskip("ncore.sensors")
    import torch

    kind = row["intrinsics"]["model"]
    values = row["intrinsics"][kind]
    height, width = row["resolution_hw"]

    def single(numbers):
        return np.array(numbers, np.float32)

    shared = {
        "resolution": np.array([width, height], np.uint64),
        "shutter_type": types.ShutterType[row["shutter_type"]],
        "principal_point": single(values["principal_point"]),
        "external_distortion_parameters": None,
    }
    if kind == "opencv_pinhole":
        parameters = types.OpenCVPinholeCameraModelParameters(
            **shared,
            focal_length=single(values["focal_length"]),
            radial_coeffs=single(values["radial"]),
            tangential_coeffs=single(values["tangential"]),
            thin_prism_coeffs=single(values["thin_prism"]),
        )
    elif kind == "opencv_fisheye":
        parameters = types.OpenCVFisheyeCameraModelParameters(
            **shared,
            focal_length=single(values["focal_length"]),
            radial_coeffs=single(values["radial"]),
            max_angle=values["max_angle"],
        )
    else:
        names = {"angle_to_pixel": "ANGLE_TO_PIXELDIST", "pixel_to_angle": "PIXELDIST_TO_ANGLE"}
        linear = values["linear_cde"]
        parameters = types.FThetaCameraModelParameters(
            **shared,
            reference_poly=types.FThetaCameraModelParameters.PolynomialType[names[values["reference_poly"]]],
            pixeldist_to_angle_poly=single(values["pixeldist_to_angle"]),
            angle_to_pixeldist_poly=single(values["angle_to_pixeldist"]),
            max_angle=values["max_angle"],
            linear_cde=single([linear[f"linear_{key}"] for key in "cde"]),
        )
    return sensors.CameraModel.from_parameters(parameters, device="cpu", dtype=torch.float64)


def places_over(model):
    columns, rows = np.meshgrid(np.linspace(1.0, model.width_px - 1.0, 41), np.linspace(1.0, model.height_px - 1.0, 31))
    return np.stack([columns.ravel(), rows.ravel()], axis=-1)


def matrix_of(row):
    from scipy.spatial.transform import Rotation

    transform = np.eye(4)
    transform[:3, :3] = Rotation.from_quat(row["rig_to_camera"]["rotation_xyzw"]).as_matrix()
    transform[:3, 3] = row["rig_to_camera"]["translation_m"]
    return transform


@pytest.mark.parametrize(
    ("model", "tolerance_px"),
    [
        *(pytest.param(model, 1e-3, id=name) for name, model in EXACT.items()),
        *(pytest.param(model, WRITE_PX, id=name) for name, model in FITTED.items()),
    ],
)
def test_ncore_projects_points_of_the_vehicle_to_the_same_pixels(tmp_path, model, tolerance_px):
    row, notes = written(model, tmp_path)
    assert any("fisheye, which is off by" in note for note in notes) == (tolerance_px == WRITE_PX)
    ncore = ncore_model(row)
    place_px = places_over(model)
    ray = model.rays(place_px)
    assert np.isfinite(ray).all()
    camera = rig_of(model).cameras[0]
    ego_from_camera = np.asarray(camera.ego_from_camera)
    point_ego_m = 20.0 * ray @ ego_from_camera[:3, :3].T + ego_from_camera[:3, 3]
    found = ncore.world_points_to_image_points_static_pose(
        point_ego_m, np.linalg.inv(matrix_of(row)), return_valid_indices=True
    )
    assert len(found.valid_indices) == len(place_px)
    # worst seen 2.2e-5 px exact (NCore's parameters are single precision), 1.6e-3 px fitted
    np.testing.assert_allclose(found.image_points.numpy(), place_px, rtol=0, atol=tolerance_px)


@pytest.mark.parametrize("reference", ["angle_to_pixel", "pixel_to_angle"])
def test_ncore_and_the_fisheye_read_from_f_theta_agree(tmp_path, reference):
    file = ftheta_file(tmp_path, FTHETA.replace("angle_to_pixel\n", f"{reference}\n"))
    rig, notes = import_rig_with_notes(file, "alpasim")
    model = rig.cameras[0].model
    (told,) = [note for note in notes if "read as a fisheye" in note]
    told_px = float(told.split()[-2])
    ncore = ncore_model(yaml.safe_load(file.read_text())["runtime"]["extra_cameras"][0])
    place_px = places_over(model)
    ray = model.rays(place_px)
    found = ncore.camera_rays_to_image_points(ray)
    seen = found.valid_flag.numpy()
    assert seen.mean() > 0.9
    off_px = np.linalg.norm(found.image_points.numpy() - place_px, axis=-1)[seen].max()
    # seen .054 and .066 px, told .10 and .13 px
    assert off_px < told_px + 1e-3 < READ_PX


# ------------------------------------------------------------------------------------------------------- f-theta


def test_f_theta_with_odd_powers_is_a_fisheye(tmp_path):
    text = """\
      model: ftheta
      ftheta:
        principal_point: [319.5, 239.5]
        reference_poly: angle_to_pixel
        angle_to_pixeldist: [0.0, 300.0, 0.0, -6.0, 0.0, 1.5]
        linear_cde: {linear_c: 1.02, linear_d: 0.0, linear_e: 0.0}
    resolution_hw: [480, 640]
"""
    rig, notes = import_rig_with_notes(ftheta_file(tmp_path, text), "alpasim")
    model = rig.cameras[0].model
    assert (model.lens, model.distortion) == ("fisheye", (-0.02, 0.005, 0.0, 0.0))
    np.testing.assert_allclose(model.intrinsics, [[306.0, 0, 320.0], [0, 300.0, 240.0], [0, 0, 1.0]])
    assert not any("off by" in note for note in notes)
    angle, turn = 0.9, 0.4
    point = [math.sin(angle) * math.cos(turn), math.sin(angle) * math.sin(turn), math.cos(angle)]
    radius_px = 300.0 * angle - 6.0 * angle**3 + 1.5 * angle**5
    expected = [320.0 + 1.02 * radius_px * math.cos(turn), 240.0 + radius_px * math.sin(turn)]
    np.testing.assert_allclose(model.project(np.array(point)), expected, atol=1e-9)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("reference_poly: angle_to_pixel", "reference_poly: x", "reference_poly: expected one of angle_to_pixel,"),
        ("angle_to_pixeldist: [0.0,", "angle_to_pixeldist: [0.1,", "begins with 0; any other tears the image's middle"),
        ("[0.0, 473", "[0.0, -473", "that grows from the image's middle to its"),
        ("[0.0, 473", "[0.0, 13", "that grows from the image's middle to its"),
        (
            "-9.587550163269043",
            "-99.5",
            "one of warpav's comes within 0.25 px of, got one that it is off",
        ),
        ("linear_d: 6.27807603450492e-05", "linear_d: 0.01", "comes within 0.25 px of, got one that it is off by 6"),
        ("linear_c: 0.9997570514678955", "linear_c: 0.0", "linear_cde.linear_c: expected the proportions of a pixel"),
        ("    resolution_hw: [768, 960]\n", "", "ftheta: expected resolution_hw beside intrinsics, because f-theta is"),
        ("max_angle: 1.3461724520632263", "max_angle: -1", "ftheta.max_angle: expected a positive angle, got -1"),
        (
            "angle_to_pixeldist: [0.0,",
            "angle_to: [0.0,",
            "angle_to_pixeldist: expected a list of 2 or 3 or 4 or 5 or 6",
        ),
    ],
)
def test_f_theta_that_is_none_is_refused(tmp_path, old, new, message):
    assert old in FTHETA
    file = ftheta_file(tmp_path, FTHETA.replace(old, new))
    with pytest.raises(InputError) as caught:
        import_rig_with_notes(file, "alpasim")
    text = str(caught.value)
    assert text.startswith(str(file))
    assert message in text
    assert "\n" not in text


# ----------------------------------------------------------------------------------------- refusals, command line


def test_lenses_that_ncore_does_not_have_are_refused(tmp_path):
    strong = CameraModel(1280, 960, lens="eucm", focal_px=(300.0, 300.0), distortion=(0.7, 2.0))
    for model, lens in (
        (CameraModel(640, 480, 6.0, lens="panorama"), "the panorama lens"),
        (CameraModel(640, 480, 6.0, lens="equirectangular"), "the equirectangular lens"),
        (strong, r"this eucm lens, from which its nearest fisheye is off by 0\.\d+ px"),
    ):
        with pytest.raises(InputError, match=rf"alpasim cannot represent {lens}; choose another format$"):
            export_rig_with_notes(rig_of(model), "alpasim", tmp_path / "rig.yaml", approximate=True)
    assert not (tmp_path / "rig.yaml").exists()


def test_distortion_that_ncore_does_not_project_is_told(tmp_path):
    model = CameraModel(1920, 1080, lens="brown_conrady", focal_px=(900.0, 900.0), distortion=(-0.3, 0.1, 0.0, 0.0))
    row, notes = written(model, tmp_path)
    (told,) = [note for note in notes if "leaves the image empty" in note]
    told_deg = float(told.split(" deg")[0].split()[-1])
    ncore = ncore_model(row)
    for angle_deg, is_seen in ((told_deg - 0.2, True), (told_deg + 0.2, False)):
        tangent = math.tan(math.radians(angle_deg))
        ray = np.array([[tangent * 0.8, tangent * 0.6, 1.0]])
        place = model.project(ray)[0]
        assert (place > 0.0).all()
        assert (place < [1920, 1080]).all()
        assert bool(ncore.camera_rays_to_image_points(ray).valid_flag[0]) == is_seen
