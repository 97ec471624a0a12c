"""Areas in the image of a pinhole camera, with derivatives, by formula: a sphere, a half-plane, a convex body.

Derivatives are to a shift of the camera along the ego axes [1/m], a spin of the scene's points about the camera's axes
[1/rad] and the logarithm of the focal length, float64 [7] in this order.
"""

import numpy as np
from scipy.spatial import ConvexHull

STEP = 1e-30  # of complex differentiation, which loses nothing however small it is


def focal_px(model):
    """Focal length [px]."""
    return 0.5 * model.width_px / np.tan(0.5 * model.fov_rad)


def in_camera(point_ego_m, ego_from_camera):
    """Points of the ego frame in camera coordinates."""
    return (np.asarray(point_ego_m, float) - ego_from_camera[:3, 3]) @ ego_from_camera[:3, :3]


def sphere_area(centre_ego_m, radius_m, ego_from_camera, model):
    """Area [px^2] and derivative of a sphere wholly in the image: an ellipse."""
    q, r, f = in_camera(centre_ego_m, ego_from_camera), radius_m, focal_px(model)
    to_contour, to_plane = q @ q - r**2, q[2] ** 2 - r**2
    area = np.pi * f**2 * r**2 * np.sqrt(to_contour) / to_plane**1.5
    per_point = area * (q / to_contour - np.array([0.0, 0.0, 3.0 * q[2] / to_plane]))
    return area, np.r_[-ego_from_camera[:3, :3] @ per_point, np.cross(q, per_point), 2.0 * area]


def half_plane_area(a_ego_m, b_ego_m, ego_from_camera, model):
    """Area to the left of the line through two points [px^2] and its derivative; it crosses top and bottom."""
    a, b = in_camera([a_ego_m, b_ego_m], ego_from_camera)
    f, normal = focal_px(model), np.cross(a, b)
    # the line's mean column is that of the image's middle row
    offset = -f * normal[2] / normal[0]
    per_normal = -f * np.array([-normal[2] / normal[0] ** 2, 0.0, 1.0 / normal[0]])
    # normal = a x b: a step of a or b changes it by da x b + a x db
    per_a, per_b = np.cross(b, per_normal), np.cross(per_normal, a)
    spin = np.cross(a, per_a) + np.cross(b, per_b)
    derivative = np.r_[-ego_from_camera[:3, :3] @ (per_a + per_b), spin, offset]
    return model.height_px * (0.5 * model.width_px + offset), model.height_px * derivative


def convex_area(corner_ego_m, edges, ego_from_camera, model, window_px=None):
    """Area [px^2] and derivative of a convex body, cut by the near plane and a window (left, top, right, bottom).

    ``edges`` are pairs of corners that a straight edge joins, [edge, 2]; without a window the image is it.
    """
    window_px = (0.0, 0.0, model.width_px, model.height_px) if window_px is None else window_px
    return _with_derivative(
        lambda moved, focal: _area(_in_window(_outline(moved(corner_ego_m), edges, focal, model), window_px)),
        ego_from_camera,
        model,
    )


def unblocked_area(body, blocking, ego_from_camera, model):
    """Area [px^2] and derivative of the part of a convex body that another, nearer one's silhouette leaves free.

    Bodies are corners [corner, 3] and pairs of corners that a straight edge joins, [edge, 2].
    """
    image_px = (0.0, 0.0, model.width_px, model.height_px)

    def free(moved, focal):
        own, other = (
            _in_window(_outline(moved(corner_ego_m), edges, focal, model), image_px)
            for corner_ego_m, edges in (body, blocking)
        )
        common = own
        for a, b in zip(other, np.roll(other, -1, axis=0), strict=True):
            if len(common) >= 3:
                # the outline runs so that its inside lies on the left in axes (column, row)
                common = _clipped(common, (b[0] - a[0]) * (common[:, 1] - a[1]) - (b[1] - a[1]) * (common[:, 0] - a[0]))
        return _area(own) - (_area(common) if len(other) >= 3 else 0j)

    return _with_derivative(free, ego_from_camera, model)


def _with_derivative(area, ego_from_camera, model):
    """A complex area of (points of the ego frame to the camera's, focal length), and its derivative."""
    values = []
    for i in range(7):

        def moved(point_ego_m, i=i):
            q = in_camera(point_ego_m, ego_from_camera)
            if i < 3:
                return q - 1j * STEP * ego_from_camera[i, :3]
            return q + 1j * STEP * (np.cross(np.eye(3)[i - 3], q) if i < 6 else 0.0)

        values.append(area(moved, focal_px(model) * (1.0 + 1j * STEP * (i == 6))))
    return values[0].real, np.array([value.imag for value in values]) / STEP


def _outline(q, edges, focal, model):
    """The outline in the image in complex numbers, cut by the near plane; decisions are taken by the real parts."""
    kept = [point for point in q if point[2].real >= model.near_m]
    for a, b in q[edges]:
        if (a[2].real >= model.near_m) != (b[2].real >= model.near_m):
            kept.append(a + (model.near_m - a[2]) / (b[2] - a[2]) * (b - a))
    if len(kept) < 3:
        return np.zeros((0, 2), complex)
    point = np.array(kept)
    u, v = focal * point[:, :2].T / point[:, 2] + 0.5 * np.array([[model.width_px], [model.height_px]])
    return np.c_[u, v][ConvexHull(np.c_[u.real, v.real]).vertices]


def _in_window(polygon, window_px):
    """The part of a convex outline in a window (left, top, right, bottom)."""
    left, top, right, bottom = window_px
    for axis, bound, sign in ((0, left, 1), (1, top, 1), (0, right, -1), (1, bottom, -1)):
        if len(polygon):
            polygon = _clipped(polygon, sign * (polygon[:, axis] - bound))
    return polygon


def _area(polygon):
    if len(polygon) < 3:
        return 0j
    u, v = polygon.T
    return 0.5 * np.sum(u * np.roll(v, -1) - v * np.roll(u, -1))


def _clipped(polygon, distance):
    """The part of a polygon at which a distance, linear along its sides, is not negative."""
    kept = []
    for i in range(len(polygon)):
        j = (i + 1) % len(polygon)
        if distance[i].real >= 0:
            kept.append(polygon[i])
        if (distance[i].real >= 0) != (distance[j].real >= 0):
            kept.append(polygon[i] + distance[i] / (distance[i] - distance[j]) * (polygon[j] - polygon[i]))
    return np.array(kept).reshape(-1, 2)
