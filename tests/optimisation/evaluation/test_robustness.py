"""Dirt and loads: against masks of pixels, the loss of a camera, and renders of a vehicle that is moved itself."""

import math
from dataclasses import replace

import numpy as np
import pytest

import warpav as wa
from tests.driving_scene import street
from tests.optimisation.test_modules import columns, models, probabilities, symmetric_cameras
from warpav.core.errors import InputError
from warpav.optimisation import LoadState, PosedRig, SoiledPart, Soiling
from warpav.optimisation._mount import views_of_rig
from warpav.optimisation.evaluation._perturbations import loaded_scene, soiled_scene
from warpav.raster.camera import CameraModel
from warpav.raster.renderer import Renderer
from warpav.rig import Rig, RigCamera
from warpav.scene import DeviceScene

PARTS = [
    SoiledPart("disc", (0.5, 0.5), 0.2),
    SoiledPart("disc", (0.1, 0.9), 0.3),
    SoiledPart("rows", (0.5, 0.6), 0.25),
    SoiledPart("columns", (1.0, 0.5), 0.5),
]
MODELS = [
    CameraModel(160, 120, math.radians(90.0)),
    CameraModel(160, 120, math.radians(90.0), lens="brown_conrady", distortion=(-0.1, 0.01, 0.0, 0.0)),
    CameraModel(160, 160, math.radians(190.0), lens="fisheye"),
    CameraModel(320, 80, 2.0 * math.pi, lens="panorama"),
]


@pytest.fixture(scope="module")
def town():
    return next(iter(wa.town([5000])))


def pixel_centres(model):
    row, column = np.mgrid[: model.height_px, : model.width_px] + 0.5
    return np.stack([column, row], axis=-1)


@pytest.fixture(scope="module")
def cameras_and_clean_images(town):
    """A camera of each lens, and what it sees without dirt."""
    one = RigCamera("one", np.array([1.3, 0.1, 2.6]), 0.4, 0.2, 0.1)
    cameras = [replace(one, name=model.lens, model=model) for model in MODELS]
    images = wa.render(Rig(cameras), town)
    return {camera.name: (camera, images[camera.name]) for camera in cameras}


@pytest.mark.parametrize("part", PARTS, ids=str)
@pytest.mark.parametrize("model", MODELS, ids=lambda model: model.lens)
def test_dirt_covers_its_part_of_the_image_and_nothing_else(town, cameras_and_clean_images, model, part):
    one, clean = cameras_and_clean_images[model.lens]
    dirty = wa.render(Rig([one]), soiled_scene(town, one, part))[one.name]
    is_soiled = dirty.depth_m < 1.3 * model.near_m  # nothing else is as near: the own roof is a metre below
    expected = part.covers(pixel_centres(model), model)
    # the outline is a polygon, so that some pixels on it differ; worst seen 0.5 %
    assert (is_soiled != expected).mean() < 0.01
    assert expected.mean() == part.covered_share(model)
    np.testing.assert_array_equal(dirty.object_index[is_soiled], 0)
    np.testing.assert_array_equal(dirty.object_index[~is_soiled], clean.object_index[~is_soiled])


@pytest.fixture(scope="module")
def problem():
    placement = wa.Placement(wa.town([0]), cameras=3)
    return placement, wa.highest_rig(placement), wa.town([5001])


def test_a_camera_that_is_covered_all_over_is_lost(problem):
    placement, rig, scenes = problem
    found = wa.robustness.soiling(rig, scenes, placement, shape="rows", share=1.0)
    outages = wa.evaluate(rig, scenes, placement).camera_outage["rig"]
    assert [each.camera for each in found.cameras] == [camera.name for camera in rig.cameras]
    assert found.expected_misses_per_100 == pytest.approx(outages.expected_misses_per_100, abs=1e-3)
    for soiled, lost in zip(found.cameras, outages.cameras, strict=True):
        assert soiled.covered_share == 1.0
        assert soiled.expected_misses_per_100 == pytest.approx(lost.expected_misses_per_100, abs=1e-3)
    assert found.worst.camera == outages.worst.camera
    assert found.worst.difference_per_100 > 1.0


