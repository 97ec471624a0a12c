"""The thesis's figures of traffic scenes by their numbers, and what they are drawn from."""

from __future__ import annotations

from pathlib import Path

from warpav.core.errors import InputError
from warpav.core.warp_setup import load_warp
from warpav.scene.capture.capture import Capture
from warpav.scene.capture.folder import read_capture
from warpav.scene.capture.plan import PlanSettings, record
from warpav.scene.capture.town_simulator import TownSimulator
from warpav.view.scene_figures.clouds import sphere, stages, window_filter
from warpav.view.scene_figures.images import contact_sheet, image_types
from warpav.view.scene_figures.mount_surface import mount_surface_stages
from warpav.view.scene_figures.occupancy import collection_heat_maps
from warpav.view.scene_figures.panels import checked_png

CAPTURE_NUMBERS = (4, 5, 6, 7, 9, 14, 15, 16)
"""Figures of one capture, by their numbers in the thesis."""
COLLECTION_NUMBER = 8
"""The figure of a collection of scenes."""
RIG_NUMBERS = (10, 11, 12)
"""The figures of rigs, which `warpav.experiments.method_figures` draws."""


def draw_figure(
    number: int,
    path: Path | str,
    *,
    seed: int | None = None,
    capture_folder: Path | None = None,
    scenes_folder: Path | None = None,
) -> Path:
    """Draw a figure by its number in the thesis.

    Args:
        number: 4 to 9, or 14 to 16.
        path: PNG file to write.
        seed: Situation of the embedded town to record for it; 3 when there is no capture either.
        capture_folder: Instead, a capture.
        scenes_folder: For figure 8: the folder of scenes to count.

    Raises:
        InputError: Another number, inputs that do not go with it, or inputs that cannot be used.
    """
    path = checked_png(path)
    if number == COLLECTION_NUMBER:
        if scenes_folder is None or seed is not None or capture_folder is not None:
            raise InputError(f"figure {number}: expected --scenes with a folder of scenes and nothing else")
        return collection_heat_maps(scenes_folder, path)
    if number not in CAPTURE_NUMBERS:
        known = ", ".join(map(str, sorted((*CAPTURE_NUMBERS, COLLECTION_NUMBER, *RIG_NUMBERS))))
        raise InputError(f"figure: expected one of {known}, got {number}")
    if scenes_folder is not None:
        raise InputError(f"figure {number}: expected --seed or --capture, got --scenes; that goes with figure 8")
    if seed is not None and capture_folder is not None:
        raise InputError(f"figure {number}: expected either --seed or --capture, got both")
    load_warp()
    capture = read_capture(capture_folder) if capture_folder is not None else recorded_town(3 if seed is None else seed)
    match number:
        case 4:
            return image_types(capture, path)
        case 5:
            return stages(capture, path)
        case 6:
            return sphere(capture, path)
        case 7:
            return window_filter(capture, path)
        case 9:
            return mount_surface_stages(capture, path)
        case _:
            return contact_sheet(capture, {14: "rgb", 15: "depth", 16: "instance"}[number], path)


def recorded_town(seed: int) -> Capture:
    """A situation of the embedded town, recorded into memory.

    Raises:
        InputError: The seed is negative.
    """
    if seed < 0:
        raise InputError(f"--seed: expected an integer from 0, got {seed}")
    with TownSimulator() as simulator:
        return record(simulator, seed, PlanSettings())
