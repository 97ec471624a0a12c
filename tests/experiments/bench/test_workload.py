"""Benchmark files: read, refused, and put on a device."""

import dataclasses

import numpy as np
import pytest

from tests.experiments.bench.small_workload import SIZE, VEHICLES, small_truth, small_workload
from warpav.core.errors import InputError
from warpav.experiments.bench._workload import (
    WEIGHT_NAMES,
    embedded_truth,
    embedded_workload,
    pack_workload,
    read_truth,
    read_workload,
)


def written(folder, arrays, name="some.npz"):
    np.savez(folder / name, **arrays)
    return folder / name


def test_every_field_is_read(tmp_path):
    arrays = small_workload()
    workload = read_workload(written(tmp_path, arrays))
    assert workload.name == "some.npz"
    assert (workload.size_px, workload.vehicle_count, workload.view_count) == (SIZE, VEHICLES, 12)
    assert workload.is_visible
    assert workload.seed == 11
    for name, key in {
        "vertex_m": "verts",
        "triangle": "faces",
        "vertex_rgb": "colors",
        "triangle_count": "face_counts",
        "vertex_end": "vert_ends",
        "vehicle_weight": "target_w",
        "pose": "cams",
        "height_m": "cam_y",
        "fov_deg": "fov_deg",
        "near_m": "near",
        "scored_pose": "poses20",
    }.items():
        np.testing.assert_array_equal(getattr(workload, name), arrays[key])
    np.testing.assert_array_equal(workload.weight["white"], arrays["w_white"])
    np.testing.assert_array_equal(workload.weight["smooth"], arrays["w_smooth"])
    assert (workload.weight["ones"] == 1.0).all()


def test_every_view_has_its_own_lens(tmp_path):
    models = read_workload(written(tmp_path, small_workload())).models([2, 0])
    assert [round(np.degrees(model.fov_rad)) for model in models] == [55] * 4 + [90] * 4
    assert [model.near_m for model in models] == [0.05] * 4 + [0.1] * 4


def test_objects_keep_their_numbers_on_the_device(device, tmp_path):
    arrays = small_workload()
    workload = read_workload(written(tmp_path, arrays))
    packed = pack_workload(workload, device=device)
    assert packed.object_count == VEHICLES
    found = np.bincount(packed.triangles.triangle_body.numpy())
    others = packed.occluder_count
    np.testing.assert_array_equal(np.r_[found[others:], found[:others]], arrays["face_counts"])
    # corners and colours go together
    corner = packed.triangles.vertex_world_m.numpy()[packed.triangles.triangle.numpy()][:, :, [1, 2, 0]]
    rgb = packed.vertex_rgb.numpy()[packed.triangles.triangle.numpy()]

    def rows(place, colour):
        return sorted(map(tuple, np.concatenate([place, colour], axis=2).reshape(-1, 18).tolist()))

    expected = rows(arrays["verts"][arrays["faces"]], arrays["colors"][arrays["faces"]])
    assert rows(corner, rgb) == expected


def test_objects_may_lack_triangles_and_everything_may_be_a_vehicle(tmp_path):
    arrays = small_workload(vehicle_count=3)
    count, end = arrays["face_counts"], arrays["vert_ends"]
    arrays["n_targets"] = np.int64(len(count))
    arrays["target_w"] = np.ones(len(count))
    arrays["faces"] = np.delete(arrays["faces"], slice(count[0], count[0] + count[1]), axis=0)
    arrays["face_counts"] = np.r_[count[0], 0, count[2:]]
    packed = pack_workload(read_workload(written(tmp_path, arrays)))
    assert packed.object_count == len(count)
    assert len(end) == len(count)
    assert np.isfinite(packed.layer_bounds_world_m.numpy()).all()


def changed(key, change):
    def apply(arrays):
        arrays[key] = change(arrays[key].copy())

    return apply


def put(index, value):
    def change(array):
        array[index] = value
        return array

    return change


