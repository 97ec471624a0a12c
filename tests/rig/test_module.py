"""Camera modules: intrinsics against closed forms, the same rays through sensor and network image, contradictions."""

import dataclasses
import math
import pickle

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from warpav.core.errors import InputError
from warpav.raster.lens import Lens
from warpav.rig import Housing, Module, Price
from warpav.rig._module import Fitting, ModuleError, vertical_angle_rad

LENSES = {
    Lens.PINHOLE: (math.radians(70.0), ()),
    Lens.BROWN_CONRADY: (math.radians(80.0), (-0.12, 0.02, 0.001, -0.002)),
    Lens.FISHEYE: (math.radians(170.0), (-0.02, 0.003, -0.001, 0.0001)),
    Lens.EUCM: (math.radians(150.0), (0.6, 1.1)),
    Lens.DOUBLE_SPHERE: (math.radians(160.0), (-0.2, 0.55)),
    Lens.PANORAMA: (math.radians(220.0), ()),
    Lens.EQUIRECTANGULAR: (math.radians(200.0), ()),
}
SENSOR = (1280, 960)


def module(**changed):
    """A module that is right, but for what is changed."""
    given = {
        "name": "mine",
        "sensor_px": SENSOR,
        "fov_rad": math.radians(70.0),
        "housing": Housing((0.03, 0.03, 0.04), (0.0, 0.0, -0.01)),
        "price": Price(1.5),
        "source": "a test",
    }
    return Module(**{**given, **changed})


def of_lens(lens, **changed):
    fov_rad, distortion = LENSES[lens]
    return module(lens=lens, fov_rad=fov_rad, distortion=distortion, **changed)


def test_a_pinhole_has_the_focal_length_of_its_tangent():
    sensor = module().sensor_model()
    focal_px = 640.0 / math.tan(math.radians(35.0))
    np.testing.assert_allclose(sensor.intrinsics, [[focal_px, 0, 640], [0, focal_px, 480], [0, 0, 1]], rtol=1e-12)
    assert 2.0 * sensor.intrinsics[0, 0] * math.tan(0.5 * sensor.fov_rad) == pytest.approx(1280.0, rel=1e-12)
    assert module().pixels_per_degree == pytest.approx(focal_px * math.pi / 180.0)


def test_a_scaled_image_keeps_the_field_and_a_crop_the_focal_length():
    focal_px = 640.0 / math.tan(math.radians(35.0))
    scaled = module(network_px=(640, 480)).camera_model()
    assert (scaled.width_px, scaled.height_px, scaled.fov_rad) == (640, 480, math.radians(70.0))
    np.testing.assert_allclose(scaled.intrinsics[:2], [[focal_px / 2, 0, 320], [0, focal_px / 2, 240]], rtol=1e-12)
    cropped = module(network_px=(640, 480), network_by="crop").camera_model()
    np.testing.assert_allclose(cropped.intrinsics[:2], [[focal_px, 0, 320], [0, focal_px, 240]], rtol=1e-12)
    assert cropped.fov_rad == pytest.approx(2.0 * math.atan(320.0 / focal_px), rel=1e-12)
    # square pixels around the axis need no calibration, which some formats cannot hold
    assert scaled.focal_px is cropped.focal_px is None


def place_in_sensor(given, place_px):
    """Where a place of the network's image lies on the sensor [px]; places count from the corner of the first pixel."""
    sensor, network = np.array(given.sensor_px), np.array(given.network_px)
    if given.network_by is Fitting.SCALING:
        return place_px * sensor / network
    return place_px + (sensor - network) // 2


@settings(max_examples=60)
@given(
    lens=st.sampled_from(list(Lens)),
    fitting=st.sampled_from(list(Fitting)),
    width_px=st.integers(8, SENSOR[0]),
    height_px=st.integers(8, SENSOR[1]),
    share=st.tuples(st.floats(0.0, 1.0), st.floats(0.0, 1.0)),
)
def test_a_place_of_the_scene_has_its_image_at_the_same_place(lens, fitting, width_px, height_px, share):
    used = of_lens(lens, network_px=(width_px, height_px), network_by=fitting)
    sensor, network = used.sensor_model(), used.camera_model()
    assert (network.width_px, network.height_px) == (width_px, height_px)
    assert network.distortion == sensor.distortion
    place_px = np.array(share) * (width_px, height_px)
    on_sensor_px = place_in_sensor(used, place_px)
    ray = network.rays(place_px)
    expected = sensor.rays(on_sensor_px)
    np.testing.assert_allclose(ray, expected, rtol=0.0, atol=1e-11)  # NaN where both see nothing; worst seen 2e-15
    if np.isfinite(ray).all():
        np.testing.assert_allclose(network.project(7.0 * ray), place_px, rtol=0.0, atol=1e-8)  # worst seen 5e-13
        np.testing.assert_allclose(sensor.project(7.0 * ray), on_sensor_px, rtol=0.0, atol=1e-8)  # worst seen 7e-13
    # a crop never sees more than the sensor, and a scaled image as much
    if fitting is Fitting.SCALING:
        assert network.fov_rad == pytest.approx(used.fov_rad, rel=1e-9)
        assert used.pixels_per_degree == pytest.approx(module_of_sensor(used) * width_px / SENSOR[0], rel=1e-9)
    else:
        assert network.fov_rad <= used.fov_rad * (1.0 + 1e-12)
        assert used.pixels_per_degree == pytest.approx(module_of_sensor(used), rel=1e-9)


def module_of_sensor(used):
    """Pixels per degree of the whole sensor."""
    return dataclasses.replace(used, network_px=used.sensor_px).pixels_per_degree


