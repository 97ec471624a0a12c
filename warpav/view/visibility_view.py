"""What a rig sees, drawn around the rig.

The view of every camera up to what hides the rest, traffic by what becomes of it, and the ground by how many
cameras see somebody there. As in `warpav.view.rig_view`, every function adds to a plotter that the caller owns, under
stable names.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from warpav.view.opengl import load_pyvista
from warpav.view.palette import COVERAGE_RGB, INK_RGB, OUTCOME_RGB, Rgb, camera_rgb, hex_colour
from warpav.view.polydata import mesh_to_pyvista

if TYPE_CHECKING:
    from collections.abc import Sequence

    from warpav.rig.rig import Rig, RigCamera
    from warpav.scene.device_scene import DeviceScene
    from warpav.scene.scene import Scene
    from warpav.sight.ground import Coverage

    Plotter = Any
    PolyData = Any

FARTHEST_M = 15.0
"""How far an unobstructed view is drawn [m]."""

RAYS_PX = 257
"""Rays along each side of an image that find where the view ends."""

_TOP_M = 2.2
"""Images leave buildings out, so what is seen of them would hang in the air [m]."""

# Neighbouring rays see one surface where their inverse reaches differ by less than this share, or as those beside them.
_SAME_REACH, _SAME_SLOPE = 0.04, 0.5

_LIFT_M = 0.04  # of the coverage above the ground, so that both can be distinguished
_COVERAGE_ALPHA = 153
_SEEN_ALPHA, _SIDE_ALPHA = 71, 15


def visibility_to_pyvista(
    camera: RigCamera, scene: DeviceScene, *, farthest_m: float = FARTHEST_M, rays: int = RAYS_PX
) -> PolyData:
    """What a camera sees, up to what hides the rest, as ``pyvista.PolyData``."""
    from warpav.sight.sight import free_shares

    model, transform = camera.model, camera.ego_from_camera
    row_px, column_px = np.linspace(0.0, model.height_px, rays), np.linspace(0.0, model.width_px, rays)
    ray = model.rays(np.stack(np.meshgrid(column_px, row_px), axis=-1).reshape(-1, 2)) @ transform[:3, :3].T
    ray_m = farthest_m * ray / np.linalg.norm(ray, axis=-1, keepdims=True)
    share = np.full(len(ray), np.nan)
    has_ray = np.isfinite(ray).all(axis=-1)
    share[has_ray] = free_shares(
        scene,
        transform[:3, 3],
        transform[:3, 3] + ray_m[has_ray],
        near_m=model.near_m,
        behind_glass=camera.behind_glass,
    )
    # a little before the surface, so that it is drawn above it
    point_m = (
        transform[:3, 3] + np.maximum(share - np.where(share < 1.0, _LIFT_M / farthest_m, 0.0), 0.0)[:, None] * ray_m
    )
    index = np.arange(rays * rays).reshape(rays, rays)
    upper_left, upper_right = index[:-1, :-1].ravel(), index[:-1, 1:].ravel()
    lower_left, lower_right = index[1:, :-1].ravel(), index[1:, 1:].ravel()
    end = np.r_[np.c_[upper_left, upper_right, lower_right], np.c_[upper_left, lower_right, lower_left]]
    inverse = 1.0 / np.maximum(share.reshape(rays, rays), 1e-6)
    along_row, along_column = _is_one_surface(inverse), _is_one_surface(inverse.T).T
    is_one_surface = np.r_[
        (along_row[:-1] & along_column[:, 1:]).ravel(), (along_row[1:] & along_column[:, :-1]).ravel()
    ] & (share[end].max(axis=1) < 1.0)
    border = np.r_[index[0], index[1:, -1], index[-1, -2::-1], index[-2::-1, 0]]
    side = np.c_[np.full(len(border) - 1, rays * rays), border[:-1], border[1:]]
    triangle = np.r_[end, side]
    part = np.r_[np.where(is_one_surface, "seen", "free"), np.full(len(side), "side")]
    point_m = np.vstack([point_m, camera.position_m])
    is_whole = np.isfinite(point_m[triangle]).all(axis=(1, 2))
    surface = load_pyvista().PolyData.from_regular_faces(np.nan_to_num(point_m), triangle[is_whole])
    surface.cell_data["part"] = part[is_whole]
    return surface


def _is_one_surface(inverse_reach: np.ndarray) -> np.ndarray:
    """Whether a ray and the next in its row see one surface, bool [row, column - 1].

    The inverse reach of a plane is all but linear in the image, however flat the rays meet it. So a step is a step from
    one surface to another where neither of the steps beside it goes on like it.
    """
    step = np.diff(inverse_reach, axis=1)
    beside = np.pad(step, ((0, 0), (1, 1)), constant_values=np.inf)
    unlike = np.minimum(np.abs(beside[:, :-2] - step), np.abs(beside[:, 2:] - step))
    least = np.minimum(inverse_reach[:, :-1], inverse_reach[:, 1:])
    return (np.abs(step) < _SAME_REACH * least) | (unlike < _SAME_SLOPE * np.abs(step))


def add_visibility(
    plotter: Plotter,
    rig: Rig,
    scene: DeviceScene,
    *,
    farthest_m: float = FARTHEST_M,
    top_m: float = _TOP_M,
    name: str = "visibility",
) -> None:
    """Paint what every camera of a rig sees in the camera's colour, with the sides of its view up to there."""
    for index, camera in enumerate(rig.cameras):
        add_camera_visibility(plotter, camera, index, scene, farthest_m=farthest_m, top_m=top_m, name=name)