@pytest.mark.parametrize(
    ("apply", "message"),
    [
        (lambda arrays: arrays.pop("cams"), "cams: expected an array of this name, got none"),
        (changed("format", lambda _: np.int64(2)), "format: expected 1, got 2"),
        (changed("res", lambda _: np.int64(0)), "res: expected 8 to 16384 pixels, got 0"),
        (changed("res", lambda _: np.float64(96)), "res: expected integers, got float64"),
        (changed("res", lambda _: np.int64(64)), "w_white: expected the shape [64, 64], got [96, 96]"),
        (changed("verts", put((7, 1), np.nan)), "verts: expected finite numbers, got nan at [7, 1]"),
        (changed("verts", lambda v: v[:, :2]), "verts: expected the shape [n, 3], got"),
        (changed("colors", put((0, 0), 1.5)), "colors: expected colours in 0..1, got 1.5 at [0, 0]"),
        (changed("faces", put((0, 0), 9999999)), "faces: expected vertices 0..25 of its own object in face 0"),
        (changed("faces", put((50, 2), 0)), "faces: expected vertices 26..51 of its own object in face 50"),
        (changed("face_counts", put(0, 47)), "face_counts: expected a sum of"),
        (changed("vert_ends", put(0, 500)), "vert_ends: expected ends that rise to"),
        (changed("n_targets", lambda _: np.int64(99)), "n_targets: expected a number of objects, 0..43, got 99"),
        (changed("target_w", lambda w: w[:-1]), "target_w: expected the shape [40], got [39]"),
        (changed("cams", lambda c: c[:0]), "cams: expected at least one camera, got none"),
        (changed("cam_y", lambda y: y[:1]), "cam_y: expected the shape [3], got [1]"),
        (changed("fov_deg", put(1, 0.0)), "fov_deg: expected angles of 1 to 170 degrees, got 0.0 at [1]"),
        (changed("near", put(2, 0.0)), "near: expected distances above 0, got 0.0 at [2]"),
        (changed("visible", lambda _: np.int64(2)), "visible: expected 0 or 1, got 2"),
        (changed("poses20", put((3, 2), np.inf)), "poses20: expected finite numbers, got inf at [3, 2]"),
        (changed("w_smooth", lambda w: w.astype("U8")), "w_smooth: expected numbers, got <U8"),
    ],
)
def test_a_bad_workload_is_told_in_one_line(tmp_path, apply, message):
    arrays = small_workload()
    apply(arrays)
    file = written(tmp_path, arrays)
    with pytest.raises(InputError) as caught:
        read_workload(file)
    assert str(caught.value).startswith(f"{file}: {message}")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("content", [b"", b"not a file of arrays", b"PK\x03\x04 cut off"])
def test_a_file_of_something_else_is_told_in_one_line(tmp_path, content):
    file = tmp_path / "other.npz"
    file.write_bytes(content)
    with pytest.raises(InputError, match=r"other\.npz: expected a benchmark file") as caught:
        read_workload(file)
    assert "\n" not in str(caught.value)


def test_a_single_array_is_no_workload(tmp_path):
    np.save(tmp_path / "one.npy", np.zeros(3))
    with pytest.raises(InputError, match=r"one\.npy: expected a benchmark file"):
        read_workload(tmp_path / "one.npy")


def test_arrays_of_objects_are_not_loaded(tmp_path):
    arrays = small_workload() | {"cams": np.array([{"x": 1}], dtype=object)}
    with pytest.raises(InputError, match="expected a benchmark file"):
        read_workload(written(tmp_path, arrays))


@pytest.mark.parametrize(
    ("apply", "message"),
    [
        (changed("poses", lambda p: p + 1.0), "poses: expected poses20 of some.npz, got other poses"),
        (changed("weights", lambda w: w[:2]), "weights: expected white, smooth, ones, got white, smooth"),
        (changed("grad", lambda g: g[:, :2]), "grad: expected the shape [20, 3, 3], got [20, 2, 3]"),
        (changed("id_views", put(0, 12)), "id_views: expected views 0..11, got 12 at [0]"),
        (changed("ids", lambda i: i[:, :8]), "ids: expected the shape [2, 96, 96]"),
        (lambda arrays: arrays.pop("depth"), "depth: expected an array of this name"),
    ],
)
def test_a_bad_truth_is_told_in_one_line(tmp_path, apply, message):
    arrays = small_workload()
    workload = read_workload(written(tmp_path, arrays))
    truth = small_truth(arrays)
    apply(truth)
    file = written(tmp_path, truth, "truth.npz")
    with pytest.raises(InputError) as caught:
        read_truth(file, workload)
    assert str(caught.value).startswith(f"{file}: {message}")


def test_weights_of_a_truth_may_come_in_any_order(tmp_path):
    arrays = small_workload()
    workload = read_workload(written(tmp_path, arrays))
    truth = small_truth(arrays)
    one = read_truth(written(tmp_path, truth, "one.npz"), workload)
    turned = truth | {k: truth[k][..., ::-1] for k in ("grad", "grad_check", "weights")}
    other = read_truth(written(tmp_path, turned, "two.npz"), workload)
    for name in WEIGHT_NAMES:
        np.testing.assert_array_equal(one.gradient[name], other.gradient[name])


def test_the_embedded_workload_is_the_reference(workload_folder):
    embedded, outside = embedded_workload(), read_workload(workload_folder / "workload.npz")
    assert embedded.is_same_work(outside)
    assert not embedded.is_same_work(dataclasses.replace(outside, near_m=outside.near_m + 0.1))
    ours, theirs = embedded_truth(embedded), read_truth(workload_folder / "truth.npz", outside)
    for name in WEIGHT_NAMES:
        np.testing.assert_array_equal(ours.gradient[name], theirs.gradient[name])
        np.testing.assert_array_equal(ours.check_gradient[name], theirs.check_gradient[name])
    np.testing.assert_array_equal(ours.object_view, theirs.object_view)
    np.testing.assert_array_equal(ours.object_index, theirs.object_index)
    np.testing.assert_array_equal(ours.depth_m, theirs.depth_m)