@pytest.mark.parametrize(
    ("lens", "fov_deg", "vertical_deg"),
    [
        ("pinhole", 70.0, math.degrees(2.0 * math.atan(0.75 * math.tan(math.radians(35.0))))),
        ("fisheye", 160.0, 120.0),
        ("equirectangular", 200.0, 150.0),
        ("panorama", 120.0, math.degrees(2.0 * math.atan(math.pi / 4.0))),
    ],
)
def test_the_vertical_field_is_checked_against_the_closed_form(lens, fov_deg, vertical_deg):
    fields = {"lens": lens, "fov_rad": math.radians(fov_deg)}
    used = module(**fields, vertical_fov_rad=math.radians(vertical_deg + 0.9))
    assert math.degrees(vertical_angle_rad(used.sensor_model())) == pytest.approx(vertical_deg)
    told = rf"vertical_fov_rad: expected {vertical_deg:.1f} degrees, .* got {vertical_deg + 1.1:.6g}"
    with pytest.raises(InputError, match=told):
        module(**fields, vertical_fov_rad=math.radians(vertical_deg + 1.1))


def test_a_lens_without_end_may_leave_corners_dark_and_a_polynomial_not():
    # beyond 1 rad of the axis this fisheye folds back: the edges' middles lie before, the corners behind
    turning = (-1.0 / 3.0, 0.0, 0.0, 0.0)
    used = module(lens="fisheye", fov_rad=1.98, distortion=turning)
    assert not np.isfinite(used.sensor_model().rays(np.array([1.0, 1.0]))).any()
    # of a Brown-Conrady lens the corners count; 1 - 3 k r^2 = 0 at r = 1
    with pytest.raises(ModuleError, match=r"distortion: expected .* got a fold-back before the upper left corner"):
        module(lens="brown_conrady", fov_rad=2.0 * math.atan(0.9), distortion=(-1.0 / 3.0, 0.0, 0.0, 0.0))
    narrow = module(lens="brown_conrady", fov_rad=2.0 * math.atan(0.5), distortion=(-1.0 / 3.0, 0.0, 0.0, 0.0))
    assert np.isfinite(narrow.sensor_model().rays(np.array([0.5, 0.5]))).all()


BAD = {
    "pinhole all round": ({"fov_rad": math.pi}, "fov_rad: expected more than 0 and below 180 degrees"),
    "NaN field": ({"fov_rad": math.nan}, "fov_rad: expected more than 0"),
    "fisheye all round": ({"lens": "fisheye", "fov_rad": 2 * math.pi}, "fov_rad: expected more than 0 and below 360"),
    "field behind the fold": (
        {"lens": "fisheye", "fov_rad": 2.2, "distortion": (-1 / 3, 0.0, 0.0, 0.0)},
        "fov_rad: expected at most 114.0 degrees, where these coefficients fold back, got 126.051",
    ),
    "rows beyond the poles": (
        {"lens": "equirectangular", "fov_rad": 2 * math.pi},
        "sensor_px: expected rows between the poles, got rows beyond them at the upper edge",
    ),
    "unknown lens": ({"lens": "fish_eye"}, "lens: expected one of pinhole, .*; did you mean fisheye?"),
    "too few coefficients": ({"lens": "eucm"}, "distortion: expected 2 coefficients of a eucm lens, got 0"),
    "coefficient out of range": (
        {"lens": "eucm", "distortion": (1.5, 1.0)},
        "distortion: expected .* alpha of a eucm lens must lie between 0 and 1",
    ),
    "half pixels": ({"sensor_px": (1280.5, 960)}, "sensor_px: expected columns and rows"),
    "crop beyond the sensor": (
        {"network_px": (1281, 100), "network_by": "crop"},
        "network_px: expected a crop of at most 1280 x 960 px, the sensor, got 1281 x 100 px; crop less",
    ),
    "unknown fitting": ({"network_by": "scale"}, "network_by: .*; did you mean scaling?"),
    "flat housing": ({"housing": Housing((0.03, 0.0, 0.04))}, "housing.size_m: expected positive metres"),
    "housing in millimetres": ({"housing": Housing((30.0, 30.0, 40.0))}, "write metres: 0.03 for 30 mm"),
    "housing elsewhere": ({"housing": Housing((0.03, 0.03, 0.04), (0.0, 0.1, 0.0))}, "housing.offset_m: expected"),
    "negative price": ({"price": Price(-1.0)}, "price.value: expected a number from 0 on"),
    "price of nothing": ({"price": Price(1.0, " ")}, "price.unit: expected a unit"),
    "negative power": ({"power_w": -0.1}, "power_w: expected watts from 0 on"),
    "zone twice": ({"zones": ("roof", "mirror", "roof")}, r"zones\[2\]: expected every zone once"),
    "name of blanks": ({"name": "front camera"}, "name: expected letters"),
    "no source": ({"source": " "}, "source: expected where the figures come from"),
}


@pytest.mark.parametrize("case", BAD)
def test_what_cannot_be_is_told_in_one_line(case):
    changed, told = BAD[case]
    with pytest.raises(ModuleError, match=told) as caught:
        module(**changed)
    assert len(str(caught.value).splitlines()) == len(caught.value.problems) == 1


def test_all_problems_are_told_at_once_and_travel_to_other_processes():
    with pytest.raises(ModuleError) as caught:
        module(fov_rad=4.0, power_w=-1.0, zones=("a", "a"))
    assert [each.field for each in caught.value.problems] == ["fov_rad", "power_w", "zones[1]"]
    again = pickle.loads(pickle.dumps(caught.value))
    assert (str(again), again.problems) == (str(caught.value), caught.value.problems)
