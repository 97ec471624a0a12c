"""The configuration: strict reading, messages with their place, round trips, the shipped files."""

import math

import pytest

from warpav.core.errors import InputError, OptionError
from warpav.optimisation import FreeRanges
from warpav.runs._mounts import camera_model, free_ranges, objective_options
from warpav.runs.config import (
    Config,
    config_names,
    described_options,
    dump_config,
    load_config,
    option_values,
    overrides_from,
    placed_config,
)


@pytest.fixture
def yaml_file(tmp_path, monkeypatch):
    """Writes a YAML file and returns its name in the working directory."""
    monkeypatch.chdir(tmp_path)

    def write(text):
        (tmp_path / "mine.yaml").write_text(text)
        return "mine.yaml"

    return write


def _message(path, *overrides):
    with pytest.raises(InputError) as caught:
        load_config(path, overrides)
    return str(caught.value)


def test_defaults_are_valid_and_immutable():
    config = load_config()
    assert config == Config()
    with pytest.raises(ValueError, match="frozen"):
        config.run.seed = 3


@pytest.mark.parametrize("name", config_names())
def test_shipped_configurations_load_by_name_and_round_trip(name, tmp_path):
    config = load_config(name)
    assert config == load_config(f"{name}.yaml") == load_config(f"configs/{name}.yaml")
    file = tmp_path / "resolved.yaml"
    file.write_text(dump_config(config))
    assert load_config(file) == config


def test_the_defaults_are_those_of_quick():
    assert Config() == load_config() == load_config("quick") == Config.load("quick")


def test_the_thesis_comes_by_its_method_alone(yaml_file):
    thesis = load_config("thesis")
    assert load_config(yaml_file("method: thesis\n")) == thesis == Config(method="thesis")
    assert load_config(None, ["method=thesis"]) == thesis
    own = load_config(yaml_file("method: thesis\noptimiser: {keep: best}\nrig: {cameras: 6}\n"))
    assert overrides_from(thesis, own) == ["rig.cameras=6", "optimiser.keep=best"]
    # what a file says stays, also where the method changes
    assert load_config("default", ["method=thesis"]).optimiser.learning_rate_position_m == 0.04
    assert load_config("quick", ["method=thesis"]).losses.in_frame_rotation == 1.0


def test_a_file_stands_on_the_file_that_it_extends(yaml_file, tmp_path):
    (tmp_path / "base.yaml").write_text("extends: default\nrig: {cameras: 5, min_spacing_m: 30 cm}\n")
    name = yaml_file("extends: base.yaml\nrig: {cameras: 6}\n")
    found = overrides_from(load_config("default"), load_config(name, ["run.seed=4"]))
    assert found == ["run.seed=4", "rig.cameras=6", "rig.min_spacing_m=0.3"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("extends: none.yaml\n", r"mine\.yaml:1: extends: none\.yaml: config: expected a YAML file or a shipped name"),
        ("rig: {cameras: 6}\nextends: [quick]\n", r"mine\.yaml:2: extends: expected a YAML file or a shipped name"),
        ("extends: mine.yaml\n", r"mine\.yaml:1: extends: expected a file that does not extend this one, got mine"),
    ],
)
def test_what_cannot_be_extended_is_named(yaml_file, text, message):
    with pytest.raises(InputError, match=message):
        load_config(yaml_file(text))


def test_a_mistake_in_a_file_below_is_placed_there(yaml_file, tmp_path):
    (tmp_path / "base.yaml").write_text("run: {seed: 1}\nrig:\n  cameras: 99\n")
    with pytest.raises(InputError, match=r"base\.yaml:3: rig\.cameras: expected a whole number from 1 to 16, got 99"):
        load_config(yaml_file("extends: base.yaml\n"))


def test_thesis_configuration_holds_the_appendix():
    config = load_config("thesis")
    optimiser = config.optimiser
    assert (config.run.iterations, config.run.batch_size, config.rig.cameras) == (100, 4, 4)
    assert (config.rig.height_offset_m, config.rig.min_spacing_m) == (0.25, 0.2)
    assert (config.losses.epsilon, config.losses.min_detected_area) == (1e-5, 0.5)
    cut = config.losses.surface_blockage, config.losses.angular_coverage, config.losses.object_visibility
    assert cut == (0.0, 0.0, 0.0)
    assert (config.detector.confidence_min, config.detector.iou_min) == (0.1, 0.5)
    assert optimiser.learning_rate_position_m == 0.25
    assert math.radians(optimiser.learning_rate_yaw_deg) == pytest.approx(0.25, rel=1e-9)
    assert (optimiser.weight_decay, optimiser.multiplier_weight_decay) == (1e-3, 1e-3)
    assert (optimiser.multiplier_learning_rate, optimiser.multiplier_damping) == (0.25, 0.0)
    assert (config.thesis.rotations, config.visibility.occlusion) == (16, "pairwise")


