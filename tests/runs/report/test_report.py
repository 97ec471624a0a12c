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

from tests.runs.report.run_parts import (
    ARMS,
    arm,
    difference,
    evaluation,
    event,
    fill,
    folder_at,
    picture,
    seen,
)
from warpav.cli.app import main
from warpav.core.errors import InputError
from warpav.rig.rig import Rig, write_rig
from warpav.runs import RunFolder
from warpav.runs._events import Bound, Certificate
from warpav.runs._rig_evaluation import TABLE_ROWS, RigEvaluation
from warpav.runs._terminal import Terminal
from warpav.runs.config import load_config
from warpav.runs.report._content import RunContent, read_content
from warpav.runs.report._statements import headline, summary
from warpav.runs.report.report import write_report
from warpav.runs.report.tables import show_run


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

    def handle_startendtag(self, tag, attrs):
        self.handle_starttag(tag, attrs)
        self.handle_endtag(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text.append(data.strip())
        if "pre" in self.open:
            self.commands[-1] += data
        if {"td", "th"} & set(self.open):
            self.tables[-1][-1][-1] += data

    def table(self, *heading):
        """The rows below a heading that begins so."""
        return next(table[1:] for table in self.tables if tuple(table[0][: len(heading)]) == heading)

    @property
    def words(self):
        return " ".join(" ".join(self.text).split())


def page_of(folder):
    """The page of a folder."""
    return Page(write_report(folder).read_text(encoding="utf-8"))


def numbers(text):
    """The numbers in a text, typographic minus signs and all."""
    return [float(each) for each in re.findall(r"[-+]?\d+\.?\d*", text.replace("\N{MINUS SIGN}", "-"))]


_IS_REPORT = shutil.ignore_patterns("report.html")


@pytest.fixture
def folder(tmp_path, finished):
    """The run folder of a finished run, with a tag in its name."""
    return RunFolder.open(shutil.copytree(finished[0].path, tmp_path / "<run>", ignore=_IS_REPORT))


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
    shown = {row[0]: row[1:] for row in page.table("12 test scenes", "optimised", "start", "highest")}
    for name, heading in TABLE_ROWS.items():
        values = [content["arms"][each][name] for each in ARMS]
        if values == [None] * 3:
            assert heading not in shown
        else:
            assert [float(cell) for cell in shown[heading]] == pytest.approx(values, abs=5e-5)
    differences = {row[0]: row[1:] for row in page.table("", "optimised - start", "optimised - highest")}
    assert numbers(differences["recall of the rig"][0]) == [0.125, 0.03, 0.2]
    assert numbers(differences["recall of the rig"][1]) == [-0.25, -0.4, -0.1]
    assert numbers(differences["objective (lower is better)"][1]) == [0.1]
    recall = page.table("recall of the rig", "objects", "optimised")
    assert ["0-10 m", "8", "0.625", "0.500", "0.875"] in recall
    assert ["<bus>", "8", "0.625", "0.500", "0.875"] in recall
    assert not any(row[0] in ("10-20 m", "vehicle") for row in recall)  # none there; only one kind


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
    heading = "optimised without", "expected misses per 100", "difference"
    assert "If one camera fails" not in page.text  # an older run does not know
    folder.write_evaluation(evaluation(camera_outage={"optimised": OUTAGE, "start": None}))
    rows = page_of(folder).table(*heading)
    assert rows == [["no camera", "12.50", ""], ["front", "20.25", "+7.75"], ["<rear> (worst)", "50.00", "+37.50"]]
    weighted = {**OUTAGE, "cameras": [{**each, **WEIGHTS} for each in OUTAGE["cameras"]]}
    weighted["weighted_expected_misses_per_100"] = 9.0
    folder.write_evaluation(evaluation(camera_outage={"optimised": weighted}))
    rows = page_of(folder).table(*heading, "weighted expected misses per 100", "weighted difference")
    assert rows[1] == ["front (worst)", "20.25", "+7.75", "10.00", "+0.00"]
    del weighted["cameras"][1]["weighted_difference_per_100"]
    folder.write_evaluation(evaluation(camera_outage={"optimised": weighted}))
    with pytest.raises(InputError, match="weighted numbers must be there for all cameras or for none"):
        write_report(folder)


def test_the_most_sensitive_camera_is_named(folder, page):
    assert "If a camera is off" not in page.text  # an older run does not know
    worst = {"camera": "<rear>", "degree": "yaw", "change_per_100": 0.254}
    draws = {"count": 8, "expected_misses_per_100": 13.0, "quantile_95": 14.0}
    tolerance = {"position_m": 0.02, "angle_rad": 0.017453292519943295, "scenes": 10, "worst": worst, "draws": draws}
    tolerance |= {"expected_misses_per_100": 12.5, "effects": []}
    both = {"mount_tolerance": tolerance, "camera_outage": {"optimised": OUTAGE}}
    folder.write_evaluation(evaluation(**both))
    told = " ".join(page_of(folder).text)
    assert "Most sensitive is <rear> in yaw: off by 1 degree, the rig is expected to miss 0.25 more of 100" in told
    assert "(10 scenes); in traffic the loss of <rear> costs most, 37.5 more misses of 100." in told
    worst |= {"degree": "z", "change_per_100": 0.1}
    folder.write_evaluation(evaluation(mount_tolerance=tolerance))
    assert "in z: off by 2 cm," in " ".join(page_of(folder).text)
    worst["change_per_100"] = 0.004
    folder.write_evaluation(evaluation(mount_tolerance=tolerance))
    nothing = "No camera that is off by 2 cm or 1 degree in one direction costs anything (10 scenes)."
    assert nothing in " ".join(page_of(folder).text)


def test_the_blind_spots_are_those_of_the_evaluation(page):
    child, adult = (table[1:] for table in page.tables if table[0][0] == "sector")
    assert [[numbers(cell) for cell in row[1:]] for row in child] == [[[80, 50], [7, 7]], [[25, 5], []]]
    assert [[numbers(cell) for cell in row[1:]] for row in adult] == [[[10, 0], [0, 0]], [[0, 0], []]]
    # 125 of 500 cells of a quarter of a square metre in 12 scenes
    assert "optimised 25.0 % (3 m² a scene)" in page.words.replace("\N{NO-BREAK SPACE}", " ")
    rows = page.table("scene", "class")
    assert [row[2] for row in rows] == ["4.2", "21.0", "30.0"]  # the nearest first
    assert [row[4:7] for row in rows] == [
        ["right", "missed", "detected"],
        ["right", "hidden", "detected"],
        ["right", "out of frame", "missed"],
    ]


def test_cameras_constraints_and_times_are_told(page):
    cameras = page.table("camera")
    assert numbers(" ".join(cameras[0][2:6])) == [1.0, 0.5, 1.5, 0.0]
    assert numbers(" ".join(cameras[1][2:6])) == [1.125, 0.5, 1.5, 30.0]  # the best rig is kept, not the last
    assert numbers(cameras[1][-1]) == [0.125, 30.0]
    constraints = page.table("constraint of the optimised rig")
    assert [numbers(" ".join(row[1:4])) for row in constraints] == [[0.5, 0.02, 0.48], [0.25, 0.2, 0.05]]
    assert [row[-1] for row in constraints] == ["yes", "yes"]
    assert "moved" in next(table[0] for table in page.tables if table[0][0] == "camera")
    assert {row[0]: float(row[1]) for row in page.table("stage")} == {
        "descent": 3.5,
        "total": 12.2,
        "one iteration: render, mean": 0.25,
        "one iteration: total, mean": 0.5,
    }


def test_the_pictures_of_the_folder_have_their_captions(page):
    assert any(caption.startswith("Recall of every rig by distance, sector") for caption in page.alt)
    assert page.alt.count("left") == 2  # what that camera sees of two scenes
    assert "The first test scene" in page.words


def test_the_command_makes_the_same_run(finished, page):
    folder, _ = finished
    program, verb, *words = shlex.split(page.commands[0])
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


# ------------------------------------------------------------------------------------------------ words


def words_of(folder, **changed):
    folder.write_evaluation(evaluation(**changed))
    run = read_content(folder)
    told = [headline(run).text, *(statement.text for statement in summary(run))]
    return "\n".join(told).replace("\N{NO-BREAK SPACE}", " ")


def test_cameras_that_would_pitch_farther_are_told(folder):
    rig = folder.rig()
    assert "wider rig.free.pitch_deg" not in words_of(folder)
    high = math.radians(folder.config().rig.free.pitch_deg[1])
    first = rig.cameras[0]
    for away, is_told in ((0.01, True), (0.5, False)):
        pitched = dataclasses.replace(first, pitch_rad=high - math.radians(away))
        write_rig(Rig([pitched, *rig.cameras[1:]]), folder.rig_path("best"))
        told = f"{first.name} pitches as far as it may (-10 to 20 degrees): a wider rig.free.pitch_deg may find more."
        assert (told in words_of(folder)) == is_told


def test_the_summary_says_what_the_numbers_say(folder, page):
    words = words_of(folder)
    assert all(line in page.words.replace("\N{NO-BREAK SPACE}", " ") for line in words.split("\n"))
    for text in (
        "The optimised rig detects more than the start and detects fewer than the highest rig.",
        "detects 5 of 8 vehicles (recall 0.625); the start 4 and the highest rig 7.",
        "(significant: better)",
        "(significant: worse)",
        "fell by 25.0 % (2.0000 to 1.5000) on the training scenes",
        "the gain holds on new scenes",
        "left by 12 cm (turned 30° to the left); 1 camera stayed.",
        "3 vehicles: 1 visible to a camera but missed by the detector, 1 hidden behind something and 1 in no "
        "camera's image. The nearest is 4 m away.",
        "no camera sees 25.0 % of the ground for someone 1.1 m tall (start 15.0 %, highest 0.0 %)",
        "That is more than at the start",
        "worst in the sector front, 0 to 5 m from its centre: no camera sees a child on 80 % of it.",
        "All 2 hold; the tightest is the distance between left and right, with 50 mm to spare.",
        "No better rig in 2 looks, after 2 of 5 iterations; the rig after 1 is kept.",
        "12 test scenes are few, and the intervals of so few tend to be too short.",
    ):
        assert text in words


@pytest.mark.parametrize(
    ("found", "told"),
    [
        (difference(0.1, -0.1, 0.3), "(not significant)"),
        (difference(0.0, 0.0, 0.0), "the same in every scene"),
        (difference(0.1, 0.05, 0.3, scenes=5), "(not significant with 5 scenes)"),
        (difference(0.1, None, None, scenes=1), "one scene has no interval"),
        (difference(0.1, 0.0, 0.3), "(not significant)"),
    ],
)
def test_no_difference_is_claimed_that_is_not_proven(folder, found, told):
    words = words_of(folder, paired={"start": {"tp_detection_rate": found}})
    assert told in words
    is_enough = found["scenes"] >= 6
    assert ("The optimised rig cannot be distinguished from the start by what it detects." in words) == is_enough


@pytest.mark.parametrize(
    ("expected", "is_warned"), [(37.5, False), (20.0, False), (15.0, True), (33.0, False), (2.7, True)]
)
def test_expected_misses_stand_beside_what_the_detector_misses(folder, expected, is_warned):
    """The detector misses 3 of 8."""
    outage = {**OUTAGE, "expected_misses_per_100": expected}
    words = words_of(folder, camera_outage={"optimised": outage, "start": OUTAGE, "highest": None})
    told = f"is expected to miss {expected:.1f}, and its detector misses 37.5; the start 12.5 and 50.0."
    assert f"Of 100 vehicles of the test scenes the optimised rig {told}" in words
    assert ("The detector misses far more than the model expects" in words) == is_warned
    assert "is expected to miss" not in words_of(folder)  # an older run does not know


def test_the_headline_of_a_search_says_what_is_expected_first(folder):
    open_recall = difference(0.02, -0.02, 0.06)
    paired = {
        "start": {"tp_detection_rate": open_recall, "objective": difference(-0.06, -0.09, -0.03)},
        "highest": {"tp_detection_rate": open_recall, "objective": difference(-0.01, -0.03, 0.01)},
    }
    arms = {
        name: arm(0.5, objective=value) for name, value in (("optimised", 0.06), ("start", 0.12), ("highest", 0.07))
    }
    folder.write_evaluation(evaluation(arms=arms, paired=paired))
    run = read_content(folder)
    assert not headline(run).text.startswith("In")  # a descent may lower something else
    search = dataclasses.replace(run, certificate=Certificate(0.06, (Bound(0.06, 100, 5000),)))
    told = headline(search)
    assert told.text.replace("\N{NO-BREAK SPACE}", " ") == (
        "In 12 scenes that no search has seen, the optimised rig is expected to miss 6.0 of 100 vehicles, "
        "significantly fewer than the start (12.0). What the detector finds there cannot tell it from the start or the "
        "highest rig."
    )
    assert told.tone == "good"
    for found in paired.values():
        found["tp_detection_rate"] = difference(0.1, 0.05, 0.2)
    folder.write_evaluation(evaluation(arms=arms, paired=paired))
    proven = headline(dataclasses.replace(read_content(folder), certificate=search.certificate)).text
    assert proven.endswith("than the start (12.0). It detects more than the start and the highest rig.")
    paired["highest"]["tp_detection_rate"] = difference(-0.1, -0.2, -0.05)
    folder.write_evaluation(evaluation(arms=arms, paired=paired))
    worse = dataclasses.replace(read_content(folder), certificate=search.certificate)
    assert headline(worse).text.startswith(
        "The optimised rig detects more than the start and detects fewer than the highest"
    )
    assert headline(worse).tone == "bad"


def test_broken_constraints_are_told_in_red(folder):
    content = evaluation()
    content["constraints"]["optimised"] = content["constraints"]["start"]
    content["arms"]["optimised"]["constraint_violation"] = 0.025
    folder.write_evaluation(content)
    page = page_of(folder)
    assert "1 of 2 are broken; the distance between left and right is 25 mm too short." in page.words
    assert page.table("constraint of the optimised rig")[1][-1] == "no"
    assert "0.0250 m" in page.text


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
    text = write_report(by_pool(folder)).read_text(encoding="utf-8")
    page = Page(text)
    assert "Best rig and bound over the camera renders" in text
    assert "loss over the iterations" not in text
    assert "on the 60 scenes of the search no rig of the pool's 60 cameras is expected to miss less than 7.75" in (
        page.words.replace("On the", "on the")
    )
    assert "misses 8.00\N{NO-BREAK SPACE}%, 0.25 points more." in text
    moved = "As the pool grew from 40 to 60 cameras, the bound moved from 9.00 % to 7.75 %"
    assert moved in text.replace("\N{NO-BREAK SPACE}", " ")
    unseen = evaluation()["arms"]["optimised"]["objective"]
    assert f"On the test scenes the rig is expected to miss {100 * unseen:.2f}\N{NO-BREAK SPACE}%" in text
    assert "What the search lowers" in text
    assert "Line: the objective of the best rig so far" in page.words
    assert "rises where a selection proves more than the one before" in page.words


def test_a_stopped_run_is_told_as_far_as_it_came(tmp_path):
    page = page_of(folder_at(tmp_path / "run"))
    assert "(stopped before the evaluation)" in page.words
    assert "Stopped after 3 iterations, before any rig was compared." in page.words
    assert "1.0000" in page.text
    assert "warpav evaluate" in page.text


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
    picture(folder.figure_path("loss_curves"))
    (folder.path / "env.json").unlink()
    page = page_of(folder)
    for lacking in ("the rig", "recall by distance and sector", "the ground that no camera"):
        assert f"Not in this folder: {lacking}" in page.words
    for lacking in ("what becomes of every single object", "every single constraint", "the versions"):
        assert f"Not in this folder: {lacking}" in page.words
    assert "#again" in page.address
    assert len([caption for caption in page.alt if caption.startswith(("A test scene through", "Loss, loss"))]) == 2
    assert [float(cell) for cell in page.table("2 test scenes", "optimised", "highest")[0][1:]] == [0.5, 0.5]


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
    "evaluation cut off": (
        _replace("evaluation.json", '{"schema": 1, "arms"'),
        "evaluation.json:1: expected valid JSON",
    ),
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
    "evaluation is too deep": (
        _replace("evaluation.json", "[" * 200_000),
        "evaluation.json: expected at most 64 levels",
    ),
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
    "further cameras are none": (
        _replace("further_cameras.csv", "x\n1\n"),
        "further_cameras.csv: expected rows of gain",
    ),
}


