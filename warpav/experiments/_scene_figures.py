"""The thesis's figures of traffic scenes, 4 to 9 and 14 to 16: finds or records what `warpav.view` draws."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from warpav.core.errors import ArgumentError, InputError
from warpav.core.warp_setup import load_warp
from warpav.scene import Box, PlanSettings, TownSimulator, read_capture, read_scene, record, scene_path, split_seeds
from warpav.view import (
    checked_figure,
    contact_sheet,
    heat_maps,
    image_types,
    mount_surface_stages,
    sphere,
    stages,
    window_filter,
)

_OF_CAPTURES = {
    4: image_types,
    5: stages,
    6: sphere,
    7: window_filter,
    9: mount_surface_stages,
    14: lambda capture, path: contact_sheet(capture, "rgb", path),
    15: lambda capture, path: contact_sheet(capture, "depth", path),
    16: lambda capture, path: contact_sheet(capture, "instance", path),
}
"""Figures of one capture, by their numbers in the thesis."""
_COLLECTION_NUMBER = 8  # the figure of a collection of scenes
RIG_NUMBERS = (10, 11, 12)
"""The figures of rigs, which `warpav.experiments._method_figures` draws."""


def draw_figure(
    number: int, path: Path | str, *, seed: int | None = None, capture: Path | None = None, scenes: Path | None = None
) -> Path:
    path = checked_figure(path, (".png",))
    if number == _COLLECTION_NUMBER:
        if scenes is None or seed is not None or capture is not None:
            raise InputError(f"figure {number}: expected scenes, a folder of them, and nothing else")
        return scene_store_heat_maps(scenes, path)
    if number not in _OF_CAPTURES:
        known = ", ".join(map(str, sorted((*_OF_CAPTURES, _COLLECTION_NUMBER, *RIG_NUMBERS))))
        raise InputError(f"figure: expected one of {known}, got {number}")
    if scenes is not None:
        raise InputError(f"figure {number}: expected seed or capture, got scenes; that goes with figure 8")
    if seed is not None and capture is not None:
        raise InputError(f"figure {number}: expected either seed or capture, got both")
    load_warp()
    seed = 3 if seed is None else seed
    if seed < 0:
        raise ArgumentError("seed", f"expected an integer from 0, got {seed}")
    with TownSimulator() as simulator:
        recorded = record(simulator, seed, PlanSettings()) if capture is None else read_capture(capture)
    return _OF_CAPTURES[number](recorded, path)


def scene_store_heat_maps(
    folder: Path, path: Path | str, *, train: Sequence[int] | None = None, test: Sequence[int] | None = None
) -> Path:
    """Figure 8 for a folder of scenes: all of them, those for training, those for testing."""
    path = checked_figure(path, (".png",))
    if not folder.is_dir():
        raise InputError(f"{folder}: expected a folder of scenes, got {'a file' if folder.exists() else 'none'}")
    found = {int(match[1]) for file in folder.iterdir() if (match := re.fullmatch(r"scene_(\d+)\.glb", file.name))}
    if not found:
        raise InputError(f"{folder}: expected files scene_SEED.glb, got none; warpav scenes make writes them")
    split = split_seeds(sorted(found))
    parts = {"all": sorted(found), "train": train or split["train"], "test": test or split["test"]}
    for name, seeds in parts.items():
        missing = sorted(set(seeds) - found)
        if missing:
            raise ArgumentError(name, "expected this scene, got no such file", place=scene_path(folder, missing[0]))
        if not seeds:
            raise InputError(f"{folder}: expected at least 3 scenes to split, got {len(found)}; name seeds of {name}")
    boxes: dict[int, list[Box]] = {}
    ego_box = None
    for seed in parts["all"]:
        scene = read_scene(scene_path(folder, seed))
        boxes[seed] = [vehicle.box for vehicle in scene.vehicles]
        if ego_box is None:
            low, high = scene.ego.bounds_m().astype(np.float64)
            ego_box = Box(0.5 * (low + high), high - low, 0.0)
    assert ego_box is not None
    return heat_maps({name: [boxes[seed] for seed in seeds] for name, seeds in parts.items()}, path, ego_box=ego_box)
