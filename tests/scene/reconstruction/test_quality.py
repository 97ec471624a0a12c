"""Reconstructed vehicles against the town's own, which the images were taken of."""

import numpy as np
import pytest

from tests.scene.capture.town_capture import town_capture
from tests.scene.reconstruction.quality import quality, roof_places
from warpav.raster.mesh import merge
from warpav.scene.capture.capture import PlanSettings
from warpav.scene.reconstruction.reconstruct import reconstruct
from warpav.scene.town.town import town_scene

SEEDS = (60_000, 60_003)


@pytest.mark.slow
def test_vehicles_are_where_and_what_they_were(capsys):
    recall_m, precision_m, iou = [], [], []
    for seed in SEEDS:
        capture = town_capture(seed, PlanSettings())
        scene, truth = reconstruct(capture), town_scene(seed)
        around = [truth.environment, truth.ego, *(other.mesh for other in truth.others)]
        places_m = roof_places(np.random.default_rng(seed), 50, capture.ego_box)
        true_mesh = {vehicle.instance_id: vehicle.mesh for vehicle in truth.vehicles}
        for vehicle in scene.vehicles:
            others = [mesh for instance_id, mesh in true_mesh.items() if instance_id != vehicle.instance_id]
            found = quality(
                vehicle.mesh, true_mesh[vehicle.instance_id], merge([*around, *others]), vehicle.box, places_m
            )
            recall_m.append(found.recall_m)
            precision_m.append(found.precision_m)
            iou.append(found.iou)
    recall_m, precision_m, iou = map(np.concatenate, (recall_m, precision_m, iou))
    with capsys.disabled():
        print(  # noqa: T201 (the figures are what this test is run for)
            f"\nrecall {1e3 * np.median(recall_m):.1f} and {1e3 * np.quantile(recall_m, 0.95):.0f} mm, "
            f"precision {1e3 * np.median(precision_m):.1f} and {1e3 * np.quantile(precision_m, 0.95):.0f} mm, "
            f"IoU {np.median(iou):.3f}"
        )
    for distance_m in (recall_m, precision_m):
        assert np.median(distance_m) <= 0.03
        assert np.quantile(distance_m, 0.95) <= 0.10
    assert np.median(iou) >= 0.93
