"""The probability of detection: kernels against NumPy and SciPy, gradients against renders, and what is stored."""

import dataclasses
import json
import math
import pickle

import numpy as np
import pytest
import warp as wp
from hypothesis import given
from hypothesis import strategies as st
from scipy.interpolate import BSpline
from scipy.spatial.transform import Rotation
from scipy.special import expit

from tests.driving_scene import camera_pose, on_device, packed_street
from warpav.core.errors import InputError
from warpav.detection import (
    FEATURES,
    Appearance,
    DetectionProbability,
    DetectorUse,
    WholeObjects,
    line_of_sight,
    stored_file,
    whole_solid_angle,
)
from warpav.detection import _probability as module
from warpav.detection._probability import FEATURE_COUNT, spline_basis
from warpav.raster.areas import AMODAL_AREA, BOTTOM, LEFT, RIGHT, TOP, VISIBLE_AREA
from warpav.raster.buffers import lens_of
from warpav.raster.camera import CameraModel
from warpav.raster.lens import Lens
from warpav.raster.renderer import Renderer
from warpav.rig import RigCamera
from warpav.scene import UprightBoxes
from warpav_kernels.raster import Lens as KernelLens

KNOTS = 7
MODEL = CameraModel(256, 256, math.radians(80.0))


def model_of(rng, scale=1.0):
    """Curves that rise with what helps, and wave a little."""
    start = np.array([1.0, 0.0, 0.0, -1.5, 1.2, 0.0, -0.4, 0.8])
    step = np.array([8.0, 1.0, 0.8, 3.0, 3.6, 0.6, 0.5, 0.2]) / (KNOTS - 1)
    rise = np.array([6.0, 2.0, 1.0, 1.5, 0.5, 0.5, 0.5, 0.5])
    waves = rng.normal(0.0, 0.15 * scale, (2, FEATURE_COUNT, KNOTS))
    return DetectionProbability(start, step, rise[:, None] * np.linspace(-0.5, 0.5, KNOTS) + waves, [0.4, -0.2])


def scipy_curve(coefficient, start, step, x):
    """The spline as SciPy evaluates it: coefficients continued by straight lines, tangents beyond the knots."""
    count = len(coefficient)
    wide = np.r_[2 * coefficient[0] - coefficient[1], coefficient, 2 * coefficient[-1] - coefficient[-2]]
    spline = BSpline(start + step * np.arange(-3, count + 3), wide, 3)
    end = start + step * (count - 1)
    inside = np.clip(x, start, end)
    return spline(inside) + (x - inside) * spline.derivative()(inside)


def features_of(measure, in_frame, whole, elevation, upright, contrast, width, height):
    """The features as their definitions say."""
    visible, alone = measure[..., VISIBLE_AREA], measure[..., AMODAL_AREA]
    left, right, top, bottom = (measure[..., side] for side in (LEFT, RIGHT, TOP, BOTTOM))
    distance = -np.log(sum(np.exp(-d) for d in (left, width - right, top, height - bottom)))
    return np.stack(
        [
            np.log1p(visible),
            visible / alone,
            in_frame / whole,
            np.log((right - left + 1) / (bottom - top + 1)),
            np.log(4 + distance),
            contrast,
            elevation,
            upright,
        ],
        axis=-1,
    )


def random_measures(rng, views=40, objects=25):
    left, right = np.sort(rng.uniform(0, 200, (2, views, objects)), axis=0)
    top, bottom = np.sort(rng.uniform(0, 100, (2, views, objects)), axis=0)
    alone = (right - left) * (bottom - top) * rng.uniform(0.3, 0.9, left.shape)
    visible = alone * rng.uniform(0, 1, left.shape) ** 2
    whole = rng.uniform(0.01, 2.0, left.shape)
    return (
        np.stack([visible, alone, 0 * alone, left, right, top, bottom], axis=-1),
        whole * rng.uniform(0, 0.8, left.shape),
        whole,
        rng.uniform(-0.5, 0.1, left.shape),
        rng.uniform(0.7, 1.0, left.shape),
        rng.uniform(0, 1, left.shape),
    )


