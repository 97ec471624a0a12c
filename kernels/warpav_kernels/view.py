"""A view: one pinhole image of the scene, and the geometry that every kernel shares.

Sample grid of a view: the image's pixels, each cut into supersampling x supersampling samples, inside a frame of one
guard sample on every side. Sample (row, column) has its centre at (column + 0.5, row + 0.5); the principal point is the
middle of the grid. The guard band has weight 0 in every measure; it is there so that outlines within half a sample of
the image's edge still carry a gradient.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

GUARD = wp.constant(1)


@wp.struct
class View:
    """Pose and lens of one view.

    Attributes:
        position_ego_m: Camera centre in the ego frame [m].
        camera_from_ego: Rotation from ego axes to camera axes (x right, y down, z forward).
        focal_px: Focal length in samples of the grid.
        near_m: Depth of the near plane [m].
    """

    position_ego_m: wp.vec3
    camera_from_ego: wp.mat33
    focal_px: float
    near_m: float


@wp.func
def point_in_camera(view: View, point_ego_m: wp.vec3) -> wp.vec3:
    """A point of the ego frame in camera coordinates [m]."""
    return view.camera_from_ego * (point_ego_m - view.position_ego_m)


@wp.func
def ray_in_camera(view: View, column: float, row: float, width: int, height: int) -> wp.vec3:
    """Ray of depth 1 through a place of the sample grid, in camera coordinates."""
    return wp.vec3((column - 0.5 * float(width)) / view.focal_px, (row - 0.5 * float(height)) / view.focal_px, 1.0)


@wp.func
def inverse_depth_of(bits: wp.int32) -> float:
    """Inverse depth [1/m] from its bit pattern; positive floats sort like their bits."""
    return wp.cast(bits, float)


@wp.kernel(enable_backward=False)
def place_views_kernel(
    # in
    position_ego_m: wp.array[wp.vec3],
    camera_from_ego: wp.array[wp.mat33],
    focal_px: wp.array[float],
    near_m: wp.array[float],
    supersampling: int,
    # out
    view: wp.array[View],
):
    """Gather each view's pose and lens into one struct.

    Launch: ``dim=view_count``; one thread per view. Not taped.
    Writes: every element of ``view`` once.
    """
    i = wp.tid()
    placed = View()
    placed.position_ego_m = position_ego_m[i]
    placed.camera_from_ego = camera_from_ego[i]
    placed.focal_px = focal_px[i] * float(supersampling)
    placed.near_m = near_m[i]
    view[i] = placed
