"""Oracles for closed surfaces."""

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

WELD_M = 2e-5


def unmatched_edge_count(mesh):
    """Directed edges that are not used exactly as often the other way round, vertices welded by position."""
    key = np.round(mesh.vertex_m.astype(np.float64) / WELD_M).astype(np.int64)
    _, weld = np.unique(key, axis=0, return_inverse=True)
    corner = weld.reshape(-1)[mesh.triangle]
    start, end = corner.ravel(), np.roll(corner, -1, axis=1).ravel()
    count = int(weld.max()) + 1
    forward, forward_use = np.unique(start * count + end, return_counts=True)
    backward, backward_use = np.unique(end * count + start, return_counts=True)
    same = np.array_equal(forward, backward) and np.array_equal(forward_use, backward_use)
    return 0 if same else len(np.setxor1d(forward, backward)) + int(np.sum(forward_use)) - int(np.sum(backward_use))


def signed_volume_m3(mesh):
    """Volume of the shells; positive when triangles are counter-clockwise seen from outside."""
    corner = mesh.vertex_m[mesh.triangle].astype(np.float64)
    return float(np.einsum("ij,ij->", corner[:, 0], np.cross(corner[:, 1], corner[:, 2])) / 6.0)


def back_face_share(mesh, rng, ray_count=20_000, hit_share_min=0.2):
    """Share of the rays from outside that hit the mesh and meet the back of a triangle first."""
    low, high = mesh.bounds_m().astype(np.float64)
    middle, radius = 0.5 * (low + high), np.linalg.norm(high - low)
    outside = rng.normal(size=(ray_count, 3))
    outside = middle + radius * outside / np.linalg.norm(outside, axis=1, keepdims=True)
    target = rng.uniform(low, high, (ray_count, 3))
    direction = (target - outside).astype(np.float32)
    caster = EmbreeScene()
    TriangleMesh(caster, mesh.vertex_m[mesh.triangle])
    hit = caster.run(outside.astype(np.float32), direction, query="INTERSECT")
    corner = mesh.vertex_m[mesh.triangle[hit[hit >= 0]]].astype(np.float64)
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    facing = np.einsum("ij,ij->i", normal, direction[hit >= 0])
    assert len(facing) > hit_share_min * ray_count
    return float(np.mean(facing > 0.0))