def add_camera_visibility(
    plotter: Plotter,
    camera: RigCamera,
    index: int,
    scene: DeviceScene,
    *,
    farthest_m: float = FARTHEST_M,
    top_m: float = _TOP_M,
    rays: int = RAYS_PX,
    name: str = "visibility",
) -> None:
    """Paint what one camera sees, with the sides of its view up to there."""
    surface = visibility_to_pyvista(camera, scene, farthest_m=farthest_m, rays=rays)
    height_m = surface.points[surface.regular_faces, 2]
    is_drawn = (surface.cell_data["part"] != "free") & (height_m.min(axis=1) < top_m)
    is_cut = is_drawn & (height_m.max(axis=1) > top_m)
    chosen = (is_drawn & ~is_cut, is_cut)
    surface, cut = (surface.extract_cells(which).extract_surface(algorithm=None) for which in chosen)
    if is_cut.any():  # to clip the whole takes VTK a second
        surface = surface.append_polydata(cut.clip("z", origin=(0.0, 0.0, top_m)))
    # most rays graze the ground, so going back along them hardly leaves it
    is_end = ~np.isclose(surface.points, camera.position_m, atol=1e-4).all(axis=1)
    surface.points[is_end, 2] += _LIFT_M
    if surface.n_cells == 0:
        plotter.remove_actor(f"{name}/{camera.name}")
        return
    alpha = np.where(surface.cell_data["part"] == "seen", _SEEN_ALPHA, _SIDE_ALPHA)
    surface.cell_data["RGBA"] = np.column_stack([np.tile(camera_rgb(index), (len(alpha), 1)), alpha]).astype(np.uint8)
    plotter.add_mesh(surface, scalars="RGBA", rgb=True, lighting=False, name=f"{name}/{camera.name}")


def add_outcomes(
    plotter: Plotter,
    scene: Scene,
    outcomes: Sequence[str],
    *,
    name: str = "scene/outcomes",
    legend: bool = True,
) -> None:
    """Add the vehicles of a scene in the colours of what becomes of them, each in a box."""
    pyvista = load_pyvista()
    if len(outcomes) != len(scene.vehicles):
        raise ValueError(f"expected an outcome of each of {len(scene.vehicles)} vehicles, got {len(outcomes)}")
    for vehicle, outcome in zip(scene.vehicles, outcomes, strict=True):
        colour = np.array(OUTCOME_RGB[outcome])
        surface = mesh_to_pyvista(vehicle.mesh)
        surface.point_data["RGB"] = (0.45 * vehicle.mesh.vertex_rgb + 0.55 * colour).astype(np.uint8)
        first = f"{name}/{vehicle.instance_id}"
        plotter.add_mesh(surface, scalars="RGB", rgb=True, lighting=False, name=f"{first}/body")
        length, width, height = vehicle.box.size_m
        box = pyvista.Box(bounds=(-length / 2, length / 2, -width / 2, width / 2, -height / 2, height / 2))
        box = box.rotate_z(np.degrees(vehicle.box.yaw_rad)).translate(vehicle.box.center_m)
        edges = box.extract_all_edges().tube(radius=0.03, n_sides=8)
        plotter.add_mesh(edges, color=OUTCOME_RGB[outcome], lighting=False, name=f"{first}/box")
    if legend:
        counts = {name: sum(outcome == name for outcome in outcomes) for name in OUTCOME_RGB}
        labels = {f"{count} {name}": OUTCOME_RGB[name] for name, count in counts.items() if count}
        add_legend(plotter, labels)


