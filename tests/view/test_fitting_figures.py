"""Figures of a rig on its vehicle: against golden images, and for what they must say."""

import math
from dataclasses import replace

import numpy as np
import pytest

from tests.view.golden import DIFFERENCE_MAX, difference, same_text
from tests.view.stand_ins import ego, rig, scene, vehicle
from warpav.core.errors import InputError
from warpav.detection import DetectionProbability
from warpav.raster.camera import CameraModel
from warpav.rig import Rig, RigCamera
from warpav.scene import Scene
from warpav.view import Canvas, drawing_of, kinds_of, plot
from warpav.view.figures import _around as around
from warpav.view.figures._from_above import camera_handles, ring_radii_m
from warpav.view.figures._style import new_figure, short_names

KINDS = ("plan", "ground", "range", "near_field", "redundancy", "resolution", "contact")


ONE = rig(4, 90.0)
TWO = {"start": rig(3, 70.0), "optimised": ONE}


@pytest.fixture(scope="module")
def street():
    return scene(vehicle(1, 9.0, 3.4))


def drawn(what, kind, street: Scene):
    return drawing_of(what, Canvas(title="Four cameras"), kind=kind, scene=street)


@pytest.fixture(scope="module")
def once(street):
    """What is drawn of `ONE` or `TWO`, drawn once."""
    figures = {}

    def figure(what, kind):
        if (id(what), kind) not in figures:
            figures[id(what), kind] = drawn(what, kind, street)
        return figures[id(what), kind]

    return figure


def words(figure):
    parts = [figure.texts, *(axis.texts for axis in figure.axes)]
    legends = [legend for axis in figure.axes for legend in axis.findobj(match=lambda each: hasattr(each, "get_texts"))]
    labels = [axis.get_xlabel() for axis in figure.axes] + [axis.get_title(loc="left") for axis in figure.axes]
    return "\n".join(
        [*(text.get_text() for part in parts for text in part), *labels, figure.get_suptitle()]
    ) + "\n".join(text.get_text() for legend in legends for text in legend.get_texts())


@same_text
@pytest.mark.parametrize("kind", KINDS)
def test_it_is_the_golden_image(kind, once):
    assert difference(once(ONE, kind), kind) < DIFFERENCE_MAX


@same_text
@pytest.mark.parametrize("kind", ["plan", "ground", "near_field", "redundancy", "resolution"])
def test_several_rigs_are_the_golden_image(kind, once):
    assert difference(once(TWO, kind), f"{kind}_two") < DIFFERENCE_MAX


def test_another_rig_is_not_the_golden_image(street):
    """Cameras that look elsewhere show: the tolerance is not too wide."""
    turned = Rig(RigCamera(c.name, c.position_m, c.yaw_rad + 0.6, 0.3, 0.0, c.model) for c in ONE.cameras)
    for kind in ("plan", "near_field", "resolution"):
        assert difference(drawn(turned, kind, street), kind) > DIFFERENCE_MAX


def test_they_say_what_they_show(street, once):
    plan = words(once(TWO, "plan"))
    for text in ("start", "≥ 12 px: limit of detectors", "3 cam_3", "10 m"):
        assert text in plan
    ground = words(drawing_of(TWO, Canvas(), kind="ground", ego=ego(), misses_per_100={"start": 5.55}))
    for text in ("5.5 misses per 100", "% of the ground within", "hidden by the own body"):
        assert text in ground
    near = words(once(ONE, "near_field"))
    for text in ("0.6 m", "front", "the top of a child's head"):
        assert text in near
    assert "worst" not in near  # ahead it is as bad, and ahead says so
    corners = zip(rig(4, 70.0).cameras, ((3.9, 0.0), (1.3, 1.1), (-1.2, 0.0), (1.3, -1.1)), strict=True)
    low = [replace(each, position_m=np.array([*xy_m, 0.8]), pitch_rad=0.6) for each, xy_m in corners]
    assert "worst" in words(drawn(Rig(low), "near_field", street))
    assert "without cam_" in words(once(ONE, "redundancy"))
    assert "° in no image" in words(drawn(rig(3, 70.0), "resolution", street))
    sheet = words(once(ONE, "contact"))
    assert "yaw 90°, pitch 0°, fov 90°" in sheet
    assert "own body" in sheet


@pytest.mark.parametrize("half_m", [pytest.param((0.35, 0.35), marks=pytest.mark.nightly), (0.02, 0.0), (3.0, 0.4)])
def test_dimensions_are_clear_of_each_other_and_of_the_vehicle(half_m, street):
    ahead_m, aside_m = half_m
    places = ((3.6 + ahead_m, 0.0), (1.3, 1.1 + aside_m), (-1.2 - ahead_m, 0.0), (1.3, -1.1 - aside_m))
    low = [
        replace(each, position_m=np.array([*xy_m, 0.8]), pitch_rad=0.6)
        for each, xy_m in zip(rig(4, 70.0).cameras, places, strict=True)
    ]
    figure = drawn({"low": Rig(low), "high": ONE}, "near_field", street)
    renderer = figure.canvas.get_renderer()
    for axis in figure.axes[:2]:
        texts = [text for text in axis.texts if text.get_text().endswith("unseen")]
        boxes = [text.get_window_extent(renderer) for text in texts]
        panel = axis.get_window_extent(renderer)
        assert boxes
        assert all(panel.x0 <= box.x0 and box.x1 <= panel.x1 for box in boxes)
        assert not any(one.overlaps(other) for k, one in enumerate(boxes) for other in boxes[:k])
        low_m, high_m = np.asarray(ego().bounds_m(), float)[:, :2]
        body_px = axis.transData.transform([low_m[::-1], high_m[::-1]])
        (x0, y0), (x1, y1) = body_px.min(axis=0), body_px.max(axis=0)
        assert not any(box.x0 < x1 and box.x1 > x0 and box.y0 < y1 and box.y1 > y0 for box in boxes)


