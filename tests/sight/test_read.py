"""Files of requirements: what is read, and what is rejected and how."""

import math

import numpy as np
import pytest
import trimesh

from warpav.core.errors import InputError
from warpav.sight import read_requirements
from warpav.sight._read import template_names
from warpav.sight._requirement import SIZES_M, Band, Polygon, Strip

POST = "area: {around_m: [0, 5]}, grid_m: 0.5, object: post"


def written(folder, *lines):
    path = folder / "mine.yaml"
    path.write_text("\n".join(["requirements:", *(f"  {line}" for line in lines)]) + "\n", encoding="utf-8")
    return path


def test_everything_that_can_be_said_is_read(tmp_path):
    trimesh.creation.box(extents=[0.4, 0.6, 1.0]).export(tmp_path / "dummy.stl")
    found = read_requirements(
        written(
            tmp_path,
            f"plain: {{{POST}}}",
            "full: {area: {strip: {side: rear, distance_m: [0.3, 3.5], along_m: [-1, 1]}}, grid_m: 0.2, pixels: 80,",
            "       object: {kind: child, height_m: 0.9, yaw_deg: 90}, visible_share: 0.8, cameras: 2, sector: rear,",
            "       weight: 2.5}",
            "own: {area: {box_m: [[-3, -1], [-2, 1]]}, grid_m: 1, object: {mesh: dummy.stl}, hard: true,",
            "      sector: [-90, 90]}",
            "free: {area: {polygon_m: [[5, 0], [7, 0], [6, 2]]}, grid_m: 1, object: lying}",
        )
    )
    plain, full, own, free = found
    assert (plain.name, plain.area, plain.visible_share, plain.pixels) == ("plain", Band((0.0, 5.0)), 0.5, 0.0)
    assert (plain.cameras, plain.sector_rad, plain.is_hard) == (1, None, True)
    assert full.area == Strip("rear", (0.3, 3.5), (-1.0, 1.0))
    assert (full.visible_share, full.pixels, full.cameras, full.weight) == (0.8, 80.0, 2, 2.5)
    assert full.sector_rad == pytest.approx((0.875 * math.pi, 1.125 * math.pi))
    assert full.test_object.size_m == (0.2, 0.3, 0.9)
    # turned to the left: its width lies along x
    np.testing.assert_allclose(full.test_object.body.bounds_m(), [[-0.15, -0.1, 0.0], [0.15, 0.1, 0.9]], atol=1e-6)
    assert own.area == Polygon(((-3.0, -1.0), (-2.0, -1.0), (-2.0, 1.0), (-3.0, 1.0)))
    assert own.test_object.kind == "dummy"
    np.testing.assert_allclose(own.test_object.body.bounds_m(), [[-0.2, -0.3, 0.0], [0.2, 0.3, 1.0]], atol=1e-6)
    assert own.sector_rad == pytest.approx((-0.5 * math.pi, 0.5 * math.pi))
    assert free.test_object.size_m == SIZES_M["lying"]


def test_every_template_is_read_and_says_what_it_is():
    assert template_names() == ["near_field", "near_robot", "near_series", "r158_like", "r159_like", "r46_like"]
    for name in template_names():
        found = read_requirements(name)
        assert found
        assert all(each.is_hard for each in found) == (not name.startswith("near_"))
    (near,) = read_requirements("near_field")
    assert (near.weight, near.share) == (0.1, 0.99)
    assert (near.area, near.test_object.kind, near.test_object.size_m[2]) == (Band((0.0, 5.0)), "post", 1.1)