def arrays_of(in_frame, whole, elevation, upright, contrast, device, **gradients):
    """What `DetectionProbability.of_measures` takes after the measures, of all kinds by turns."""
    parts = [
        wp.array(a.astype(np.float32), device=device, **gradients)
        for a in (in_frame[..., None], whole, elevation, upright, contrast)
    ]
    kind = wp.array(np.arange(whole.shape[1], dtype=np.int32) % 3, device=device)
    return parts[0], WholeObjects(*parts[1:4], kind), parts[4]


@given(
    st.integers(2, 9),
    st.floats(-3.0, 3.0),
    st.floats(0.05, 4.0),
    st.lists(st.floats(-20.0, 20.0), min_size=1, max_size=20),
    st.integers(0, 1000),
)
def test_curves_are_scipys_natural_splines(count, start, step, values, seed):
    coefficient = np.random.default_rng(seed).normal(size=count)
    ours = spline_basis(np.array(values), start, step, count) @ coefficient
    np.testing.assert_allclose(ours, scipy_curve(coefficient, start, step, np.array(values)), rtol=1e-9, atol=1e-9)


def test_pixels_are_those_of_the_network(device, rng):
    """An image that is scaled on its way counts as the scaled one; at scale 1 not a bit changes."""
    measure, *others = random_measures(rng)
    model = model_of(rng)
    others = arrays_of(*others, device)
    scaled = measure * [1.5 * 0.5, 1.5 * 0.5, 1.0, 1.5, 1.5, 0.5, 0.5]  # areas, box area, left, right, top, bottom
    found = []
    for each, scale, size in (
        (measure, (1.5, 0.5), (200, 100)),
        (scaled, (1.0, 1.0), (300, 50)),
        (scaled, None, (300, 50)),
    ):
        array = wp.array(each.astype(np.float32), device=device)
        chosen = model if scale is None else dataclasses.replace(model, network_scale=scale)
        found.append(chosen.of_measures(array, *others, width_px=size[0], height_px=size[1]))
    np.testing.assert_allclose(found[0].feature.numpy(), found[1].feature.numpy(), rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(found[0].probability.numpy(), found[1].probability.numpy(), rtol=1e-4, atol=1e-6)
    np.testing.assert_array_equal(found[1].probability.numpy(), found[2].probability.numpy())
    assert pickle.loads(pickle.dumps(dataclasses.replace(model, network_scale=(1.5, 0.5)))).network_scale == (1.5, 0.5)
    with pytest.raises(ValueError, match="positive, finite network_scale"):
        dataclasses.replace(model, network_scale=(0.0, 1.0))


def test_probabilities_match_numpy(device, rng):
    measure, *others = random_measures(rng)
    model = model_of(rng)
    array = wp.array(measure.astype(np.float32), device=device)
    seen = model.of_measures(array, *arrays_of(*others, device), width_px=200, height_px=100)
    feature = features_of(measure, *others, 200, 100)
    kind = np.arange(measure.shape[1]) % 3
    own = np.where(kind < 2, kind, 0)  # cyclists have no curves of their own
    curves = [
        [scipy_curve(model.coefficient[q, f], model.start[f], model.step[f], feature[..., f]) for q in range(2)]
        for f in range(FEATURE_COUNT)
    ]
    logit = np.choose(own, model.constant[:, None, None] + np.sum(curves, axis=0))
    small = np.minimum(measure[..., VISIBLE_AREA], 1.0)
    expected = expit(logit) * (6 * small**5 - 15 * small**4 + 10 * small**3)
    # worst seen 2e-6 and 6e-7
    np.testing.assert_allclose(seen.feature.numpy(), feature, rtol=2e-5, atol=2e-5)
    np.testing.assert_allclose(seen.probability.numpy(), expected, atol=5e-6)
    np.testing.assert_allclose(
        model.of_features(feature, np.broadcast_to(kind, feature.shape[:2])), expit(logit), atol=1e-12
    )
    assert expected.min() < 0.1 < 0.9 < expected.max()


def test_what_is_not_visible_has_no_chance(device, rng):
    measure, *others = random_measures(rng, 1, 3)
    measure[0, 0, VISIBLE_AREA] = 0.0
    measure[0, 1, [VISIBLE_AREA, AMODAL_AREA]] = 0.0
    measure[0, 1, [LEFT, RIGHT, TOP, BOTTOM]] = [200, 0, 100, 0]
    array = wp.array(measure.astype(np.float32), device=device, requires_grad=True)
    in_frame, whole, contrast = arrays_of(*others, device, requires_grad=True)
    arrays = [array, in_frame, whole.solid_angle_sr, whole.elevation, whole.upright, contrast]
    tape = wp.Tape()
    with tape:
        seen = model_of(rng).of_measures(array, in_frame, whole, contrast, width_px=200, height_px=100)
    tape.backward(grads={seen.probability: wp.array(np.ones((1, 3), np.float32), device=device)})
    assert seen.probability.numpy()[0, :2].tolist() == [0.0, 0.0]
    assert not seen.feature.numpy()[0, :2].any()
    for array in arrays:
        assert np.isfinite(array.grad.numpy()).all()
        assert not array.grad.numpy()[0, :2].any()
    assert seen.probability.numpy()[0, 2] > 0.0


@pytest.mark.parametrize("lens", [Lens.PINHOLE, Lens.FISHEYE, Lens.EQUIRECTANGULAR])
def test_lines_of_sight_are_those_of_projected_edges(lens, device, rng):
    """How high a place lies, and how upright a short vertical edge there is in the image of turned cameras."""
    wide = math.radians(360.0 if lens is Lens.EQUIRECTANGULAR else 80.0)
    model = CameraModel(256, 128 if lens is Lens.EQUIRECTANGULAR else 256, wide, lens=lens)
    cameras = [RigCamera("turned", rng.normal(size=3), *rng.uniform(-0.5, 0.5, 3), model) for _ in range(6)]
    pose = np.stack([camera.ego_from_camera for camera in cameras])
    place = np.column_stack([rng.uniform(8.0, 12.0, 9), rng.uniform(-4.0, 4.0, (2, 9)).T])
    lenses = wp.array([lens_of(model)], dtype=KernelLens, device=device)
    views = [
        wp.array(part.astype(np.float32), dtype=dtype, device=device)
        for part, dtype in ((pose[:, :3, 3], wp.vec3), (pose[:, :3, :3].swapaxes(1, 2), wp.mat33))
    ]
    centre = wp.array(place.astype(np.float32), dtype=wp.vec3, device=device)
    elevation, upright = (a.numpy() for a in line_of_sight(*views, lenses, centre, vehicle_count=len(place)))
    for each, at in enumerate(pose):
        ends = [model.project((place + np.array([0.0, 0.0, z]) - at[:3, 3]) @ at[:3, :3]) for z in (-1e-4, 1e-4)]
        edge = ends[1] - ends[0]
        away = place - at[:3, 3]
        np.testing.assert_allclose(elevation[each], away[:, 2] / np.linalg.norm(away, axis=1), atol=1e-5)
        np.testing.assert_allclose(upright[each], -edge[:, 1] / np.linalg.norm(edge, axis=1), atol=1e-3)


def test_boxes_cover_what_rays_say(device, rng):
    eyes = np.array([[0.0, 0.0, 4.0], [5.0, 1.0, 1.0], [-3.0, -4.0, 0.2], [0.5, 0.2, 0.1], [2.2, 0.0, -6.0]])
    centre, half, turn = np.array([0.3, -0.2, 0.4]), np.array([2.0, 0.9, 0.7]), 0.4
    along = np.array([[math.cos(turn), math.sin(turn)]])
    box = UprightBoxes(
        *(wp.array(a.astype(np.float32), dtype=t, device=device) for a, t in
          ((centre[None], wp.vec3), (half[None], wp.vec3), (along, wp.vec2)))
    )  # fmt: skip
    found = whole_solid_angle(wp.array(eyes.astype(np.float32), dtype=wp.vec3, device=device), box, vehicle_count=1)
    ray = rng.normal(size=(400_000, 3))
    ray = Rotation.from_rotvec([0, 0, -turn]).apply(ray / np.linalg.norm(ray, axis=1, keepdims=True))
    for eye, ours in zip(eyes, found.numpy()[:, 0], strict=True):
        start = Rotation.from_rotvec([0, 0, -turn]).apply(eye - centre)
        if (np.abs(start) < half).all():
            assert ours == 0.0
            continue
        near = (-np.sign(ray) * half - start) / ray
        far = (np.sign(ray) * half - start) / ray
        hits = (near.max(axis=1) < far.min(axis=1)) & (near.max(axis=1) > 0)
        # the mean of 400,000 rays has a spread of up to 0.006 sr
        assert ours == pytest.approx(4 * math.pi * hits.mean(), abs=0.02)


def poses():
    """Level cameras on and around the roof."""
    rng = np.random.default_rng(4)
    return [camera_pose([*rng.uniform([0.0, -0.7], [2.2, 0.7]), 1.8], yaw) for yaw in rng.uniform(-3.1, 3.1, 12)]


def test_contrast_is_the_distance_of_mean_colours(device):
    scene = packed_street(device)
    renderer = Renderer([MODEL] * 12, device=device)
    frame = renderer.render(scene.raster, *on_device(poses(), device))
    appearance = Appearance.of(frame, scene)
    value = appearance.measures.value.numpy()
    image, index = frame.colours().numpy(), frame.depths_and_ids()[1].numpy()
    found, expected = [], []
    for v, k in np.argwhere(value[:, :, VISIBLE_AREA] > 300):
        left, right, top, bottom = value[v, k, [LEFT, RIGHT, TOP, BOTTOM]]
        wide, high = 0.25 * (right - left) + 2, 0.25 * (bottom - top) + 2
        rows = slice(int(max(top - high, 0)), int(min(bottom + high, 256)))
        columns = slice(int(max(left - wide, 0)), int(min(right + wide, 256)))
        own = index[v, rows, columns] == k
        colours = image[v, rows, columns]
        expected.append(np.linalg.norm(colours[own].mean(axis=0) - colours[~own].mean(axis=0)))
        found.append(appearance.contrast.numpy()[v, k])
    assert len(found) >= 8
    # all pixels against a grid of 24 x 24: worst seen 0.02
    np.testing.assert_allclose(found, expected, atol=0.05)
    assert np.ptp(found) > 0.1


X, Y, Z, YAW = range(4)


def moved(direction, step):
    """The poses, moved along an axis of the ego frame [m] or turned about the vertical [rad]."""
    at = np.array(poses())
    if direction == YAW:
        at[:, :3, :3] = Rotation.from_rotvec([0, 0, step]).as_matrix() @ at[:, :3, :3]
    else:
        at[:, direction, 3] += step
    return at


def test_gradients_to_poses_match_differences_of_renders(device):
    scene, model = packed_street(device), model_of(np.random.default_rng(0), 0.3)

    def seen_from(renderer, at, tape=None):
        position, rotation = on_device(at, device)
        position.requires_grad = rotation.requires_grad = True
        frame = renderer.render(scene.raster, position, rotation)
        appearance = Appearance.of(frame, scene)
        appearance.contrast.fill_(0.2)  # held fixed by definition
        with tape or wp.Tape():
            probability = model.on_tape(appearance, position, rotation).probability
        return probability, position, rotation

    fine = Renderer([MODEL] * 12, supersampling=4, device=device)
    columns = []
    for direction, step in ((X, 0.03), (Y, 0.03), (Z, 0.03), (YAW, 0.003)):
        high, low = (seen_from(fine, moved(direction, sign * step))[0].numpy() for sign in (1, -1))
        columns.append((high - low) / (2 * step))
    truth = np.stack(columns, axis=-1)

    tape, at = wp.Tape(), moved(X, 0.0)
    probability, position, rotation = seen_from(Renderer([MODEL] * 12, supersampling=2, device=device), at, tape)
    ours = np.zeros_like(truth)
    per_yaw = at[:, :3, :3].transpose(0, 2, 1) @ np.cross([0.0, 0.0, 1.0], np.eye(3))
    for k in range(scene.vehicle_count):
        tape.zero()
        chosen = np.zeros(probability.shape, np.float32)
        chosen[:, k] = 1.0
        tape.backward(grads={probability: wp.array(chosen, device=device)})
        ours[:, k, :YAW] = position.grad.numpy()
        ours[:, k, YAW] = np.einsum("vij,vij->v", rotation.grad.numpy(), per_yaw)

    scale = np.array([1.0, 1.0, 1.0, 0.1])  # 0.1 rad weighs as much as 1 m
    ours, truth = ours * scale, truth * scale
    norm = np.linalg.norm(truth, axis=-1)
    kept = norm > 0.02
    assert kept.sum() >= 18
    cosine = (ours * truth).sum(axis=-1)[kept] / (norm * np.linalg.norm(ours, axis=-1))[kept]
    # seen: .9991 and .92; the worst is a car that the roof's edge begins to hide right there, on one side of the pose
    assert np.median(cosine) >= 0.995
    assert np.quantile(cosine, 0.1) >= 0.85


def use_of(tmp_path, settings=None, content=b"network"):
    model = tmp_path / "mine.onnx"
    model.write_bytes(content)
    return DetectorUse(model, settings or {"camera": {"width_px": 256}})


RECORD = {"fit": {"seeds": [1, 2]}, "held_out": {"seeds": [3]}, "command": "warpav detector fit"}


def written(tmp_path, rng, use):
    model = model_of(rng)
    model = DetectionProbability(model.start, model.step, model.coefficient, model.constant, RECORD)
    return model, model.write(tmp_path, use)


def test_what_is_written_is_found_again(tmp_path, rng):
    use = use_of(tmp_path)
    model, file = written(tmp_path, rng, use)
    found = DetectionProbability.find(use, unseen=[3, 4])
    for name in ("start", "step", "coefficient", "constant"):
        np.testing.assert_array_equal(getattr(found, name), getattr(model, name))
    assert found.record["command"] == "warpav detector fit"
    data = json.loads(file.read_text())
    assert [curve["feature"] for curve in data["curves"]] == [each.name for each in FEATURES]
    assert data["model"]["sha256"] == use.model_sha256
    # written again as it was read
    assert found.write(tmp_path, use).read_text() == file.read_text()


def test_another_network_or_camera_needs_another_fit(tmp_path, rng, monkeypatch):
    monkeypatch.setattr(module, "user_cache_folder", lambda _: tmp_path / "cache")
    written(tmp_path, rng, use_of(tmp_path))
    for other in (use_of(tmp_path, {"camera": {"width_px": 640}}), use_of(tmp_path, content=b"another network")):
        assert stored_file(other) is None
        with pytest.raises(
            InputError, match=r"mine\.onnx: detection probability: expected a fit .* run warpav detector"
        ):
            DetectionProbability.find(other)


def test_a_fit_that_saw_the_test_scenes_is_refused(tmp_path, rng):
    use = use_of(tmp_path)
    written(tmp_path, rng, use)
    with pytest.raises(InputError, match=r"fit\.seeds: expected other scenes .* such as 2; run warpav detector fit"):
        DetectionProbability.find(use, unseen=[7, 2])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda data: {**data, "schema": 99}, "schema: expected 2, got 99"),
        (lambda data: {**data, "identity": "0"}, "got another detector or camera"),
        (lambda data: [], "schema: expected 2, got None"),
        (lambda data: {**data, "curves": data["curves"][:-1]}, "damaged file"),
        (lambda data: {**data, "curves": None}, "damaged file"),
        (lambda data: {**data, "kinds": {"vehicle": "high"}}, "damaged file"),
        (lambda data: {**data, "kinds": {"vehicle": float("nan"), "pedestrian": 0.0}}, "damaged file .*finite"),
        (lambda data: {k: v for k, v in data.items() if k != "fit"}, "damaged file .*fit"),
    ],
)
def test_damaged_files_are_refused(tmp_path, rng, change, message):
    use = use_of(tmp_path)
    _, file = written(tmp_path, rng, use)
    file.write_text(json.dumps(change(json.loads(file.read_text()))))
    with pytest.raises(InputError, match=message) as caught:
        DetectionProbability.find(use)
    assert str(caught.value).endswith("run warpav detector fit --again")
    assert "\n" not in str(caught.value)
