"""JSON Schemas of files: what ships is valid, every key that a reader knows is there, and no other."""

import copy
import re
from pathlib import Path

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from warpav.core.errors import InputError
from warpav.core.yaml_file import read_yaml
from warpav.rig import read_modules, read_rig, read_zones
from warpav.runs.config import file_schema, load_config
from warpav.sight import read_requirements

jsonschema = pytest.importorskip("jsonschema", reason="jsonschema is not installed")

ROOT = Path(__file__).parents[2]
READERS = {
    "config": lambda file: load_config(str(file)),
    "rig": read_rig,
    "modules": read_modules,
    "zones": read_zones,
    "requirements": read_requirements,
}
SHIPPED = {
    "config": sorted((ROOT / "configs").glob("*.yaml")),
    "rig": sorted((ROOT / "warpav/rig/presets").glob("*.yaml")),
    "modules": [ROOT / "warpav/rig/modules.yaml"],
    "requirements": sorted((ROOT / "warpav/sight/templates").glob("*.yaml")),
}
EVERY_KEY = {
    "rig": """
frame: ego
panes:
  pane: {normal: [0, 0, 1], outline_m: [[0, 0, 1], [1, 0, 1], [1, 1, 1]], reach_m: [-0.1, 0.1]}
cameras:
  - {name: a, position_m: [1, 0, 1.5], yaw_deg: 0, pitch_deg: 0, roll_deg: 0, lens: fisheye, fov_deg: 190.0,
     width_px: 64, height_px: 64, distortion: [0.0, 0.0, 0.0, 0.0], behind_glass: pane}
  - {name: b, position_m: [1, 0, 1.5], yaw_deg: 0, pitch_deg: 0, roll_deg: 0, focal_px: [50, 50], centre_px: [32, 32],
     width_px: 64, height_px: 64}
  - {name: c, position_m: [1, 0, 1.5], yaw_deg: 0, pitch_deg: 0, roll_deg: 0, module: side_2mp_100}
  - name: d
    position_m: [1, 0, 1.8]
    yaw_deg: 0
    pitch_deg: 0
    roll_deg: 0
    beams: {elevation_deg: [-10, 10], lines: 2, azimuth_step_deg: 1, azimuth_deg: [-90, 90], range_m: [50, 90],
            least_range_m: 0.5, rate_hz: 10, weight: [[1], [2]]}
  - {name: e, position_m: [1, 0, 1.8], yaw_deg: 0, pitch_deg: 0, roll_deg: 0, radar: {azimuth_deg: [-60, 60],
     elevation_deg: [-8, 8], range_m: {vehicle: 150, pedestrian: 60, cyclist: 80}, least_range_m: 0.5, cell_m: 0.5,
     cell_deg: 3, visible_share: 0.3, probability: 0.9, rate_hz: 15}}
""",
    "modules": """
extends: builtin
modules:
  - {name: a, sensor_px: [640, 480], network_px: [320, 240], network_by: scaling, lens: fisheye, fov_deg: 120,
     vertical_fov_deg: 90, distortion: [0, 0, 0, 0], housing: {size_m: [0.03, 0.03, 0.03], offset_m: [0, 0, 0]},
     price: {value: 1, unit: EUR}, power_w: null, zones: [roof], role: front, source: a guess}
  - name: b
    kind: lidar
    beams: {elevation_deg: [-10, 10], lines: 2, azimuth_step_deg: 1, azimuth_deg: [-90, 90], range_m: [50, 90],
            least_range_m: 0.5, rate_hz: 10, weight: [[1], [2]]}
    housing: {size_m: [0.1, 0.1, 0.1]}
    price: {value: 1, unit: EUR}
    source: a guess
  - {name: c, kind: radar, housing: {size_m: [0.1, 0.1, 0.1]}, price: {value: 1, unit: EUR}, source: a guess,
     radar: {azimuth_deg: [-60, 60], elevation_deg: [-8, 8], range_m: {vehicle: 150, pedestrian: 60, cyclist: 80},
     least_range_m: 0.5, cell_m: 0.5, cell_deg: 3, visible_share: 0.3, probability: 0.9, rate_hz: 15}}
""",
    "zones": """
zones:
  roof: {normal: up, kind: [rack, roof], box_m: [[-1, -1, 1], [1, 1, 2]], keep_out_m: [[[0, 0, 0], [1, 1, 1]]],
         origin_m: [0, 0, 0], stand_off_m: 0.02, recess_m: 0.01, yaw_deg: [0, 90], pitch_deg: 5, roll_deg: null,
         mirror: true}
  glass: {normal: [0.6, 0, 0.8], centred: true, behind_glass: true, outline_m: [[0, 0, 0], [0, 1, 0], [1, 0, 0]]}
""",
    "requirements": """
requirements:
  a: {area: {around_m: [0, 5]}, grid_m: 0.5, object: post, visible_share: 0.5, pixels: 10, cameras: 2, sector: front,
      hard: true}
  b: {area: {strip: {side: left, distance_m: [0, 2], along_m: [0, 1]}}, grid_m: 1, weight: 0.1, share: 0.9,
      sector: [10, 20], object: {kind: child, height_m: 1, width_m: 0.2, length_m: 0.2, yaw_deg: 10}}
  c: {area: {box_m: [[0, 0], [1, 1]]}, grid_m: 1, object: adult}
  d: {area: {polygon_m: [[0, 0], [1, 0], [1, 1]]}, grid_m: 1, object: lying}
checks: {far_m: null, traffic_lights: 0.9, redundancy: 0.5, camera_loss: 0.2, tolerance: false, hard: [redundancy]}
""",
}
UNUSED = {"modules", "mesh", "pattern"}  # keys that name files, and are not in these


