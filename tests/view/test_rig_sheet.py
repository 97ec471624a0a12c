"""The page of a rig: its fans against closed forms and against the rays of an image's border, its scale, its files."""

import math

import numpy as np
import pytest

from tests.view.stand_ins import ego, rig, scene
from warpav.cli.app import main
from warpav.core.errors import InputError
from warpav.raster.camera import CameraModel
from warpav.rig import Rig, RigCamera
from warpav.view import plot
from warpav.view._outlines import seen_ground_m
from warpav.view.figures._rig_sheet import _field_of_view_rad, _horizontal_arcs_rad, _vertical_arcs_rad, rig_sheet

EXACT_RAD = 1e-7  # worst seen 3e-9: a quarter of a degree halved thirty times, and float64


def camera(model, yaw_deg=0.0, pitch_deg=0.0, roll_deg=0.0, place_m=(1.0, 0.0, 1.5)):
    return RigCamera("cam", np.array(place_m), *np.radians([yaw_deg, pitch_deg, roll_deg]), model)


def border_rays(one, step_px=0.05):
    """Directions of the image's border in the ego frame, once around."""
    width, height = one.model.width_px, one.model.height_px
    across, down = np.arange(0.0, width, step_px), np.arange(0.0, height, step_px)
    border_px = np.concatenate(
        [
            np.stack([across, 0.0 * across], axis=1),
            np.stack([0.0 * down + width, down], axis=1),
            np.stack([width - across, 0.0 * across + height], axis=1),
            np.stack([0.0 * down, height - down], axis=1),
        ]
    )
    return one.model.rays(border_px) @ one.ego_from_camera[:3, :3].T


def arc_deg(arcs):
    assert len(arcs) == 1
    return np.degrees(arcs[0])


@pytest.mark.parametrize("yaw_deg", [0.0, 55.0, 180.0, -91.0])
def test_a_level_pinhole_spans_its_field_of_view(yaw_deg):
    one = camera(CameraModel(400, 200, math.radians(80.0)), yaw_deg)
    first, last = arc_deg(_horizontal_arcs_rad(one))
    assert last - first == pytest.approx(80.0, abs=math.degrees(EXACT_RAD))
    assert math.remainder(0.5 * (first + last) - yaw_deg, 360.0) == pytest.approx(0.0, abs=1e-6)
    half_deg = math.degrees(math.atan(0.5 * math.tan(math.radians(40.0))))
    assert arc_deg(_vertical_arcs_rad(one)) == pytest.approx([-half_deg, half_deg], abs=1e-6)


def test_a_fisheye_sees_behind_itself_and_a_panorama_all_round():
    wide = camera(CameraModel(400, 400, math.radians(190.0), lens="fisheye"), 90.0)
    assert arc_deg(_horizontal_arcs_rad(wide)) == pytest.approx([-5.0, 185.0], abs=1e-5)
    assert arc_deg(_vertical_arcs_rad(wide)) == pytest.approx([-95.0, 95.0], abs=1e-5)
    all_round = camera(CameraModel(720, 180, 2.0 * math.pi, lens="panorama"), 30.0)
    assert _horizontal_arcs_rad(all_round) == [(-math.pi, math.pi)]
    ahead, behind = np.degrees(_vertical_arcs_rad(all_round))
    assert [behind[1] - behind[0], ahead[1] - ahead[0]] == pytest.approx([ahead[1] - ahead[0]] * 2)


