"""Triangle meshes with one colour per vertex."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from warpav.core.errors import InputError

MAX_COUNT = 2**31 - 1
"""Indices of vertices and triangles are 32-bit integers."""


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh on the host: ``Mesh(vertices, faces, rgb)``.

    Anything array-like will do: numbers are stored with the types below, and one colour [3] is given to every vertex.

    Attributes:
        vertex_m: Vertex positions [m], float32, shape [vertex, 3], in the frame that the owner states.
        triangle: Vertex indices, int32, shape [triangle, 3], counter-clockwise seen from outside.
        vertex_rgb: sRGB colour per vertex, uint8, shape [vertex, 3].

    Raises:
        InputError: Indices that are not whole or need more than 32 bits, or colours outside 0..255. Whether the mesh
            can be drawn is for `check` to say, which `Scene` asks.
        TypeError: Something that holds no numbers.
    """

    vertex_m: np.ndarray
    triangle: np.ndarray
    vertex_rgb: np.ndarray

    def __post_init__(self) -> None:
        """Give the arrays their types; those that have them already are kept as they are."""
        kept = (("vertex_m", np.float32), ("triangle", np.int32), ("vertex_rgb", np.uint8))
        if all(isinstance(a := getattr(self, name), np.ndarray) and a.dtype == dtype for name, dtype in kept) and (
            self.vertex_rgb.ndim == 2
        ):
            return
        vertex, index, colour = (_numbers(getattr(self, name), name) for name, _ in kept)
        _refuse(~((colour >= 0) & (colour <= 255)), colour, "mesh: colours must be 0..255", "vertex_rgb")
        _refuse(index % 1 != 0, index, "mesh: triangle indices must be whole", "triangle")
        _refuse(np.abs(index) > MAX_COUNT, index, f"mesh: triangle indices must be below {MAX_COUNT}", "triangle")
        with np.errstate(over="ignore"):  # what 32 bits cannot hold is infinite
            vertex = np.ascontiguousarray(vertex, np.float32)
        colour = np.ascontiguousarray(colour, np.uint8)
        if colour.shape == (3,):
            colour = np.tile(colour, (len(vertex), 1))
        for (name, dtype), array in zip(kept, (vertex, index, colour), strict=True):
            object.__setattr__(self, name, np.ascontiguousarray(array, dtype))

    @classmethod
    def create(cls, vertex_m: object, triangle: object, vertex_rgb: object, *, name: str = "mesh") -> Mesh:
        """Mesh from anything array-like, checked.

        Args:
            vertex_m: Positions [m], shape [vertex, 3], finite.
            triangle: Vertex indices, shape [triangle, 3].
            vertex_rgb: Colours 0..255, shape [vertex, 3] or [3] for one colour everywhere.
            name: What the mesh is called in messages.

        Returns:
            The mesh, with arrays of the documented types.

        Raises:
            InputError: No triangles, non-finite positions, an index out of range or not whole, a colour outside 0..255,
                or shapes that do not fit.
        """
        with np.errstate(over="ignore"):  # what 32 bits cannot hold is infinite
            vertex = np.ascontiguousarray(vertex_m, dtype=np.float32)
        index, colour = np.asarray(triangle), np.asarray(vertex_rgb)
        if colour.shape not in ((3,), vertex.shape):
            raise InputError(f"{name}: expected colours of shape {list(vertex.shape)}, got {list(colour.shape)}")
        _refuse(~((colour >= 0) & (colour <= 255)), colour, f"{name}: colours must be 0..255", "vertex_rgb")
        colour = np.ascontiguousarray(colour, dtype=np.uint8)
        if colour.ndim == 1:
            colour = np.tile(colour, (len(vertex), 1))
        _check(vertex, index, colour, name)  # before 32 bits cut the indices
        _refuse(index % 1 != 0, index, f"{name}: triangle indices must be whole", "triangle")
        return cls(vertex, np.ascontiguousarray(index, dtype=np.int32), colour)

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
    """One mesh that holds all triangles of ``meshes`` in order; needs at least one mesh.

    Raises:
        ValueError: Together they have more vertices or triangles than indices can tell apart.
    """
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


def _numbers(values: object, name: str) -> np.ndarray:
    array = np.asarray(values)
    if not (np.issubdtype(array.dtype, np.integer) or np.issubdtype(array.dtype, np.floating)):
        raise TypeError(f"mesh: expected numbers in {name}, got {type(values).__name__} of {array.dtype}")
    return array


def _check(vertex: np.ndarray, index: np.ndarray, colour: np.ndarray, name: str) -> None:
    """See `Mesh.check`."""
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
