"""Lenses of camera models against OpenCV, closed forms and themselves backwards."""

import dataclasses
import math

import cv2
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from warpav.raster.camera import CameraModel, rotational_additions
from warpav.raster.lens import Lens, LensShape

# coefficients of calibrated cameras: a dashboard camera, a wide one, two fisheyes
BARREL = (-0.31, 0.11, 0.0008, -0.0005, -0.017)
RATIONAL = (0.42, -0.09, 1e-4, 2e-4, 0.003, 0.78, 0.02, -0.004)
KB4 = (-0.013, 0.0021, -0.0042, 0.0007)


def calibrated(lens, distortion, focal_px=(310.0, 305.0)):
    return CameraModel(
        640, 480, lens=lens, focal_px=focal_px, centre_px=(331.5, 236.25), distortion=distortion, near_m=0.05
    )


def points(rng, count, widest_deg):
    """Points in camera coordinates up to an angle from the axis."""
    angle, turn = math.radians(widest_deg) * np.sqrt(rng.uniform(0, 1, count)), rng.uniform(0, 2 * math.pi, count)
    ray = np.c_[np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn), np.cos(angle)]
    return ray * rng.uniform(0.3, 60.0, (count, 1))


@pytest.mark.parametrize("distortion", [(), BARREL[:4], BARREL, RATIONAL])
def test_brown_conrady_is_opencvs(rng, distortion):
    model = calibrated("brown_conrady", distortion)
    point = points(rng, 500, 40.0)
    known = np.array(distortion) if distortion else None
    expected = cv2.projectPoints(point, np.zeros(3), np.zeros(3), model.intrinsics, known)[0][:, 0]
    np.testing.assert_allclose(model.project(point), expected, atol=1e-9)
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-12)
    if hasattr(cv2, "undistortPointsIter"):  # OpenCV 4
        back = cv2.undistortPointsIter(expected[:, None], model.intrinsics, known, None, None, criteria)[:, 0]
    else:
        back = cv2.undistortPoints(expected[:, None], model.intrinsics, known, criteria=criteria)[:, 0]
    np.testing.assert_allclose(model.rays(expected)[:, :2], back, atol=1e-8)


@pytest.mark.parametrize("distortion", [(), KB4])
def test_fisheye_is_opencvs(rng, distortion):
    model = calibrated("fisheye", distortion)
    point = points(rng, 500, 88.0)  # OpenCV's points lie in front
    known = np.array(distortion or (0.0,) * 4)
    expected = cv2.fisheye.projectPoints(point[:, None], np.zeros(3), np.zeros(3), model.intrinsics, known)[0][:, 0]
    np.testing.assert_allclose(model.project(point), expected, atol=1e-9)
    near = points(rng, 500, 75.0)
    image = cv2.fisheye.projectPoints(near[:, None], np.zeros(3), np.zeros(3), model.intrinsics, known)[0]
    back = cv2.fisheye.undistortPoints(image, model.intrinsics, known)[:, 0]
    ray = model.rays(image[:, 0])
    np.testing.assert_allclose(np.linalg.norm(ray, axis=1), 1.0, rtol=1e-12)
    np.testing.assert_allclose(ray[:, :2] / ray[:, 2:], back, atol=1e-6)  # OpenCV stops at 1e-8 of the angle


def test_a_panorama_unrolls_a_cylinder():
    model = CameraModel(720, 100, 2.0 * math.pi, lens="panorama")
    at = model.project([[0, 0, 5.0], [3.0, 0, 0], [-3.0, 3.0, 0.0], [-1e-9, 0, -2.0], [1e-9, 0, -2.0]])
    pixel_rad = math.radians(0.5)
    np.testing.assert_allclose(at, [[360, 50], [540, 50], [180, 50 + 1.0 / pixel_rad], [0, 50], [720, 50]], atol=1e-6)
    # a part of the circle that is not centred on the optical axis
    side = CameraModel(90, 60, lens=Lens.PANORAMA, focal_px=(90.0, 80.0), centre_px=(-200.0, 30.0))
    assert side.fov_rad == pytest.approx(1.0)
    ray = side.rays([[45.0, 30.0], [45.0, 38.0]])
    np.testing.assert_allclose(np.arctan2(ray[:, 0], ray[:, 2]), 245.0 / 90.0)
    np.testing.assert_allclose(side.project(7.0 * ray), [[45.0, 30.0], [45.0, 38.0]], atol=1e-9)


