"""What the studies that ship compare: arms, settings, circumstances, and what is refused."""

from collections import Counter
from pathlib import Path

import pytest

from tests.cli.small_run import complaint
from warpav.core.errors import InputError
from warpav.experiments import _study as module
from warpav.experiments import find_study
from warpav.experiments._study import _loss_overrides, _thesis_rows
from warpav.rig import builtin_modules
from warpav.runs import read_baselines
from warpav.runs.config import load_config

STUDIES = [file.stem for file in sorted((Path(module.__file__).parent / "studies").glob("*.yaml"))]
SETTINGS = ["dense_4_rack", "ngsim_4_body", "sind_6_body", "dense_2_roof_bus_all"]
LAYOUTS = {"nuscenes": (6, 1), "argoverse2": (7, 2), "edgar": (8, 4), "robotaxi": (9, 5), "series": (8, 1)}


@pytest.mark.parametrize("quick", [False, True])
@pytest.mark.parametrize("name", [*STUDIES, "table3", *SETTINGS])
def test_every_study_is_one_of_its_configuration(name, quick):
    """Its options are options, no arm comes twice, and every arm has the reference that it names."""
    setting = name if name in SETTINGS else None
    if name in ("rivals", "at_cost"):
        return
    study = find_study("rivals" if setting else name, setting=setting, quick=quick)
    arms = [arm.name for arm in study.arms]
    assert len(set(arms)) == len(arms)
    assert set(study.references.values()) <= set(arms)
    config = load_config(study.config, study.overrides([]))
    for arm in study.arms:
        arm.search_config(config)


def test_a_setting_is_composed_of_words():
    rack, body = (find_study("rivals", setting=f"sind_4_{mount}") for mount in ("rack", "body"))
    assert (rack.name, rack.judge, rack.camera_renders_max) == ("rivals_sind_4_rack", "detector", 30_000)
    assert {arm.name for arm in body.arms} - {arm.name for arm in rack.arms} == {"highest_raised"}
    assert any(option.endswith("zones/car_body.yaml") for option in body.options)
    bus = find_study("rivals", setting="dense_6_body_bus_all")
    assert any(option.endswith("zones/bus_body.yaml") for option in bus.options)
    assert "nuscenes_as_built" not in {arm.name for arm in bus.arms}
    assert "nuscenes_as_built" in {arm.name for arm in find_study("rivals", setting="dense_6_body").arms}
    assert "corners" not in {arm.name for arm in find_study("rivals", setting="dense_2_roof").arms}


@pytest.mark.parametrize("traffic", ["dense", "sind", "motorway"])
@pytest.mark.parametrize("layout", LAYOUTS)
def test_layouts_have_the_modules_that_their_settings_name(layout, traffic):
    """With LiDARs all of the rig, without them its cameras."""
    cameras, lidars = LAYOUTS[layout]
    catalogue = builtin_modules()
    for form, count in (("", cameras), ("_lidar", cameras + lidars)):
        study = find_study("at_cost", setting=f"{layout}{form}_{traffic}")
        config = load_config(study.config, study.overrides([]))
        for arm in study.arms:
            arm.check(config, None)
        [rig] = read_baselines(config).values()
        of_module = Counter(camera.module for camera in rig.cameras)
        assert {name: (of_module[name],) * 2 for name in config.rig.modules} == dict(config.rig.modules)
        is_lidar = {name: catalogue[name].beams is not None for name in of_module}
        assert set(config.rig.modules) == {name for name in of_module if form or not is_lidar[name]}
        assert config.rig.cameras == count
        assert (config.rig.is_symmetric, str(config.requirements)) == (True, "near_field")


def test_a_rig_at_cost_needs_a_layout_and_its_modules():
    study = find_study("at_cost", setting="series_dense")
    for option in ("baselines.rigs=null", "rig.modules=null"):
        with pytest.raises(InputError, match=r"arm as_built: expected one rig of modules in baselines\.rigs"):
            study.arms[1].check(load_config(study.config, study.overrides([option])), None)


def test_circumstances_have_arms_of_their_own():
    study = find_study("sweep", vary=["cameras=2,4", "traffic=sind"])
    points = ("middle", "cameras_2", "cameras_4", "traffic_sind")
    assert study.references == {f"highest_{point}": f"default_{point}" for point in points}
    assert {arm.name: arm.overrides for arm in study.arms}["highest_cameras_4"] == ("rig.cameras=4",)
    scenes = {arm.name: arm.search_overrides for arm in find_study("scene_count").arms}
    assert scenes["default_scenes_50"][-1] == "scenes.train_seeds=0..49"


def test_arms_of_the_thesis_have_its_weights():
    names = [arm.name for arm in find_study("table2").arms]
    assert len(names) == len(_thesis_rows("II"))
    assert dict(each.split("=") for each in _loss_overrides("IFR+10*DOA"))["losses.detected_area"] == "10.0"
    assert [arm.name for arm in find_study("table4").arms][-1] == "sgd_ifr_doa_sb_ov"
    with pytest.raises(ValueError, match="got 'XYZ'"):
        _loss_overrides("IFR+XYZ")


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["rivals"], "(--setting): expected a word of each of these with _ between: dense sind ngsim; 2 4 6"),
        (["rivals", "--setting", "sind_3_rack"], "got sind_3_rack"),
        (["rivals", "--setting", "ngsim_4_rack"], "scenes.recordings: expected a value for rivals_ngsim_4_rack"),
        (["open", "--setting", "dense_4_roof"], "(--setting): expected nothing, as open has no settings"),
        (["open", "--vary", "cameras"], "(--vary): expected nothing, as it is an option of sweep"),
        (["sweep", "--vary", "colour"], "(--vary): expected a factor out of cameras, fov, height, traffic"),
        (["sweep", "--vary", "cameras=few"], "(--vary): expected values of cameras with commas, numbers, got 'few'"),
        (["sweep", "--vary", "traffic=none"], "out of dense, easy, motorway, sind, urban"),
        (["open", "--arms", "nuscense"], "did you mean nuscenes"),
        (["open", "--budget", "0"], "(--budget): expected at least 1, got 0"),
        (["ablations", "optimiser.starts=3"], "got one that arm"),
        (["table1", "--arms", "sgd"], "measures gradients of one descent"),
    ],
)
@pytest.mark.usefixtures("working_directory")
def test_what_does_not_fit_is_named(capsys, words, told):
    assert told in complaint(capsys, "experiment", *words)


def test_the_user_leaves_alone_what_arms_set():
    study = find_study("table2")
    with pytest.raises(InputError, match=r"losses\.detected_area: expected an option that the arms of table2"):
        study.overrides(["losses.detected_area=3"])
