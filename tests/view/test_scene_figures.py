"""Figures of traffic scenes: what they count against plain loops, and what they draw by its colours and places."""

import math

import cv2
import numpy as np
import pytest

from tests.cli.small_run import complaint
from tests.scene.capture.town_capture import town_capture
from tests.view.stand_ins import near, needs_opengl, pixels, scene, vehicle
from warpav.cli.app import main
from warpav.experiments import _scene_figures as scene_figures
from warpav.scene import (
    EGO_INSTANCE,
    ENVIRONMENT_INSTANCE,
    Box,
    CloudSettings,
    PlanSettings,
    ReconstructionSettings,
    fuse,
    write_scene,
)
from warpav.scene.reconstruction._settings import MeshSettings
from warpav.view._palette import camera_rgb
from warpav.view.figures import _clouds as clouds
from warpav.view.figures import _images as images
from warpav.view.figures import _rigs as rigs
from warpav.view.figures._clouds import BACKGROUND_RGB
from warpav.view.figures._style import DOTS_PER_INCH, WIDTH_INCH, count_text

WIDTH_PX = WIDTH_INCH * DOTS_PER_INCH
COARSE = ReconstructionSettings(
    vehicle=MeshSettings(4000, 0.12, 0.24, 1500),
    ego=MeshSettings(8000, 0.08, 0.16, 2000),
    environment=MeshSettings(10_000, 0.8, 1.6, 4000),
)


@pytest.fixture
def drawn(monkeypatch):
    """Matplotlib's figures of what was drawn, to read their texts; clouds are drawn coarsely."""
    monkeypatch.setattr(clouds, "_SUPERSAMPLING", 1)
    figures = []
    for module in (images, clouds, rigs):

        def save(figure, path, real=module.save_figure):
            figures.append(figure)
            return real(figure, path)

        monkeypatch.setattr(module, "save_figure", save)
    return figures


def panel(image, axis):
    """The pixels of one panel of a figure that was drawn."""
    box = axis.get_window_extent()
    return image[image.shape[0] - int(box.y1) : image.shape[0] - int(box.y0), int(box.x0) : int(box.x1)]


def remarks(figure):
    return {axis.get_title("left"): axis.get_title("right") for axis in figure.axes}


def capture():
    """A capture of two vehicles, small enough to be drawn soon."""
    return town_capture(settings=PlanSettings(vehicle_count=2, width_px=160, height_px=120))


# ------------------------------------------------------------------------------------------------- images: 4, 14 to 16


def test_depth_colours_run_from_one_limit_to_the_other():
    import matplotlib

    colours = matplotlib.colormaps["viridis_r"]
    depth_m = np.array([[0.1, 2.0, 2.0 * math.sqrt(10.0), 20.0, 300.0, np.inf]], np.float32)
    rgb = images.depth_rgb(depth_m, (2.0, 20.0))[0]
    expected = [np.rint(255.0 * np.array(colours(share)[:3])) for share in (0.0, 0.0, 0.5, 1.0, 1.0)]
    assert np.abs(rgb[:5].astype(float) - expected).max() <= 1.0  # the middle may round to the next of 256 colours
    assert not near(rgb.astype(float), rgb[5], 40.0)[:5].any()  # the sky is no depth


def test_instances_have_colours_of_their_own():
    ids = np.array([[ENVIRONMENT_INSTANCE, EGO_INSTANCE, *range(1, 25)]], np.uint16)
    rgb = images.instance_rgb(ids)[0]
    assert len(np.unique(rgb, axis=0)) == 26
    distance = np.linalg.norm(rgb[:, None].astype(float) - rgb[None], axis=-1)
    assert distance[np.triu_indices(26, 1)].min() > 15.0  # worst seen 24


def test_image_types_stand_side_by_side(tmp_path, drawn):
    town = capture()
    image = pixels(images.image_types(town, tmp_path / "4.png"))
    assert image.shape[1] == WIDTH_PX
    colour, depth, instance = (panel(image, axis) for axis in drawn[0].axes[:3])
    assert np.ptp([colour.shape, depth.shape, instance.shape], axis=0).max() <= 1
    text = drawn[0].axes[0].get_xlabel()
    (shown,) = [one for one in town.images if f"view {one.view.name}\n" in text]
    for instance_id in np.unique(shown.instance):
        share = (shown.instance == instance_id).mean()
        drawn_share = near(instance[3:-3, 3:-3], images.instance_rgb(np.array([[instance_id]]))[0, 0], 3.0).mean()
        assert drawn_share == pytest.approx(share, abs=0.02)  # worst seen .011: edges mix; without the frame
    assert colour.std() > 20.0


# ------------------------------------------------------------------------------------------------- point clouds: 5 to 7


