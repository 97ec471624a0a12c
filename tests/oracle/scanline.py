"""Areas of objects in an image, exact to rounding: a scanline renderer in double precision, for small scenes.

The image is cut into slabs of rows at every corner and wherever two lines cross: sides of triangles, lines where two
surfaces pass through each other, borders of pixels. In a slab every outline is straight, so the scanline in its middle
stands for all of it. That scanline is cut into intervals in the same way; what is nearest in an interval's middle is
nearest in all of it. Shares no code with the rasteriser.
"""

from itertools import pairwise

import numpy as np
from scipy.spatial.transform import Rotation

SHIFTS, SPINS, ZOOM = (0, 1, 2), (3, 4, 5), 6


def areas(meshes, ego_from_camera, model, *, weight=None, log_zoom=0.0):
    """Weighted areas of every mesh in a pinhole camera: what is visible of it and what it covers alone [px^2].

    Float64 [2, mesh]; with weights of the pixels, [image, row, column], [image, 2, mesh]. The focal length is
    multiplied by ``exp(log_zoom)``. A few hundred triangles are many.
    """
    width, height = model.width_px, model.height_px
    focal = 0.5 * width / np.tan(0.5 * model.fov_rad) * np.exp(log_zoom)
    parts = [_image_triangles(mesh, ego_from_camera, model, focal) for mesh in meshes]
    corner = np.concatenate(parts)
    owner = np.repeat(np.arange(len(meshes)), [len(part) for part in parts])
    if weight is None:
        columns, total = np.array([0.0, width]), np.tile([0.0, width], (1, height, 1))
    else:
        columns, total = np.arange(width + 1.0), np.cumsum(np.pad(weight, ((0, 0), (0, 0), (1, 0))), axis=2)
    rows = _event_rows(corner, owner, columns, height)
    intervals = _intervals(corner, 0.5 * (rows[1:] + rows[:-1]), width)
    result = np.zeros((len(total), 2, len(meshes)))
    for (low, high), line in zip(pairwise(rows), intervals, strict=True):
        hit = ~np.isnan(line[:, 0])
        if not hit.any():
            continue
        start, end, w_start, w_end = line[hit].T
        of = owner[hit]
        cut = np.unique(np.r_[start, end, _passes(start, end, w_start, w_end, of)])
        middle = 0.5 * (cut[1:] + cut[:-1])
        share = (middle - start[:, None]) / (end - start)[:, None]
        w = np.where((share > 0.0) & (share < 1.0), w_start[:, None] + share * (w_end - w_start)[:, None], 0.0)
        nearest = np.where(w.max(axis=0) > 0.0, of[w.argmax(axis=0)], -1)
        gain = np.array([(high - low) * np.diff(np.interp(cut, columns, t)) for t in total[:, int(low + 1e-6)]])
        for k in np.unique(of):
            result[:, 0, k] += gain[:, nearest == k].sum(axis=1)
            result[:, 1, k] += gain[:, (w[of == k] > 0.0).any(axis=0)].sum(axis=1)
    return result[0] if weight is None else result


def gradients(meshes, ego_from_camera, model, *, shift_m, spin_rad, **settings):
    """Central differences of `areas`: to ego x, y, z [1/m], spins about camera axes [1/rad], the log focal length.

    Float64 [2, mesh, 7]; with weights another first axis. ``shift_m`` is a thousandth of the distance or less;
    ``spin_rad`` is also the step of the logarithm of the focal length.
    """
    columns = []
    for direction in (*SHIFTS, *SPINS, ZOOM):
        step = shift_m if direction in SHIFTS else spin_rad
        settings_of = {sign: {"log_zoom": sign * step * (direction == ZOOM), **settings} for sign in (1, -1)}
        high, low = (
            areas(meshes, moved(ego_from_camera, direction, sign * step), model, **settings_of[sign])
            for sign in (1, -1)
        )
        columns.append((high - low) / (2.0 * step))
    return np.stack(columns, axis=-1)


def moved(ego_from_camera, direction, step):
    """The pose, its centre shifted along an ego axis or its points spun about a camera axis."""
    result = np.array(ego_from_camera, float)
    if direction in SHIFTS:
        result[direction, 3] += step
    elif direction in SPINS:
        spin = Rotation.from_rotvec(step * np.eye(3)[direction - SPINS[0]]).as_matrix()
        result[:3, :3] = result[:3, :3] @ spin.T
    return result


def _image_triangles(mesh, ego_from_camera, model, focal):
    """Triangles before the near plane: column, row, 1/z of their corners, [triangle, 3, 3]."""
    camera = (np.asarray(mesh.vertex_m, float) - ego_from_camera[:3, 3]) @ ego_from_camera[:3, :3]
    fans = []
    for polygon in camera[mesh.triangle]:
        kept = []
        for a, b in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
            if a[2] >= model.near_m:
                kept.append(a)
            if (a[2] >= model.near_m) != (b[2] >= model.near_m):
                kept.append(a + (model.near_m - a[2]) / (b[2] - a[2]) * (b - a))
        fans += [(kept[0], kept[i], kept[i + 1]) for i in range(1, len(kept) - 1)]
    q = np.array(fans).reshape(-1, 3, 3)
    centre = 0.5 * np.array([model.width_px, model.height_px])
    return np.concatenate([centre + focal * q[..., :2] / q[..., 2:], 1.0 / q[..., 2:]], axis=2)


