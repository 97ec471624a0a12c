"""An experiment that ends in seconds: two scenes of a street to train on, two to test on, two small cameras."""

import functools

from tests.driving_scene import street
from warpav.experiments._arms import Arm
from warpav.experiments._study import Study, _loss_overrides
from warpav.runs.config import load_config
from warpav.scene import write_scene

OPTIONS = (
    "scenes.source=folder",
    "scenes.train_seeds=[0, 1]",
    "scenes.test_seeds=[2, 3]",
    "run.batch_size=2",
    "run.iterations=2",
    "run.pictures=none",
    "rig.cameras=2",
    "camera.width_px=64",
    "camera.height_px=64",
    "detector.confidence_min=0.1",
)

BOTH = _loss_overrides("IFR+DOA")
ARMS = (Arm("sgd_ifr_doa", "optimiser", BOTH), Arm("random_ifr_doa", "random_batches", BOTH))
SMALL = Study("small", "thesis", ARMS, runs=2)


@functools.cache
def scene_folder(folder):
    """The scenes, written once."""
    folder.mkdir(exist_ok=True)
    for seed in range(4):
        write_scene(street(5, seed, 1), folder / f"scene_{seed}.glb")
    return folder


def overrides(folder, *more):
    """Overrides of ``thesis`` for scenes in a folder."""
    return [*OPTIONS, f"scenes.folder={scene_folder(folder)}", *more]


def config(folder, *more):
    """The configuration for scenes in a folder."""
    return load_config("thesis", overrides(folder, *more))