@pytest.mark.parametrize(("damage", "told"), BROKEN.values(), ids=BROKEN)
def test_a_broken_folder_is_one_line_with_status_2(folder, capsys, damage, told):
    damage(folder)
    assert main(["report", str(folder.path)]) == 2
    message = capsys.readouterr().err
    assert told in message
    assert message.count("\n") == 1
    assert str(folder.path) in message
    assert not (folder.path / "report.html").exists()


# ------------------------------------------------------------------------------------------------ the terminal


def printed(width=300, **changed):
    """What the terminal shows of an evaluation."""
    stream = io.StringIO()
    run = RunContent(evaluation=RigEvaluation.model_validate(evaluation(**changed)))
    show_run(Terminal(file=stream, width=width), run)
    return stream.getvalue()


def test_the_terminal_says_what_the_page_says(finished):
    stream = io.StringIO()
    run = read_content(finished[0])
    show_run(Terminal(file=stream, width=3000), run)
    words = stream.getvalue()
    for statement in (headline(run), *summary(run)):
        text = statement.text.replace("\N{NO-BREAK SPACE}", " ").replace("\N{MINUS SIGN}", "-")
        assert text.replace("°", " deg") in words
    assert "│ recall of the rig" in words


def test_rigs_that_do_not_fit_side_by_side_come_in_parts_beside_the_first():
    arms = {f"rig_with_a_name_{k}": arm(0.5) for k in range(5)}
    many = {"arms": arms, "outcomes": None, "ground": None, "constraints": None, "paired": {}}
    assert printed(80, **many).count("12 test scenes ") == 4 + 1  # two names of 17 letters take 80 columns
    assert "…" not in printed(80, **many)
    assert printed(**many).count("12 test scenes ") == 1 + 1  # the last is the caution


