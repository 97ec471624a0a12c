"""The colours of every image and figure: one per camera, the same in 3D views and in figures."""

from __future__ import annotations

from typing import Any

import numpy as np

Rgb = tuple[int, int, int]
"""An sRGB colour, 0..255."""

CAMERA_RGB: tuple[Rgb, ...] = (
    (36, 107, 224),  # blue
    (240, 126, 22),  # orange
    (18, 160, 128),  # teal
    (206, 58, 142),  # magenta
    (122, 86, 214),  # violet
    (214, 160, 0),  # gold
    (0, 158, 206),  # sky
    (142, 94, 58),  # brown
    (126, 162, 32),  # olive
    (84, 96, 116),  # slate
)

PAPER_RGB: Rgb = (255, 255, 255)
GROUND_RGB: Rgb = (238, 240, 243)
INK_RGB: Rgb = (38, 44, 54)
MUTED_RGB: Rgb = (132, 140, 152)
GRID_RGB: Rgb = (226, 229, 234)

DESCENT_RGB: Rgb = (255, 214, 10)
"""Of arrows that show where a step moves and turns cameras."""

TRUTH_RGB: Rgb = (255, 255, 255)
TRUE_POSITIVE_RGB: Rgb = (57, 211, 83)
FALSE_POSITIVE_RGB: Rgb = (240, 62, 62)
MISS_RGB: Rgb = (255, 159, 28)

OUTCOME_RGB: dict[str, Rgb] = {
    "detected": TRUE_POSITIVE_RGB,
    "missed": MISS_RGB,
    "hidden": (150, 110, 210),
    "out of frame": (96, 104, 116),
}
"""Of every `warpav.optimisation.evaluation._metrics.ObjectOutcome`."""

COVERAGE_RGB: tuple[Rgb, ...] = ((226, 74, 66), (190, 218, 242), (104, 166, 222), (38, 102, 180))
COVERAGE_WORDS = ("no camera", "one camera", "two cameras", "three or more")
"""Of ground by how many cameras see it."""

NOT_ALONE_RGB: tuple[Rgb, Rgb] = ((224, 234, 244), (150, 150, 150))
"""Of what several rigs see, and none."""

_ZONE_RGB: tuple[Rgb, ...] = (
    (86, 180, 233),
    (230, 159, 0),
    (0, 158, 115),
    (204, 121, 167),
    (240, 228, 66),
    (213, 94, 0),
    (120, 120, 200),
    (170, 200, 120),
)
"""Of zones of the body, which differ to most colour-blind readers as well."""

FURTHER_RGB: tuple[Rgb, ...] = ((247, 243, 220), (246, 198, 91), (226, 98, 44), (138, 16, 34))
"""Of what one more camera would bring, from nothing to most."""


def further_map() -> Any:  # noqa: ANN401 (matplotlib)
    """`FURTHER_RGB` as a map of colours."""
    from matplotlib.colors import LinearSegmentedColormap

    return LinearSegmentedColormap.from_list("further", [hex_colour(rgb) for rgb in FURTHER_RGB])


def alone(seen: np.ndarray) -> np.ndarray:
    """Which of several, from 0, alone sees something, of bool [one, ...]; their number: several do; one more: none."""
    shared = np.where(seen.any(axis=0), len(seen), len(seen) + 1)
    return np.where(seen.sum(axis=0) == 1, seen.argmax(axis=0), shared)


def zone_rgb(index: int) -> Rgb:
    """Colour of the zone with this index, from 0; the colours repeat after the eighth."""
    return _ZONE_RGB[index % len(_ZONE_RGB)]


def camera_rgb(index: int) -> Rgb:
    """Colour of the camera with this index, from 0; the colours repeat after the tenth."""
    return CAMERA_RGB[index % len(CAMERA_RGB)]


BASELINE_RGB: dict[str, Rgb] = {
    "start": MUTED_RGB,
    "by hand": MUTED_RGB,
    "highest": camera_rgb(1),
    "random": camera_rgb(4),
}
"""Of rigs that a result is compared with; the result has the colour of the first camera."""


def hex_colour(rgb: Rgb) -> str:
    return "#{:02x}{:02x}{:02x}".format(*rgb)
