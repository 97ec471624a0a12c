"""Figures of a run, looked at by their colours and places."""

import dataclasses

import numpy as np
import pytest

from tests.view.stand_ins import ego, near, pixels, rig
from warpav.core.errors import InputError
from warpav.detection import Detections
from warpav.optimisation import CameraObservation, FurtherCameras
from warpav.rig import MountSurface, Rig
from warpav.view import detections_sheet, further_figure, loss_figure, search_figure, top_view_figure
from warpav.view._palette import FALSE_POSITIVE_RGB, FURTHER_RGB, MISS_RGB, TRUE_POSITIVE_RGB, camera_rgb, further_map
from warpav.view.figures._convergence import _running_mean
from warpav.view.figures._style import DOTS_PER_INCH, WIDTH_INCH, save_figure


def surface():
    x = np.linspace(0.0, 1.0, 41)
    return MountSurface(
        height_m=np.tile((1.5 - 0.3 * x)[:, None], (1, 17)).astype(np.float32),
        origin_m=np.array([-0.4, -0.8]),
        cell_m=0.1,
    )


def records(count=30):
    position = np.array([[0.0, 0.0, 1.5], [1.0, 0.0, 1.5], [0.0, 0.6, 1.5]])
    return [
        {
            "iteration": i,
            "loss": 2.0 * 0.9**i,
            "terms": {"ifr": 0.9**i, "doa": 0.9**i},
            "multipliers": {"oob": 0.1 * i, "cd": [0.0, 0.02 * i]},
            "positions_m": position.tolist(),
        }
        for i in range(count)
    ]


def where(image, rgb, tolerance=12.0):
    """Rows and columns of the pixels of this colour."""
    return np.nonzero(near(image, rgb, tolerance))


def test_loss_curves_hold_a_line_per_term(tmp_path):
    image = pixels(save_figure(loss_figure(records(), min_distance_m=0.3), tmp_path / "loss.png"))
    assert image.shape[1] == WIDTH_INCH * DOTS_PER_INCH
    for index in range(2):
        assert len(where(image, camera_rgb(index))[0]) > 300
    rows, columns = where(image, FALSE_POSITIVE_RGB)
    assert np.ptp(columns) > 300
    assert rows.min() > image.shape[0] / 2  # the limit is drawn in the lower right panel


