"""`warpav bench` from its command to its files."""

import json
import math
import subprocess
import sys

import numpy as np
import pytest

from tests.architecture.test_startup import HEAVY, modules_after
from tests.cli.small_run import complaint
from tests.experiments.bench.small_workload import SIZE, VEHICLES, small_truth, small_workload
from warpav.cli.app import main
from warpav.experiments.bench._items import Bench
from warpav.experiments.bench._run import array_file
from warpav.experiments.bench._scores import ImageScores, gradient_scores
from warpav.experiments.bench._workload import WEIGHT_NAMES, Truth

pytestmark = pytest.mark.usefixtures("working_directory")

NUMBERS = ("median_ms", "min_ms", "max_ms", "n", "threads", "setup_ms", "compile_ms")


@pytest.fixture
def files(tmp_path):
    """A small workload and a truth."""
    arrays = small_workload()
    np.savez(tmp_path / "small.npz", **arrays)
    np.savez(tmp_path / "truth.npz", **small_truth(arrays))
    return tmp_path


def bench(*argv):
    return main(["bench", "--repeat", "1", *map(str, argv)])


def test_results_follow_the_schema(files, device, capsys):
    assert bench("--workload", "small.npz", "--device", device, "--supersample", 2, "--json", "out.json") == 0
    content = json.loads((files / "out.json").read_text())
    assert content["schema"] == "warpav-bench-1"
    assert set(content["versions"]) == {"warpav", "warp", "python", "numpy"}
    assert content["device"]["kind"] == device.partition(":")[0]
    assert content["device"]["name"]
    assert content["workload"] == {
        "file": "small.npz", "seed": 11, "faces": 43 * 48 + 2 - 48 + 12 - 48, "views": 12, "res": SIZE, "visible": 1,
    }  # fmt: skip
    assert content["options"]["supersample"] == 2
    assert content["scores"] == {}
    assert set(content["items"]) == {"w1", "w2", "w3"}
    for entry in content["items"].values():
        assert all(entry[name] >= 0 for name in NUMBERS)
        assert entry["min_ms"] <= entry["median_ms"] <= entry["max_ms"]
        assert entry["n"] == 1
        assert entry["peak_rss_mib" if device == "cpu" else "peak_device_mib"] > 0
    w1 = content["items"]["w1"]
    for name in WEIGHT_NAMES:
        assert np.shape(w1["grad"][name]) == (20, 3)
        assert np.shape(w1["value"][name]) == (20,)
        assert np.abs(w1["grad"][name]).max() > 1
    with np.load(files / content["items"]["w2"]["arrays"]) as arrays:
        assert set(arrays.files) == {"ids", "depth"}
        ids, depth = arrays["ids"], arrays["depth"]
    assert ids.shape == depth.shape == (12, SIZE, SIZE)
    assert ids.dtype.kind == "i"
    assert depth.dtype == np.float32
    assert -1 <= ids.min() <= ids.max() == VEHICLES + 2
    np.testing.assert_array_equal(ids == -1, depth == -1)
    with np.load(files / content["items"]["w3"]["arrays"]) as arrays:
        assert arrays.files == ["rgb"]
        rgb = arrays["rgb"]
    assert rgb.shape == (12, SIZE, SIZE, 3)
    assert rgb.dtype == np.float32
    assert not rgb[ids == -1].any()
    assert sorted(file.name for file in files.iterdir()) == [
        "out.json", "out.w2.npz", "out.w3.npz", "small.npz", "truth.npz",
    ]  # fmt: skip
    printed = capsys.readouterr().out
    assert "small.npz" in printed
    assert "measured elsewhere" not in printed  # other renderers were measured on other work
    if device == "cpu":
        assert content["reference"]["embreex"]["w3"]["ratio"] > 0


def test_the_truth_only_adds_scores(files):
    assert bench("--workload", "small.npz", "--json", "without.json", "--no-embree") == 0
    assert bench("--workload", "small.npz", "--truth", "truth.npz", "--json", "with.json", "--no-embree") == 0
    one, other = (json.loads((files / name).read_text()) for name in ("without.json", "with.json"))
    assert one["items"]["w1"]["grad"] == other["items"]["w1"]["grad"]
    assert one["items"]["w1"]["value"] == other["items"]["w1"]["value"]
    for item in ("w2", "w3"):
        with np.load(files / f"without.{item}.npz") as a, np.load(files / f"with.{item}.npz") as b:
            for name in a.files:
                np.testing.assert_array_equal(a[name], b[name])
    assert one["scores"] == {}
    assert set(other["scores"]) == {"w1", "w2"}
    assert set(other["scores"]["w1"]) == set(WEIGHT_NAMES)
    for parts in other["scores"]["w1"].values():
        for part in ("xz", "xzyaw"):
            assert set(parts[part]) == {"cos_median", "cos_min", "rel_median", "rel_p90", "rel_max", "rel_all"}
    assert 0 <= other["scores"]["w2"]["id_share"] < 0.5  # the truth is made up