def _event_rows(corner, owner, columns, height_px):
    """Rows between which every outline is straight and crosses no other, nor a border of pixels."""
    start, end = corner[..., :2].reshape(-1, 2), np.roll(corner, -1, axis=1)[..., :2].reshape(-1, 2)
    pass_start, pass_end = _pass_lines(corner, owner)
    top, bottom = np.c_[columns, np.full(len(columns), -1.0)], np.c_[columns, np.full(len(columns), height_px + 1.0)]
    start, end = np.r_[start, pass_start, top], np.r_[end, pass_end, bottom]
    rows = np.r_[np.arange(height_px + 1.0), start[:, 1], end[:, 1], _crossing_rows(start, end)]
    rows = np.unique(rows[(rows >= 0.0) & (rows <= height_px)])
    return rows[np.diff(rows, prepend=-1.0) > 1e-10]


def _crossing_rows(start, end):
    """Rows where two lines cross."""
    along = end - start
    between = start[None] - start[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        cross = along[:, None, 0] * along[None, :, 1] - along[:, None, 1] * along[None, :, 0]
        s = (between[..., 0] * along[None, :, 1] - between[..., 1] * along[None, :, 0]) / cross
        t = (between[..., 0] * along[:, None, 1] - between[..., 1] * along[:, None, 0]) / cross
        row = start[:, None, 1] + s * along[:, None, 1]
    return row[(s >= 0) & (s <= 1) & (t >= 0) & (t <= 1)]


def _pass_lines(corner, owner):
    """Start and end of the lines in the image along which triangles of two objects pass through each other."""
    u, v = corner[..., 0], corner[..., 1]
    doubled = (u[:, 1] - u[:, 0]) * (v[:, 2] - v[:, 0]) - (u[:, 2] - u[:, 0]) * (v[:, 1] - v[:, 0])
    kept = np.abs(doubled) > 1e-12
    corner, owner = corner[kept], owner[kept]
    # 1/z is linear in the image: w = plane . (u, v, 1); inside is side . (u, v, 1) >= 0
    ones = np.ones((*corner.shape[:2], 1))
    image = np.concatenate([corner[..., :2], ones], axis=2)
    plane = np.linalg.solve(image, corner[..., 2:])[..., 0]
    side = np.cross(image, np.roll(image, -1, axis=1)) * np.sign(doubled[kept])[:, None, None]
    starts, ends = [np.zeros((0, 2))], [np.zeros((0, 2))]
    for i in range(len(corner)):
        j = np.flatnonzero(owner > owner[i])
        line = plane[j] - plane[i]
        norm = np.linalg.norm(line[:, :2], axis=1)
        j, line, norm = j[norm > 1e-12], line[norm > 1e-12], norm[norm > 1e-12]
        origin = -line[:, :2] * (line[:, 2] / norm**2)[:, None]
        along = np.c_[-line[:, 1], line[:, 0]] / norm[:, None]
        low, high = np.full(len(j), -np.inf), np.full(len(j), np.inf)
        for bound in (*(np.broadcast_to(s, (len(j), 3)) for s in side[i]), *np.moveaxis(side[j], 1, 0)):
            at, rate = (bound[:, :2] * origin).sum(axis=1) + bound[:, 2], (bound[:, :2] * along).sum(axis=1)
            with np.errstate(divide="ignore", invalid="ignore"):
                cut = -at / rate
            low = np.where(rate > 0, np.maximum(low, cut), low)
            high = np.where(rate < 0, np.minimum(high, cut), high)
            high = np.where((rate == 0) & (at < 0), -np.inf, high)
        crosses = low < high
        starts.append((origin + low[:, None] * along)[crosses])
        ends.append((origin + high[:, None] * along)[crosses])
    return np.concatenate(starts), np.concatenate(ends)


def _intervals(corner, rows, width_px):
    """What scanlines cut out of triangles, inside the image: start, end, 1/z at both, [line, triangle, 4]; or NaN."""
    a, b = corner, np.roll(corner, -1, axis=1)
    y = rows[:, None, None]
    crosses = (a[..., 1] < y) != (b[..., 1] < y)
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.where(crosses, (y - a[..., 1]) / (b[..., 1] - a[..., 1]), np.nan)[..., None]
        point = a[..., [0, 2]] + share * (b - a)[..., [0, 2]]  # column and 1/z on every side
        # NaN comes last: the two sides that cross the line are the first two
        order = np.argsort(point[..., 0], axis=-1)[..., :2, None]
        (x0, w0), (x1, w1) = (np.moveaxis(np.take_along_axis(point, order, axis=2)[:, :, k], -1, 0) for k in (0, 1))
        slope = (w1 - w0) / (x1 - x0)
        start, end = np.clip(x0, 0.0, width_px), np.clip(x1, 0.0, width_px)
        found = np.stack([start, end, w0 + slope * (start - x0), w0 + slope * (end - x0)], axis=-1)
        return np.where((end - start > 1e-12)[..., None], found, np.nan)


def _passes(start, end, w_start, w_end, of):
    """Places where surfaces of two objects pass through each other."""
    slope = (w_end - w_start) / (end - start)
    zero = w_start - slope * start
    i, j = np.nonzero(of[:, None] < of[None, :])
    with np.errstate(divide="ignore", invalid="ignore"):
        x = (zero[j] - zero[i]) / (slope[i] - slope[j])
    return x[(x > np.maximum(start[i], start[j])) & (x < np.minimum(end[i], end[j]))]
