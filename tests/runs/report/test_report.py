"""The report: its numbers are those of the run folder, for finished, stopped, old, hostile and broken ones."""

import dataclasses
import io
import json
import math
import re
import shlex
import shutil
from html.parser import HTMLParser

import pytest

from tests.cli.small_run import complaint
from tests.runs.report.run_parts import ARMS, arm, difference, evaluation, event, fill, folder_at, picture, seen
from warpav.core.errors import InputError
from warpav.rig import Rig, write_rig
from warpav.runs import RigEvaluation, RunFolder
from warpav.runs._rig_evaluation import TABLE_ROWS
from warpav.runs._terminal import Terminal
from warpav.runs.config import load_config
from warpav.runs.report._content import RunContent, read_content
from warpav.runs.report._statements import cautions, headline, summary
from warpav.runs.report.report import write_report
from warpav.runs.report.tables import next_commands, show_everything, show_run


class Page(HTMLParser):
    """Collects tags, texts, addresses and tables, and checks that every tag is closed."""

    VOID = frozenset({"meta", "img", "link"})

    def __init__(self, text):
        super().__init__()
        self.open, self.seen, self.text, self.address, self.named, self.tables, self.alt = [], [], [], [], [], [], []
        self.commands = []
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        attributes = dict(attrs)
        self.seen.append(tag)
        self.address += [attributes[name] for name in ("src", "href") if name in attributes]
        if "id" in attributes:
            self.named.append(attributes["id"])
        if tag == "img":
            self.alt.append(attributes["alt"])
        if tag == "pre":
            self.commands.append("")
        if tag == "table":
            self.tables.append([])
        if tag == "tr":
            self.tables[-1].append([])
        if tag in ("td", "th"):
            self.tables[-1][-1].append("")
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text.append(data.strip())
        if "small" in self.open:
            self.tables[-1][-1][-1] += " "
        if "pre" in self.open:
            self.commands[-1] += data
        if {"td", "th"} & set(self.open):
            self.tables[-1][-1][-1] += data

    def table(self, *heading):
        """The rows below a heading that begins so."""
        return next(table[1:] for table in self.tables if tuple(table[0][: len(heading)]) == heading)

    @property
    def words(self):
        return " ".join(" ".join(self.text).replace("\N{NO-BREAK SPACE}", " ").split())


def page_of(folder, **changed):
    """The page of a folder, with another evaluation."""
    if changed:
        folder.write_evaluation(evaluation(**changed))
    return Page(write_report(folder).read_text(encoding="utf-8"))


def numbers(text):
    """The numbers in a text, typographic minus signs and all."""
    return [float(each) for each in re.findall(r"[-+]?\d+\.?\d*", text.replace("\N{MINUS SIGN}", "-"))]


@pytest.fixture
def folder(tmp_path, finished):
    """The run folder of a finished run, with a tag in its name."""
    ignored = shutil.ignore_patterns("report.html")
    return RunFolder.open(shutil.copytree(finished[0].path, tmp_path / "<run>", ignore=ignored))


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """The same, to be read only, and the text of its report."""
    folder = fill(folder_at(tmp_path_factory.mktemp("finished") / "<run>"))
    return folder, write_report(folder).read_text(encoding="utf-8")


@pytest.fixture
def page(finished):
    return Page(finished[1])


# ------------------------------------------------------------------------------------------------ numbers


def test_the_tables_hold_the_numbers_of_the_evaluation(page):
    content = evaluation()
    rows = {row[0]: row[1:] for row in page.table("12 test scenes", "found", "start", "highest")}
    assert "visible to a camera [%]" not in rows  # known of no rig
    for name, (heading, factor, digits) in TABLE_ROWS.items():
        if name != "visible_rate":
            values = [factor * content["arms"][each][name] for each in ARMS]
            shown = [numbers(cell)[0] for cell in rows[heading]]
            assert shown == pytest.approx(values, abs=0.5001 * 10.0**-digits)
    missed = rows["missed per 100, equal false alarms"]
    assert [numbers(cell)[1:] for cell in missed] == [[], [12.5, 3.0, 20.0], [-25.0, -40.0, -10.0]]
    assert numbers(rows["AP50, image by image [%]"][1])[1:] == [1.0, -2.0, 4.0]
    groups = page.table("missed per 100", "objects", "found")
    assert ["0-10 m", "8", "38", "50", "12"] in groups
    assert ["<bus>", "8", "38", "50", "12"] in groups
    assert not any(row[0] in ("10-20 m", "vehicle") for row in groups)  # none there; only one kind