def test_window_clouds_are_those_of_plain_loops_over_pixels():
    town, settings = capture(), CloudSettings()
    found = clouds.window_clouds(town, settings)
    boxes = {EGO_INSTANCE: town.ego_box, **{one.instance_id: one.box for one in town.vehicles}}
    counts = {name: dict.fromkeys(boxes, 0) for name in ("shown", "boxed", "gained")}
    lost = 0
    for image in town.images:
        row, column = np.nonzero(np.isfinite(image.depth_m))
        matrix = image.view.model.intrinsics
        depth_m = image.depth_m[row, column].astype(float)
        camera_m = np.stack(
            [
                (column + 0.5 - matrix[0, 2]) / matrix[0, 0] * depth_m,
                (row + 0.5 - matrix[1, 2]) / matrix[1, 1] * depth_m,
                depth_m,
                np.ones(len(row)),
            ]
        )
        ego_m = (image.view.ego_from_camera @ camera_m)[:3].T
        instance = image.instance[row, column]

        def inside(box, margin_m, ego_m=ego_m):
            turn = np.array(
                [[math.cos(box.yaw_rad), math.sin(box.yaw_rad)], [-math.sin(box.yaw_rad), math.cos(box.yaw_rad)]]
            )
            local = np.concatenate([(ego_m - box.center_m)[:, :2] @ turn.T, (ego_m - box.center_m)[:, 2:]], axis=1)
            return (np.abs(local) <= box.size_m / 2 + margin_m).all(axis=1)

        in_any = np.any([inside(box, -settings.box_margin_m) for box in boxes.values()], axis=0)
        lost += (in_any & (instance == ENVIRONMENT_INSTANCE)).sum()
        for instance_id, box in boxes.items():
            own, boxed = instance == instance_id, inside(box, settings.box_margin_m)
            counts["shown"][instance_id] += own.sum()
            counts["boxed"][instance_id] += (own & boxed).sum()
            counts["gained"][instance_id] += (own & ~boxed & ~in_any).sum()
    # a point in a million may fall on the other side of a wall, since clouds are single precision
    assert [len(one) for one in found.shown] == [counts["shown"][one.instance_id] for one in town.vehicles]
    assert [len(one) for one in found.boxed] == pytest.approx(
        [counts["boxed"][one.instance_id] for one in town.vehicles], abs=3
    )
    assert len(found.gained) == pytest.approx(sum(counts["gained"].values()), abs=3)
    assert len(found.lost) == pytest.approx(lost, abs=3)
    assert len(found.gained) > 100
    assert all(len(one) < len(before) for one, before in zip(found.outside, found.boxed, strict=True))


@needs_opengl
def test_window_filter_tells_the_counts_of_the_fused_clouds(tmp_path, drawn):
    town = capture()
    chosen = town.vehicles[1].instance_id
    image = pixels(clouds.window_filter(town, tmp_path / "7.png", instance_id=chosen))
    assert image.shape[1] == WIDTH_PX
    fused = fuse(town, town.images, CloudSettings())
    shown = remarks(drawn[0])
    assert shown["Its outside"] == count_text(len(fused.vehicles[1].cloud))
    pixel_count = sum(int(((one.instance == chosen) & np.isfinite(one.depth_m)).sum()) for one in town.images)
    assert shown[f"Vehicle {chosen}"] == count_text(pixel_count)
    before, after = (panel(image, axis) for axis in drawn[0].axes[5:7])
    assert not near(before, camera_rgb(0), 60.0).any()
    assert near(after, camera_rgb(0), 60.0).sum() > 20  # what panes show
    for axis in drawn[0].axes:
        assert panel(image, axis).std() > 5.0


@needs_opengl
def test_nothing_lies_beyond_the_sphere(tmp_path, drawn):
    radius_m = 25.0
    image = pixels(clouds.sphere(capture(), tmp_path / "6.png", settings=CloudSettings(radius_m=radius_m)))
    assert image.shape[1] == WIDTH_PX
    coloured = []
    for axis in drawn[0].axes:
        row, column = np.indices(image.shape[:2])
        y, x = (
            axis.transData.inverted()
            .transform(np.stack([column.ravel() + 0.5, image.shape[0] - row.ravel() - 0.5], axis=-1))
            .T
        )
        (right, left), (low, high) = sorted(axis.get_xlim()), axis.get_ylim()
        is_beyond = (
            (np.hypot(x, y) > radius_m + 1.5) & (x > low + 1) & (x < high - 1) & (y > right + 1) & (y < left - 1)
        )
        coloured.append((~near(image, (255, 255, 255), 30.0).ravel() & is_beyond).sum())
    assert coloured[0] > 3000
    assert coloured[1] == 0