@pytest.mark.parametrize(
    ("are_inequalities", "given", "step", "damping"),
    [
        (True, {}, 1.0, 10.0),
        (False, {}, 0.25, 0.0),
        (True, {"multiplier_learning_rate": 0.5, "multiplier_damping": 2.0}, 0.5, 2.0),
    ],
)
def test_multipliers_step_as_their_constraints_ask(are_inequalities, given, step, damping):
    optimiser = load_config(None, [f"optimiser.{key}={value}" for key, value in given.items()]).optimiser
    assert optimiser.multiplier_step(are_inequalities=are_inequalities) == step
    assert optimiser.damping(are_inequalities=are_inequalities) == damping


@pytest.mark.parametrize(
    ("text", "metres"),
    [("0.3", 0.3), ("20 cm", 0.2), ("20cm", 0.2), ("250 mm", 0.25), ("10 in", 0.254), ("1 ft", 0.3048), ("1e-1", 0.1)],
)
def test_lengths_take_units(text, metres):
    assert load_config(None, [f"rig.min_spacing_m={text}"]).rig.min_spacing_m == pytest.approx(metres, rel=1e-12)


@pytest.mark.parametrize(("text", "degrees"), [("80", 80.0), ("80 deg", 80.0), ("1.5 rad", math.degrees(1.5))])
def test_angles_take_units(text, degrees):
    assert load_config(None, [f"camera.fov_deg={text}"]).camera.fov_deg == pytest.approx(degrees, rel=1e-12)


@pytest.mark.parametrize(
    ("text", "seeds"),
    [
        ("40..44", (40, 41, 42, 43, 44)),
        ("[9, 3, 7, 1]", (9, 3, 7, 1)),
        ("[0..2, 8]", (0, 1, 2, 8)),
        ("[4, 5, 6, 7]", (4, 5, 6, 7)),
    ],
)
def test_seeds_take_ranges_and_lists(text, seeds):
    config = load_config(None, [f"scenes.train_seeds={text}"])
    assert config.scenes.train_seeds == seeds


@pytest.mark.parametrize(
    ("text", "within_m"), [("any", 0.0), ("both", math.inf), ("60", 60.0), ("0.05 m", 0.05), ("30 ft", 9.144)]
)
def test_fusion_is_a_word_or_a_distance_and_needs_cameras_and_lidars(text, within_m):
    config = Config.load("quick", f"lidar.fusion={text}")
    assert config.lidar.fused.within_m == within_m
    assert Config.model_validate(config.model_dump(mode="json")).lidar == config.lidar
    objective_options(config.replace({"rig.modules": {"lidar_32": 1, "side_2mp_100": "0..3"}}))
    for modules, missing in (({}, "LiDAR"), ({"rig.modules": {"lidar_32": 2}}, "camera")):
        if within_m:
            with pytest.raises(OptionError, match=f"lidar.fusion: expected any, as rig.modules has no {missing}"):
                objective_options(config.replace(modules))


def test_cameras_take_lenses():
    config = load_config(None, ["camera.lens=panorama", "camera.fov_deg=360"])
    assert camera_model(config).fov_rad == pytest.approx(2.0 * math.pi)
    config = load_config(None, ["camera.lens=fisheye", "camera.fov_deg=200", "camera.distortion=[0.01, -0.002, 0, 0]"])
    model = camera_model(config)
    assert (model.lens, model.distortion) == ("fisheye", (0.01, -0.002, 0.0, 0.0))
    assert load_config(None, []).camera.distortion == ()


def test_what_is_free_has_bounds_in_units_and_reads_back():
    config = load_config(None, ["rig.free.pitch_deg=[-20, 0.2 rad]", "rig.free.height_m=['5 cm', 0.4]"])
    assert config.rig.free.pitch_deg == (-20.0, pytest.approx(math.degrees(0.2)))
    assert config.rig.free.height_m == (pytest.approx(0.05), 0.4)
    assert config.rig.free.fov_deg is None
    ranges = free_ranges(config)
    assert ranges.pitch_rad == (pytest.approx(math.radians(-20.0)), pytest.approx(0.2))
    assert (ranges.height_m, ranges.fov_rad) == (config.rig.free.height_m, None)
    assert free_ranges(load_config(None, ["rig.free.pitch_deg=null"])) == FreeRanges()
    assert free_ranges(load_config("thesis")) == FreeRanges()