OUTAGE = {
    "expected_misses_per_100": 12.5,
    "worst": "<rear>",
    "cameras": [
        {"camera": "front", "expected_misses_per_100": 20.25, "difference_per_100": 7.75},
        {"camera": "<rear>", "expected_misses_per_100": 50.0, "difference_per_100": 37.5},
    ],
}
WEIGHTS = {"weighted_expected_misses_per_100": 10.0, "weighted_difference_per_100": -0.0}


def test_what_is_missed_without_each_camera_is_told(folder, page):
    heading = "found without", "expected misses per 100", "difference"
    assert "If a camera fails" not in page.text  # an older run does not know
    rows = page_of(folder, camera_outage={"optimised": OUTAGE, "start": None}).table(*heading)
    assert rows == [["no camera", "12.5", ""], ["front", "20.2", "+7.8"], ["<rear> (worst)", "50.0", "+37.5"]]
    weighted = {**OUTAGE, "cameras": [{**each, **WEIGHTS} for each in OUTAGE["cameras"]]}
    weighted["weighted_expected_misses_per_100"] = 9.0
    outages = {"camera_outage": {"optimised": weighted}}
    rows = page_of(folder, **outages).table(*heading, "weighted expected misses per 100", "weighted difference")
    assert rows[1] == ["front (worst)", "20.2", "+7.8", "10.0", "+0.0"]
    del weighted["cameras"][1]["weighted_difference_per_100"]
    with pytest.raises(InputError, match="weighted numbers must be there for all cameras or for none"):
        page_of(folder, **outages)


def test_the_most_sensitive_camera_is_named(folder, page):
    assert "If a camera is off" not in page.text  # an older run does not know
    worst = {"camera": "<rear>", "degree": "yaw", "change_per_100": 0.254}
    draws = {"count": 8, "expected_misses_per_100": 13.0, "quantile_95": 14.0}
    tolerance = {"position_m": 0.02, "angle_rad": 0.017453292519943295, "scenes": 10, "worst": worst, "draws": draws}
    tolerance |= {"expected_misses_per_100": 12.5, "effects": []}
    told = page_of(folder, mount_tolerance=tolerance, camera_outage={"optimised": OUTAGE}).words
    assert "Most sensitive is <rear> in yaw: off by 1 degree, the rig is expected to miss 0.25 more of 100" in told
    assert "(10 scenes); in traffic the loss of <rear> costs most, 37.5 more misses of 100." in told
    worst |= {"degree": "z", "change_per_100": 0.1}
    assert "in z: off by 2 cm," in page_of(folder, mount_tolerance=tolerance).words
    worst["change_per_100"] = 0.004
    nothing = "No camera that is off by 2 cm or 1 degree in one direction costs anything (10 scenes)."
    assert nothing in page_of(folder, mount_tolerance=tolerance).words


def test_the_blind_spots_are_those_of_the_evaluation(page):
    ground = page.table("ground blind for a child")
    assert [[numbers(cell) for cell in row[1:]] for row in ground] == [[[80, 50], [7, 7]], [[25, 5], []]]
    rows = page.table("scene", "class")
    assert [row[2] for row in rows] == ["4.2", "21.0", "30.0"]  # the nearest first
    assert [row[4:7] for row in rows] == [
        ["right", "missed", "detected"],
        ["right", "hidden", "detected"],
        ["right", "out of frame", "missed"],
    ]


