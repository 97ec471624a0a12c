"""Rows of studies and the tables of them; the published page follows from the published rows."""

import re
from pathlib import Path

import numpy as np
import pytest

from warpav.core.errors import InputError
from warpav.experiments import filled_page, read_rows, write_rows
from warpav.experiments._rows import MARK, rows_of, table_of
from warpav.optimisation import paired_difference

ROOT = Path(__file__).parents[2]
PUBLISHED = ROOT / "docs" / "results.csv"
PAGES = [ROOT / "docs" / "results.md", ROOT / "README.md"]
SCENES = 12


def made_run(arm, seed, misses, renders=100):
    """A run that misses so many of 100 in each scene, and is expected to."""
    of_scene = [float(each) for each in np.broadcast_to(misses, SCENES)]
    metrics = {
        "objective": float(np.mean(of_scene)) / 100.0,
        "misses_at_equal_false_alarms": float(np.mean(of_scene)),
        "per_scene": {"misses_at_equal_false_alarms": of_scene, "objective": [each / 100.0 for each in of_scene]},
    }
    return {
        **{"arm": arm, "seed": seed, "metrics": metrics, "objects_of_scene": [10] * SCENES},
        **{"camera_renders": renders, "seconds": {"search": 1.5}},
    }


@pytest.fixture
def results():
    rng = np.random.default_rng(0)
    return {
        "default": [made_run("default", seed, rng.uniform(30, 40, SCENES)) for seed in range(3)],
        "highest": [made_run("highest", 0, rng.uniform(40, 50, SCENES), renders=0)],
    }


def test_rows_are_runs_and_differences_over_scenes_and_runs(results, tmp_path):
    rows = rows_of(results, "made", "builtin", {"highest": "default"}, resamples=199)
    assert [(row["arm"], row.get("seed")) for row in rows] == [
        *(("default", str(seed)) for seed in range(3)),
        *(("highest", "0"), ("highest", None)),
    ]
    scenes = [[run["metrics"]["per_scene"] for run in runs] for runs in results.values()]
    tables = [np.array([each["misses_at_equal_false_alarms"] for each in runs]) for runs in scenes]
    expected = paired_difference(*tables[::-1], weight=[10] * SCENES, resamples=199)
    found = rows[-1]
    assert (found["of"], found["reference"]) == ("misses_at_equal_false_alarms", "default")
    assert [float(found[each]) for each in ("more", "low", "high")] == pytest.approx(
        [expected.mean, expected.low, expected.high], rel=1e-5
    )
    write_rows(rows, tmp_path / "rows.csv")
    again = read_rows(tmp_path / "rows.csv")
    table = table_of("arms made", again).markdown()
    assert table == table_of("arms made", rows).markdown()
    mean = np.mean([run["metrics"]["misses_at_equal_false_alarms"] for run in results["default"]])
    assert f"| default | 3 | {mean:.1f} |  |" in table
    assert f"{expected.mean:+.1f} [{expected.low:+.1f}, {expected.high:+.1f}]" in table


def test_without_a_detector_the_objective_is_compared(results):
    for runs in results.values():
        for run in runs:
            run["test_objective_of_scene"] = run.pop("metrics")["per_scene"]["objective"]
    rows = rows_of(results, "made", "builtin", {"highest": "default"}, resamples=99)
    assert rows[-1]["of"] == "objective"
    assert "expected misses per 100" in table_of("arms made", rows).markdown()


def test_layouts_stand_beside_what_their_cost_buys():
    """Cost, misses and near field of three arms; differences with the sign of how many fewer the search misses."""
    runs = {"default": (30.0, 17.0), "as_built": (36.0, 17.4), "by_hand": (33.0, 17.4)}
    results = {
        arm: [{**made_run(arm, 0, 2 * misses), "cost": cost, "required_share": 0.9}]
        for arm, (misses, cost) in runs.items()
    }
    for runs in results.values():  # of what any sensor could find, half as many are missed
        metrics = runs[0]["metrics"]
        metrics["attainable_misses_per_100"] = metrics["misses_at_equal_false_alarms"] / 2
        of_scene = metrics["per_scene"]
        of_scene["attainable_misses_per_100"] = [each / 2 for each in of_scene["misses_at_equal_false_alarms"]]
    study, references = "at_cost_nuscenes_lidar_sind", dict.fromkeys(("as_built", "by_hand"), "default")
    rows = rows_of(results, study, "builtin", references, resamples=99)
    for table in (table_of("costs", rows), table_of(f"costs {study} builtin", rows)):
        [line] = table.rows
        assert line[0] == "nuscenes, lidar, SinD crossing"
        assert line[1:3] == ("17.4 / 17.4 / 17.0", "36.0 / 33.0 / 30.0")
        assert [each.split()[0] for each in line[3:5]] == ["+6.0", "+3.0"]
        assert line[5] == "90 / 90 / 90"
    assert table_of("costs at_cost_series", rows).rows == ()


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_published_tables_are_computed_from_the_published_rows(page):
    text = page.read_text(encoding="utf-8")
    assert MARK.search(text)
    assert filled_page(text, read_rows(PUBLISHED)) == text


def test_what_is_published_is_small_and_every_study_is_shown():
    assert PUBLISHED.stat().st_size < 200_000
    assert PAGES[0].stat().st_size < 22_000
    studies = {row["study"] for row in read_rows(PUBLISHED)}
    shown = {word for _, marked, _ in MARK.findall(PAGES[0].read_text(encoding="utf-8")) for word in marked.split()}
    assert studies - shown <= {"trained_on", "correlation"}


def test_a_file_that_is_no_rows_is_named(tmp_path):
    file = tmp_path / "rows.csv"
    for text, told in (("", "column study"), ("study,judge\na,b\n", "column arm")):
        file.write_text(text)
        with pytest.raises(InputError, match=rf"rows\.csv: .*{told}"):
            read_rows(file)
    with pytest.raises(InputError, match=re.escape("none.csv: expected rows of studies")):
        read_rows(tmp_path / "none.csv")
