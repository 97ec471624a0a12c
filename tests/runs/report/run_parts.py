"""Parts of a run folder whose numbers are known, for tests of its report."""

import numpy as np
from PIL import Image

from warpav.raster.camera import CameraModel
from warpav.rig import Rig, RigCamera, write_rig
from warpav.runs import RunFolder
from warpav.runs._rig_evaluation import TABLE_ROWS
from warpav.runs.config import load_config

ARMS = ("optimised", "start", "highest")
SECTORS = ("front", "rear")
BANDS = ("0-5", "5-10")
OVERRIDES = ["run.iterations=2", "run.batch_size=1", "scenes.test_seeds=[1007,1009]", "rig.cameras=2"]
OVERRIDES += ["camera.fov_deg=80"]


def folder_at(path, *overrides, events=3):
    """A run folder with some iterations and nothing else."""
    folder = RunFolder.create(load_config("quick", [*OVERRIDES, *overrides, f"run.out={path}"]), name="x", device="cpu")
    for iteration in range(events):
        folder.append_event(event(iteration))
    return folder


def event(iteration):
    return {
        "iteration": iteration,
        "loss": 2.0 - 0.5 * iteration,
        "terms": {"missed": 0.5, "zone_0": 0.1 - 0.1 * iteration},
        "multipliers": {"zone_0": 0.2 * iteration},
        "positions_m": [[0.0, 0.0, 1.5], [0.0, 0.5 + 0.1 * iteration, 1.5]],
        "yaw_deg": [0.0, 90.0],
        "seconds": {"render": 0.25, "total": 0.5},
        "training_objective": 1.0 if iteration == 0 else None,
    }


def arm(recall, **changed):
    """Metrics of a rig that finds this share of 8 objects."""
    group = {"objects": 8, "visible": 8, "detected": round(8 * recall), "recall": recall, "recall_visible": recall}
    none = {"objects": 0, "visible": 0, "detected": 0, "recall": None, "recall_visible": None}
    return {
        **{name: round(0.011 * (k + 1) + 0.1 * recall, 4) for k, name in enumerate(TABLE_ROWS)},
        "tp_detection_rate": recall,
        "misses_at_equal_false_alarms": 100.0 * (1.0 - recall),
        "constraint_violation": 0.0,
        "visible_rate": None,
        "objects": 8,
        "frames": 4,
        "recall_by": {
            "road_user": {"vehicle": group},
            "distance_m": {"0-10": group, "10-20": none},
            "sector": {"rear left": group},
            "category": {"<bus>": group},
        },
        "per_scene": {},
        **changed,
    }


def difference(mean, low, high, scenes=12):
    return {"mean": mean, "low": low, "high": high, "scenes": scenes}


def seen(distance_m, outcome, start="detected", scene="town_7"):
    return {
        "scene": scene,
        "category": "<bus>",
        "distance_m": distance_m,
        "bearing_deg": -100.0,
        "outcome": {"optimised": outcome, "start": start, "highest": "detected"},
    }


def evaluation(**changed):
    """The content of a whole evaluation.json of 12 scenes; 3 of 8 objects are not detected."""
    return {
        "scenes": {"test": 12},
        "arms": {"optimised": arm(0.625), "start": arm(0.5), "highest": arm(0.875)},
        "paired": {
            "start": {
                "misses_at_equal_false_alarms": difference(-12.5, -20.0, -3.0),
                "ap50_pooled": difference(0.01, -0.02, 0.04),
                "objective": difference(-0.25, -0.5, -0.125),
            },
            "highest": {
                "misses_at_equal_false_alarms": difference(25.0, 10.0, 40.0),
                "objective": difference(0.1, None, None),
            },
        },
        "training_objective": {"start": 2.0, "optimised": 1.5},
        "seconds": {"descent": 3.5, "total": 12.25},
        "descent": {"iterations": 2, "planned": 5, "ended": "no better rig in 2 looks", "kept": 1},
        "constraints": {
            name: [
                margin("border", ["left"], 0.5, 0.02),
                margin("spacing", ["left", "right"], 0.175 if name == "start" else 0.25, 0.2),
            ]
            for name in ARMS
        },
        "outcomes": [
            seen(21.0, "hidden"),
            seen(4.25, "missed"),
            seen(30.0, "out of frame", start="missed"),
            *(seen(9.0 + k, "detected", start="missed" if k < 3 else "detected") for k in range(5)),
        ],
        "ground": {
            "scenes": 12,
            "heights_m": [1.1, 1.7],
            "cell_m": 0.5,
            "radius_m": 25.0,
            "sectors": list(SECTORS),
            "bands_m": list(BANDS),
            "cells": [[[100, 300], [100, 0]]] * 2,
            "blind": {
                "optimised": [[[80, 20], [25, 0]], [[10, 0], [0, 0]]],
                "start": [[[50, 20], [5, 0]], [[0, 0], [0, 0]]],
                "highest": [[[0, 0], [0, 0]]] * 2,
            },
        },
        **changed,
    }


def margin(kind, cameras, value_m, limit_m):
    slack_m = value_m - limit_m
    return {
        "kind": kind,
        "cameras": cameras,
        "value_m": value_m,
        "limit_m": limit_m,
        "slack_m": slack_m,
        "is_kept": slack_m >= 0.0,
    }


def rig(shift_m=0.0, turn_rad=0.0):
    model = CameraModel(64, 48)
    return Rig(
        [
            RigCamera("left", np.array([1.0 + shift_m, 0.5, 1.5]), turn_rad, 0.0, 0.0, model),
            RigCamera("right", np.array([1.0, -0.5, 1.5]), 0.0, 0.0, 0.0, model),
        ]
    )


def picture(path, size_px=(64, 48), seed=0):
    """A picture that no compression makes small."""
    noise = np.random.default_rng(seed).integers(0, 256, (*size_px[::-1], 3), dtype=np.uint8)
    path.parent.mkdir(exist_ok=True)
    Image.fromarray(noise).save(path)


def fill(folder, content=None):
    """Everything that a finished run leaves."""
    folder.write_evaluation(evaluation() if content is None else content)
    write_rig(rig(), folder.rig_path("initial"))
    write_rig(rig(shift_m=0.125, turn_rad=np.radians(30.0)), folder.rig_path("best"))
    write_rig(rig(shift_m=0.75), folder.rig_path("final"))
    for name in ("rig", "rig_top_view", "detections", "loss_curves", "another"):
        picture(folder.figure_path(name))
    for name in ("recall", "differences", "ground", "first_scene_left", "hardest_scene_left"):
        picture(folder.figure_path(name))
    return folder
