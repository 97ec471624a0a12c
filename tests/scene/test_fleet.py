"""Vehicles of other makers in traffic: same places, sizes, categories and velocities, other bodies."""

import shutil

import numpy as np
import pytest
from scipy.stats import binom

from tests.cli.small_run import complaint
from tests.scene.traffic.recordings import street, write
from warpav.core.errors import InputError
from warpav.scene import SHIPPED, SceneRecipe, TownSource, fleet_of, level_scene, vehicle_mesh, write_vehicle
from warpav.scene._cache import built_scenes, scene_file
from warpav.scene._fleet import CATEGORIES, _bodies
from warpav.scene.town._paint import _PAINT_COLOURS
from warpav.scene.town._vehicle_shapes import VARIANT_COUNT, body_size_m
from warpav.scene.traffic.moments import Moment
from warpav.scene.traffic.traffic_scene import TrafficSource
from warpav.scene.vehicles import vehicle_folder

PLACES = (("easy", 0), ("easy", 1), ("urban", 1), ("dense", 0), ("motorway", 1))


@pytest.fixture(scope="module")
def fleet():
    return fleet_of([SHIPPED], 1.0)


@pytest.fixture(scope="module")
def pairs(fleet):
    """Scenes of every level, with the town's own vehicles and with others."""
    return [(level_scene(seed, level), level_scene(seed, level, fleet)) for level, seed in PLACES]


def is_same(one, other):
    names = ("vertex_m", "triangle", "vertex_rgb")
    return all(np.array_equal(getattr(one, name), getattr(other, name)) for name in names)


def exchanged(own, other):
    """Pairs of vehicles of which the second has another mesh."""
    return [(a, b) for a, b in zip(own.vehicles, other.vehicles, strict=True) if not is_same(a.mesh, b.mesh)]


def saloon(folder, name="mine", *, height=1.0, scale=1.0):
    """A car in a GLB file: a mesh that a user may have."""
    mesh = vehicle_mesh("saloon", np.array([0.4, 0.03, 0.03]))
    axle_m = mesh.vertex_m[mesh.vertex_m[:, 2] < 1e-3, 0].min()
    vertex_m = (mesh.vertex_m - [axle_m + 0.1, 0.0, 0.0]) * scale * np.array([1.0, 1.0, height])
    write_vehicle(type(mesh)(vertex_m, mesh.triangle, mesh.vertex_rgb), folder / f"{name}.glb")
    return folder / f"{name}.glb"


# -------------------------------------------------------------------------------------- places and sizes


def test_all_but_the_meshes_of_vehicles_stays(pairs):
    count = 0
    for own, other in pairs:
        assert is_same(own.environment, other.environment)
        assert own.source == other.source
        assert all(is_same(a.mesh, b.mesh) for a, b in zip(own.others, other.others, strict=True))
        for a, b in zip(own.vehicles, other.vehicles, strict=True):
            assert (a.category, a.instance_id, a.box.yaw_rad) == (b.category, b.instance_id, b.box.yaw_rad)
            np.testing.assert_array_equal(a.velocity_ego_m_s, b.velocity_ego_m_s)
        count += len(exchanged(own, other))
    assert count >= 0.95 * sum(len(own.vehicles) for own, _ in pairs)


@pytest.mark.parametrize("category", CATEGORIES)
def test_meshes_fill_the_size_stand_on_the_ground_and_keep_their_wheels_round(fleet, category):
    for body in _bodies(fleet.paths):
        if category not in body.categories:
            continue
        for variant in range(VARIANT_COUNT):
            size_m = body_size_m(category, variant)
            mesh = body.mesh(size_m, np.array([0.4, 0.03, 0.03]), coarse=False)
            low, high = mesh.bounds_m()
            np.testing.assert_allclose(high - low, size_m, atol=1e-4)
            np.testing.assert_allclose(low, [-0.5 * size_m[0], -0.5 * size_m[1], 0.0], atol=1e-4)
            x_m = body.looks[0].vertex_m[:, 0]
            assert len(body.wheel_m) >= 2
            for first_m, last_m in body.wheel_m:
                inside = (x_m >= first_m) & (x_m <= last_m)
                grown = np.ptp(mesh.vertex_m[inside, 0]) / np.ptp(x_m[inside])
                assert grown == pytest.approx(size_m[2] / body.size_m[2], rel=1e-4)
            assert np.all(np.diff(mesh.vertex_m[np.argsort(x_m), 0]) >= -1e-4)  # the front stays the front
            assert body.fits(size_m)


# --------------------------------------------------------------------------------------- draws and looks


def test_as_many_are_exchanged_as_the_share_says(fleet, pairs):
    half = fleet_of([SHIPPED], 0.5)
    could = done = 0
    for (level, seed), (own, other) in zip(PLACES, pairs, strict=True):
        mixed = level_scene(seed, level, half)
        could += len(exchanged(own, other))
        for vehicle, one, every in zip(mixed.vehicles, own.vehicles, other.vehicles, strict=True):
            # each is drawn by itself: whoever is exchanged is exchanged alike, whatever the share
            is_own = is_same(vehicle.mesh, one.mesh)
            assert is_own or is_same(vehicle.mesh, every.mesh)
            done += not is_own
    assert could > 120
    assert binom.ppf(0.0005, could, 0.5) <= done <= binom.ppf(0.9995, could, 0.5)