@pytest.mark.parametrize("lens", list(Lens))
@pytest.mark.parametrize("fov_deg", [30.0, 100.0, 150.0])
def test_a_field_of_view_ends_at_the_images_edges(lens, fov_deg):
    distortion = {Lens.FISHEYE: KB4, Lens.EUCM: (0.6, 1.1), Lens.DOUBLE_SPHERE: (-0.2, 0.6)}.get(lens, ())
    model = CameraModel(320, 200, math.radians(fov_deg), lens=lens, distortion=distortion)
    left, right = model.rays([[0.0, 100.0], [320.0, 100.0]])
    for ray, sign in ((left, -1.0), (right, 1.0)):
        assert math.degrees(math.atan2(ray[0], ray[2])) == pytest.approx(sign * fov_deg / 2, abs=1e-9)
    # the same lens given by its focal lengths
    fx, fy = model.intrinsics[0, 0], model.intrinsics[1, 1]
    given = CameraModel(320, 200, lens=lens, focal_px=(fx, fy), distortion=model.distortion)
    assert given.fov_rad == pytest.approx(model.fov_rad, abs=1e-9)
    np.testing.assert_allclose(given.intrinsics, model.intrinsics)


coefficient = st.floats(-0.35, 0.35)
small = st.floats(-0.002, 0.002)
brown = st.tuples(coefficient, coefficient, small, small, st.floats(-0.1, 0.1))
kannala = st.tuples(st.floats(-0.15, 0.15), st.floats(-0.05, 0.05), st.floats(-0.02, 0.02), st.floats(-0.005, 0.005))


@settings(max_examples=100)
@given(
    st.one_of(
        st.tuples(st.just("brown_conrady"), brown),
        st.tuples(st.just("fisheye"), kannala),
        st.tuples(st.just("eucm"), st.tuples(st.floats(0.0, 1.0), st.floats(0.3, 3.0))),
        st.tuples(st.just("double_sphere"), st.tuples(st.floats(-0.9, 0.9), st.floats(0.0, 1.0))),
        st.tuples(st.sampled_from(["pinhole", "panorama"]), st.just(())),
    ),
    st.floats(150.0, 500.0),
)
@example(("brown_conrady", (0.0, -0.25, 0.0, 0.0, 2e-25)), 150.0)  # a term that matters nowhere
@example(("fisheye", (0.0, 0.0, 0.013671875, -0.001953125)), 150.0)  # Newton's steps go to and fro
def test_images_of_rays_are_where_the_rays_began(lens_and_distortion, focal_px):
    lens, distortion = lens_and_distortion
    model = calibrated(lens, distortion, (focal_px, 0.9 * focal_px))
    column, row = np.meshgrid(np.arange(0.5, 640, 40), np.arange(0.5, 480, 40))
    place = np.stack([column, row], axis=-1)
    ray = model.rays(place)
    seen = np.isfinite(ray[..., 0])
    assert seen[6, 8]  # the middle
    # in pixels; a place is seen where undistorting it comes within 1e-4 focal lengths
    np.testing.assert_allclose(model.project(3.0 * ray)[seen], place[seen], atol=0.06)
    error = np.abs(model.project(3.0 * ray)[seen] - place[seen])
    assert np.quantile(error, 0.95) < 1e-6
    if lens in ("pinhole", "panorama"):
        assert seen.all()