RULES = [
    {"rule": "own_body", "cameras": ["left"], "value": 0.25, "limit": 0.3, "unit": "", "is_kept": True},
    {"rule": "azimuth_gap", "cameras": [], "value": 12.0, "limit": 9.0, "unit": "", "is_kept": False}
    | {"asked": 3.0, "price": 0.025},
]


def test_cameras_constraints_rules_and_times_are_told(folder, page):
    found, start = (table[1:] for table in page.tables if table[0][0] == "camera")
    assert numbers(" ".join(found[0][1:6])) == [1.125, 0.5, 1.5, 30.0, 0.0]  # the best rig is kept, not the last
    assert numbers(" ".join(start[0][1:6])) == [1.0, 0.5, 1.5, 0.0, 0.0]
    constraints = page.table("constraint")
    assert [numbers(" ".join(row[1:4])) for row in constraints] == [[0.25, 0.2, 0.05], [0.5, 0.02, 0.48]]
    assert {row[0]: float(row[1]) for row in page.table("stage")} == {
        "descent": 3.5,
        "total": 12.2,
        "one iteration: render, mean": 0.25,
        "one iteration: total, mean": 0.5,
    }
    ruled = page_of(folder, rules={"optimised": RULES})
    assert ruled.table("rule, worst camera") == [
        ["own body in the image", "at most 30\N{NO-BREAK SPACE}%", "25\N{NO-BREAK SPACE}%, left"],
        ["widest gap of directions at 15 m", "at most 9°", "12° (broken)"],
    ]
    told = "1 of 2 broken: widest gap of directions at 15 m 12°, at most 9° asked. A gap of 3 degrees, as asked, would"
    assert f"Rules {told} cost 2.5 % more." in ruled.words
    content = evaluation()
    content["constraints"]["optimised"] = content["constraints"]["start"]
    broken = page_of(folder, constraints=content["constraints"])
    assert "1 of 2 are broken; the distance between left and right is 25 mm too short." in broken.words


def test_the_command_makes_the_same_run(finished, page):
    folder, _ = finished
    program, verb, *words = shlex.split(page.commands[1].splitlines()[0])
    assert (program, verb) == ("warpav", "optimise")
    base = [word for word in words if "=" not in word] or ["quick"]
    again = load_config(base[0], [word for word in words if "=" in word])
    assert again == load_config(folder.config(), ["run.out=null"])


def test_the_page_is_whole_by_itself(finished, page):
    assert "what follows from it is left out" not in page.words
    folder, text = finished
    outside = [address for address in page.address if not address.startswith(("data:", "#"))]
    assert outside == []
    assert {address[1:] for address in page.address if address.startswith("#")} <= set(page.named)
    assert len(set(page.named)) == len(page.named)
    assert "script" not in page.seen
    assert all(page.alt)
    # pictures with a better stand-in on the page are left out, others come
    assert "another" in page.alt
    assert not any(caption.startswith("A test scene through") for caption in page.alt)
    assert write_report(folder).read_text(encoding="utf-8") == text


def test_a_page_is_small_whatever_its_pictures(folder):
    for k in range(6):
        picture(folder.figure_path(f"noise_{k}"), (800, 600), seed=k)
    assert write_report(folder).stat().st_size < 2_000_000


# ------------------------------------------------------------------------------------------------ words


def told_by(folder, **changed):
    """Headline, statements and cautions of a folder with another evaluation."""
    folder.write_evaluation(evaluation(**changed))
    run = read_content(folder)
    found = [headline(run), *summary(run), *cautions(run)]
    return "\n".join(each.text for each in found).replace("\N{NO-BREAK SPACE}", " ").replace("\N{MINUS SIGN}", "-")