@needs_opengl
def test_stages_lead_from_all_pixels_to_meshes(tmp_path, drawn):
    town = capture()
    image = pixels(clouds.stages(town, tmp_path / "5.png", settings=COARSE))
    assert image.shape[1] == WIDTH_PX
    shown = list(remarks(drawn[0]).items())
    assert [text[:3] for text, _ in shown] == ["(4)", "(5)", "(6)", "(7)", "(8)", "(9)"]
    every = sum(one.depth_m.size for one in town.images)
    hit = sum(int(np.isfinite(one.depth_m).sum()) for one in town.images)
    assert shown[0][1] == count_text(every)
    assert shown[1][1] == count_text(hit)
    fused = fuse(town, town.images, CloudSettings())
    parts = (fused.environment, fused.sphere, fused.ego.cloud, *(one.cloud for one in fused.vehicles))
    assert shown[3][1] == count_text(sum(map(len, parts)))
    for axis in drawn[0].axes:
        one = panel(image, axis)
        assert near(one, BACKGROUND_RGB, 6.0).mean() < 0.6
        assert one.std() > 20.0


# ------------------------------------------------------------------------------------------- collections of scenes: 8


def test_vehicle_occupancy_matches_a_loop_over_cells(rng):
    scenes = [
        [
            Box(np.array([*rng.uniform(-8.0, 8.0, 2), rng.uniform(0.5, 2.0)]), rng.uniform(1.0, 5.0, 3), yaw_rad)
            for yaw_rad in rng.uniform(-math.pi, math.pi, 4)
        ]
        for _ in range(3)
    ]
    found = rigs.vehicle_occupancy(scenes, radius_m=6.0, cell_m=0.5)
    expected = np.zeros((24, 24))
    for i in range(24):
        for j in range(24):
            x, y = -6.0 + 0.5 * (i + 0.5), -6.0 + 0.5 * (j + 0.5)
            for boxes in scenes:
                for box in boxes:
                    dx, dy = x - box.center_m[0], y - box.center_m[1]
                    along = dx * math.cos(box.yaw_rad) + dy * math.sin(box.yaw_rad)
                    across = dy * math.cos(box.yaw_rad) - dx * math.sin(box.yaw_rad)
                    if abs(along) <= box.size_m[0] / 2 and abs(across) <= box.size_m[1] / 2:
                        expected[i, j] += 1.0 / 3.0
                        break
    assert found == pytest.approx(expected, abs=1e-12)
    assert 0.05 < expected.mean() < 0.6


@pytest.fixture
def scenes_folder(tmp_path):
    """Five scenes: a vehicle to the left in all, one ahead in the first three."""
    folder = tmp_path / "scenes"
    folder.mkdir()
    for seed in range(5):
        ahead = [vehicle(2, 12.0, 0.0)] if seed < 3 else []
        write_scene(scene(vehicle(1, 0.0, 6.0), *ahead), folder / f"scene_{seed}.glb")
    return folder


def test_heat_maps_lie_where_the_vehicles_stand(tmp_path, scenes_folder, drawn):
    image = pixels(scene_figures.draw_figure(8, tmp_path / "8.png", scenes=scenes_folder))
    assert image.shape[1] == WIDTH_PX
    maps = drawn[0].axes[:3]
    assert [(axis.get_title("left"), axis.get_title("right")) for axis in maps] == [
        ("All", "5 scenes, 8 vehicles"),
        ("Train", "3 scenes, 6 vehicles"),
        ("Test", "1 scene, 1 vehicle"),
    ]
    for axis, has_vehicle_ahead in zip(maps, (True, True, False), strict=True):

        def is_coloured(x_m, y_m, axis=axis):
            column, up = axis.transData.transform((y_m, x_m)).astype(int)
            red, green, blue = image[image.shape[0] - up, column]
            return max(red, green, blue) - min(red, green, blue) > 60.0

        assert is_coloured(0.5, 6.3)
        assert is_coloured(12.5, 0.4) == has_vehicle_ahead
        assert not is_coloured(0.5, -6.3)  # left is left


def test_heat_maps_take_the_seeds_that_are_named(tmp_path, scenes_folder, drawn, capsys):
    out = tmp_path / "heat.png"
    assert main(["scenes", "heatmap", str(scenes_folder), "--out", str(out), "--train", "[3]", "--test", "0..1"]) == 0
    assert capsys.readouterr().out == f"wrote {out}\n"
    assert [axis.get_title("right") for axis in drawn[0].axes[1:3]] == ["1 scene, 1 vehicle", "2 scenes, 4 vehicles"]


# ------------------------------------------------------------------------------------------------- mount surface: 9