@pytest.mark.parametrize(
    ("line", "text"),
    [
        (f"a: {{{POST}, visible_shar: 0.5}}", "mine.yaml:2: .*visible_shar: .*did you mean visible_share"),
        (f"a: {{{POST}, visible_share: 1.5}}", "a.visible_share: expected a share above 0 and up to 1.*, got 1.5"),
        (f"a: {{{POST}, cameras: 0}}", "a.cameras: expected at least 1 camera.*, got 0"),
        (f"a: {{{POST}, cameras: 1.5}}", "a.cameras: .* a whole number.*, got 1.5"),
        (f"a: {{{POST}, pixels: -1}}", "a.pixels: expected an area of 0 px"),
        (f"a: {{{POST}, hard: true, weight: 1}}", "a.weight: expected no weight of a hard requirement"),
        (f"a: {{{POST}, hard: false}}", "a.hard: expected a weight beside it"),
        (f"a: {{{POST}, weight: 1, share: 1.5}}", "a.share: expected a share of the points above 0 and up to 1"),
        (f"a: {{{POST}, share: 0.9}}", "a.share: expected none of a hard requirement"),
        (f"a: {{{POST}, hard: maybe}}", "a.hard: expected true or false.*, got 'maybe'"),
        (f"a: {{{POST}, weight: 0}}", "a.weight: expected a positive number.*, got 0"),
        (f"a: {{{POST}, sector: raer}}", "a.sector: expected one of front, .*got 'raer'; did you mean rear"),
        (f"a: {{{POST}, sector: [90, -90]}}", "a.sector: expected two yaws in degrees, counter-clockwise"),
        ("a: {area: {around_m: [0, 5]}, grid_m: 0, object: post}", "a.grid_m: expected a positive number"),
        ("a: {area: {around_m: [0, 5]}, object: post}", "a.grid_m: expected a positive number.*, got nothing; add"),
        ("a: {area: {around_m: [0, 5]}, grid_m: 1, object: poste}", "a.object.kind: .*; did you mean post"),
        ("a: {area: {around_m: [0, 5]}, grid_m: 1, object: {height_m: 1}}", "expected one of kind and mesh, got none"),
        ("a: {area: {around_m: [0, 5]}, grid_m: 1, object: {kind: post, heght_m: 1}}", "did you mean height_m"),
        ("a: {area: {around_m: [0, 5]}, grid_m: 1, object: {mesh: none.stl}}", "a.object.mesh: .*expected a mesh file"),
        ("a: {area: {around_m: [0, 5]}, grid_m: 1, object: {mesh: none.stl, width_m: 1}}", "no size of a mesh"),
        ("a: {area: {around_m: [5, 0]}, grid_m: 1, object: post}", "around_m: expected a range, the lower end"),
        ("a: {area: {around_m: [-1, 1]}, grid_m: 1, object: post}", "around_m: expected distances of 0 m or more"),
        ("a: {area: {around: [0, 5]}, grid_m: 1, object: post}", "did you mean around_m"),
        ("a: {area: {}, grid_m: 1, object: post}", "a.area: expected one of around_m, strip, .*, got none"),
        ("a: {area: {around_m: [0, 1], box_m: [[0, 0], [1, 1]]}, grid_m: 1, object: post}", "got around_m, box_m"),
        ("a: {area: {box_m: [[1, 0], [0, 1]]}, grid_m: 1, object: post}", "box_m: expected a box: its lowest corner"),
        ("a: {area: {polygon_m: [[0, 0], [1, 1]]}, grid_m: 1, object: post}", "expected at least three corners"),
        ("a: {area: {strip: {side: back, distance_m: [0, 1]}}, grid_m: 1, object: post}", "side: expected one of"),
        ("a: 3", "requirements.a: expected a mapping with area"),
    ],
)  # fmt: skip
def test_mistakes_are_named_with_their_line(tmp_path, line, text):
    with pytest.raises(InputError, match=text):
        read_requirements(written(tmp_path, line))


def test_files_that_hold_no_requirements_are_rejected(tmp_path):
    with pytest.raises(
        InputError, match=r"expected a YAML file or one of .*got 'nearfield'; did you mean near_field\?"
    ):
        read_requirements("nearfield")
    with pytest.raises(InputError, match=r"none\.yaml: expected a readable YAML file"):
        read_requirements(tmp_path / "none.yaml")
    (tmp_path / "mine.yaml").write_text("requirement: {}\n", encoding="utf-8")
    with pytest.raises(InputError, match=r"mine.yaml:1: .*did you mean requirements\?"):
        read_requirements(tmp_path / "mine.yaml")
    (tmp_path / "mine.yaml").write_text("requirements: {}\n", encoding="utf-8")
    with pytest.raises(InputError, match="at least one requirement"):
        read_requirements(tmp_path / "mine.yaml")
    with pytest.raises(InputError, match="expected every key once"):
        read_requirements(written(tmp_path, f"a: {{{POST}}}", f"a: {{{POST}}}"))
