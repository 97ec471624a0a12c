"""Catalogues of camera modules: the shipped one, reading, and messages that lead to the line."""

import math
import re

import numpy as np
import pytest

import warpav as wa
from warpav.core.errors import InputError
from warpav.raster.beams import Radar
from warpav.raster.lens import Lens
from warpav.rig import Housing, Price, builtin_modules, module_table, read_modules
from warpav.rig._module import Fitting, vertical_angle_rad

ONE = """\
modules:
  - name: mine
    sensor_px: [1920, 1080]
    network_px: [960, 540]
    network_by: crop
    lens: fisheye
    fov_deg: 100
    vertical_fov_deg: 56
    distortion: [-0.02, 0.003, 0, 0]
    housing: {size_m: [0.03, 0.03, 0.04], offset_m: [0, 0, -0.01]}
    price: {value: 25, unit: EUR}
    power_w: 0.8
    zones: [roof, mirror]
    role: side
    source: data sheet 7
"""


def catalogue(tmp_path, text):
    file = tmp_path / "mine.yaml"
    file.write_text(text, encoding="utf-8")
    return file


def test_every_field_is_read(tmp_path):
    (found,) = read_modules(catalogue(tmp_path, ONE)).values()
    assert found == wa.Module(
        name="mine",
        sensor_px=(1920, 1080),
        network_px=(960, 540),
        network_by=Fitting.CROP,
        lens=Lens.FISHEYE,
        fov_rad=math.radians(100.0),
        vertical_fov_rad=math.radians(56.0),
        distortion=(-0.02, 0.003, 0.0, 0.0),
        housing=Housing((0.03, 0.03, 0.04), (0, 0, -0.01)),
        price=Price(25, "EUR"),
        power_w=0.8,
        zones=("roof", "mirror"),
        role="side",
        source="data sheet 7",
    )


def test_what_may_be_left_out_has_the_documented_defaults(tmp_path):
    text = "\n".join(
        line for line in ONE.splitlines() if not re.match(r" +(network|lens|vertical|distortion|zones)", line)
    )
    text = text.replace(", offset_m: [0, 0, -0.01]", "").replace("power_w: 0.8", "power_w: null")
    (found,) = read_modules(catalogue(tmp_path, text)).values()
    assert (found.network_px, found.network_by, found.lens) == ((1920, 1080), "scaling", "pinhole")
    assert (found.distortion, found.zones, found.power_w, found.vertical_fov_rad) == ((), (), None, None)
    assert found.housing.offset_m == (0.0, 0.0, 0.0)


def test_a_catalogue_can_extend_the_shipped_one(tmp_path):
    found = read_modules(catalogue(tmp_path, "extends: builtin\n" + ONE))
    assert list(found) == [*builtin_modules(), "mine"]
    assert list(read_modules(catalogue(tmp_path, ONE))) == ["mine"]


def changed(old, new):
    assert ONE.count(old) == 1
    return ONE.replace(old, new)


