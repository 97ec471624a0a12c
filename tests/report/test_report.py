"""The report: one file with everything in it, for finished and for stopped runs."""

from html.parser import HTMLParser

import pytest

from warpav.config import load_config
from warpav.errors import InputError
from warpav.report.report import write_report
from warpav.results import ARM_ROWS, RunFolder

ONE_PIXEL_PNG = bytes.fromhex(
    "89504e470d0a1a0a0000000d49484452000000010000000108060000001f15c4890000000d49444154789c6360606060000000050001"
    "a5f645400000000049454e44ae426082"
)


class Page(HTMLParser):
    """Collects tags, texts and addresses, and checks that every tag is closed."""

    VOID = frozenset({"meta", "img"})

    def __init__(self, text):
        super().__init__()
        self.open, self.seen, self.text, self.address = [], [], [], []
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.seen.append(tag)
        self.address += [value for name, value in attrs if name in ("src", "href")]
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text.append(data.strip())


def _metrics(violation=0.0):
    return {**dict.fromkeys(ARM_ROWS, 0.5), "constraint_violation": violation, "ap50_pooled": None}


def _recall(**recall):
    """Recall by group of one arm: two kinds of road users, one bin of two, a category with a tag in its name."""
    some = {"objects": 4, "visible": 4, "detected": 3, "recall": 0.75, "recall_visible": 0.75}
    none = {"objects": 0, "visible": 0, "detected": 0, "recall": None, "recall_visible": None}
    return {
        "road_user": {"vehicle": some, "cyclist": some},
        "distance_m": {"0-10": some, "10-20": none},
        "sector": {"rear left": {**some, **recall}},
        "category": {"<bus>": some},
    }


@pytest.fixture
def folder(tmp_path):
    """A run folder with two iterations."""
    config = load_config("quick", [f"run.out={tmp_path}/<run>"])
    folder = RunFolder.create(config, name="x")
    for iteration in range(2):
        folder.append_event({"iteration": iteration, "loss": 2.0 - iteration})
    return folder


def test_a_finished_run_is_told_in_full(folder):
    difference = {"mean": 0.1, "low": 0.05, "high": 0.2, "scenes": 2}
    alone = {"mean": 0.1, "low": None, "high": None, "scenes": 1}
    folder.write_evaluation(
        {
            "scenes": {"test": 2},
            "arms": {"optimised": _metrics(), "highest": _metrics(violation=0.25)},
            "paired": {"highest": {"tp_detection_rate": difference, "objective": alone}},
            "training_objective": {"start": 2.0, "optimised": 1.5},
        }
    )
    folder.figure_path("rig").write_bytes(ONE_PIXEL_PNG)
    folder.figure_path("another").write_bytes(ONE_PIXEL_PNG)
    page = Page(write_report(folder).read_text())
    for text in (
        "<run>",
        "yes",
        "-25.0%",
        "On 2 test scenes",
        "highest",
        "0.2500",
        "+0.100 [+0.050, +0.200]",
        "+0.100",
    ):
        assert text in page.text
    assert "scenes.train_seeds" in page.text
    assert len(page.address) == 2
    assert all(address.startswith("data:image/png;base64,") for address in page.address)


def test_recall_by_group_is_shown_for_groups_with_objects(folder):
    arms = {
        "optimised": {**_metrics(), "recall_by": _recall(recall=0.875)},
        "highest": {**_metrics(), "recall_by": _recall(recall=0.125)},
    }
    folder.write_evaluation({"scenes": {"test": 2}, "arms": arms, "paired": {}})
    text = Page(write_report(folder).read_text()).text
    place = text.index("rear left")
    assert [word for word in text[place : place + 8] if word][:4] == ["rear left", "4", "0.875", "0.125"]
    for shown in ("0-10 m", "<bus>", "vehicle", "cyclist"):
        assert shown in text
    assert "10-20 m" not in text
    # one kind of road users says nothing new, and a run from before these metrics has a report too
    del arms["optimised"]["recall_by"]["road_user"]["cyclist"]
    folder.write_evaluation({"scenes": {"test": 2}, "arms": arms, "paired": {}})
    assert "vehicle" not in Page(write_report(folder).read_text()).text
    del arms["highest"]["recall_by"]
    folder.write_evaluation({"scenes": {"test": 2}, "arms": arms, "paired": {}})
    assert "rear left" not in Page(write_report(folder).read_text()).text


def test_a_stopped_run_is_told_as_far_as_it_came(folder):
    page = Page(write_report(folder).read_text())
    assert any("stopped before the evaluation" in text for text in page.text)
    assert "1.0000" in page.text


def test_a_run_without_iterations_is_refused(tmp_path):
    folder = RunFolder.create(load_config("quick", [f"run.out={tmp_path}/run"]), name="x")
    with pytest.raises(InputError, match="expected at least one iteration to report on, got none"):
        write_report(folder)
    assert not (folder.path / "report.html").exists()