def test_the_page_says_what_the_numbers_say(folder, page):
    words = told_by(folder)
    shown = page.words.replace("\N{MINUS SIGN}", "-")
    assert all(" ".join(line.split()) in shown for line in words.split("\n"))
    for text in (
        "In 12 unseen scenes the rig that was found misses 37.5 of 100 vehicles at 0.5 false alarms an image, the "
        "start 50.0: +12.5 [+3.0, +20.0] fewer; the 95 % interval excludes 0.",
        "missed per 100, equal false alarms 37.5 (highest 12.5)",  # what is worse
        "ground front, 0 to 5 m, blind for a child on 80 % (start 50 %)",
        "It finds 3 vehicles that the start does not detect (right 3; 9 to 11 m; there 3 missed).",
        "It loses 2 vehicles that the start detects (right 2; 4 to 21 m; here 1 hidden, 1 missed).",
        "On the training scenes it fell by 25.0 % (2.0000 to 1.5000)",
        "left by 12 cm (turned 30° to the left); 1 camera stayed.",
        "3 vehicles: 1 visible to a camera but missed by the detector, 1 hidden behind something and 1 in no "
        "camera's image. The nearest is 4 m away.",
        "no camera sees someone 1.1 m tall on 25 % of the ground (start 15 %, highest 0 %)",
        "Worst nearby: front, 0 to 5 m from its middle, 80 %.",
        "All 2 hold; the tightest is the distance between left and right, with 50 mm to spare.",
        "After 2 of 5 iterations: no better rig in 2 looks; the rig after 1 is kept.",
        "the intervals of 12 tend to be too short",
    ):
        assert text in words


@pytest.mark.parametrize(
    ("found", "told", "tone"),
    [
        (difference(-9.0, -12.0, -1.0), "the 95 % interval excludes 0", "good"),
        (difference(9.0, 1.0, 12.0), "the 95 % interval excludes 0", "bad"),
        (difference(9.0, 0.0, 12.0), "the 95 % interval includes 0", "open"),
        (difference(9.0, 1.0, 12.0, scenes=5), "5 scenes cannot tell them apart", "open"),
        (difference(9.0, None, None, scenes=1), "1 scene cannot tell them apart", "open"),
    ],
)
def test_no_difference_is_claimed_that_the_scenes_do_not_show(folder, found, told, tone):
    assert told in told_by(folder, paired={"start": {"misses_at_equal_false_alarms": found}}).split("\n")[0]
    said = headline(read_content(folder))
    assert (said.tone, said.about) == (tone, "WORSE THAN ITS START" if tone == "bad" else "")


def outage_of(expected):
    return {"camera_outage": {"optimised": {**OUTAGE, "expected_misses_per_100": expected}}}


def arms_of(**changed):
    return {"arms": {name: arm(0.5, **changed) for name in ARMS}}


REQUIREMENT = {
    **{"name": "near", "hard": True, "weight": None, "points": 4, "met": 2, "share": 0.5, "is_met": False},
    "need": {"object": "child", "visible_share": 0.5, "pixels": 1.0, "cameras": 1, "share": 0.99},
    "worst": [{"position_m": [1.0, -2.0], "camera": None, "cameras": 0, "visible_share": 0.0, "pixels": 0.0}],
    "gap": {"area_m2": 1.2345, "sector": "rear left"},
}
UNMET = {"requirements": {name: [REQUIREMENT] for name in ARMS}}
FEW = "tend to be too short"
CAUTIONS = {
    "worse objective": ({"training_objective": {"start": 0.2, "optimised": 0.3}}, "has objective 0.3, its start 0.2"),
    "no objective": ({"training_objective": {"start": 0.2, "optimised": None}}, "objective no number"),
    "requirement": (
        UNMET,
        "near at 50.0 % of 4 points, asked 99 %; worst at x = 1.0 m, y = -2.0 m; largest gap: 1.23 m², rear left",
    ),
    "unmet start": ({**UNMET, "training_objective": {"start": None, "optimised": 0.1}}, "as it does not meet near."),
    "own body": (arms_of(tp_detection_rate=0.0, body_share_max=0.97), "own body covers up to 97% of an image"),
    "expected": ({**arms_of(misses_per_100=37.5), **outage_of(15.0)}, "do not rely on the expected misses of this run"),
    "easy": (arms_of(misses_at_equal_false_alarms=1.9), "do not tell them apart: try scenes.level=dense"),
    "few false alarms": (arms_of(confidence_at_equal_false_alarms=0.0), "highest rig raise no more than 0.5 an image"),
    "few scenes": ({"scenes": {"test": 5}}, "with fewer than 6, no interval can exclude 0"),
}


