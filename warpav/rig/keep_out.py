"""Parts of a body that carry no camera: glass, lamps, plates and wheels, as boxes for a person to edit."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

from warpav.raster.mesh import Mesh

WORDS = {
    "glass": ("glass", "window", "windscreen", "windshield"),
    "lamp": ("light", "lamp", "indicator", "reflector"),
    "plate": ("plate", "licence", "license"),
    "wheel": ("wheel", "tyre", "tire", "rim"),
}
"""How files name such parts; a word that ends so counts, such as ``headlights``."""

MARGIN_M = {"glass": 0.02, "lamp": 0.02, "plate": 0.02, "wheel": 0.08, "other colour": 0.02}
"""How far a box reaches beyond its part [m]; around wheels their arches."""

OTHER_COLOUR = 45.0
"""Distance of a colour, 0..255, from all shades of the paint, from which on it is no paint."""

_SHADES = (0.45, 1.35)  # of the paint, in light and shadow
_WHEEL_HEIGHT_M, _WHEEL_RATIO = (0.4, 1.4), (0.8, 1.25)
_PATCH_M2 = (0.002, 6.0)
_NEAR_M = 0.03


def kinds_of_names(names: Sequence[str]) -> np.ndarray:
    """What parts of some names are, out of `WORDS`, empty where the name says nothing; str [name]."""
    return np.array([_kind_of(name) for name in names], dtype=object)


def _kind_of(name: str) -> str:
    words = re.findall(r"[a-z]+", re.sub(r"([a-z])([A-Z])", r"\1 \2", name).lower())
    for kind, ends in WORDS.items():
        if any(word.removesuffix("s").endswith(ends) or word.endswith(ends) for word in words):
            return kind
    return ""


def propose_keep_out(mesh: Mesh, kind: np.ndarray | None = None) -> list[tuple[str, np.ndarray]]:
    """Boxes of what carries no camera, and what each is.

    Wheels are round parts of their own on the ground. What a file names is taken from there; without names whatever has
    another colour than the paint, which is the most frequent one.

    Args:
        mesh: The vehicle in the ego frame [m].

    Returns:
        Of each part its kind, out of `MARGIN_M`, and its box in the ego frame [m], float64 [2, 3].
    """
    corner_m = mesh.vertex_m[mesh.triangle].astype(np.float64)
    kind = np.full(len(corner_m), "", object) if kind is None else kind.copy()
    has_names = bool((kind != "").any())
    ground_m = corner_m[..., 2].min()
    for patch in _patches(mesh, np.ones(len(corner_m), bool)):
        low_m, high_m = corner_m[patch].min(axis=(0, 1)), corner_m[patch].max(axis=(0, 1))
        length_m, _, height_m = high_m - low_m
        is_round = _WHEEL_RATIO[0] < length_m / max(height_m, 1e-6) < _WHEEL_RATIO[1]
        if low_m[2] < ground_m + 0.1 and _WHEEL_HEIGHT_M[0] < height_m < _WHEEL_HEIGHT_M[1] and is_round:
            kind[patch] = "wheel"
    if not has_names:
        kind[(kind == "") & _has_other_colour(mesh, corner_m)] = "other colour"
    doubled = np.cross(corner_m[:, 1] - corner_m[:, 0], corner_m[:, 2] - corner_m[:, 0])
    area_m2 = 0.5 * np.linalg.norm(doubled, axis=1)
    found: list[tuple[str, np.ndarray]] = []
    for name, margin_m in MARGIN_M.items():
        boxes = []
        for patch in _patches(mesh, kind == name):
            if _PATCH_M2[0] < area_m2[patch].sum() < _PATCH_M2[1]:
                boxes.append(np.stack([corner_m[patch].min(axis=(0, 1)), corner_m[patch].max(axis=(0, 1))]))
        if name == "wheel":  # one that hangs together with the body has its like on the other side
            boxes += [box * [1.0, 0.0, 1.0] - box[::-1] * [0.0, 1.0, 0.0] for box in boxes]
        found += [(name, np.round(box + np.array([[-margin_m], [margin_m]]), 3)) for box in _merged(boxes)]
    return found


def _patches(mesh: Mesh, wanted: np.ndarray) -> list[np.ndarray]:
    """Triangles that hang together among some, bool [triangle]: the numbers of each group. Near vertices are one."""
    from scipy import sparse
    from scipy.sparse import csgraph

    if not wanted.any():
        return []
    _, place = np.unique(np.round(mesh.vertex_m, 4), axis=0, return_inverse=True)
    triangle = place.reshape(-1)[mesh.triangle[wanted]]
    count = int(place.max()) + 1
    start, end = triangle[:, [0, 1]].ravel(), triangle[:, [1, 2]].ravel()
    links = sparse.coo_array((np.ones(len(start), bool), (start, end)), shape=(count, count))
    _, label = csgraph.connected_components(links, directed=False)
    of_triangle = label[triangle[:, 0]]
    order = np.argsort(of_triangle, kind="stable")
    return np.split(np.flatnonzero(wanted)[order], np.flatnonzero(np.diff(of_triangle[order])) + 1)


def _has_other_colour(mesh: Mesh, corner_m: np.ndarray) -> np.ndarray:
    """Which triangles have a colour that is no shade of the paint, bool [triangle]."""
    rgb = mesh.vertex_rgb[mesh.triangle].mean(axis=1).astype(np.float64)
    doubled = np.cross(corner_m[:, 1] - corner_m[:, 0], corner_m[:, 2] - corner_m[:, 0])
    _, group = np.unique((rgb // 32).astype(int), axis=0, return_inverse=True)
    area_m2 = np.bincount(group.reshape(-1), weights=np.linalg.norm(doubled, axis=1))
    paint = rgb[group.reshape(-1) == area_m2.argmax()].mean(axis=0)
    shade = np.clip(rgb @ paint / max(paint @ paint, 1.0), *_SHADES)
    return np.linalg.norm(rgb - shade[:, None] * paint, axis=1) > OTHER_COLOUR


def _merged(boxes: list[np.ndarray]) -> list[np.ndarray]:
    """Boxes [2, 3] of which none comes near another: those that do become one."""
    boxes = list(boxes)
    k = 0
    while k < len(boxes):
        one = boxes[k]
        near = [
            j
            for j, other in enumerate(boxes)
            if j != k and (one[0] <= other[1] + _NEAR_M).all() and (other[0] <= one[1] + _NEAR_M).all()
        ]
        if near:
            group = np.stack([one, *(boxes[j] for j in near)])
            boxes = [box for j, box in enumerate(boxes) if j != k and j not in near]
            boxes.append(np.stack([group[:, 0].min(axis=0), group[:, 1].max(axis=0)]))
            k = 0
        else:
            k += 1
    return boxes