@pytest.mark.parametrize(
    ("lens", "fov_deg", "distortion"),
    [("pinhole", 90.0, ()), ("brown_conrady", 90.0, (-0.1, 0.01, 0.0, 0.0)), ("fisheye", 100.0, ())],
)
def test_pitched_and_rolled_fans_end_where_the_border_crosses_the_horizon(lens, fov_deg, distortion):
    model = CameraModel(320, 240, math.radians(fov_deg), lens=lens, distortion=distortion)
    one = camera(model, 70.0, 18.0, 25.0)
    ray = border_rays(one)
    up = ray[:, 2] / np.linalg.norm(ray, axis=1)
    crossing = np.flatnonzero(np.sign(up) != np.sign(np.roll(up, -1)))
    following = (crossing + 1) % len(up)
    share = (up[crossing] / (up[crossing] - up[following]))[:, None]
    at = (1.0 - share) * ray[crossing] + share * ray[following]
    expected_deg = sorted(np.degrees(np.arctan2(at[:, 1], at[:, 0])))
    level_deg = arc_deg(_horizontal_arcs_rad(camera(model, 70.0)))
    found_deg = arc_deg(_horizontal_arcs_rad(one))
    assert found_deg == pytest.approx(expected_deg, abs=1e-3)  # worst seen 2e-5: between samples of the border
    assert np.abs(found_deg - level_deg).max() > 1.0  # the fan of a level camera would be wrong


def test_a_camera_that_looks_down_has_the_ground_of_its_border():
    one = camera(CameraModel(320, 240, math.radians(60.0)), 40.0, 62.0, 10.0, (1.0, 0.5, 2.0))
    assert _horizontal_arcs_rad(one) == []
    ray = border_rays(one)
    foot_m = one.position_m[:2] - ray[:, :2] * (one.position_m[2] / ray[:, 2:])
    [outline_m] = seen_ground_m(one, reach_m=100.0, step_rad=math.radians(0.1))

    def area_m2(point):
        x, y = point.T
        return 0.5 * abs(x @ np.roll(y, -1) - y @ np.roll(x, -1))

    assert area_m2(outline_m) == pytest.approx(area_m2(foot_m), rel=0.01)  # worst seen 0.003: steps of 0.1 degrees
    assert outline_m.max(axis=0) == pytest.approx(foot_m.max(axis=0), abs=0.02)
    assert outline_m.min(axis=0) == pytest.approx(foot_m.min(axis=0), abs=0.02)
    assert seen_ground_m(camera(CameraModel(), pitch_deg=-80.0), reach_m=100.0) == []


def test_straight_down_the_plane_is_that_of_the_upper_edge():
    arcs = _vertical_arcs_rad(camera(CameraModel(200, 200, math.radians(80.0)), pitch_deg=90.0))
    assert arc_deg(arcs) == pytest.approx([-130.0, -50.0], abs=1e-5)


def test_the_page_is_in_the_scale_that_it_states():
    figure = rig_sheet(rig(), ego=ego(), range_m=[4.0, 8.0])
    assert figure.get_size_inches() * 25.4 == pytest.approx([210.0, 297.0])
    [stated] = [text.get_text() for text in figure.texts if text.get_text().startswith("1 : ")]
    for axis in figure.axes:
        for unit in ((1.0, 0.0), (0.0, 1.0)):
            drawn_px = np.linalg.norm(axis.transData.transform(unit) - axis.transData.transform((0.0, 0.0)))
            assert 1000.0 / (drawn_px / figure.dpi * 25.4) == pytest.approx(float(stated.removeprefix("1 : ")))
    words = {text.get_text() for part in (figure, *figure.axes) for text in part.texts}
    assert {"0 cam_0", "3 cam_3", "4 m", "8 m", "256 x 256", "80 x 80"} <= words


@pytest.mark.parametrize("turn_deg", [(0.0, 0.0, 0.0), (97.0, 30.0, 0.0), (10.0, -80.0, 25.0)])
def test_the_table_has_the_field_of_the_lens_however_it_is_turned(turn_deg):
    wide = camera(CameraModel(640, 480, math.radians(190.0), lens="fisheye"), *turn_deg)
    assert np.degrees(_field_of_view_rad(wide)) == pytest.approx([190.0, 142.5], abs=1e-5)
    words = [text.get_text() for text in rig_sheet(Rig([wide]), ego=ego()).texts]
    assert {"190° fisheye", "640 x 480"} <= set(words)
    assert any(word.startswith("190 x 14") for word in words)