@pytest.mark.parametrize(("changed", "told"), CAUTIONS.values(), ids=CAUTIONS)
def test_what_a_reader_should_know_is_said(folder, changed, told):
    assert told in told_by(folder, **changed)


def test_what_is_well_is_not_warned_of(folder):
    many = {"scenes": {"test": 30}, "ground": None, "paired": {}, **outage_of(19.0)}
    told_by(folder, **arms_of(misses_per_100=37.5, false_alarms_per_frame=0.5), **many)
    assert cautions(read_content(folder)) == []
    praise = "Worse in nothing that is measured"
    assert praise in page_of(folder).words
    worse = {"training_objective": {"start": 0.2, "optimised": 0.3}}
    told_by(folder, **arms_of(misses_per_100=37.5, false_alarms_per_frame=0.5), **many, **worse)
    assert cautions(read_content(folder)) == []
    assert praise not in page_of(folder).words


def test_cameras_that_would_pitch_farther_are_told(folder):
    first, *others = folder.rig().cameras
    high_rad = math.radians(folder.config().rig.free.pitch_deg[1])
    for away_deg, is_told in ((0.01, True), (0.5, False)):
        pitched = dataclasses.replace(first, pitch_rad=high_rad - math.radians(away_deg))
        write_rig(Rig([pitched, *others]), folder.rig_path("best"))
        told = f"{first.name} pitches as far as it may (-10 to 20 degrees): a wider rig.free.pitch_deg may find more."
        assert (told in told_by(folder)) == is_told


# ------------------------------------------------------------------------------------------------ stopped, old, hostile


def by_pool(folder):
    """The events of a search by a pool in place of those of a descent."""
    states = [("start", 0.3, None, None), ("selection", 0.1, 0.09, 40), ("polish", 0.08, 0.09, 40)]
    states += [("pricing", 0.08, 0.09, 40), ("selection", 0.08, 0.0775, 60), ("settled", 0.08, 0.0775, 60)]
    for name in ("events.jsonl", "metrics.csv"):
        (folder.path / name).unlink()
    for k, (stage, objective, bound, pool_cameras) in enumerate(states):
        search = {"stage": stage, "bound": bound, "pool_cameras": pool_cameras, "camera_renders": 100 * (k + 1)}
        folder.append_event({**event(k), "loss": objective, "training_objective": objective, **search})
    return folder


def test_the_bound_is_told_with_what_it_is_over(folder):
    changed = {**arms_of(per_scene={"object_weight": [8.0]}), "training_objective": {"start": 0.3, "optimised": 0.076}}
    page = page_of(by_pool(folder), **changed)
    assert any(caption.startswith("The best rig so far, and the bound") for caption in page.alt)
    assert (
        "Proven: no rig of the 60 rendered candidate cameras that keeps the rules is expected to miss fewer than 7.75 "
        "of 100 vehicles, by the modelled probability of detection, on the 60 scenes of the search. The rig has "
        "7.60, below it, as its cameras were moved between the candidates. Of other poses and scenes it says nothing."
    ) in page.words
    assert page.words.lower().count("proven") == 1
    assert "significant" not in page.words
    expected = {row[0]: row[1] for row in page.table("12 test scenes")}["expected misses per 100, weighted"]
    assert float(expected) == pytest.approx(100.0 * arm(0.5)["objective"], abs=0.05)


def test_a_stopped_run_is_told_as_far_as_it_came(tmp_path):
    page = page_of(folder_at(tmp_path / "run"))
    assert "Stopped after 3 iterations, before any rig was compared." in page.words
    assert "warpav optimise --resume" in page.commands[0]
    assert "#misses" not in page.address


def test_a_run_without_iterations_is_refused(tmp_path):
    folder = folder_at(tmp_path / "run", events=0)
    with pytest.raises(InputError, match="expected at least one iteration to report on, got none"):
        write_report(folder)
    assert not (folder.path / "report.html").exists()