@pytest.mark.parametrize("lens", ["brown_conrady", "fisheye", "panorama"])
def test_every_lens_sees_what_embree_sees(files, lens):
    assert bench("--workload", "small.npz", "--lens", lens, "--json", f"{lens}.json") == 0
    content = json.loads((files / f"{lens}.json").read_text())
    assert content["options"]["lens"] == lens
    assert set(content["items"]) == {"w1", "w2", "w3"}
    assert set(content["scores"]) == {"w2"}  # nothing is known of gradients
    assert content["scores"]["w2"]["id_share"] >= 0.9999
    assert content["scores"]["w2"]["depth_p999_m"] < 1e-3
    assert content["reference"]["embreex"]["w2"]["ratio"] > 0


def test_a_truth_is_a_pinholes(files, capsys):
    assert bench("--workload", "small.npz", "--truth", "truth.npz", "--lens", "fisheye", "--items", "w2") == 2
    assert "truth" in capsys.readouterr().err


def test_only_what_was_asked_for_is_measured(files):
    assert bench("--workload", "small.npz", "--items", "w2", "--json", "two.json", "--no-embree") == 0
    content = json.loads((files / "two.json").read_text())
    assert set(content["items"]) == {"w2"}
    assert "reference" not in content
    assert not (files / "two.w3.npz").exists()


def test_the_embedded_workload_is_scored_and_compared(files, capsys):
    assert bench("--items", "w1,w2", "--no-embree", "--json", "out.json") == 0
    content = json.loads((files / "out.json").read_text())
    assert (content["workload"]["seed"], content["workload"]["faces"]) == (7, 112768)
    scores = content["scores"]["w1"]
    # seen .0015, .0700, .0021, .0224
    assert scores["smooth"]["xzyaw"]["rel_all"] < 0.0025
    assert scores["white"]["xzyaw"]["rel_all"] < 0.09
    assert scores["smooth"]["xz"]["rel_all"] < 0.003
    assert scores["white"]["xz"]["rel_all"] < 0.03
    assert content["scores"]["w2"]["id_share"] > 0.99999  # seen 1.0
    assert content["scores"]["w2"]["depth_p999_m"] < 1e-4  # seen 4.2e-5
    printed = capsys.readouterr().out
    assert printed.count("measured elsewhere") > 5
    for peer in ("Mitsuba", "PyTorch3D", "nvdiffrast"):
        assert peer in printed


def test_a_sweep_goes_through_every_supersampling(files, capsys):
    argv = ["--workload", "small.npz", "--truth", "truth.npz", "--items", "w1", "--sweep", "--json", "out.json"]
    assert bench(*argv) == 0
    rows = json.loads((files / "out.json").read_text())["sweep"]
    assert [row["supersample"] for row in rows] == [1, 2, 4, 8]
    assert all(row["min_ms"] > 0 and set(row["scores"]["w1"]) == set(WEIGHT_NAMES) for row in rows)
    printed = capsys.readouterr().out
    assert all(f" x{row['supersample']} " in printed for row in rows)


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        (["--workload", "none.npz"], "none.npz: expected an existing .npz file, got none of that name"),
        (["--workload", "truth.npz"], "truth.npz: format: expected an array of this name, got none"),
        (["--workload", "small.npz", "--truth", "small.npz"], "small.npz: weights: expected an array of this name"),
        (["--items", "w1,w4"], "command line (--items): expected some of w1,w2,w3, got 'w4'"),
        (["--repeat", "0"], "command line (--repeat): expected at least 1, got 0"),
        (["--json", "nowhere/out.json"], "nowhere/out.json: --json: expected an existing folder"),
        (["--json", "."], ".: --json: expected a file to write, got a folder"),
        (["--device", "cuda:77"], "device: expected one of"),
        (["--supersample", "3"], "command line:"),
    ],
)
def test_bad_input_is_told_in_one_line_and_writes_nothing(files, capsys, argv, message):
    before = sorted(files.iterdir())
    target = [] if "--json" in argv else ["--json", "out.json"]
    assert complaint(capsys, "bench", *target, *argv).startswith(message)
    assert sorted(files.iterdir()) == before


def test_a_run_that_fails_leaves_nothing(files, monkeypatch, capsys):
    (files / "out.json").write_text("earlier")

    def fail(self):
        yield from list(self.depth_and_object())[:0]
        raise MemoryError

    monkeypatch.setattr(Bench, "rgb", fail)
    before = sorted(files.iterdir())
    assert bench("--workload", "small.npz", "--json", "out.json", "--no-embree") == 1
    assert "MemoryError" in capsys.readouterr().err
    assert sorted(files.iterdir()) == before
    assert (files / "out.json").read_text() == "earlier"