REQUIREMENT = {
    **{"name": "near", "hard": True, "weight": None, "points": 4, "met": 2, "share": 0.5, "is_met": False},
    "need": {"object": "child", "visible_share": 0.5, "pixels": 1.0, "cameras": 1, "share": 0.99},
    "worst": [{"position_m": [1.0, -2.0], "camera": None, "cameras": 0, "visible_share": 0.0, "pixels": 0.0}],
    "gap": {"area_m2": 1.2345, "sector": "rear left"},
}
WARNINGS = {
    "all is well": ({}, ()),
    "worse objective": (
        {"training_objective": {"start": 0.2, "optimised": 0.3}},
        ("WORSE THAN ITS START: the optimised rig has objective 0.3, its start 0.2",),
    ),
    "no objective": ({"training_objective": {"start": 0.2, "optimised": None}}, ("objective no number",)),
    "worse recall": (
        {"paired": {"start": {"tp_detection_rate": difference(-0.2, -0.3, -0.1)}}},
        ("has recall 0.6250 on the test scenes, its start 0.5000",),
    ),
    "requirement": (
        {"requirements": {name: [REQUIREMENT] for name in ARMS}},
        (
            "REQUIREMENT NOT MET: near at 50.0 % of 4 points, asked 99 %; worst at x = 1.0 m, y = -2.0 m; largest gap: "
            "1.23 m², rear left",
        ),
    ),
    "start that is not allowed": (
        {
            "requirements": {name: [REQUIREMENT] for name in ARMS},
            "training_objective": {"start": None, "optimised": 0.1},
        },
        ("the start is not allowed, as it does not meet near.",),
    ),
    "own body": (
        {"arms": {name: arm(0.0, body_share_max=0.97) for name in ARMS}},
        ("highest detects nothing: the vehicle's own body covers up to 97% of an image",),
    ),
}


@pytest.mark.parametrize(("changed", "told"), WARNINGS.values(), ids=WARNINGS)
def test_what_is_wrong_with_a_rig_is_said(changed, told):
    words = printed(3000, **changed)
    assert all(text in words for text in told)
    if not told:
        assert not any(text in words for text in ("WORSE", "NOT MET", "detects nothing"))