def checker(of):
    return jsonschema.Draft202012Validator(file_schema(of))


def mistakes(of, data):
    return [f"{error.json_path}: {error.message}" for error in checker(of).iter_errors(data)]


def schema_of(of):
    schema = file_schema(of)
    return inlined(schema, schema)


def inlined(schema, root):
    """The schema with what ``$ref`` leads to in its place."""
    if isinstance(schema, list):
        return [inlined(each, root) for each in schema]
    if not isinstance(schema, dict):
        return schema
    if "$ref" in schema:
        return inlined(root["$defs"][schema["$ref"].rpartition("/")[2]], root)
    return {name: inlined(each, root) for name, each in schema.items() if name != "$defs"}


def mappings(data, schema):
    """All mappings of the data whose keys are fixed: where the schema has properties."""
    found = []
    for option in [schema, *schema.get("anyOf", ())]:
        if isinstance(data, dict) and "properties" in option and option.get("additionalProperties") is False:
            found.append(data)
            found += [each for key in data for each in mappings(data[key], option["properties"].get(key, {}))]
        elif isinstance(data, dict) and isinstance(option.get("additionalProperties"), dict):
            found += [each for value in data.values() for each in mappings(value, option["additionalProperties"])]
        elif isinstance(data, list) and "items" in option:
            found += [each for value in data for each in mappings(value, option["items"])]
    return found


def keys_of(schema):
    """All keys that a schema knows, anywhere."""
    inner = [*schema.get("anyOf", ()), *schema.get("properties", {}).values()]
    inner += [schema[name] for name in ("items", "additionalProperties") if isinstance(schema.get(name), dict)]
    own = schema.get("properties", {}) if schema.get("additionalProperties") is False else {}
    return {*own, *(key for each in inner if isinstance(each, dict) for key in keys_of(each))}


@pytest.mark.parametrize(("of", "file"), [(of, file) for of, files in SHIPPED.items() for file in files])
def test_shipped_files_are_valid(of, file):
    assert mistakes(of, read_yaml(file)[0]) == []


def test_examples_of_the_documentation_are_valid():
    count = 0
    for page in ("guide/series_car.md", "reference/files.md"):
        for text in re.findall(r"^```yaml\n(.*?)^```$", (ROOT / "docs" / page).read_text(), re.MULTILINE | re.DOTALL):
            data = read_yaml(text)[0] or {}
            of = {"zones": "zones", "modules": "modules", "requirements": "requirements", "cameras": "rig"}
            of = next((of[key] for key in of if isinstance(data.get(key), (dict, list))), None)
            if of and "as usual" not in text:
                assert mistakes(of, data) == [], f"{page}: {text}"
                count += 1
    assert count >= 5


@pytest.mark.parametrize("of", EVERY_KEY)
def test_readers_and_schemas_know_the_same_keys(of, tmp_path):
    data = read_yaml(EVERY_KEY[of])[0]
    (tmp_path / "file.yaml").write_text(EVERY_KEY[of])
    READERS[of](tmp_path / "file.yaml")  # so the reader knows all of these
    assert mistakes(of, data) == []
    used = {key for each in mappings(data, schema_of(of)) for key in each}
    assert keys_of(schema_of(of)) - used <= UNUSED
    for one in mappings(data, schema_of(of)):  # and the schema all that the reader does
        one["unheard_of"] = 1
        (tmp_path / "file.yaml").write_text(yaml.safe_dump(data, sort_keys=False))
        with pytest.raises(InputError) as error:
            READERS[of](tmp_path / "file.yaml")
        del one["unheard_of"]
        known = re.search(r"expected (?:one of |the key )([\w, ]+?)(?: alone)?, got ", str(error.value))
        assert set(known[1].split(", ")) <= keys_of(schema_of(of)) | {of}  # by name


@pytest.mark.parametrize("of", EVERY_KEY)
@settings(max_examples=60)
@given(draw=st.data())
def test_a_changed_key_is_refused_by_both(of, draw, tmp_path_factory):
    data = copy.deepcopy(read_yaml(EVERY_KEY[of])[0])
    some = draw.draw(st.sampled_from([each for each in mappings(data, schema_of(of)) if each]))
    key = draw.draw(st.sampled_from(sorted(some)))
    place = draw.draw(st.integers(0, len(key)))
    other = key[:place] + draw.draw(st.sampled_from("xq_zj")) + key[place + draw.draw(st.integers(0, 1)) :]
    if other in keys_of(schema_of(of)):
        return
    some[other] = some.pop(key)
    file = tmp_path_factory.mktemp("mutated") / "file.yaml"
    file.write_text(yaml.safe_dump(data, sort_keys=False))
    assert mistakes(of, data), (key, other)
    with pytest.raises(InputError):
        READERS[of](file)