@pytest.mark.parametrize(
    ("lens", "distortion", "limit_deg"),
    [
        # r (1 + k1 r^2) grows up to r = 1 / sqrt(-3 k1)
        ("brown_conrady", (-0.3, 0.0, 0.0, 0.0), math.degrees(math.atan(0.995 / math.sqrt(0.9)))),
        # t (1 + k1 t^2) likewise
        ("fisheye", (-0.2, 0.0, 0.0, 0.0), math.degrees(0.995 / math.sqrt(0.6))),
        ("fisheye", (0.1, 0.0, 0.0, 0.0), 180.0),
        # alpha of one half sees all round; beyond it the image turns where cos t / d is -(1 - alpha) / alpha
        ("eucm", (0.5, 1.3), 0.995 * 180.0),
        ("eucm", (0.75, 1.0), 0.995 * math.degrees(math.acos(-1.0 / 3.0))),
        # without a second sphere, alpha alone
        ("double_sphere", (0.0, 0.75), 0.995 * math.degrees(math.acos(-1.0 / 3.0))),
        ("double_sphere", (0.0, 0.0), 0.995 * 90.0),
        # a pole of the rational model, 1 + k4 r^2 = 0
        ("brown_conrady", (0.5, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0), math.degrees(math.atan(0.995))),
    ],
)
def test_lenses_see_nothing_where_their_image_stops_growing(lens, distortion, limit_deg):
    model = calibrated(lens, distortion, (100.0, 100.0))
    assert math.degrees(model.shape.limit_rad) == pytest.approx(limit_deg)
    limit = math.radians(limit_deg)
    inside, outside = ([math.sin(a), 0.0, math.cos(a)] for a in (0.99 * limit, min(1.01 * limit, math.pi)))
    at = model.project([inside, outside])
    assert np.isfinite(at[0]).all()
    assert np.isnan(at[1]).all() == (limit_deg < 180.0)
    if limit_deg < 180.0:
        edge_px = 100.0 * model.shape.edge
        rays = model.rays([[331.5 + 0.999 * edge_px, 236.25], [331.5 + 1.001 * edge_px, 236.25]])
        assert np.isfinite(rays[0]).all()
        assert np.isnan(rays[1]).all()
        # the calibrated model's field of view ends there as well
        assert model.fov_rad < 2.0 * limit + 1e-9


def test_unified_models_have_the_rays_of_their_papers(rng):
    """Their closed forms of unprojection, which the product does not use."""
    place = rng.uniform(-0.5, 0.5, size=(200, 2))
    squared = (place**2).sum(axis=1)
    alpha, beta = 0.6, 1.2
    z = (1.0 - beta * alpha**2 * squared) / (alpha * np.sqrt(1.0 - (2.0 * alpha - 1.0) * beta * squared) + 1.0 - alpha)
    by_eucm = np.c_[place, z] / np.linalg.norm(np.c_[place, z], axis=1)[:, None]
    np.testing.assert_allclose(LensShape(Lens.EUCM, (alpha, beta)).ray(place), by_eucm, atol=1e-12)
    xi, alpha = -0.25, 0.58
    z = (1.0 - alpha**2 * squared) / (alpha * np.sqrt(1.0 - (2.0 * alpha - 1.0) * squared) + 1.0 - alpha)
    scale = (z * xi + np.sqrt(z**2 + (1.0 - xi**2) * squared)) / (z**2 + squared)
    by_spheres = scale[:, None] * np.c_[place, z] - [0.0, 0.0, xi]
    np.testing.assert_allclose(LensShape(Lens.DOUBLE_SPHERE, (xi, alpha)).ray(place), by_spheres, atol=1e-12)