BAD = {
    "no field": (changed("    fov_deg: 100\n", ""), 2, "modules[0].fov_deg: expected the horizontal", "; add fov_deg"),
    "pinhole too wide": (
        changed("lens: fisheye\n    fov_deg: 100", "lens: pinhole\n    fov_deg: 180").replace(
            "    distortion: [-0.02, 0.003, 0, 0]\n", ""
        ),
        7,
        "modules[0].fov_deg: expected more than 0 and below 180 degrees (pinhole), got 180 degrees",
        "; a fisheye sees more",
    ),
    "vertical": (changed("vertical_fov_deg: 56", "vertical_fov_deg: 75"), 8, "vertical_fov_deg: expected 5", "got 75 "),
    "text for a number": (changed("fov_deg: 100", "fov_deg: wide"), 7, "modules[0].fov_deg: expected the", "'wide'"),
    "housing": (changed("size_m: [0.03,", "size_m: [0,"), 10, "housing.size_m: expected positive", "[0.0, 0.0"),
    "no housing": (changed("{size_m: [0.03, 0.03, 0.04], offset_m: [0, 0, -0.01]}", "null"), 10, "a mapping with", ""),
    "lens": (changed("lens: fisheye", "lens: fish_eye"), 6, "modules[0].lens: expected one", "did you mean fisheye?"),
    "key": (changed("power_w:", "power:"), 12, "modules[0].power: expected one of", "; did you mean power_w?"),
    "zone": (changed("[roof, mirror]", "[roof, roof]"), 13, "modules[0].zones[1]: expected every zone once", "roof"),
    "name twice": (ONE + ONE.removeprefix("modules:\n").replace("mine", "Mine"), 16, "modules[1].name: expected every "
                   "name once, got 'Mine'", "; give it another name than that of modules[0]"),
    "shipped name": (
        "extends: builtin\n" + ONE.replace("mine", "front_8mp_30"),
        3,
        "modules[0].name: expected every name once, got 'front_8mp_30'",
        "than that of the shipped catalogue",
    ),
    "extends": ("extends: other\n" + ONE, 1, "extends: expected builtin, to hold the shipped modules", "got 'other'"),
    "root key": (ONE + "vehicle: car\n", 16, "vehicle: expected one of extends, modules, got 'vehicle'", "; remove it"),
    "a list": ("- name: mine\n", 1, "expected a mapping with extends, modules", ""),
    "a module of text": ("modules:\n  - mine\n", 2, "modules[0]: expected a mapping with name", "'mine'"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_a_mistake_is_one_line_with_its_place(case, tmp_path):
    text, line, told, remedy = BAD[case]
    file = catalogue(tmp_path, text)
    with pytest.raises(InputError) as caught:
        read_modules(file)
    lines = [each for each in str(caught.value).splitlines() if told in each]
    assert len(lines) == 1, str(caught.value)
    assert lines[0].startswith(f"{file}:{line}: ")
    assert remedy in lines[0]
    assert len(str(caught.value).splitlines()) == 1, str(caught.value)


SHIPPED = builtin_modules()


@pytest.mark.parametrize("name", [name for name, each in SHIPPED.items() if not each.beams])
def test_a_shipped_module_is_what_its_name_says(name):
    used = builtin_modules()[name]
    assert used.name == name
    megapixels, fov_deg = re.search(r"_(\d(?:_\d)?)mp_(\d+)", name).groups()
    assert math.prod(used.sensor_px) / 1e6 == pytest.approx(float(megapixels.replace("_", ".")), rel=0.1)
    assert math.degrees(used.fov_rad) == pytest.approx(float(fov_deg))
    # relative prices alone, and no figure without a word on where it is from
    assert used.price.unit == "relative"
    assert "illustrative" in used.source
    assert used.power_w is None
    assert 0.0 < used.price.value < 10.0
    sensor, network = used.sensor_model(), used.camera_model()
    assert vertical_angle_rad(sensor) < sensor.fov_rad
    # all of the network's image shows something, corners included, and its pixels are square
    corner_px = [(0.5, 0.5), (network.width_px - 0.5, 0.5), (0.5, network.height_px - 0.5)]
    assert np.isfinite(network.rays(np.array(corner_px))).all()
    assert network.focal_px is None
    # an optical axis has as many pixels a degree as the lens says
    focal_px = network.intrinsics[0, 0]
    assert used.pixels_per_degree == pytest.approx(math.radians(focal_px))


@pytest.mark.parametrize("name", [name for name, each in SHIPPED.items() if each.beams])
def test_a_shipped_lidar_is_what_its_name_says(name):
    used, beams = SHIPPED[name], SHIPPED[name].beams
    kind, number = re.search(r"(?:lidar|radar)_(flat_|blind_spot|[a-z_]+)?(\d+)?", name).groups()
    if kind is None:
        assert (len(beams.elevation_rad), beams.is_all_round) == (int(number), True)
    elif number is not None:
        assert math.degrees(beams.sector_rad) == pytest.approx(float(number))
    assert "illustrative" in used.source
    assert used.camera_model().near_m == used.least_range_m > 0.5 * math.hypot(*used.housing.size_m)
    low, high = np.sin(beams.ends_rad[[0, -1]])
    expected = beams.count if beams.radar is None else beams.sector_rad * (high - low)
    assert beams.density().sum() == pytest.approx(expected, rel=1e-3)


LIDAR = """\
modules:
  - name: mine
    kind: lidar
    beams: {elevation_deg: [-25, 15], lines: 32, azimuth_step_deg: 0.2, range_m: [80, 150], least_range_m: 0.4}
    housing: {size_m: [0.1, 0.09, 0.1]}
    price: {value: 12, unit: EUR}
    zones: [roof]
    source: data sheet 8
"""


def test_a_lidar_is_read_and_its_rig_comes_back(tmp_path):
    (found,) = read_modules(catalogue(tmp_path, LIDAR)).values()
    assert found.beams.count == 57_600
    assert np.degrees(found.beams.elevation_rad[:2]) == pytest.approx([-25, -25 + 40 / 31])
    pattern = tmp_path / "scan.csv"
    shots = np.random.default_rng(0).uniform([-30, -10], [30, 10], (4000, 2))
    pattern.write_text("azimuth_deg,elevation_deg\n" + "\n".join(f"{a},{e}" for a, e in shots))
    by_angles = "elevation_deg: [-25, 15], lines: 32, azimuth_step_deg: 0.2"
    (scanner,) = read_modules(catalogue(tmp_path, LIDAR.replace(by_angles, "pattern: scan.csv"))).values()
    assert scanner.beams.count == pytest.approx(4000, rel=0.01)
    (radar,) = read_modules(catalogue(tmp_path, RADAR)).values()
    assert radar.beams.radar == Radar((150.0, 60.0, 80.0), 0.5, 0.3, 0.9)
    assert np.degrees(radar.beams.ends_rad) == pytest.approx([-8.5, 0.0, 8.5])
    models = [each.camera_model() for each in (found, scanner, radar)]
    cameras = [wa.Camera(f"lidar_{k}", [k, 0, 2], model=model) for k, model in enumerate(models)]
    wa.write_rig(wa.Rig(cameras), tmp_path / "rig.yaml")
    back = wa.read_rig(tmp_path / "rig.yaml")
    assert [each.model for each in back.cameras] == models


RADAR = re.sub(
    "lidar\n    beams: .*",
    "radar\n    radar: {azimuth_deg: [-60, 60], elevation_deg: [-8.5, 8.5], least_range_m: 0.3, cell_m: 0.5, cell_deg: "
    "3, range_m: {vehicle: 150, pedestrian: 60, cyclist: 80}, visible_share: 0.3, probability: 0.9}",
    LIDAR,
)


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ("elevation_deg: [-25, 15]", "elevation_deg: [15, -25]", "beams: elevation_rad: expected 2 to 4096 ascending"),
        ("range_m: [80, 150]", "range_m: [0, 150]", "beams: range_m: expected positive, ascending"),
        ("least_range_m: 0.4", "least_range_m: 0.01", "least_range_m: expected metres from 0.084"),
        ("lines: 32, ", "lines: 32, rate_hz: 5000, ", "beams: rate_hz: expected more than 0 and up to 1000"),
        ("azimuth_step_deg: 0.2, ", "", "beams.azimuth_step_deg: expected degrees from a shot"),
        ("    kind: lidar\n", "", "sensor_px: expected columns and rows"),
        ("    zones: [roof]\n", "    zones: [roof]\n    lens: fisheye\n", "lens: expected nothing of another kind"),
        ("elevation_deg: [-25, 15], lines: 32, azimuth_step_deg: 0.2", "pattern: none.csv", "none.csv"),
        (", cyclist: 80", "", "radar.range_m.cyclist: expected metres, such as 80, got nothing"),
        ("visible_share: 0.3", "visible_share: 1.3", "radar: visible_share: expected a share between 0 and 1"),
        ("probability: 0.9", "probability: 95", "radar: probability: expected more than 0, at most 1, got 95"),
        ("cell_deg: 3", "cell_deg: 300", "radar: step_rad: expected a positive angle within the sector"),
    ],
)
def test_a_mistake_in_a_lidar_is_one_line(tmp_path, old, new, told):
    text = LIDAR if old in LIDAR else RADAR
    assert text.count(old) == 1
    with pytest.raises(InputError) as caught:
        read_modules(catalogue(tmp_path, text.replace(old, new)))
    assert told in str(caught.value)
    assert len(str(caught.value).splitlines()) == 1


def test_the_table_says_what_the_network_gets(tmp_path):
    lines = module_table(read_modules(catalogue(tmp_path, ONE))).splitlines()
    assert len(lines) == 2
    cells = re.split(r" {2,}", lines[1])
    (used,) = read_modules(catalogue(tmp_path, ONE)).values()
    assert cells == [
        "mine",
        "1920 x 1080",
        "960 x 540 crop",
        "fisheye",
        f"{math.degrees(used.camera_model().fov_rad):.1f}",
        f"{used.pixels_per_degree:.1f}",
        "25 EUR",
        "0.8",
        "side",
        "roof, mirror",
        "data sheet 7",
    ]
