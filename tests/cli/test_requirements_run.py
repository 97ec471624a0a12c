"""``warpav optimise`` with requirements: searched for, judged, written, and refused."""

import json

import pytest

from tests.cli.small_run import complaint
from tests.cli.test_pool_run import POOL
from warpav.cli.app import main
from warpav.runs import RunFolder

pytestmark = pytest.mark.usefixtures("working_directory")

NEAR = """requirements:
  near: {area: {around_m: [0.5, 2.5]}, grid_m: 1.0, object: post, pixels: 10, weight: 5, share: 0.999}
"""


def test_a_run_sees_more_of_what_it_has_to_see(working_directory, capsys):
    (working_directory / "mine.yaml").write_text(NEAR, encoding="utf-8")
    assert main(["optimise", *POOL, "requirements=mine.yaml", "run.out=near"]) == 0
    shown = capsys.readouterr().out
    assert "REQUIREMENT NOT MET: near at " in shown
    assert "points of near seen" in shown
    folder = RunFolder.open("near")
    assert folder.config().requirements == str((working_directory / "near" / "requirements.yaml").absolute())
    (working_directory / "mine.yaml").unlink()
    found = json.loads((working_directory / "near" / "evaluation.json").read_text())
    share = {name: outcomes[0]["share"] for name, outcomes in found["requirements"].items()}
    assert set(share) == set(found["arms"])
    terms = folder.events()[-1]["terms"]
    assert found["training_objective"]["optimised"] == pytest.approx(
        (terms["expected_miss_rate"] + 5.0 * terms["requirements"]) / 6.0,
        abs=0.02,  # before numbers are rounded
    )
    page = (working_directory / "near" / "report.html").read_text(encoding="utf-8")
    assert "Seen near the vehicle" in page
    assert "points met near the vehicle" in page
    assert "expected misses and unmet points near the vehicle together" in page
    assert "is expected to miss fewer than" not in page  # that is not what the bound is over
    assert main(["optimise", *POOL, "requirements=null", "run.out=plain"]) == 0
    capsys.readouterr()
    assert main(["rig", "requirements", "plain", "--requirements", "near/requirements.yaml", "--json", "out.json"]) == 0
    plain = json.loads((working_directory / "out.json").read_text())["requirements"][0]["share"]
    assert share["optimised"] > plain
    assert main(["evaluate", "near", "--json", "again.json"]) == 0
    again = json.loads((working_directory / "again.json").read_text())
    assert next(iter(again["requirements"].values()))[0]["share"] == share["optimised"]


def test_the_near_field_counts_by_default_and_asks_for_nothing(working_directory, capsys):
    assert main(["optimise", *POOL, "run.out=default"]) == 0
    shown = capsys.readouterr().out
    assert "points of near_field seen" in shown
    assert "NOT MET" not in shown
    folder = RunFolder.open("default")
    assert folder.config().requirements == "auto"
    found = json.loads((working_directory / "default" / "evaluation.json").read_text())
    outcome = found["requirements"]["optimised"][0]
    assert (outcome["need"]["share"], outcome["is_met"]) == (None, True)
    terms = folder.events()[-1]["terms"]
    assert found["training_objective"]["optimised"] == pytest.approx(
        (terms["expected_miss_rate"] + 0.1 * terms["requirements"]) / 1.1, abs=0.02
    )
    page = (working_directory / "default" / "report.html").read_text(encoding="utf-8")
    assert "near_field is met at" in page
    assert "Not met: " not in page


def test_hard_requirements_that_cannot_be_met_are_named(working_directory, capsys):
    (working_directory / "mine.yaml").write_text(
        "requirements:\n  far: {area: {box_m: [[30, -1], [31, 1]]}, grid_m: 1, object: post, pixels: 9000}\n",
        encoding="utf-8",
    )
    assert main(["optimise", *POOL, "requirements=mine.yaml", "run.out=no"]) == 2
    assert "requirement far: " in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "text"),
    [
        (["requirements=near_fild"], "did you mean near_field"),
        (["requirements=near_field", "optimiser.search=descent", "run.batch_size=2"], "only the search by a pool"),
    ],
)
def test_requirements_that_cannot_be_used_are_one_line(capsys, options, text):
    assert text in complaint(capsys, "optimise", *POOL, *options)