def test_paint_is_drawn_and_glass_tyres_and_lamps_keep_their_colours(fleet):
    for body in _bodies(fleet.paths):
        look = body.looks[0]
        meshes = [body.mesh(body.size_m, _PAINT_COLOURS[k], coarse=False) for k in (0, 9)]
        differs = (meshes[0].vertex_rgb != meshes[1].vertex_rgb).any(axis=1)
        np.testing.assert_array_equal(differs, look.paint > 0.0)
        assert 0.2 < differs.mean() < 0.7
        red = meshes[1].vertex_rgb[differs].astype(float).mean(axis=0)
        assert red[0] > 1.5 * red[1]
        assert len(np.unique(meshes[0].vertex_rgb[~differs] // 16, axis=0)) > 5


# ------------------------------------------------------------------------------------------ reproducible


def test_scenes_are_kept_by_share_and_content_of_the_meshes(tmp_path):
    folder, kept = tmp_path / "mine", tmp_path / "kept"
    folder.mkdir()
    saloon(folder)
    before = fleet_of([folder], 0.5)
    sources = [TownSource(7), TownSource(7, fleet=before), TownSource(7, fleet=fleet_of([folder], 0.6))]
    saloon(folder, scale=1.04)
    after = fleet_of([folder], 0.5)
    assert before.content != after.content
    sources += [TownSource(7, fleet=after)]
    (folder / "mine.yaml").write_text("category: estate\n")
    sources += [TownSource(7, fleet=fleet_of([folder], 0.5))]
    assert len({scene_file(source, kept) for source in sources}) == len(sources)
    assert len({SceneRecipe(source).file_name for source in sources}) == len(sources)
    with pytest.raises(InputError, match="expected the files of before"):
        before.exchange(0)
    [built] = built_scenes([sources[-1]], folder=kept)
    [again] = built_scenes([sources[-1]], folder=kept)
    assert all(is_same(a.mesh, b.mesh) for a, b in zip(built.vehicles, again.vehicles, strict=True))
    moment = Moment(write(tmp_path, street()), 0, "a")
    assert TrafficSource(moment, 0).fingerprint != TrafficSource(moment, 0, after).fingerprint


# ----------------------------------------------------------------------------------------------- input


def test_what_is_written_beside_a_mesh_counts(tmp_path):
    saloon(tmp_path)
    (tmp_path / "mine.yaml").write_text("category: [suv, van]\nforward: -x\n")
    [body] = _bodies((tmp_path,))
    assert body.categories == ("suv", "van")
    (tmp_path / "mine.yaml").unlink()
    [forward] = _bodies((tmp_path,))
    # turned about: what was the front axle's place is the rear axle's
    assert body.wheel_m[0][0] == pytest.approx(-forward.wheel_m[-1][1], abs=0.05)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("category: saloom", "mine.yaml:1: category[0]: expected one of hatchback, .*; did you mean saloon?"),
        ("category: []", "mine.yaml:1: category: expected at least 1 values, got"),
        ("kind: saloon", "mine.yaml:1: kind: expected one of category, up, forward, scale, got 'kind'"),
        ("up: z\nforward: w", "mine.yaml:2: forward: expected one of x, y, z, -x, -y, -z, got 'w'"),
        ("scale: 0", "mine.yaml:1: scale: expected more than 0, got 0"),
        ("saloon", "mine.yaml:1: expected an object, got 'saloon'"),
        ("forward: y", "mine.yaml: forward: expected an axis across y, which points up, got 'y'"),
        (
            "scale: 0.01",
            "mine.glb: units: expected a vehicle of 2 to 20 m, .*; write scale: 1 into mine.yaml beside it",
        ),
    ],
)
def test_what_is_wrong_beside_a_mesh_is_refused_in_one_line(tmp_path, text, message):
    saloon(tmp_path)
    (tmp_path / "mine.yaml").write_text(text)
    with pytest.raises(InputError, match=message.replace("?", r"\?").replace("[", r"\[")) as caught:
        fleet_of([tmp_path])
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("command", ["option", "flag"])
@pytest.mark.parametrize(
    ("vehicles", "message"),
    [
        ("empty", "expected mesh files (glb, gltf, obj, dae, ply, stl, off, usd, usda, usdc, usdz, step"),
        ("broken", "broken.glb: vehicle: expected a readable glb file"),
        ("nowhere", "no such file"),
        (SHIPPED.replace("pp", "p"), "did you mean shipped?"),
        ("low.ply", "write scale: "),
        ("tall.glb", "expected the size of one of hatchback, saloon, estate, suv, van, lorry, bus, got"),
    ],
)
def test_bad_vehicles_end_with_one_line_and_status_2(tmp_path, monkeypatch, capsys, command, vehicles, message):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty").mkdir()
    (tmp_path / "broken").mkdir()
    (tmp_path / "broken" / "broken.glb").write_bytes(b"no mesh")
    shutil.copy(vehicle_folder() / "bus.glb", tmp_path / "bus.glb")
    import trimesh

    mesh = vehicle_mesh("saloon", np.array([0.5, 0.5, 0.5]))
    trimesh.Trimesh(0.55 * mesh.vertex_m, mesh.triangle, process=False).export(tmp_path / "low.ply")
    saloon(tmp_path, "tall", height=2.4)
    words = {
        "option": ["scenes", "statistics", f"scenes.vehicles={vehicles}", "--seeds", "0..1"],
        "flag": ["scenes", "make", "--count", "1", "--out", "out", "--vehicles", vehicles],
    }[command]
    assert message in complaint(capsys, *words)
    assert not list(tmp_path.glob("out/*"))