@needs_opengl
def test_mount_surface_is_measured_filled_and_smoothed(tmp_path, drawn):
    image = pixels(rigs.mount_surface_stages(capture(), tmp_path / "9.png", settings=COARSE, cell_m=0.05))
    assert image.shape[1] == WIDTH_PX
    shown = remarks(drawn[0])
    fused = fuse(capture(), capture().images, CloudSettings())
    assert drawn[0].axes[0].get_xlabel() == count_text(len(fused.ego.cloud))
    measured, filled, smoothed = (np.ma.filled(axis.images[0].get_array(), np.nan) for axis in drawn[0].axes[1:4])
    share = f"{100.0 * np.isfinite(measured).mean():.0f} %"
    assert list(shown)[:4] == ["Map and points", f"Measured, {share}", "Filled", "Smoothed"]
    assert np.isfinite(measured).mean() < 0.95
    assert filled[np.isfinite(measured)] == pytest.approx(measured[np.isfinite(measured)])
    assert np.isin(filled, measured).all()  # each unmeasured cell has a measured height
    assert not np.isin(smoothed, measured).all()
    picture = panel(image, drawn[0].axes[0])
    assert 0.1 < near(picture, BACKGROUND_RGB, 6.0).mean() < 0.9
    yellow = near(picture, (253, 231, 37), 40.0)  # the roof is the highest
    assert yellow.sum() > 1000


# ------------------------------------------------------------------------------------------------- the command line


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["14", "--out", "sheet.jpg"], "sheet.jpg: --out: expected a name that ends in .png, got '.jpg'"),
        (["3", "--out", "3.png"], "figure: expected one of 4, 5, 6, 7, 8, 9, 10, 11, 12, 14, 15, 16, got 3"),
        (["four", "--out", "4.png"], "command line"),
        (["4"], "--out"),
        (["4", "--out", "4.png", "--seed", "-1"], "command line (--seed): expected an integer from 0, got -1"),
        (["4", "--out", "4.png", "--capture", "nowhere"], "nowhere"),
        (["4", "--out", "4.png", "--capture", "a", "--seed", "1"], "expected either seed or capture, got both"),
        (["4", "--out", "4.png", "--scenes", "a"], "that goes with figure 8"),
        (["8", "--out", "8.png"], "figure 8: expected scenes"),
        (["8", "--out", "8.png", "--scenes", "nowhere"], "nowhere: expected a folder of scenes, got none"),
        (["8", "--out", "8.png", "--scenes", "."], "expected files scene_SEED.glb, got none"),
        (["10", "--out", "10.jpg"], "10.jpg: --out: expected a name that ends in .png, got '.jpg'"),
        (["11", "--out", "11.png", "--run", "nowhere"], "nowhere: run folder: expected an existing folder"),
        (["12", "--out", "12.png", "--seed", "1"], "figure 12: expected --run, --config or key=value, got --seed"),
        (["12", "--out", "12.png", "--config", "quik"], "did you mean quick?"),
        (["12", "--out", "12.png", "rig.cameras=none"], "rig.cameras"),
        (["4", "--out", "4.png", "rig.cameras=6"], "figure 4: expected no --run, --config or key=value"),
        (["13", "--out", "13.png"], "figure: expected one of 4, 5, 6, 7, 8, 9, 10, 11, 12, 14, 15, 16, got 13"),
    ],
)
def test_wrong_words_are_told_in_one_line(tmp_path, monkeypatch, capsys, words, message):
    monkeypatch.chdir(tmp_path)
    assert message in complaint(capsys, "scenes", "figure", *words)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("number", [14, 15, 16])
def test_a_contact_sheet_by_its_number_frames_every_image_by_its_reason(tmp_path, monkeypatch, capsys, number):
    town = capture()
    monkeypatch.setattr(scene_figures, "record", lambda simulator, seed, settings: town if seed == 3 else None)
    out = tmp_path / "new" / "figure.png"
    assert main(["scenes", "figure", str(number), "--out", str(out), "--seed", "3"]) == 0
    assert capsys.readouterr().out == f"wrote {out}\n"
    assert [file.name for file in out.parent.iterdir()] == ["figure.png"]
    image = pixels(out)
    assert image.shape[1] == WIDTH_PX
    for kind in images.KIND_RGB:
        count = sum(one.view.kind == kind for one in town.images)
        part_count, parts = cv2.connectedComponents(near(image, images.KIND_RGB[kind], 3.0).astype(np.uint8))
        extents = [np.ptp(np.nonzero(parts == part), axis=1) for part in range(1, part_count)]
        frames = [extent for extent in extents if extent.min() > 100]
        assert len(frames) == count, kind
        assert all(extent[1] / extent[0] == pytest.approx(4 / 3, rel=0.02) for extent in frames)