def test_inequalities_that_were_never_broken_are_not_drawn(tmp_path):
    run = records()
    for i, record in enumerate(run):
        record["terms"] |= {"zone_0": -1.0, "zone_1": 0.1 - 0.02 * i}
        record["multipliers"] = {"zone_0": 0.0, "zone_1": 0.02 * i}
    image = pixels(save_figure(loss_figure(run), tmp_path / "loss.png"))
    half = image[: image.shape[0] // 2]
    assert len(where(half, camera_rgb(2))[0]) > 300  # zone_1
    assert len(where(half, camera_rgb(3))[0]) == 0


def test_loss_curves_need_records():
    with pytest.raises(InputError, match="expected an iteration to draw, got none"):
        loss_figure([])
    with pytest.raises(InputError, match="terms, multipliers"):
        loss_figure([{"iteration": 0, "loss": 1.0, "positions_m": []}])


def test_panels_that_say_nothing_are_left_out():
    def titles(run):
        return [axis.get_title(loc="left") for axis in loss_figure(run).axes]

    run = records(3)
    assert titles([{**each, "multipliers": {}} for each in run])[2:] == ["Smallest distance between cameras [m]"]
    assert titles(run) == ["Loss", "Loss terms", "Multipliers", "Smallest distance between cameras [m]"]
    for record in run:
        record["terms"], record["multipliers"] = {"misses": 1.0, "oob": -0.1}, {"oob": 0.0}
    assert titles(run) == ["Loss", "Smallest distance between cameras [m]"]
    one = {"iteration": 0, "loss": 1.0, "terms": {}, "multipliers": {}, "positions_m": [[0.0, 0.0, 1.5]]}
    assert titles([one]) == ["Loss"]


def search_records():
    """A start far above, a selection, two steps below its bound, pricing, a selection that ends."""
    rows = [
        ("start", 0.30, None, 40),
        ("selection", 0.10, 0.098, 400),
        ("polish", 0.09, 0.098, 600),
        ("polish", 0.08, 0.098, 700),
        ("pricing", 0.08, 0.098, 1000),
        ("selection", 0.08, 0.079, 1000),
        ("settled", 0.08, 0.079, 1000),
    ]
    names = ("stage", "training_objective", "bound", "camera_renders")
    return [dict(zip(names, row, strict=True)) for row in rows]


def test_a_search_is_drawn_over_what_it_has_spent(tmp_path):
    axis = search_figure(search_records()).axes[0]
    lines = {line.get_label(): line.get_xydata() for line in axis.get_lines()}
    np.testing.assert_allclose(lines["best rig so far"][:4], [[40, 0.30], [400, 0.10], [600, 0.09], [700, 0.08]])
    np.testing.assert_allclose(lines["bound of the pool"][:2], [[400, 0.098], [1000, 0.079]])
    np.testing.assert_allclose(lines["selected"], [[400, 0.10], [1000, 0.08]])
    np.testing.assert_allclose(lines["polished"], [[600, 0.09], [700, 0.08]])
    # the bands: what was spent on the pool, the polish and the pricing
    bands = sorted(
        {(*patch.get_extents().transformed(axis.transData.inverted()).intervalx.round(3),) for patch in axis.patches}
    )
    assert bands == [(0.0, 40.0), (40.0, 400.0), (400.0, 600.0), (600.0, 700.0), (700.0, 1000.0)]
    assert len({patch.get_facecolor() for patch in axis.patches[:2]}) == 1  # the pool is drawn up to its selection
    low, high = axis.get_ylim()
    assert low < 0.079
    assert 0.10 < high < 0.15
    assert [text.get_text() for text in axis.texts] == ["start 0.3000 \N{UPWARDS ARROW}"]
    image = pixels(save_figure(search_figure(search_records()), tmp_path / "search.png"))
    assert len(where(image, camera_rgb(0))[0]) > 500
    assert len(where(image, FALSE_POSITIVE_RGB)[0]) > 200


def test_a_start_that_is_near_is_a_mark():
    records = search_records()
    records[0]["training_objective"] = 0.101
    axis = search_figure(records).axes[0]
    assert "start" in {line.get_label() for line in axis.get_lines()}
    assert not axis.texts
    assert axis.get_ylabel() == "objective"  # it may hold requirements, or the loss of a camera


def test_a_descent_has_no_curve_of_a_search(tmp_path):
    assert search_figure(records()) is None
    assert search_figure([]) is None
    assert search_figure(search_records()[:1]) is None  # stopped before the first selection
    assert list(tmp_path.iterdir()) == []


def test_one_more_camera_is_drawn_at_its_place_in_the_colour_of_its_gain(tmp_path):
    further = FurtherCameras(
        np.array([[0.0, 0.5, 1.5], [3.2, -0.5, 1.4], [0.0, 0.4, 1.5]]),
        np.array([np.pi / 2, 0.0, 0.0]),
        np.zeros(3),
        np.full(3, 1.5),
        np.array([0.02, 0.01, 0.0]),
    )
    arguments = {"rig": rig(), "ego": ego(), "mount_surface": surface()}
    image = pixels(save_figure(further_figure(further=further, **arguments), tmp_path / "map.png"))
    body = image[:, : int(0.85 * image.shape[1])]  # without the bar of colours
    best, second = where(body, FURTHER_RGB[-1]), where(body, [round(255 * each) for each in further_map()(0.5)[:3]])
    assert len(best[0]) > 100
    assert len(second[0]) > 100
    assert best[0].mean() > second[0].mean()  # x points up
    assert best[1].mean() < second[1].mean()  # y points left
    assert np.ptp(best[1]) > np.ptp(best[0])  # its arrow points to the left of the vehicle
    assert np.ptp(second[0]) > np.ptp(second[1])
    none = FurtherCameras(np.zeros((0, 3)), *np.zeros((4, 0)))
    assert further_figure(further=none, **arguments) is None
    assert not (tmp_path / "none.png").exists()


def test_top_view_shows_cameras_on_their_side(tmp_path):
    path = np.linspace(0.0, 1.0, 5)[:, None, None] * np.array([c.position_m for c in rig().cameras])
    figure = top_view_figure(rig=rig(), rig_initial=rig(), ego=ego(), mount_surface=surface(), trajectory_m=path)
    image = pixels(save_figure(figure, tmp_path / "top.png"))
    image = image[: int(0.9 * len(image))]  # without the key
    middle = [np.mean(where(image, camera_rgb(index), 5.0), axis=1) for index in range(4)]
    ahead, left, behind, right = middle  # row, column; x points up in the figure and y left
    assert ahead[0] < left[0] < behind[0]
    assert left[1] < ahead[1] < right[1]


def test_names_in_the_top_view_keep_apart():
    one = rig().cameras[0]
    crowd = Rig(dataclasses.replace(one, name=f"a_camera_with_a_long_name_{k}") for k in range(4))
    figure = top_view_figure(rig=crowd, ego=ego(), mount_surface=surface())
    figure.draw_without_rendering()
    boxes = [text.get_window_extent() for text in figure.axes[0].texts]
    assert len(boxes) == 4
    # of a fraction of a pixel the layout may differ
    assert not any(one.padded(-2.0).overlaps(other) for k, one in enumerate(boxes) for other in boxes[:k])
    assert all(box.x1 <= figure.axes[0].get_window_extent().x1 + 2.0 for box in boxes)


def test_top_view_shows_the_zone_on_request(tmp_path):
    roof = dataclasses.replace(surface(), is_mountable=np.zeros((41, 17), bool))
    roof.is_mountable[5:20, 4:13] = True
    drawn = [top_view_figure(rig=rig(), ego=ego(), mount_surface=roof, shows_zone=shows) for shows in (False, True)]
    plain, bordered = (pixels(save_figure(each, tmp_path / "top.png")) for each in drawn)
    rows, columns = np.nonzero(np.abs(bordered - plain).max(axis=-1) > 40.0)
    # 1.5 m long and 0.9 m wide
    assert np.ptp(rows) / np.ptp(columns) == pytest.approx(1.5 / 0.9, rel=0.1)


def test_detections_have_their_colours_and_sizes(tmp_path):
    none = np.full(4, np.nan)
    found = Detections(np.array([[10, 120, 50, 180], [10, 20, 90, 60]], float), np.ones(2), np.zeros(2, int), ("car",))
    truth = np.array([[10, 20, 90, 60], none, [120, 100, 180, 160]], float)
    seen = CameraObservation(np.full((200, 200, 3), 90, np.uint8), truth, found, np.array([1, -1, -1]))
    image = pixels(detections_sheet({"start": {"front": seen}}, tmp_path / "found.png"))
    grey = np.abs(image - 90.0).max(axis=-1) < 2.0
    rows, columns = np.nonzero(grey.mean(axis=1) > 0.3)[0], np.nonzero(grey.mean(axis=0) > 0.3)[0]
    scale = np.ptp(columns) / 200.0
    image = image[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1]  # without the legend
    for rgb, (x0, y0, x1, y1) in (
        (TRUE_POSITIVE_RGB, (10, 20, 90, 60)),
        (FALSE_POSITIVE_RGB, (10, 120, 50, 180)),
        (MISS_RGB, (120, 100, 180, 160)),
    ):
        rows, columns = where(image, rgb, 40.0)
        found = np.array([columns.min(), rows.min(), columns.max(), rows.max()]) / scale
        np.testing.assert_allclose(found, [x0, y0, x1, y1], atol=2.5)


def test_rows_of_a_detection_sheet_may_differ_in_length(tmp_path):
    none = np.zeros((0, 4))
    nothing = Detections(none, np.zeros(0), np.zeros(0, int), ())
    seen = CameraObservation(np.zeros((8, 8, 3), np.uint8), none, nothing, np.zeros(0, int))
    assert detections_sheet({"start": {}, "end": {"a": seen, "b": seen}}, tmp_path / "found.png").is_file()


def test_running_mean_is_the_mean_of_what_is_there():
    value = np.array([1.0, np.nan, 3.0, 8.0, 2.0])
    expected = [np.nanmean(value[max(0, i - 1) : i + 2]) for i in range(5)]
    np.testing.assert_allclose(_running_mean(value, window=3), expected)
    assert np.isnan(_running_mean(np.full(3, np.nan))).all()
