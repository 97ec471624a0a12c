"""Triangle meshes with one colour per vertex."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np

from warpav.core.errors import InputError

_GREY = (128, 128, 128)  # colour of a mesh that was given none

MAX_COUNT = 2**31 - 1
"""Indices of vertices and triangles are 32-bit integers."""


@dataclass(frozen=True, eq=False)
class Mesh:
    """A triangle mesh on the host: ``Mesh(vertices, faces, rgb)``.

    Anything array-like will do: numbers are stored with the types below. One colour [3] is given to every vertex;
    without colours the mesh is grey.

    Attributes:
        vertex_m: Vertex positions [m], float32, shape [vertex, 3], in the frame that the owner states.
        triangle: Vertex indices, int32, shape [triangle, 3], counter-clockwise seen from outside.
        vertex_rgb: sRGB colour per vertex, uint8, shape [vertex, 3]; `_GREY` where left out.

    Raises:
        InputError: Indices that are not whole or need more than 32 bits, or colours outside 0..255. Whether the mesh
            can be drawn is for `check` to say, which `Scene` asks.
        TypeError: Something that holds no numbers.
    """

    vertex_m: np.ndarray
    triangle: np.ndarray
    vertex_rgb: np.ndarray = cast("np.ndarray", _GREY)  # noqa: RUF009 (a constant)

    def __post_init__(self) -> None:
        """Give the arrays their types; those that have them already are kept as they are."""
        kept = (self.vertex_m, self.triangle, self.vertex_rgb)
        types = (np.float32, np.int32, np.uint8)
        if all(isinstance(a, np.ndarray) and a.dtype == t for a, t in zip(kept, types, strict=True)) and (
            self.vertex_rgb.ndim == 2
        ):
            return
        for name, array in zip(("vertex_m", "triangle", "vertex_rgb"), _arrays(*kept, "mesh"), strict=True):
            object.__setattr__(self, name, array)

    @classmethod
    def create(cls, vertex_m: object, triangle: object, vertex_rgb: object = _GREY, *, name: str = "mesh") -> Mesh:
        """Mesh from anything array-like, checked.

        Args:
            vertex_m: Positions [m], shape [vertex, 3], finite.
            triangle: Vertex indices, shape [triangle, 3].
            vertex_rgb: Colours 0..255, shape [vertex, 3] or [3] for one colour everywhere.
            name: What the mesh is called in messages.

        Raises:
            InputError: No triangles, non-finite positions, an index out of range or not whole, a colour outside 0..255,
                or shapes that do not fit.
        """
        mesh = cls(*_arrays(vertex_m, triangle, vertex_rgb, name))
        mesh.check(name)
        return mesh

    def check(self, name: str) -> None:
        """Make sure that the mesh can be drawn; ``name`` is what it is called in messages.

        Raises:
            InputError: No triangles, non-finite positions, an index out of range, or shapes that do not fit.
        """
        _check(self.vertex_m, self.triangle, self.vertex_rgb, name)

    def transformed(self, rotation: np.ndarray, translation_m: np.ndarray) -> Mesh:
        """The mesh with every vertex v mapped to ``rotation @ v + translation_m``; [3, 3] and [3]."""
        moved = self.vertex_m.astype(np.float64) @ np.asarray(rotation, np.float64).T + np.asarray(translation_m)
        return Mesh(np.ascontiguousarray(moved, dtype=np.float32), self.triangle, self.vertex_rgb)

    def mirrored(self) -> Mesh:
        """The mesh with left and right (y) exchanged; triangles still face outwards."""
        return Mesh(self.vertex_m * np.array([1, -1, 1], np.float32), self.triangle[:, ::-1].copy(), self.vertex_rgb)

    def bounds_m(self) -> np.ndarray:
        """Lowest and highest corner [m], shape [2, 3]."""
        return np.stack([self.vertex_m.min(axis=0), self.vertex_m.max(axis=0)])


def merge(meshes: Sequence[Mesh]) -> Mesh:
    """One mesh that holds all triangles of ``meshes`` in order; needs at least one mesh."""
    for name, count in (
        ("vertices", sum(len(mesh.vertex_m) for mesh in meshes)),
        ("triangles", sum(len(mesh.triangle) for mesh in meshes)),
    ):
        if count > MAX_COUNT:
            raise ValueError(f"{len(meshes)} meshes have {count} {name} together, more than {MAX_COUNT}")
    first = np.cumsum([0, *(len(mesh.vertex_m) for mesh in meshes)])
    return Mesh(
        np.concatenate([mesh.vertex_m for mesh in meshes]),
        np.concatenate([mesh.triangle + np.int32(offset) for mesh, offset in zip(meshes, first, strict=False)]),
        np.concatenate([mesh.vertex_rgb for mesh in meshes]),
    )


def _arrays(vertex: object, index: object, colour: object, name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices, indices and colours with the types of a mesh, if these can hold them."""
    given = {"vertex_m": vertex, "triangle": index, "vertex_rgb": colour}
    arrays = {field: np.asarray(values) for field, values in given.items()}
    for field, array in arrays.items():
        if not (np.issubdtype(array.dtype, np.integer) or np.issubdtype(array.dtype, np.floating)):
            raise TypeError(f"{name}: expected numbers in {field}, got {type(given[field]).__name__} of {array.dtype}")
    vertices, triangles, colours = arrays.values()
    _refuse(~((colours >= 0) & (colours <= 255)), colours, f"{name}: colours must be 0..255", "vertex_rgb")
    _refuse(triangles % 1 != 0, triangles, f"{name}: triangle indices must be whole", "triangle")
    too_large = f"{name}: triangle indices must be below {MAX_COUNT}"
    _refuse(np.abs(triangles) > MAX_COUNT, triangles, too_large, "triangle")
    if colours.shape == (3,):
        colours = np.tile(colours, (len(vertices), 1))
    with np.errstate(over="ignore"):  # what 32 bits cannot hold is infinite
        return (
            np.ascontiguousarray(vertices, np.float32),
            np.ascontiguousarray(triangles, np.int32),
            np.ascontiguousarray(colours, np.uint8),
        )


def _check(vertex: np.ndarray, index: np.ndarray, colour: np.ndarray, name: str) -> None:
    if vertex.ndim != 2 or vertex.shape[1] != 3:
        raise InputError(f"{name}: expected vertices of shape [n, 3], got {list(vertex.shape)}")
    if index.ndim != 2 or index.shape[1:] != (3,) or len(index) == 0:
        raise InputError(f"{name}: expected at least one triangle of three indices, got {list(index.shape)}")
    if colour.shape != vertex.shape:
        shapes = f"{list(vertex.shape)}, got {list(colour.shape)}"
        raise InputError(f"{name}: expected colours of shape {shapes}")
    bad = ~np.isfinite(vertex)
    count = f"{np.count_nonzero(bad.any(axis=1))} of {len(vertex)}"
    _refuse(bad, vertex, f"{name}: {count} vertices are NaN or infinite; repair the mesh first", "vertex_m")
    bad = ~((index >= 0) & (index < len(vertex)))
    limits = f"0..{len(vertex) - 1}, got {index.min()}..{index.max()}"
    _refuse(bad, index, f"{name}: triangle indices must be {limits}", "triangle")


def _refuse(bad: np.ndarray, values: np.ndarray, what: str, array: str) -> None:
    """Raise where ``bad`` is set anywhere; the message names the first such row of the array."""
    row = np.flatnonzero(np.atleast_2d(bad).any(axis=1))
    if len(row):
        raise InputError(f"{what}: {array}[{row[0]}] is {np.atleast_2d(values)[row[0]].tolist()}")
