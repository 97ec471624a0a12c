"""Triangles split for their textures: colours nearer to them, and the same surface without gaps."""

import numpy as np
import pytest
from PIL import Image

from warpav.scene.mesh_colours import Texture, TexturedMesh, follow_textures

QUAD = np.array([[0, 0, 0], [4, 0, 0], [4, 2, 0], [0, 2, 0]], float)
TWO = np.array([[0, 1, 2], [0, 2, 3]])


def textured(texel_rgb, vertex=QUAD, triangle=TWO, uv=None, texture_of=0):
    texture = Texture(Image.fromarray(np.asarray(texel_rgb, np.uint8)))
    uv = vertex[:, :2] / vertex[:, :2].max(axis=0) if uv is None else uv
    rgb = texture.rgb(uv).astype(float)
    return TexturedMesh(vertex, triangle, rgb, uv, np.full(len(triangle), texture_of)), [texture]


def chequers(count, texels=8):
    field = (np.add.outer(np.arange(count), np.arange(count)) % 2 * 200 + 20).astype(np.uint8)
    return np.repeat(np.repeat(field, texels, 0), texels, 1)[..., None].repeat(3, axis=2)


def areas(mesh):
    corner = mesh.vertex[mesh.triangle]
    return 0.5 * np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1)


def rms_on(mesh, textures, rng, count=50_000):
    """Rms difference of drawn colour and texture at random points of the textured surface, of 255."""
    area = np.where(mesh.texture_of >= 0, areas(mesh), 0.0)
    index = rng.choice(len(area), count, p=area / area.sum())
    share = rng.dirichlet(np.ones(3), count)  # even over a triangle
    corner = mesh.triangle[index]
    drawn, uv = (np.einsum("pc,pcx->px", share, each[corner]) for each in (mesh.rgb, mesh.uv))
    there = np.zeros_like(drawn)
    for k, texture in enumerate(textures):
        there[mesh.texture_of[index] == k] = texture.rgb(uv[mesh.texture_of[index] == k])
    return float(np.sqrt(((drawn - there) ** 2).mean()))


def rim(mesh):
    """Length of all edges of an odd number of triangles, places joined; and how many there are."""
    place, joined = np.unique(mesh.vertex + 0.0, axis=0, return_inverse=True)
    triangle = joined.reshape(-1)[mesh.triangle]
    edge = np.sort(np.stack([triangle, np.roll(triangle, -1, axis=1)], axis=-1).reshape(-1, 2), axis=1)
    found, count = np.unique(edge, axis=0, return_counts=True)
    odd = found[count % 2 == 1]
    return float(np.linalg.norm(place[odd[:, 0]] - place[odd[:, 1]], axis=1).sum()), len(odd)


def test_a_chequered_quad_is_followed_within_the_budget(rng):
    mesh, textures = textured(chequers(8))
    before = rms_on(mesh, textures, rng)
    errors = []
    for vertices_max in (100, 400, 1600, 6400):
        found = follow_textures(mesh, textures, vertices_max=vertices_max)
        assert len(found.vertex) <= vertices_max
        np.testing.assert_allclose(areas(found).sum(), 8.0, rtol=1e-12)
        assert not found.vertex[:, 2].any()
        assert (np.cross(*(np.diff(found.vertex[found.triangle], axis=1).transpose(1, 0, 2)))[:, 2] > 0.0).all()
        np.testing.assert_array_equal(found.vertex[:4], QUAD)
        np.testing.assert_array_equal(found.rgb[4:], textures[0].rgb(found.uv[4:]))
        np.testing.assert_allclose(found.uv, found.vertex[:, :2] / [4, 2], atol=1e-12)
        assert rim(found)[0] == pytest.approx(12.0)
        errors.append(rms_on(found, textures, rng))
    assert before > 80.0
    assert errors == sorted(errors, reverse=True)
    assert errors[-1] < 0.35 * before  # measured: .334


def test_a_closed_box_stays_closed():
    corner = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
    side = [[0, 1, 3], [0, 3, 2]], [[4, 6, 7], [4, 7, 5]], [[0, 4, 5], [0, 5, 1]]
    other = [[2, 3, 7], [2, 7, 6]], [[0, 2, 6], [0, 6, 4]], [[1, 5, 7], [1, 7, 3]]
    index = np.array([*side, *other]).reshape(-1)
    # every triangle with vertices of its own, as where textures do not join
    uv = np.tile([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]], (12, 1))
    mesh, textures = textured(chequers(8), corner[index], np.arange(36).reshape(-1, 3), uv)
    found = follow_textures(mesh, textures, vertices_max=4000)
    assert len(found.vertex) > 3000
    assert rim(found) == (0.0, 0)
    np.testing.assert_allclose(areas(found).sum(), 6.0)
