"""Where meshes end inside an image, exactly: from their edges, cut at the near plane and at the image's borders."""

import numpy as np


def boxes(meshes, pose, model):
    """Left, top, right, bottom [px] of every mesh alone in a pinhole camera, [mesh, 4]; NaN where it is out of sight.

    A side at the image's border reads too far inside where a single face covers two corners of the image.
    """
    return np.array([box_of(mesh, pose, model) for mesh in meshes])


def box_of(mesh, pose, model):
    triangle = np.asarray(mesh.triangle)
    edge = np.unique(np.sort(np.concatenate([triangle[:, [a, b]] for a, b in ((0, 1), (1, 2), (2, 0))])), axis=0)
    start, end = ((mesh.vertex_m.astype(float) - pose[:3, 3]) @ pose[:3, :3])[edge].transpose(1, 0, 2)
    crosses = (start[:, 2] > model.near_m) | (end[:, 2] > model.near_m)
    start, end = start[crosses], end[crosses]
    start, end = behind_near_plane(start, end, model.near_m), behind_near_plane(end, start, model.near_m)
    start, end = model.project(start), model.project(end)
    size = np.array([model.width_px, model.height_px], float)
    with np.errstate(divide="ignore", invalid="ignore"):
        borders = np.stack([-start, size - start]) / (end - start)
    first = np.nanmax(np.c_[borders.min(axis=0), np.zeros(len(start))], axis=1)
    last = np.nanmin(np.c_[borders.max(axis=0), np.ones(len(start))], axis=1)
    seen = first <= last
    start, way = start[seen], (end - start)[seen]
    place_px = np.concatenate([start + t[seen, None] * way for t in (first, last)])
    if not len(place_px):
        return np.full(4, np.nan)
    return np.concatenate([place_px.min(axis=0), place_px.max(axis=0)])


def behind_near_plane(start, end, near_m):
    """The starts of edges, moved along them to the near plane where they lie before it."""
    with np.errstate(divide="ignore", invalid="ignore"):
        t = (near_m - start[:, 2:]) / (end[:, 2:] - start[:, 2:])
    return np.where(start[:, 2:] < near_m, start + t * (end - start), start)