@pytest.mark.parametrize(
    ("options", "confidence", "false_alarms"),
    [
        (["scenes.targets=vehicle"], 0.4, 0.0),
        (["scenes.targets=[vehicle]"], 0.4, 0.0),
        (["scenes.targets=[vehicle, cyclist]"], 0.5, 0.5),
        (["scenes.targets=cyclist", "detector.confidence_min=0.3", "losses.false_alarms=0"], 0.3, 0.0),
    ],
)
def test_what_only_vehicles_do_without(options, confidence, false_alarms):
    config = load_config("quick", options)
    assert (config.detector.confidence_min, config.losses.false_alarms) == (confidence, false_alarms)


def test_an_override_beats_the_file_and_the_last_one_wins(yaml_file):
    config = load_config(yaml_file("rig: {cameras: 3}\n"), ["rig.cameras=5", "rig.cameras=6"])
    assert config.rig.cameras == 6


def test_described_options_say_type_range_and_default():
    described = {option.name: option for option in described_options()}
    assert {name: option.default for name, option in described.items()} == option_values(Config())
    assert all(option.description and option.section_description for option in described.values())
    assert {name for name, option in described.items() if option.expected.startswith("text")} == {"executor.address"}
    assert described["rig.min_spacing_m"].expected.startswith("a length in metres above 0 m to 5 m")
    assert described["scenes.mirror"].expected == "true or false"
    assert described["rig.free.pitch_deg"].section == "rig.free"


FILE_MISTAKES = [
    (
        "rig:\n  cameras: 4\n  min_spacng_m: 0.3\n",
        "mine.yaml:3: rig.min_spacng_m: expected one of cameras, start, freeze, height_offset_m, min_spacing_m, free, "
        "fewest_cameras, modules, catalogue, max_cost, symmetric, got 'min_spacng_m'; did you mean rig.min_spacing_m?",
    ),
    ("fov_deg: 80\n", "mine.yaml:1: fov_deg: expected one of run, device"),
    (
        "rig.free.pitch_deg: [0, 10]\n",
        "mine.yaml:1: rig.free.pitch_deg: expected sections, got 'rig.free.pitch_deg'; write "
        "rig: {free: {pitch_deg: ...}}",
    ),
    (
        "rig:\ncameras: 4\nstart: highest\n",
        "mine.yaml:1: rig: expected a section with cameras, start, freeze, height_offset_m, min_spacing_m, free, "
        "fewest_cameras, modules, catalogue, max_cost, symmetric, got nothing (null); indent "
        "cameras and start below it",
    ),
    (
        "rig:\n  cameras: many\n",
        "mine.yaml:2: rig.cameras: expected a whole number from 1 to 16, got 'many'; cameras on the vehicle",
    ),
    ("rig: {cameras: 0}\n", "mine.yaml:1: rig.cameras: expected a whole number from 1 to 16, got 0;"),
    (
        "\n\nrig: {min_spacing_m: 5 parsec}\n",
        "mine.yaml:3: rig.min_spacing_m: expected a length in metres, such as 0.2 or \"20 cm\", got '5 parsec'; "
        "'parsec' is no unit of length, use m, cm, mm, in, ft",
    ),
    ("camera: {fov_deg: 200}\n", "mine.yaml:1: camera.fov_deg: expected an angle in degrees from 10 deg to 170 deg,"),
    (
        "camera: {lens: fisheye, fov_deg: 100, distortion: [-0.6, 0, 0, 0]}\n",
        "mine.yaml:1: camera.fov_deg: expected an angle in degrees from 10 deg to 84.98 deg, the widest",
    ),
    ("camera: {lens: fisheye, distortion: [0.1]}\n", "mine.yaml:1: camera.distortion: expected as many numbers as the"),
    ("camera: {distortion: 0.1}\n", "mine.yaml:1: camera.distortion: expected a list of numbers, such as"),
    ("camera: {fov_deg: .nan}\n", "mine.yaml:1: camera.fov_deg: expected an angle in degrees"),
    ("device: cuda\n", "mine.yaml:1: device: expected cpu or a GPU such as cuda:0, got 'cuda'; write cuda:0 for"),
    ("method: thesi\n", "mine.yaml:1: method: expected thesis or default, got 'thesi'"),
    (
        "scenes: {source: film}\n",
        "mine.yaml:1: scenes.source: expected town, traffic, places, captured or folder, got",
    ),
    ("scenes: {test_seeds: 9..3}\n", "mine.yaml:1: scenes.test_seeds: expected a range whose end is not below its"),
    ("scenes: {test_seeds: [50, 50]}\n", "mine.yaml:1: scenes.test_seeds: expected every seed once, got 50 twice"),
    (
        "scenes:\n  train_seeds: 0..9\n  test_seeds: 8..12\n",
        "mine.yaml:3: scenes.test_seeds: expected test scenes that are not trained on, got 2 seed(s) in both",
    ),
    ("detector: {model: no.onnx}\n", "mine.yaml:1: detector.model: expected builtin or the path of an ONNX file, got"),
    (
        "losses: {in_frame_rotation: 0, expected_miss_rate: 0}\n",
        "mine.yaml:1: losses.expected_miss_rate: expected at least one weight above 0, got only zeros",
    ),
    (
        "run: {batch_size: 61}\noptimiser: {search: descent}\n",
        "mine.yaml:1: run.batch_size: expected at most the 60 training scene(s), got 61",
    ),
    ("thesis: {rotations: 3}\n", "mine.yaml:1: thesis.rotations: expected at least one direction per camera"),
    (
        "rig:\n  free:\n    fov_deg: [110, 60]\n",
        "mine.yaml:3: rig.free.fov_deg: expected two angles from 10 deg to 360 deg, the lower one first, such as "
        "[60, 110], or null, got [110, 60]",
    ),
    ("rig: {free: {height_m: [-0.1, 0.4]}}\n", "mine.yaml:1: rig.free.height_m: expected two heights from 0 m to 2 m"),
    (
        "rig: {free: {height_m: [0.3, 40 cm]}}\n",
        "mine.yaml:1: rig.free.height_m: expected bounds that hold the 0.25 of rig.height_offset_m, got [0.3, 0.4]",
    ),
    (
        "method: thesis\nrig: {free: {pitch_deg: [-5, 5]}}\n",
        "mine.yaml:2: rig.free.pitch_deg: expected null, as the thesis moves x, y and yaw alone, got [-5.0, 5.0];",
    ),
    (
        "camera: {lens: fisheye, distortion: [0, 0, 0, 0]}\nrig: {free: {fov_deg: [60, 355]}}\n",
        "mine.yaml:2: rig.free.fov_deg: expected at most 350 deg, the widest for this fisheye lens, got [60.0, 355.0]",
    ),
    (
        "losses: {angular_coverage: 1}\nrig: {free: {fov_deg: [60, 110]}}\n",
        "mine.yaml:2: rig.free.fov_deg: expected null, as losses.angular_coverage takes one field of view for all",
    ),
    ("rig: {cameras: 4}\nrig: {}\n", "mine.yaml:2: rig: expected every key once, got it again (first in line 1)"),
    (
        "frame: ego\ncameras: []\n",
        "mine.yaml: expected a configuration, got a rig file; rig.start=mine.yaml begins with it",
    ),
    ("- 4\n", "mine.yaml:1: expected sections such as 'rig: {cameras: 4}', got [4]"),
]