def test_dirt_costs_nothing_where_nobody_is_and_something_where_they_are(problem):
    placement, rig, scenes = problem
    sky, middle = (
        wa.robustness.soiling(rig, scenes, placement, shape="rows", place=(0.5, y), share=0.1) for y in (0.05, 0.5)
    )
    assert [each.difference_per_100 for each in sky.cameras] == pytest.approx([0.0] * 3, abs=1e-3)
    assert min(each.difference_per_100 for each in middle.cameras) >= 0.0
    assert middle.worst.difference_per_100 > 10.0  # objects stand around the horizon
    assert middle.worst.camera in str(middle.table())
    assert "band of rows around 50% of the width and 50% of the height" in str(middle.table())


def test_of_a_symmetric_rig_each_camera_of_a_pair_is_soiled_by_itself():
    """Against all cameras of the rig rendered one by one where they stand, without a mount that knows of pairs."""
    cameras, pose, scenes = symmetric_cameras(), columns()[:10], [street(6, 0), street(4, 1)]
    part, rig = SoiledPart("columns", (0.3, 0.5), 0.4), cameras.mount.rig(pose)
    assert len(pose) < len(rig.cameras) < 2 * len(pose)
    of_model = dict(zip(models(), probabilities(), strict=True))

    def detected(camera, scene):
        packed = DeviceScene.pack(scene)
        views = views_of_rig(Rig([camera]), rotation_count=1, rotation_step_rad=0.0)
        frame = Renderer([camera.model]).render(packed.raster, views.position_ego_m, views.camera_from_ego)
        seen = of_model[camera.model].model.of_coverage(frame, packed, views.position_ego_m, views.camera_from_ego)
        return seen.probability.numpy()[0]

    clean = [[detected(each, scene) for scene in scenes] for each in rig.cameras]

    def misses(soiled=None):
        rows = list(clean)
        if soiled is not None:
            camera = rig.cameras[soiled]
            rows[soiled] = [detected(camera, soiled_scene(scene, camera, part)) for scene in scenes]
        together = np.array([np.concatenate(row) for row in rows], np.float64)
        return 100.0 * np.prod(1.0 - together, axis=0).mean()

    names = [camera.name for camera in rig.cameras]
    found = Soiling.of(PosedRig(names, pose, cameras), scenes, part)
    assert [each.camera for each in found.cameras] == names
    assert found.expected_misses_per_100 == pytest.approx(misses(), abs=0.1)
    for k, each in enumerate(found.cameras):
        assert each.expected_misses_per_100 == pytest.approx(misses(k), abs=0.1), each.camera
    row, cost = cameras.mount.rows_of_cameras(pose), np.array([each.difference_per_100 for each in found.cameras])
    is_pair = row[1:] == row[:-1]
    assert np.abs(np.diff(cost))[is_pair].max() > 0.5


def moved_with(transform, one):
    """The camera of the same vehicle in the frame that a transform leads to."""
    return RigCamera.at(one.name, transform @ one.ego_from_camera, one.model)