def coverage_to_pyvista(coverage: Coverage) -> PolyData:
    """The ground as ``pyvista.PolyData``, one square for each cell where somebody can stand.

    Cell data: ``cameras_<height>m`` (int64), how many cameras see somebody of a height there, -1 where nobody so tall
    can stand; and ``blind_<height>m`` (bool).
    """
    ground = coverage.ground
    row, column = np.nonzero(coverage.is_open.any(axis=0))
    half_m = 0.5 * ground.cell_m
    corner = np.array([[-half_m, -half_m], [half_m, -half_m], [half_m, half_m], [-half_m, half_m]])
    position_m = np.stack([ground.x_m[row], ground.y_m[column]], axis=-1)[:, None] + corner
    height_m = np.broadcast_to(ground.ground_m[row, column][:, None, None] + _LIFT_M, (len(row), 4, 1))
    point_m = np.concatenate([position_m, height_m], axis=-1).reshape(-1, 3)
    surface = load_pyvista().PolyData.from_regular_faces(point_m, np.arange(4 * len(row)).reshape(-1, 4))
    for height, count in zip(coverage.heights_m, coverage.count, strict=True):
        surface.cell_data[f"cameras_{height:g}m"] = count[row, column]
        surface.cell_data[f"blind_{height:g}m"] = count[row, column] == 0
    return surface


def add_coverage(
    plotter: Plotter, coverage: Coverage, *, height_m: float | None = None, name: str = "coverage", legend: bool = True
) -> PolyData:
    """Add the ground in the colours of how many cameras see somebody there; red is a blind spot."""
    height_m = coverage.heights_m[0] if height_m is None else height_m
    if height_m not in coverage.heights_m:
        raise ValueError(f"height_m must be one of {coverage.heights_m}, got {height_m}")
    surface = coverage_to_pyvista(coverage)
    surface.cell_data["RGBA"] = np.zeros((surface.n_cells, 4), np.uint8)
    colour_coverage(surface, coverage, height_m)
    plotter.add_mesh(surface, scalars="RGBA", rgb=True, lighting=False, name=name)
    if legend:
        words = ("no camera", "one camera", "two cameras", "more cameras")
        who = patch_words(height_m)
        labels = {f"{who}: {word}": rgb for word, rgb in zip(words, COVERAGE_RGB, strict=True)}
        add_legend(plotter, labels)
    return surface


def patch_words(height_m: float) -> str:
    """Whom a height of a coverage means [m]: the ground itself, or somebody so tall."""
    from warpav.sight.ground import PATCH_M

    return "the ground" if height_m <= PATCH_M else f"{height_m:g} m tall"


def colour_coverage(surface: PolyData, coverage: Coverage, height_m: float) -> None:
    """Change the colours of ground that is drawn already, to those of another coverage of the same ground."""
    row, column = np.nonzero(coverage.is_open.any(axis=0))
    count = coverage.count[coverage.heights_m.index(height_m), row, column]
    palette = np.array([(*rgb, _COVERAGE_ALPHA) for rgb in COVERAGE_RGB] + [(0, 0, 0, 0)], np.uint8)  # last: nobody
    surface.cell_data["RGBA"][:] = palette[
        np.where(count < 0, len(COVERAGE_RGB), np.minimum(count, len(COVERAGE_RGB) - 1))
    ]


def add_legend(plotter: Plotter, labels: dict[str, Rgb], *, name: str = "legend", bottom: float = 0.025) -> None:
    """Add what colours mean, in the lower left corner; an earlier legend is replaced."""
    for actor in [actor for actor in plotter.actors if actor.startswith(f"{name}/")]:
        plotter.remove_actor(actor)
    size = 10.0 * plotter.window_size[1] / 800.0
    for line, (text, rgb) in enumerate(reversed(labels.items())):
        actor = plotter.add_text(
            f" {text} ",
            position=(0.015, bottom + 0.037 * line),
            viewport=True,
            font_size=size,
            color=hex_colour(INK_RGB),
            name=f"{name}/{line}",
        )
        actor.prop.background_color = hex_colour(rgb)
        actor.prop.background_opacity = 0.8