@pytest.mark.parametrize(("text", "message"), FILE_MISTAKES, ids=range(len(FILE_MISTAKES)))
def test_a_mistake_in_a_file_is_named_with_its_line(yaml_file, text, message):
    found = _message(yaml_file(text))
    assert found.startswith(message)
    assert "\n" not in found


OVERRIDE_MISTAKES = [
    (
        "rig.cameras=many",
        "command line (rig.cameras=many): rig.cameras: expected a whole number from 1 to 16, got 'many'",
    ),
    ("rgi.cameras=4", "command line (rgi.cameras=4): rgi: expected one of run,"),
    ("rig.camera=4", "command line (rig.camera=4): rig.camera: expected one of cameras,"),
    ("rig.cameras.x=4", "command line (rig.cameras.x=4): rig.cameras: expected a section, got 3 in the file"),
    ("device.x=4", "command line (device.x=4): device: expected cpu or a GPU such as cuda:0, got {x: 4}"),
    ("rig.cameras", "command line (rig.cameras): expected key=value, got 'rig.cameras'; did you mean rig.cameras=...?"),
    (
        "nuscenes",
        "command line (nuscenes): expected key=value, got 'nuscenes'; a command takes one rig; plot compares it with",
    ),
    ("lidar.fusion=all", "command line (lidar.fusion=all): lidar.fusion: expected any, both, or a distance in metres"),
    ("rig.=3", "command line (rig.=3): expected key=value, got 'rig.=3'"),
    ("rig.cameras=[1", "command line (rig.cameras=[1): expected valid YAML, got a syntax error: "),
    (
        "scenes.train_seeds=[5000, 1, 2, 3]",
        "command line (scenes.train_seeds=[5000, 1, 2, 3]): scenes.test_seeds: expected test scenes that are not",
    ),
]