def test_a_vehicle_longer_than_its_rings_is_within_the_drawing():
    above, side = rig_sheet(rig(), ego=ego(), range_m=[1.0]).axes
    low_m, high_m = np.asarray(ego().bounds_m(), float)
    for first_m, last_m in (above.get_ylim(), side.get_xlim()):
        assert first_m < low_m[0] < high_m[0] < last_m


def test_what_the_view_from_the_side_leaves_out_is_said():
    figure = rig_sheet(rig(), ego=ego())
    side = figure.axes[1]
    assert side.get_ylim()[1] > 3.0  # as high as the page has room for
    assert f"cut {side.get_ylim()[1]:.1f} m above the ground" in [text.get_text() for text in side.texts]
    assert not any("cut" in text.get_text() for text in rig_sheet(rig(), ego=ego(), range_m=[2.0]).axes[1].texts)


def test_cameras_at_one_place_have_their_numbers_beside_it():
    model = CameraModel(fov_rad=math.radians(60.0))
    pair = Rig(
        RigCamera(f"c{k}", np.array([1.0, side, 1.5]), side, 0.0, 0.0, model) for k, side in enumerate((-0.8, 0.8))
    )
    above, side = rig_sheet(pair, ego=ego()).axes
    for axis, is_on, column in ((above, True, 1), (side, False, 0)):
        at_m = [text.get_position() for text in axis.texts if text.get_text() in ("c0", "c1")]
        apart_m = np.array(at_m)[-2:] - ([[0.8, 1.0], [-0.8, 1.0]] if column else [[1.0, 1.5]] * 2)
        assert (np.abs(apart_m).max(axis=1) < 1e-9).all() == is_on


def test_many_cameras_make_the_page_longer():
    figure = rig_sheet(rig(60))
    assert figure.get_size_inches()[1] * 25.4 > 297.0
    lowest = min(text.get_position()[1] for text in figure.texts if text.get_text().startswith("59 "))
    note = next(text for text in figure.texts if text.get_text().startswith("Above"))
    assert lowest > note.get_window_extent().y1 / figure.bbox.height


@pytest.mark.parametrize(("suffix", "begins"), [("png", b"\x89PNG"), ("pdf", b"%PDF"), ("svg", b"<?xml")])
def test_it_is_written_in_every_format(tmp_path, suffix, begins):
    cameras = [
        *rig().cameras,
        camera(CameraModel(400, 300, math.radians(190.0), lens="fisheye"), 90.0, 30.0),
        RigCamera("down", np.array([1.0, 0.9, 1.0]), 1.6, math.radians(70.0)),
        RigCamera("sky", np.array([1.0, 0.0, 1.6]), 0.0, math.radians(-89.0)),
    ]
    path = tmp_path / "new" / f"sheet.{suffix}"
    assert plot(Rig(cameras), kind="sheet", scene=scene(), out=path) == path
    content = path.read_bytes()
    assert content.startswith(begins)
    assert suffix != "pdf" or b"/Subtype /Image" not in content  # vectors alone
    plot(Rig(cameras), kind="sheet", scene=scene(), out=path)
    assert path.read_bytes() == content


def test_what_does_not_fit_is_named(tmp_path):
    with pytest.raises(InputError, match=r"range_m: expected positive radii in metres, got \[-1.0, 5.0\]"):
        plot(rig(), kind="sheet", range_m=[5.0, -1.0], out=tmp_path / "x.png")
    with pytest.raises(TypeError, match="plot: range_m: expected an option of a Rig"):
        plot(rig(), range_m=[5.0], out=tmp_path / "x.png")
    with pytest.raises(InputError, match=r"expected a name that ends in \.png, \.pdf, \.svg, got '\.html'"):
        plot(rig(), kind="sheet", out=tmp_path / "x.html")


def test_the_command_writes_it(tmp_path, capsys):
    out = tmp_path / "sheet.svg"
    assert main(["inspect", "nuscenes", "--show", "sheet", "--out", str(out)]) == 0
    assert capsys.readouterr().out == f"wrote {out}\n"
    assert out.read_text().startswith("<?xml")