@pytest.mark.parametrize(("pitch_deg", "height_m"), [(2.0, 0.0), (-3.0, -0.1), (0.0, 0.3)])
def test_under_a_load_the_world_moves_as_if_the_vehicle_did(town, pitch_deg, height_m):
    """The same images come of a pitched and raised vehicle, body and cameras, in a world that stays."""
    state = LoadState(pitch_deg, height_m)
    angle = math.radians(pitch_deg)
    nose_down = np.eye(4)
    nose_down[:3, :3] = [[math.cos(angle), 0, math.sin(angle)], [0, 1, 0], [-math.sin(angle), 0, math.cos(angle)]]
    nose_down[2, 3] = height_m
    rig = Rig(
        RigCamera(f"c{k}", np.array([1.3, 0.1, 1.62]), yaw, 0.1, 0.02, model)
        for k, (yaw, model) in enumerate(zip((0.3, 2.0, -1.5, 3.0), MODELS, strict=True))
    )
    of_load = wa.render(rig, loaded_scene(town, state))
    body = town.ego.transformed(nose_down[:3, :3], nose_down[:3, 3])
    directly = wa.render(Rig(moved_with(nose_down, one) for one in rig.cameras), replace(town, ego=body))
    level = wa.render(rig, town)
    for name, image in of_load.items():
        differs = (image.object_index != directly[name].object_index).mean()
        assert differs < 0.002  # worst seen 0.0006: float32 on outlines
        world = image.object_index == 0  # the own body stays
        for other in (directly, level):
            world &= (other[name].object_index == 0) & np.isfinite(image.depth_m) & np.isfinite(other[name].depth_m)
        depth_m, expected_m, level_m = (each.depth_m[world] for each in (image, directly[name], level[name]))
        assert np.quantile(np.abs(depth_m / expected_m - 1.0), 0.95) < 1e-5
        assert (np.abs(depth_m / level_m - 1.0) > 1e-3).mean() > 0.1  # walls beside it keep their depth
    ahead = np.array([math.cos(angle), 0.0, math.sin(angle)])  # where the level line ahead lies: nose down, higher
    box = loaded_scene(town, state).vehicles[0].box
    expected = np.linalg.inv(nose_down) @ np.append(town.vehicles[0].box.center_m, 1.0)
    np.testing.assert_allclose(box.center_m, expected[:3], atol=1e-9)
    np.testing.assert_allclose(state.ground_from_ego[:3, :3] @ ahead, [1.0, 0.0, 0.0], atol=1e-12)


def test_no_load_costs_nothing_and_names_stay(problem):
    placement, rig, scenes = problem
    found = wa.robustness.load_states(rig, scenes, placement, states={"none": (0.0, 0.0), "steep": (12.0, 0.0)})
    assert [each.name for each in found.states] == ["none", "steep"]
    assert found.states[0].difference_per_100 == pytest.approx(0.0, abs=1e-4)
    assert found.worst.name == "steep"
    assert found.worst.difference_per_100 > 0.2
    assert "+12.0" in str(found.table())
    usual = wa.robustness.load_states(rig, scenes, placement)
    assert [each.name for each in usual.states] == ["nose down", "nose up", "laden"]
    assert usual.expected_misses_per_100 == found.expected_misses_per_100


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"shape": "star"}, "shape: expected one of disc, rows, columns, got 'star'"),
        ({"place": (0.5, 1.2)}, r"place: expected two shares of the image from 0 to 1, got \(0.5, 1.2\)"),
        ({"share": 0.0}, r"share: expected a share of the image's area in \(0, 1\], got 0.0"),
        ({"share": math.nan}, "share: expected a share"),
    ],
)
def test_dirt_that_cannot_be_is_one_line(problem, options, words):
    placement, rig, scenes = problem
    with pytest.raises(InputError, match=words):
        wa.robustness.soiling(rig, scenes, placement, **options)


def test_loads_and_placements_that_cannot_be_are_one_line(problem):
    placement, rig, scenes = problem
    with pytest.raises(InputError, match=r"pitch_deg: expected an angle within 30, got 31\.0"):
        wa.robustness.load_states(rig, scenes, placement, states={"much": (31.0, 0.0)})
    with pytest.raises(InputError, match="height_m: expected a finite number, got inf"):
        wa.robustness.load_states(rig, scenes, placement, states={"up": (0.0, math.inf)})
    with pytest.raises(InputError, match="states: expected at least one load, got none"):
        wa.robustness.load_states(rig, scenes, placement, states={})
    thesis = wa.Placement(wa.town([0]), cameras=3, losses={"detected_area": 1.0})
    with pytest.raises(InputError, match=r"losses: expected the expected_miss_rate alone, .*, for what dirt costs"):
        wa.robustness.soiling(rig, scenes, thesis)
