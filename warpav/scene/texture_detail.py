"""Triangles split until colours at vertices follow the textures that lie over them; the surface stays as it is.

Warpav draws one colour per vertex, linear in between. Where a triangle is large beside the detail of its texture, its
edges are halved, again and again, those first where most area has most error. An edge is halved in all triangles that
share it, so no gaps open.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from warpav.scene.mesh_colours import Texture

VERTICES_MAX = 20_000  # vertices of a vehicle up to which triangles are split
TOLERANCE = 6.0  # rms difference of colour and texture over a triangle, of 255, up to which it stays whole
_LEAST_TEXELS = 1.0
_ROUNDS_MAX = 200
_LATTICES = (4, 8, 16, 32)
_TEXELS_A_SAMPLE = 4.0


@dataclass(frozen=True, eq=False)
class TexturedMesh:
    """A mesh whose triangles have textures."""

    # Positions in any unit, float64 [vertex, 3]; vertices are split where positions in the texture differ.
    vertex: np.ndarray
    triangle: np.ndarray  # vertex indices, int64 [triangle, 3]
    rgb: np.ndarray  # colours at the vertices, 0..255, float64 [vertex, 3]
    uv: np.ndarray  # positions in the texture, float64 [vertex, 2]; of no meaning where a triangle has none
    texture_of: np.ndarray  # number of every triangle's texture, -1 for none, int64 [triangle]


def follow_textures(
    mesh: TexturedMesh,
    textures: Sequence[Texture],
    *,
    vertices_max: int = VERTICES_MAX,
) -> TexturedMesh:
    """Split triangles until the colours follow the textures, or there are enough vertices."""
    size_px = np.array([texture.size_px for texture in textures], np.float64).reshape(-1, 2)
    error = _colour_errors(mesh, textures, np.arange(len(mesh.triangle)))
    for _ in range(_ROUNDS_MAX):
        left = vertices_max - len(mesh.vertex)
        texels = _edge_texels(mesh, size_px)
        longest = texels.max(axis=1)
        weight = np.where((error > TOLERANCE) & (longest > _LEAST_TEXELS), error**2 * _areas(mesh), 0.0)
        worst = np.argsort(-weight, kind="stable")[: np.count_nonzero(weight)]
        if left < 1 or not len(worst):
            break
        worst = worst[: max(left // 8, 1)]  # a part of them at a time, so that the rest goes where it does most
        # a number for every edge, the same wherever two places are joined
        _, place = np.unique(mesh.vertex + 0.0, axis=0, return_inverse=True)
        place = place.reshape(-1)[mesh.triangle]
        ends = np.sort(np.stack([place, np.roll(place, -1, axis=1)], axis=-1), axis=-1)
        edge = ends[..., 0] * len(mesh.vertex) + ends[..., 1]
        wanted = edge[worst][texels[worst] > 0.5 * longest[worst][:, None]]
        split = _split(mesh, textures, np.isin(edge, wanted))
        if len(split.mesh.vertex) > vertices_max:
            if len(worst) == 1:
                break
            wanted = edge[worst[:1]][texels[worst[:1]] > 0.5 * longest[worst[:1]][:, None]]
            split = _split(mesh, textures, np.isin(edge, wanted))
            if len(split.mesh.vertex) > vertices_max:
                break
        mesh = split.mesh
        error = np.concatenate([error[split.kept], _colour_errors(mesh, textures, split.new)])
    return mesh


def _colour_errors(mesh: TexturedMesh, textures: Sequence[Texture], index: np.ndarray) -> np.ndarray:
    """Rms difference of colour and texture on a lattice in triangles, of 255, [triangle]; 0 without a texture."""
    size_px = np.array([texture.size_px for texture in textures], np.float64).reshape(-1, 2)
    error = np.zeros(len(index))
    longest = _edge_texels(mesh, size_px, index).max(axis=1, initial=0.0)
    level = np.searchsorted(np.array(_LATTICES[:-1]) * _TEXELS_A_SAMPLE, longest, side="right")
    for number, texture in enumerate(textures):
        for step, lattice in enumerate(_LATTICES):
            some = np.flatnonzero((mesh.texture_of[index] == number) & (level == step))
            first, second = np.meshgrid(np.arange(lattice), np.arange(lattice), indexing="ij")
            inside = first + second < lattice
            pair = (np.stack([first[inside], second[inside]], axis=1) + 1.0 / 3.0) / lattice
            share = np.concatenate([pair, 1.0 - pair.sum(axis=1, keepdims=True)], axis=1)
            for part in np.array_split(some, max(len(some) * len(share) // 500_000, 1)):
                corner = mesh.triangle[index[part]]
                uv = np.einsum("sc,tcx->tsx", share, mesh.uv[corner])
                drawn = np.einsum("sc,tcx->tsx", share, mesh.rgb[corner])
                there = texture.rgb(uv.reshape(-1, 2)).reshape(drawn.shape)
                error[part] = np.sqrt(((drawn - there) ** 2).mean(axis=(1, 2)))
    return error


@dataclass(frozen=True, eq=False)
class _Split:
    """A mesh after a round: ``kept`` triangles of the old one come first, ``new`` ones behind."""

    mesh: TexturedMesh
    kept: np.ndarray
    new: np.ndarray


def _split(mesh: TexturedMesh, textures: Sequence[Texture], is_halved: np.ndarray) -> _Split:
    """The mesh with a vertex in the middle of some edges, bool [triangle, 3]; edge i runs from corner i to i + 1."""
    is_kept = ~is_halved.any(axis=1)
    triangle, is_halved, texture_of = (each[~is_kept] for each in (mesh.triangle, is_halved, mesh.texture_of))
    ends = np.sort(np.stack([triangle, np.roll(triangle, -1, axis=1)], axis=-1), axis=-1)
    found, number = np.unique(ends[is_halved], axis=0, return_inverse=True)
    middle = np.full(triangle.shape, -1)
    middle[is_halved] = len(mesh.vertex) + number.reshape(-1)
    # turned, so that halved edges come first
    first = np.where(is_halved.sum(axis=1) == 2, np.argmin(is_halved, axis=1) + 1, np.argmax(is_halved, axis=1))
    turn = (first[:, None] + np.arange(3)) % 3
    (a, b, c), (p, q, r) = (np.take_along_axis(each, turn, axis=1).T for each in (triangle, middle))
    halves = [((a, p, c), (p, b, c)), ((p, b, q), (a, p, q), (a, q, c)), ((a, p, r), (p, b, q), (r, q, c), (p, q, r))]
    pieces, owners = [], []
    for count, corners in enumerate(halves, start=1):
        some = np.flatnonzero(is_halved.sum(axis=1) == count)
        pieces += [np.stack(each, axis=1)[some] for each in corners]
        owners += [some] * len(corners)
    new_texture = texture_of[np.concatenate(owners)]
    uv, rgb = mesh.uv[found].mean(axis=1), mesh.rgb[found].mean(axis=1)
    whose = np.full(len(found), -1)
    whose[number.reshape(-1)] = np.broadcast_to(texture_of[:, None], triangle.shape)[is_halved]
    for k, texture in enumerate(textures):
        rgb[whose == k] = texture.rgb(uv[whose == k])
    kept = np.flatnonzero(is_kept)
    new = np.concatenate(pieces)
    split = TexturedMesh(
        np.concatenate([mesh.vertex, mesh.vertex[found].mean(axis=1)]),
        np.concatenate([mesh.triangle[kept], new]),
        np.concatenate([mesh.rgb, rgb]),
        np.concatenate([mesh.uv, uv]),
        np.concatenate([mesh.texture_of[kept], new_texture]),
    )
    return _Split(split, kept, len(kept) + np.arange(len(new)))


def _edge_texels(mesh: TexturedMesh, size_px: np.ndarray, index: np.ndarray | None = None) -> np.ndarray:
    """Lengths of edges in the texture [px], float64 [triangle, 3]; 0 without one."""
    triangle, number = (
        (mesh.triangle, mesh.texture_of) if index is None else (mesh.triangle[index], mesh.texture_of[index])
    )
    if not len(size_px):
        return np.zeros(triangle.shape)
    uv_px = mesh.uv[triangle] * size_px[number][:, None]
    length = np.linalg.norm(np.roll(uv_px, -1, axis=1) - uv_px, axis=2)
    return np.where(np.isfinite(length) & (number >= 0)[:, None], length, 0.0)


def _areas(mesh: TexturedMesh) -> np.ndarray:
    corner = mesh.vertex[mesh.triangle]
    return 0.5 * np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1)