def test_an_equirectangular_image_holds_azimuth_and_elevation():
    model = CameraModel(360, 180, 2.0 * math.pi, lens="equirectangular")
    ray = model.rays([[270.0, 90.0], [180.0, 45.0], [180.0, 181.0]])
    np.testing.assert_allclose(ray[0], [1.0, 0.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(ray[1], [0.0, -math.sqrt(0.5), math.sqrt(0.5)], atol=1e-12)
    assert np.isnan(ray[2]).all()  # below the nadir


def test_another_size_shows_the_same():
    model = calibrated("brown_conrady", BARREL)
    large = model.resized(1280, 720)
    np.testing.assert_allclose(large.rays([[200.0, 300.0]]), model.rays([[100.0, 200.0]]), rtol=1e-12)
    assert CameraModel(100, 100, 1.0).resized(50, 80) == CameraModel(50, 80, 1.0)
    # a change of anything else keeps what was calibrated
    assert dataclasses.replace(model, near_m=1.0).intrinsics.tolist() == model.intrinsics.tolist()
    assert model != dataclasses.replace(model, distortion=BARREL[:4], fov_rad=None)
    assert len({model, calibrated(Lens.BROWN_CONRADY, list(BARREL))}) == 1


def test_a_camera_that_sees_all_round_need_not_turn():
    assert rotational_additions(2.0 * math.pi) == (1, 2.0 * math.pi)
    assert rotational_additions(math.radians(200.0)) == (2, math.pi)
    assert rotational_additions(math.radians(300.0)) == (2, math.pi)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"fov_rad": math.pi}, "fov_rad of a pinhole lens must lie between 0 and pi, got 3.14"),
        ({"fov_rad": math.nan}, "fov_rad .* got nan"),
        ({"fov_rad": 7.0, "lens": "panorama"}, "between 0 and 2 pi, got 7.0"),
        ({"fov_rad": 2.0, "lens": "brown_conrady", "distortion": (-0.5, 0, 0, 0)}, r"fov_rad must be at most 1\.\d+ "),
        ({"lens": "mirror"}, "lens must be one of pinhole, .*, got 'mirror'"),
        ({"lens": "eucm", "distortion": (1.2, 1.0)}, "alpha of a eucm lens must lie between 0 and 1, got 1.2"),
        ({"lens": "double_sphere", "distortion": (-1.0, 0.5)}, "xi of a double_sphere lens must lie between -0.99"),
        ({"lens": "eucm"}, "a eucm lens has 2 distortion coefficients, got 0"),
        ({"lens": "fisheye", "distortion": (0.1, 0.2)}, "a fisheye lens has 0 or 4 distortion coefficients, got 2"),
        ({"distortion": (0.1,) * 4}, "a pinhole lens has 0 distortion coefficients, got 4"),
        ({"lens": "fisheye", "distortion": (0, 0, math.inf, 0)}, r"distortion\[2\] must be finite, got inf"),
        ({"focal_px": (100.0, -1.0)}, r"focal_px must be positive, got \(100.0, -1.0\)"),
        ({"focal_px": (math.nan, 1.0)}, "focal_px must be two finite numbers"),
        ({"focal_px": (100.0, 100.0), "centre_px": (3.0,)}, "centre_px must be two finite numbers"),
        ({"centre_px": (128.0, 128.0)}, "centre_px needs focal_px"),
        ({"focal_px": (100.0, 100.0), "fov_rad": 1.0}, "fov_rad 1.0 contradicts focal_px, which gives 1.81"),
        ({"focal_px": (9.0, 9.0), "lens": "panorama"}, r"at least 40\.744 px, got focal_px\[0\] = 9\.0"),
        ({"width_px": 4}, "at least 8 x 8 whole pixels, got 4 x 256"),
        ({"height_px": 64.5}, "at least 8 x 8 whole pixels, got 256 x 64.5"),
        ({"near_m": math.inf}, "near_m must be positive and finite, got inf"),
        ({"near_m": 0.0}, "near_m must be positive and finite, got 0.0"),
    ],
)
def test_a_camera_model_refuses(changes, message):
    with pytest.raises(ValueError, match=message):
        CameraModel(**changes)


@pytest.mark.parametrize(
    "model",
    [
        CameraModel(640, 480, 1.2),
        CameraModel(640, 480, 1.2, lens="brown_conrady", distortion=BARREL[:4]),
        CameraModel(640, 480, 2.4, lens="fisheye", distortion=KB4),
        CameraModel(640, 480, 3.0, lens="panorama"),
        calibrated("brown_conrady", BARREL),
    ],
)
def test_a_zoom_makes_focal_lengths_longer_and_nothing_else(model):
    for log_zoom in (0.3, -0.05):
        zoomed = model.zoomed(log_zoom)
        expected = model.intrinsics.copy()
        expected[[0, 1], [0, 1]] *= math.exp(log_zoom)
        np.testing.assert_allclose(zoomed.intrinsics, expected, rtol=1e-6)
        assert (zoomed.fov_rad < model.fov_rad) == (log_zoom > 0.0)
        assert zoomed.log_zoom_over(model) == pytest.approx(log_zoom, abs=1e-6)
        assert zoomed.is_zoom_of(model)
        assert (zoomed.focal_px is None) == (model.focal_px is None)
    assert model.zoomed(0.0) is model
    assert model.log_zoom_over(model) == 0.0
    assert not dataclasses.replace(model, near_m=0.2).is_zoom_of(model)


def test_a_zoom_that_the_lens_cannot_see_is_refused():
    with pytest.raises(ValueError, match="panorama"):
        CameraModel(640, 480, 6.0, lens="panorama").zoomed(-0.5)


def test_the_jacobian_of_brown_conrady_is_that_of_differences(rng):
    shape = LensShape(Lens.BROWN_CONRADY, (-0.2, 0.06, 0.02, -0.03, -0.01, 0.1, 0.02, 0.01))
    at, step = rng.uniform(-0.6, 0.6, (20, 2)), 1e-5 * np.eye(2)
    ends = [(shape._moved(at + each)[0] - shape._moved(at - each)[0]) / 2e-5 for each in step]
    np.testing.assert_allclose(shape._moved(at)[1], np.stack(ends, axis=-1), atol=1e-8)