def test_a_range_that_the_model_ends_keeps_its_line_and_has_ticks():
    azimuth_rad = np.arange(8) * math.pi / 4.0
    figure = new_figure(3.0, 3.0)
    axis = figure.add_subplot(projection="polar")
    range_m, limit_m = np.full(8, 100.0), np.array([50.0] * 5 + [200.0] * 3)
    around._draw_ranges(axis, azimuth_rad, {0.5: range_m}, limit_m, 0, 4.0)
    whole, cut, ticks = (line.get_ydata() for line in axis.lines[:3])
    assert whole[5:8] == pytest.approx(100.0)
    assert cut[:5] == pytest.approx(50.0)
    assert np.isnan(cut[5:8]).all()
    assert ticks[:2] == pytest.approx([50.0, 54.0])
    assert len(ticks) == 9  # at 0, 90 and 180 degrees


def test_cameras_have_their_names_of_several_rigs_under_the_names_of_these():
    some, other = rig(2), Rig(replace(each, name=f"other_{each.name}") for each in rig(2).cameras)
    assert list(camera_handles({"a": rig(3), "b": some})) == ["Cameras"]
    found = camera_handles({"a": some, "b": other})
    assert {key: [each.get_label() for each in handles] for key, handles in found.items()} == {
        "Cameras, a": ["0 cam_0", "1 cam_1"],
        "Cameras, b": ["0 other_cam_0", "1 other_cam_1"],
    }


@pytest.mark.parametrize(
    ("names", "short"),
    [
        ("left front", "left front"),
        ("CAM_FRONT CAM_BACK_LEFT", "F BL"),
        ("camera_0 camera_1", "0 1"),
        ("front_8mp_120_right fisheye_1_3mp_190_rear", "FrRi FiRe"),
        ("side_x side_y_x", "1 2"),
    ],
)
def test_short_names_are_unique(names, short):
    cameras = [replace(rig(1).cameras[0], name=name) for name in names.split()]
    assert short_names(cameras) == short.split()


def test_one_narrow_camera_does_not_make_the_others_small(street):
    far = RigCamera("far", np.array([1.3, 0.0, 1.58]), 0.0, 0.0, 0.0, CameraModel(fov_rad=math.radians(12.0)))
    found = words(drawn(Rig([*ONE.cameras, far]), "redundancy", street))
    assert "within 20 m" in found
    assert "not drawn: seen up to" in found


@pytest.mark.slow
def test_ranges_of_several_rigs_have_a_panel_for_each_class(street):
    asked = []

    def probability(model):
        asked.append(model)
        return DetectionProbability.builtin(model)

    figure = drawing_of(TWO, Canvas(), kind="range", ego=ego(), probability=probability)
    assert len(figure.axes) == 4  # three classes and the key
    assert {model.fov_rad for model in asked} == {math.radians(70.0), math.radians(90.0)}
    assert "detected with a probability of at least 0.9" in words(figure)


def test_cameras_of_all_lenses_are_drawn(street):
    models = [
        CameraModel(400, 300, math.radians(190.0), lens="fisheye"),
        CameraModel(720, 180, 2.0 * math.pi, lens="panorama"),
        CameraModel(320, 240, math.radians(60.0)),
    ]
    pitches = (0.3, 0.0, -math.radians(80.0))  # the last one looks at the sky
    several = Rig(
        RigCamera(f"c{k}", np.array([1.0, 0.0, 1.7]), 1.0, pitch, 0.0, model)
        for k, (pitch, model) in enumerate(zip(pitches, models, strict=True))
    )
    for kind in ("plan", "near_field", "redundancy", "resolution", "contact"):
        assert drawn(several, kind, street).axes


def test_a_vehicle_is_asked_for_before_anything_is_computed(tmp_path, monkeypatch, street):
    monkeypatch.setattr("warpav.view.figures._plan.size_ranges_m", lambda *_a, **_k: pytest.fail("computed"))
    with pytest.raises(InputError, match="ego: expected the vehicle for kind='plan', got none; give ego="):
        plot(rig(), kind="plan", out=tmp_path / "x.png")
    with pytest.raises(InputError, match="scene: expected the scene for kind='contact', got none"):
        plot(rig(), kind="contact", ego=ego(), out=tmp_path / "x.png")
    with pytest.raises(InputError, match="rigs: expected at least one rig by name, got none"):
        plot({}, kind="plan", ego=ego(), out=tmp_path / "x.png")
    with pytest.raises(TypeError, match="expected rigs by name, got str as 'a'"):
        plot({"a": "b"}, kind="plan", ego=ego(), out=tmp_path / "x.png")
    assert list(kinds_of(dict)) == ["plan", "ground", "range", "near_field", "redundancy", "resolution"]


@pytest.mark.parametrize("reach_m", [3.0, 8.3, 25.0, 61.0, 204.0, 900.0])
def test_rings_are_few_and_round(reach_m):
    ring_m = ring_radii_m(reach_m)
    assert 4 <= len(ring_m) <= 10
    assert ring_m[-1] <= reach_m
    assert ring_m[0] / 10.0 ** math.floor(math.log10(ring_m[0])) == pytest.approx(
        round(ring_m[0] / 10 ** math.floor(math.log10(ring_m[0])))
    )