@pytest.mark.parametrize(("override", "message"), OVERRIDE_MISTAKES, ids=[text for text, _ in OVERRIDE_MISTAKES])
def test_a_mistake_in_an_override_is_named_with_the_override(yaml_file, override, message):
    found = _message(yaml_file("rig: {cameras: 3}\n"), override)
    assert found.startswith(message)
    assert "\n" not in found


@pytest.mark.parametrize(
    ("options", "descends"),
    [
        ([], False),
        (["optimiser.search=pool"], False),
        (["optimiser.search=pool", "losses.combine=best"], False),
        (["optimiser.search=descent"], True),
        (["losses.combine=best"], True),
        (["losses.detector_share=0.5"], True),
        (["losses.object_visibility=1"], True),
        (["losses={expected_miss_rate: 0, in_frame_rotation: 1}"], True),
    ],
)
def test_batches_may_exceed_the_training_scenes_where_no_descent_takes_any(yaml_file, options, descends):
    file, scenes = yaml_file("run: {batch_size: 4}\n"), "scenes.train_seeds=[1, 2]"
    assert (load_config(file, options).search_kind == "descent") == descends
    if descends:
        found = _message(file, *options, scenes)
        place = f"command line ({scenes}): run.batch_size"
        assert found == f"{place}: expected at most the 2 training scene(s), got 4; set run.batch_size=2 or lower"
    else:
        assert load_config(file, [*options, scenes]).run.batch_size == 4


def test_all_mistakes_are_reported_at_once(yaml_file):
    found = _message(yaml_file("run: {seed: -1}\nrig:\n  cameras: x\nunknown: 1\n"), "camera.fov_deg=1 turn")
    assert [line.split(": expected")[0] for line in found.splitlines()] == [
        "mine.yaml:1: run.seed",
        "mine.yaml:3: rig.cameras",
        "command line (camera.fov_deg=1 turn): camera.fov_deg",
        "mine.yaml:4: unknown",
    ]


def test_a_missing_file_is_named_with_a_suggestion(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert _message("quik") == "quik: config: expected a YAML file or a shipped name, got 'quik'; did you mean quick?"
    assert "shipped ones are" in _message("zzz.yaml")
    assert "an option is given with its value, as rig.cameras=VALUE" in _message("rig.cameras")
    (tmp_path / "bytes.yaml").write_bytes(b"\xff\xfe\xff")
    assert _message("bytes.yaml") == "bytes.yaml: expected a readable YAML file, got: not UTF-8 text"


def test_a_run_folder_is_no_configuration_but_holds_one(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "runs" / "quick"
    folder.mkdir(parents=True)
    (folder / "config.yaml").write_text("run: {iterations: 7}\n")
    assert _message("runs/quick") == (
        "runs/quick: config: expected a YAML file or a shipped name, got a run folder; runs/quick/config.yaml repeats "
        "it, rig.start=runs/quick begins with its rig"
    )
    assert load_config("runs/quick/config.yaml", ["rig.start=runs/quick"]).run.iterations == 7


@pytest.mark.parametrize(
    ("option", "place"),
    [
        ("rig.cameras", "mine.yaml:2"),
        ("device", "command line (device=cuda:3)"),
        ("rig.min_spacing_m", "command line (rig={min_spacing_m: 1})"),
        ("mount.cell_m", "mine.yaml"),
    ],
)
def test_what_turns_out_wrong_later_is_told_with_its_place(yaml_file, option, place):
    file = yaml_file("rig:\n  cameras: 6\n")
    overrides = ["device=cuda:3"] if option != "rig.min_spacing_m" else ["rig={min_spacing_m: 1}"]
    with pytest.raises(InputError) as caught, placed_config(file, overrides):
        raise OptionError(option, "expected more, got less")
    assert str(caught.value) == f"{place}: {option}: expected more, got less"


@pytest.mark.parametrize(
    ("text", "overrides", "warning"),
    [
        ("segregation: {rotations: 9}\n", [], "mine.yaml:1: segregation is called thesis now; the old name works in"),
        ("", ["segregation.rotations=9"], r"command line \(segregation.rotations=9\): segregation is called thesis"),
    ],
)
def test_an_option_that_was_renamed_works_with_one_line_of_warning(yaml_file, text, overrides, warning):
    with pytest.warns(FutureWarning, match=warning) as warnings:
        config = load_config(yaml_file(text), overrides)
    assert len(warnings) == 1
    assert config == load_config(yaml_file(""), ["thesis.rotations=9"])
    with pytest.warns(FutureWarning, match="segregation is called thesis now"):
        assert Config(segregation={"rotations": 9}) == config