def test_an_old_folder_says_what_it_lacks_and_how_to_get_it(tmp_path):
    folder = folder_at(tmp_path / "run", events=0)
    folder.append_event({"iteration": 0, "loss": 2.0, "positions_m": [[0.0, 0.0, 1.0]], "yaw_deg": [0.0]})
    numbers_alone = dict.fromkeys(TABLE_ROWS, 0.5)
    folder.write_evaluation({"scenes": {"test": 2}, "arms": {"optimised": numbers_alone, "highest": numbers_alone}})
    picture(folder.figure_path("detections"))
    (folder.path / "env.json").unlink()
    page = page_of(folder)
    for lacking in ("the rig", "misses by distance and sector", "the ground that no camera"):
        assert f"Not in this folder: {lacking}" in page.words
    assert "#again" in page.address
    assert len([caption for caption in page.alt if caption.startswith("A test scene")]) == 1
    assert [float(cell) for cell in page.table("2 test scenes", "found", "highest")[0][1:]] == [0.5, 0.5]


def test_options_of_another_version_do_not_matter(folder):
    config = folder.path / "config.yaml"
    config.write_text(config.read_text() + "gone:\n  option: '<b>'\n")
    page = page_of(folder)
    assert ["gone.option", "<b>"] in [row for table in page.tables for row in table]
    assert "warpav optimise config.yaml run.out=again" in page.text
    assert "what follows from it is left out: config.yaml:" in page.words
    assert "gone" in page.words.partition("what follows from it is left out")[2][:60]


def test_names_are_text_and_nothing_else(tmp_path):
    evil = '<script>alert("x")</script>'
    content = evaluation()
    for part in ("arms", "paired", "constraints"):
        content[part] = {evil if name == "highest" else name: each for name, each in content[part].items()}
    content["ground"]["blind"][evil] = content["ground"]["blind"].pop("highest")
    for each in content["outcomes"]:
        each["outcome"][evil] = each["outcome"].pop("highest")
    content["outcomes"][0] |= {"scene": evil, "category": evil}
    content["constraints"]["optimised"][0]["cameras"] = [evil]
    content["descent"]["ended"] = evil
    content["seconds"][evil] = 1.0
    folder = fill(folder_at(tmp_path / "<script>"), content)
    environment = folder.environment()
    (folder.path / "env.json").write_text(json.dumps({**environment, "command": evil, "packages": {evil: evil}}))
    picture(folder.figure_path("<img src=x onerror=alert(1)>"))
    text = write_report(folder).read_text()
    page = Page(text)
    assert "script" not in page.seen
    assert "<script" not in text
    assert "onerror=alert(1)>" not in text
    assert page.words.count(evil) >= 8
    assert "<img src=x onerror=alert(1)>" in page.alt


# ------------------------------------------------------------------------------------------------ broken folders


def _replace(name, content):
    def apply(folder):
        file = folder.path / name
        (file.write_bytes if isinstance(content, bytes) else file.write_text)(content)

    return apply


def _evaluation(**changed):
    return lambda folder: folder.write_evaluation(evaluation(**changed))


def _recall_by(change):
    def apply(folder):
        content = json.loads(json.dumps(evaluation()))
        change(content["arms"]["start"]["recall_by"])
        folder.write_evaluation(content)

    return apply


def _event(**changed):
    return _replace("events.jsonl", json.dumps({**event(0), **changed}) + "\n")