def test_help_imports_nothing_heavy():
    modules, output = modules_after("from warpav.cli.app import main\nassert main(['bench', '--help']) in (0, None)")
    assert "--supersample" in output
    assert modules & HEAVY == set()


# ---------------------------------------------------------------------------------------------------------- scores


def test_gradient_scores_are_what_they_are_called():
    truth = np.array([[3.0, 4.0, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, 0.0]])
    ours = np.array([[3.0, 4.0, 5.0], [0.0, -2.0, 0.0], [1.0, 0.0, 0.0]])
    scores = gradient_scores(dict.fromkeys(WEIGHT_NAMES, ours), dict.fromkeys(WEIGHT_NAMES, truth))["white"]
    assert scores["xz"] == pytest.approx(
        {
            "cos_median": 0.0,
            "cos_min": -1.0,
            "rel_median": 1.0,
            "rel_p90": 1.8,
            "rel_max": 2.0,
            "rel_all": math.sqrt(16 + 1) / math.sqrt(29),
        }
    )
    assert scores["xzyaw"]["cos_median"] == pytest.approx(0.5 * (25 / (5 * math.sqrt(50)) - 1))
    assert scores["xzyaw"]["rel_all"] == pytest.approx(math.sqrt(25 + 16 + 1) / math.sqrt(29))


def test_gradients_without_truth_have_no_score():
    nothing = dict.fromkeys(WEIGHT_NAMES, np.zeros((2, 3)))
    assert set(gradient_scores(nothing, nothing)["ones"]["xz"].values()) == {None}


def test_image_scores_compare_the_known_views():
    index = np.array([[[0, 1], [-1, 2]], [[3, 3], [3, -1]]])
    depth = np.array([[[1.0, 2.0], [-1.0, 4.0]], [[5.0, 6.0], [7.0, -1.0]]], np.float32)
    nothing = dict.fromkeys(WEIGHT_NAMES, np.zeros((0, 3)))
    scores = ImageScores(Truth("truth", nothing, nothing, np.array([3, 1]), index, depth))
    ours, ours_depth = np.zeros((4, 2, 2), int), np.zeros((4, 2, 2), np.float32)
    ours[3], ours_depth[3] = [[0, 1], [-1, 0]], [[1.5, 2.0], [-1.0, 9.0]]
    ours[1], ours_depth[1] = [[3, 3], [3, 0]], [[5.0, 6.25], [7.0, 1.0]]
    scores.add(0, ours[:2], ours_depth[:2])
    scores.add(2, ours[2:], ours_depth[2:])
    assert scores.result() == {
        "id_share": 6 / 8,
        "depth_median_m": 0.0,
        "depth_p999_m": pytest.approx(0.5, abs=2e-3),
        "depth_max_m": 0.5,
    }


# ------------------------------------------------------------------------------------------------------ array files


def test_arrays_are_written_row_by_row(tmp_path, rng):
    wide, narrow = rng.normal(size=(7, 3, 2)).astype(np.float32), rng.integers(0, 9, 5).astype(np.int16)
    shapes = {"wide": (wide.shape, wide.dtype), "narrow": (narrow.shape, narrow.dtype)}
    with array_file(tmp_path / "some.npz", shapes) as append:
        append("wide", wide[:2])
        append("narrow", narrow)
        append("wide", wide[2:])
        assert list(tmp_path.iterdir()) == []
    with np.load(tmp_path / "some.npz") as found:
        np.testing.assert_array_equal(found["wide"], wide)
        np.testing.assert_array_equal(found["narrow"], narrow)


def test_an_array_that_lacks_rows_is_not_written(tmp_path):
    with (
        pytest.raises(AssertionError),
        array_file(tmp_path / "some.npz", {"wide": ((2, 2), np.dtype(np.float32))}) as append,
    ):
        append("wide", np.zeros((1, 2), np.float32))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_memory_does_not_grow_with_the_views(tmp_path):
    arrays = small_workload()
    peaks = []
    for cameras in (16, 128):
        rng = np.random.default_rng(0)
        more = {
            "cams": np.c_[rng.uniform(-1, 1, (cameras, 2)), rng.uniform(-3, 3, cameras)],
            **{name: np.repeat(arrays[name][:1], cameras) for name in ("cam_y", "fov_deg", "near")},
        }
        np.savez(tmp_path / "many.npz", **(arrays | more))
        command = "import sys; from warpav.cli.app import main; sys.exit(main(sys.argv[1:]))"
        argv = ["bench", "--workload", "many.npz", "--repeat", "1", "--no-embree", "--json", "out.json"]
        subprocess.run([sys.executable, "-c", command, *argv], cwd=tmp_path, check=True, capture_output=True)
        content = json.loads((tmp_path / "out.json").read_text())
        assert content["workload"]["views"] == 4 * cameras
        peaks.append(content["items"]["w3"]["peak_rss_mib"])
    assert peaks[1] < peaks[0] + 30  # arrays of 512 views: 76 MB