BROKEN = {
    "evaluation cut off": (_replace("evaluation.json", '{"schema": 1'), "evaluation.json:1: expected valid JSON"),
    "evaluation is a list": (_replace("evaluation.json", "[]"), "evaluation.json: expected what warpav optimise"),
    "text for a number": (_evaluation(scenes={"test": "many"}), "evaluation.json: scenes.test: expected what"),
    "another schema": (_evaluation(schema=2), "evaluation.json: schema: expected what"),
    "arm without ground": (
        _evaluation(ground={**evaluation()["ground"], "blind": {}}),
        "outcomes and ground must be of all arms, constraints of the first, highest is missing",
    ),
    "unknown outcome": (_evaluation(outcomes=[seen(1.0, "vanished")]), "outcomes.0.outcome.optimised: expected what"),
    "iteration is a list": (_replace("events.jsonl", "[]\n"), "events.jsonl:1: expected an object, got"),
    "iteration without number": (
        _replace("events.jsonl", '{"loss": 1}\n'),
        "events.jsonl:1: iteration: expected a value, got nothing; add iteration",
    ),
    "configuration is a list": (_replace("config.yaml", "[1]\n"), "config.yaml: expected sections of options"),
    "picture is none": (_replace("figures/rig.png", b"\x89PNG nothing"), "rig.png: expected an image, got"),
    "evaluation is too deep": (_replace("evaluation.json", "[" * 200_000), "evaluation.json: expected at most 64"),
    "no number of scenes": (_evaluation(scenes={}), "evaluation.json: scenes: expected what"),
    "group without recall": (
        _recall_by(lambda table: table["sector"]["rear left"].update(recall=None)),
        "evaluation.json: arms.start.recall_by.sector.rear left: expected what",
    ),
    "group of one arm only": (
        _recall_by(lambda table: table["sector"].clear()),
        "recall_by must have the same groups for all arms",
    ),
    "terms are a number": (_event(terms=5), "events.jsonl:1: terms: expected an object, got"),
    "further cameras are none": (_replace("further_cameras.csv", "x\n1\n"), "cameras.csv: expected rows of gain"),
}


@pytest.mark.parametrize(("damage", "told"), BROKEN.values(), ids=BROKEN)
def test_a_broken_folder_is_one_line_with_status_2(folder, capsys, damage, told):
    damage(folder)
    message = complaint(capsys, "report", str(folder.path))
    assert told in message
    assert str(folder.path) in message
    assert not (folder.path / "report.html").exists()


# ------------------------------------------------------------------------------------------------ the terminal


def printed(run, width=3000, show=show_everything):
    """What the terminal shows of a run."""
    stream = io.StringIO()
    show(Terminal(file=stream, width=width), run)
    return stream.getvalue()


def test_the_terminal_says_what_the_page_says(finished):
    run = read_content(finished[0])
    everything, few = printed(run), printed(run, show=show_run)
    for statement in (headline(run), *summary(run), *cautions(run)):
        text = statement.text.replace("\N{NO-BREAK SPACE}", " ").replace("\N{MINUS SIGN}", "-").replace("°", " deg")
        assert text in everything
    assert "│ missed per 100, equal false alarms" in everything
    assert re.search(r"missed per 100, equal false alarms +37.5 +50.0 +12.5 +\+12.5 \[\+3.0, \+20.0\]", few)
    assert len(few.splitlines()) <= 20


def test_rigs_that_do_not_fit_side_by_side_come_in_parts_beside_the_first():
    arms = {f"rig_with_a_name_{k}": arm(0.5) for k in range(5)}
    many = {"arms": arms, "outcomes": None, "ground": None, "constraints": None, "paired": {}}
    run = RunContent(evaluation=RigEvaluation.model_validate(evaluation(**many)))
    assert printed(run, 85).count("12 test scenes ") == 4  # two names of 17 letters take 85 columns
    assert "…" not in printed(run, 85)
    assert printed(run).count("12 test scenes ") == 1


@pytest.mark.parametrize(
    ("options", "again"),
    [
        (["run.out=my run"], "scenes.level=dense"),
        (["scenes.ego=bus"], "'my run'/config.yaml scenes.level=dense run.out='my run'_dense"),
    ],
)
def test_what_to_do_next_keeps_the_options_of_the_run(options, again):
    run = RunContent(evaluation=RigEvaluation.model_validate(evaluation()), config=load_config("quick", options))
    assert next_commands(run, "my run") == ["warpav view 'my run'", f"warpav optimise {again}"]
