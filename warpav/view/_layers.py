"""What pictures in space are made of, and what is laid over them: sight, outcomes, zones, requirements, next steps.

Every ``add_...`` adds to a plotter of the caller under stable names; what was drawn under the same name goes, and None
adds nothing.
"""

from __future__ import annotations

import math
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from warpav.view._opengl import load_pyvista, load_pyvista_data
from warpav.view._palette import (
    COVERAGE_RGB,
    COVERAGE_WORDS,
    DESCENT_RGB,
    INK_RGB,
    MUTED_RGB,
    OUTCOME_RGB,
    Rgb,
    camera_rgb,
    further_map,
    hex_colour,
    zone_rgb,
)

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from warpav.optimisation import FurtherCameras
    from warpav.raster.mesh import Mesh
    from warpav.rig import MountSurface, Rig, RigCamera
    from warpav.scene import DeviceScene, Scene
    from warpav.sight import Coverage, RequirementResult

    Plotter = Any
    PolyData = Any

SQUARE = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])
"""Corners of a cell around its middle, in cells."""

_GAIN_TITLE = "one more camera: further objects found of 100"


def mesh_to_pyvista(mesh: Mesh) -> PolyData:
    """The mesh as ``pyvista.PolyData``; colours are the point data ``RGB`` (uint8, shape [vertex, 3])."""
    pyvista = load_pyvista_data()
    surface = pyvista.PolyData.from_regular_faces(np.asarray(mesh.vertex_m), np.asarray(mesh.triangle))
    surface.point_data["RGB"] = mesh.vertex_rgb
    return surface


def _faces_to_pyvista(corner_m: np.ndarray, sides: int = 4) -> PolyData:
    return load_pyvista_data().PolyData.from_regular_faces(corner_m, np.arange(len(corner_m)).reshape(-1, sides))


def paint(plotter: Plotter, surface: PolyData, *, name: str, colours: str = "RGB") -> None:
    """Add a surface in the colours of its data as they are: those of meshes hold their light."""
    plotter.add_mesh(surface, scalars=colours, rgb=True, lighting=False, show_edges=False, name=name)


def remove(plotter: Plotter, name: str) -> None:
    """Take an actor away, and those whose names begin with its name and a slash."""
    for each in [each for each in plotter.actors if each == name or each.startswith(f"{name}/")]:
        plotter.remove_actor(each)


@contextmanager
def no_render(plotter: Plotter) -> Iterator[None]:
    """Change a plotter without drawing after every change, as pyvista does once it was drawn."""
    plotter.suppress_rendering = True
    try:
        yield
    finally:
        plotter.suppress_rendering = False


def add_text(plotter: Plotter, text: str, at: tuple[float, float], *, size: float, name: str, **style: Any) -> Any:  # noqa: ANN401
    """Write a text at a place of the image, as shares of it from the lower left corner."""
    style = {"color": hex_colour(INK_RGB)} | style
    return plotter.add_text(text, position=at, viewport=True, font_size=size, name=name, **style)


def add_legend(plotter: Plotter, labels: dict[str, Rgb], *, name: str = "legend", bottom: float = 0.025) -> None:
    """Say what colours mean, in the lower left corner; an earlier legend is replaced."""
    remove(plotter, name)
    size = 10.0 * plotter.window_size[1] / 800.0
    for line, (text, rgb) in enumerate(reversed(labels.items())):
        at = (0.015, bottom + 0.037 * line)
        actor = add_text(plotter, f" {text} ", at, size=size, name=f"{name}/{line}")
        actor.prop.background_color = hex_colour(rgb)
        actor.prop.background_opacity = 0.8


def add_labels(plotter: Plotter, point_m: np.ndarray, texts: list[str], *, size: int, name: str) -> None:
    """Write texts at points, without a frame, before everything else."""
    style = {"shape": None, "show_points": False, "always_visible": True}
    plotter.add_point_labels(point_m, texts, text_color=hex_colour(INK_RGB), font_size=size, name=name, **style)


def _add_gains(
    plotter: Plotter,
    surface: PolyData | None,
    most: float,
    *,
    name: str,
    at: tuple[float, float],
    **style: Any,  # noqa: ANN401 (of pyvista)
) -> None:
    """Add a surface in the colours of its ``gain_of_100``, with a scale; what was drawn before under the name goes."""
    plotter.remove_actor(name)
    if _GAIN_TITLE in plotter.scalar_bars:
        plotter.remove_scalar_bar(_GAIN_TITLE)
    if surface is None or not surface.n_cells:
        return
    size = max(9, round(16 * min(1.0, plotter.window_size[0] / 1280)))
    scale = {"title": _GAIN_TITLE, "color": hex_colour(INK_RGB), "fmt": "%.2g", "n_labels": 3}
    scale |= {"position_x": at[0], "position_y": at[1], "width": 0.35, "height": 0.115}
    scale |= {"title_font_size": size, "label_font_size": size}
    colours = {"scalars": "gain_of_100", "cmap": further_map(), "clim": (0.0, max(most, 1e-9))}
    plotter.add_mesh(surface, **colours, **style, name=name, scalar_bar_args=scale)
    plotter.scalar_bars[_GAIN_TITLE].SetTitle(f"{_GAIN_TITLE}\n ")  # VTK lets it touch its numbers


# --------------------------------------------------------------------------------------------------- what is seen

_FARTHEST_M = 15.0
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
    camera: RigCamera, scene: DeviceScene, *, farthest_m: float = _FARTHEST_M, rays: int = RAYS_PX
) -> PolyData:
    """What a camera sees, up to what hides the rest; cell data ``part``: seen, free (nothing is near), side."""
    from warpav.sight import free_shares

    model, transform = camera.model, camera.ego_from_camera
    row_px, column_px = np.linspace(0.0, model.height_px, rays), np.linspace(0.0, model.width_px, rays)
    ray = model.rays(np.stack(np.meshgrid(column_px, row_px), axis=-1).reshape(-1, 2)) @ transform[:3, :3].T
    ray_m = farthest_m * ray / np.linalg.norm(ray, axis=-1, keepdims=True)
    share = np.full(len(ray), np.nan)
    has_ray, centre_m = np.isfinite(ray).all(axis=-1), transform[:3, 3]
    glass = {"near_m": model.near_m, "behind_glass": camera.behind_glass}
    share[has_ray] = free_shares(scene, centre_m, centre_m + ray_m[has_ray], **glass)
    # a little before the surface, so that it is drawn above it
    point_m = centre_m + np.maximum(share - np.where(share < 1.0, _LIFT_M / farthest_m, 0.0), 0.0)[:, None] * ray_m
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


def add_visibility(plotter: Plotter, camera: RigCamera, index: int, scene: DeviceScene, *, rays: int = RAYS_PX) -> None:
    """Paint what a camera sees in its colour, with the sides of its view up to there."""
    name = f"visibility/{camera.name}"
    surface = visibility_to_pyvista(camera, scene, rays=rays)
    height_m = surface.points[surface.regular_faces, 2]
    is_drawn = (surface.cell_data["part"] != "free") & (height_m.min(axis=1) < _TOP_M)
    is_cut = is_drawn & (height_m.max(axis=1) > _TOP_M)
    chosen = (is_drawn & ~is_cut, is_cut)
    surface, cut = (surface.extract_cells(which).extract_surface(algorithm=None) for which in chosen)
    if is_cut.any():  # to clip the whole takes VTK a second
        surface = surface.append_polydata(cut.clip("z", origin=(0.0, 0.0, _TOP_M)))
    # most rays graze the ground, so going back along them hardly leaves it
    is_end = ~np.isclose(surface.points, camera.position_m, atol=1e-4).all(axis=1)
    surface.points[is_end, 2] += _LIFT_M
    if surface.n_cells == 0:
        plotter.remove_actor(name)
        return
    alpha = np.where(surface.cell_data["part"] == "seen", _SEEN_ALPHA, _SIDE_ALPHA)
    surface.cell_data["RGBA"] = np.column_stack([np.tile(camera_rgb(index), (len(alpha), 1)), alpha]).astype(np.uint8)
    paint(plotter, surface, colours="RGBA", name=name)


def add_outcomes(
    plotter: Plotter,
    scene: Scene,
    outcomes: Sequence[str],
    *,
    legend: bool = True,
    colours: Mapping[str, Rgb] = OUTCOME_RGB,
) -> None:
    """Add the vehicles of a scene in the colours of what becomes of them, each in a box."""
    pyvista = load_pyvista()
    if len(outcomes) != len(scene.vehicles):
        raise ValueError(f"expected an outcome of each of {len(scene.vehicles)} vehicles, got {len(outcomes)}")
    for vehicle, outcome in zip(scene.vehicles, outcomes, strict=True):
        colour, name = colours[outcome], f"scene/outcomes/{vehicle.instance_id}"
        surface = mesh_to_pyvista(vehicle.mesh)
        surface.point_data["RGB"] = (0.45 * vehicle.mesh.vertex_rgb + 0.55 * np.array(colour)).astype(np.uint8)
        paint(plotter, surface, name=f"{name}/body")
        length, width, height = vehicle.box.size_m
        box = pyvista.Box(bounds=(-length / 2, length / 2, -width / 2, width / 2, -height / 2, height / 2))
        box = box.rotate_z(np.degrees(vehicle.box.yaw_rad)).translate(vehicle.box.center_m)
        edges = box.extract_all_edges().tube(radius=0.03, n_sides=8)
        plotter.add_mesh(edges, color=colour, lighting=False, name=f"{name}/box")
    if legend:
        counts = {name: sum(outcome == name for outcome in outcomes) for name in OUTCOME_RGB}
        add_legend(plotter, {f"{count} {name}": OUTCOME_RGB[name] for name, count in counts.items() if count})


def coverage_to_pyvista(coverage: Coverage) -> PolyData:
    """The ground, one square for each cell where somebody can stand.

    Cell data: ``cameras_<height>m`` (int64), how many cameras see somebody of a height there, -1 where nobody so tall
    can stand; and ``blind_<height>m`` (bool).
    """
    ground = coverage.ground
    row, column = np.nonzero(coverage.is_open.any(axis=0))
    middle_m = np.stack([ground.x_m[row], ground.y_m[column]], axis=-1)
    height_m = np.broadcast_to(ground.ground_m[row, column][:, None, None] + _LIFT_M, (len(row), 4, 1))
    point_m = np.concatenate([middle_m[:, None] + ground.cell_m * SQUARE, height_m], axis=-1)
    surface = _faces_to_pyvista(point_m.reshape(-1, 3))
    for height, count in zip(coverage.heights_m, coverage.count, strict=True):
        surface.cell_data[f"cameras_{height:g}m"] = count[row, column]
        surface.cell_data[f"blind_{height:g}m"] = count[row, column] == 0
    return surface


BIT_CAMERAS = 31
"""Cameras of which the ground knows which see it, each a bit of a number."""


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
    row, column = np.nonzero(coverage.is_open.any(axis=0))
    is_seen = coverage.is_seen[:BIT_CAMERAS, coverage.heights_m.index(height_m), row, column]
    surface.cell_data["seen_by"] = (1 << np.arange(len(is_seen))) @ is_seen
    paint(plotter, surface, colours="RGBA", name=name)
    if legend:
        who = patch_words(height_m)
        add_legend(plotter, {f"{who}: {word}": rgb for word, rgb in zip(COVERAGE_WORDS, COVERAGE_RGB, strict=True)})
    return surface


def patch_words(height_m: float) -> str:
    """Whom a height of a coverage means [m]: the ground itself, or somebody so tall."""
    from warpav.sight import PATCH_M

    return "the ground" if height_m <= PATCH_M else f"{height_m:g} m tall"


def colour_coverage(surface: PolyData, coverage: Coverage, height_m: float) -> None:
    """Change the colours of ground that is drawn already, to those of another coverage of the same ground."""
    row, column = np.nonzero(coverage.is_open.any(axis=0))
    count = coverage.count[coverage.heights_m.index(height_m), row, column]
    palette = np.array([(*rgb, _COVERAGE_ALPHA) for rgb in COVERAGE_RGB] + [(0, 0, 0, 0)], np.uint8)  # last: nobody
    shown = np.where(count < 0, len(COVERAGE_RGB), np.minimum(count, len(COVERAGE_RGB) - 1))
    surface.cell_data["RGBA"][:] = palette[shown]


# --------------------------------------------------------------------------------------------------- requirements

_REQUIREMENT_LIFT_M = 0.06  # above the coverage, which is above the ground
_DISC_CORNERS = 12
_SHARE_OF_GRID = 0.4


def requirements_to_pyvista(result: RequirementResult) -> PolyData:
    """Points of requirements on the ground: discs where they are met, crosses where not."""
    ghosts, is_met = result.ghosts, result.is_point_met
    radius_m = _SHARE_OF_GRID * ghosts.of_each("grid_m").astype(float)
    angle = 2.0 * np.pi * np.arange(_DISC_CORNERS) / _DISC_CORNERS
    rim = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    disc = np.stack([np.zeros_like(rim), rim, np.roll(rim, -1, axis=0)], axis=1)
    bar = np.array([[-1.0, -0.22], [1.0, -0.22], [1.0, 0.22], [-1.0, 0.22]])
    bars = [bar @ [[c, s], [-s, c]] for c, s in ((np.sqrt(0.5), np.sqrt(0.5)), (np.sqrt(0.5), -np.sqrt(0.5)))]
    cross = np.stack([each[[0, k, k + 1]] for each in bars for k in (1, 2)])
    corners, points = [], []
    for shape, chosen, lift in ((disc, is_met, 1.0), (cross, ~is_met, 1.5)):
        index = np.flatnonzero(chosen)
        plane_m = ghosts.position_m[index][:, None, None] + radius_m[index][:, None, None, None] * shape
        height_m = np.full((*plane_m.shape[:-1], 1), lift * _REQUIREMENT_LIFT_M)
        corners.append(np.concatenate([plane_m, height_m], axis=-1).reshape(-1, 3))
        points.append(np.repeat(index, len(shape)))
    surface, point = _faces_to_pyvista(np.concatenate(corners), 3), np.concatenate(points)
    surface.cell_data["RGB"] = np.array(COVERAGE_RGB, np.uint8)[np.minimum(result.camera_count, 3)][point]
    surface.cell_data["point"] = point
    return surface


def add_requirements(plotter: Plotter, result: RequirementResult | None) -> None:
    """Lay the points of requirements on the ground, in the colour of how many cameras see enough there."""
    remove(plotter, "requirements")
    if result is not None:
        paint(plotter, requirements_to_pyvista(result), name="requirements")
        labels = {f"seen enough by {word}": rgb for word, rgb in zip(COVERAGE_WORDS, COVERAGE_RGB, strict=True)}
        add_legend(plotter, labels | {"cross: not met": MUTED_RGB}, name="requirements/legend")


# --------------------------------------------------------------------------------------------------- on the body

_ZONE_LIFT_M = 0.03

WHOLE = "mountable zone"
"""What a surface without zones is called."""


def zones_to_pyvista(surface: MountSurface, *, lift_m: float = 0.0) -> PolyData:
    """The cells that can carry a camera, one square each.

    A zone that carries several modules is there once. Of symmetric rigs the right halves of zones are there too.

    Cell data: ``height_m`` above the ground, ``border_distance_m`` to the nearest position that carries none, and
    ``zone``, the number of its zone among `_zone_names`.
    """
    is_shown = surface.inside.copy()
    number = np.zeros(surface.height_m.shape, int)
    if surface.zones:
        names = _zone_names(surface)
        own = [zone.name for zone in surface.zones]
        is_shown &= np.array([own.index(name) == k for k, name in enumerate(own)])[surface.zone_of_cell]
        number = np.array([names.index(name) for name in own])[surface.zone_of_cell]
    middle_m = surface.origin_m + np.argwhere(is_shown) * surface.cell_m
    corner_m = (middle_m[:, None] + surface.cell_m * SQUARE).reshape(-1, 2)
    height_m = surface.height_at_m(corner_m) + lift_m
    if surface.zones:
        # beside a gap of the chart a corner belongs to the zone of its cell
        zone = np.repeat(surface.zone_at(middle_m), 4)
        local_m = np.column_stack([corner_m, height_m])
        point_m = surface.plane_m[zone] + np.einsum("ki,kij->kj", local_m, surface.axes[zone])
    else:
        point_m = surface.point_m(corner_m, height_m)
    data = {
        "border_distance_m": surface.border_distance_m[is_shown].astype(np.float64),
        "height_m": surface.point_m(middle_m, surface.height_m[is_shown].astype(np.float64))[:, 2],
        "zone": number[is_shown],
    }
    if any(surface.pairs):
        is_pair = np.asarray(surface.pairs)[surface.module_at(middle_m)]
        mirrored_m = point_m.reshape(-1, 4, 3)[is_pair] * (1.0, -1.0, 1.0)
        point_m = np.concatenate([point_m, mirrored_m.reshape(-1, 3)])
        data = {name: np.concatenate([each, each[is_pair]]) for name, each in data.items()}
    squares = _faces_to_pyvista(point_m)
    squares.cell_data.update(data)
    return squares


def _zone_names(surface: MountSurface) -> list[str]:
    return list(dict.fromkeys(zone.name for zone in surface.zones)) or [WHOLE]


def add_zones(plotter: Plotter, surface: MountSurface | None, *, name: str = "zones", bottom: float = 0.025) -> None:
    """Paint the cells that can carry a camera, every zone in a colour of its own, with a legend."""
    remove(plotter, name)
    if surface is None:
        return
    labels: dict[str, Rgb] = {each: zone_rgb(k) for k, each in enumerate(_zone_names(surface))}
    squares = zones_to_pyvista(surface, lift_m=_ZONE_LIFT_M)
    squares.cell_data["RGB"] = np.array(list(labels.values()), np.uint8)[squares.cell_data["zone"]]
    paint(plotter, squares, name=name)
    add_legend(plotter, labels, name=f"{name}/legend", bottom=bottom)


def add_mount_surface(plotter: Plotter, surface: MountSurface, *, scale: Mapping[str, Any] | None = None) -> None:
    """Paint where cameras may stand: zones in their colours, else by height, from dark (low) to light."""
    if surface.zones:
        add_zones(plotter, surface, name="mount_surface")
        return
    squares = zones_to_pyvista(surface, lift_m=_ZONE_LIFT_M)
    style = {"scalars": "height_m", "cmap": "viridis", "lighting": False, "name": "mount_surface"}
    plotter.add_mesh(squares, **style, show_scalar_bar=scale is not None, scalar_bar_args=scale)
    if scale is not None:
        plotter.scalar_bars[scale["title"]].SetTitle(f"{scale['title']}\n ")  # as of gains


def gain_to_pyvista(surface: MountSurface, further: FurtherCameras, *, lift_m: float = 0.0) -> PolyData:
    """`zones_to_pyvista`, with the cell data ``gain_of_100``: what the best further camera near would bring.

    That is one of the same zone within 0.2 m of the square's middle along the surface, however far above it cameras
    stand; NaN where the search has asked for none there.
    """
    from scipy.spatial import KDTree

    from warpav.optimisation import PLACE_M

    squares = zones_to_pyvista(surface, lift_m=lift_m)
    gain_of_100 = np.full(squares.n_cells, np.nan)
    if len(further):
        names = _zone_names(surface)
        own = np.array([names.index(zone.name) for zone in surface.zones] or [0])
        middle_m = squares.points.reshape(-1, 4, 3).mean(axis=1)
        place_m, _ = surface.place_of(surface.left_of(further.position_m))
        zone = own[surface.zone_at(place_m)]
        cells = KDTree(surface.place_of(surface.left_of(middle_m))[0])
        for camera in np.argsort(further.gain, kind="stable"):  # the best last, which so prevails
            near = np.array(cells.query_ball_point(place_m[camera], PLACE_M), int)
            gain_of_100[near[squares.cell_data["zone"][near] == zone[camera]]] = 100.0 * further.gain[camera]
    squares.cell_data["gain_of_100"] = gain_of_100
    return squares


def add_gain(
    plotter: Plotter, surface: MountSurface, further: FurtherCameras | None, *, at: tuple[float, float] = (0.62, 0.025)
) -> None:
    """Paint the body in the colours of what one more camera would bring there.

    Where the search has asked for no camera, nothing is painted: what is not known is not made up from neighbours.
    """
    squares, most = None, 0.0
    if further is not None and len(further):
        squares, most = gain_to_pyvista(surface, further, lift_m=_ZONE_LIFT_M), 100.0 * float(further.gain.max())
        squares = squares.extract_cells(np.isfinite(squares.cell_data["gain_of_100"])).extract_surface(algorithm=None)
    _add_gains(plotter, squares, most, name="gain", at=at, lighting=False)


# --------------------------------------------------------------------------------------------------- of a search

_LONGEST_M = 0.8
"""Length of the arrow of the camera on which the loss depends most [m]; the others are shorter in proportion."""

_WIDEST_RAD = math.radians(60.0)
"""Angle of the bent arrow of the camera on whose yaw the loss depends most, likewise."""

_RADIUS_M = 0.42  # of the bent arrows
_RISE_M = 0.1  # of all arrows above the middle of a camera, so that its housing does not hide them
_SHAFT_M, _TIP_M = 0.022, 0.06
_LEAST = 1e-2  # of the longest; shorter arrows would be all tip


@dataclass(frozen=True, eq=False)
class Steepest:
    """Minus the gradient of the loss at a rig: by x and y on the mount surface [1/m], [camera, 2], and yaw [1/rad]."""

    along: np.ndarray
    turn: np.ndarray

    @classmethod
    def of_event(cls, event: Mapping[str, Any]) -> Steepest | None:
        """That of a line of ``events.jsonl``; None for runs that did not record it."""
        gradient = event.get("gradient")
        if not gradient:
            return None
        along = -np.asarray(gradient["position_per_m"], np.float64).reshape(-1, 2)
        return cls(along, -np.asarray(gradient["yaw_per_rad"], np.float64))


def _arrows_m(rig: Rig, descent: Steepest, surface: MountSurface) -> np.ndarray:
    """Arrows along the mount surface for where the descent moves the cameras, in the ego frame [m], [camera, 3].

    Lengths are in proportion to the gradient's norm; all 0 where the loss depends on no position.
    """
    norm = np.linalg.norm(descent.along, axis=1, keepdims=True)
    if not norm.any():
        return np.zeros((len(rig.cameras), 3))
    ahead = np.divide(descent.along, norm, out=np.zeros_like(descent.along), where=norm > 0.0)
    position_m, _ = surface.place_of(np.array([camera.position_m for camera in rig.cameras]))
    reach_m = max(surface.cell_m, 0.05)
    rise_m = surface.height_at_m(position_m + reach_m * ahead) - surface.height_at_m(position_m - reach_m * ahead)
    tangent = np.column_stack([ahead, rise_m / (2.0 * reach_m)])
    tangent = np.einsum("ki,kij->kj", tangent, surface.axes[surface.zone_at(position_m)])
    length = np.linalg.norm(tangent, axis=1, keepdims=True)
    return tangent / np.maximum(length, 1e-12) * _LONGEST_M * norm / norm.max()


def add_descent(plotter: Plotter, rig: Rig, descent: Steepest | None, surface: MountSurface) -> None:
    """Add straight arrows for where a step moves the cameras and bent ones for the direction in which it turns them.

    Lengths and angles are in proportion to the gradient; the longest of each kind have a fixed size.
    """
    remove(plotter, "descent")
    if descent is None:
        return
    if len(descent.turn) != len(rig.cameras):
        raise ValueError(f"expected a gradient for each of {len(rig.cameras)} cameras, got {len(descent.turn)}")
    turn_rad = _WIDEST_RAD * descent.turn / max(np.abs(descent.turn).max(initial=0.0), 1e-300)
    for camera, arrow, angle in zip(rig.cameras, _arrows_m(rig, descent, surface), turn_rad, strict=True):
        start, curves = camera.position_m + np.array([0.0, 0.0, _RISE_M]), {}
        if np.linalg.norm(arrow) > _LEAST * _LONGEST_M:
            curves["move"] = start + np.linspace(0.0, 1.0, 2)[:, None] * arrow
        if abs(angle) > _LEAST * _WIDEST_RAD:
            bearing = camera.yaw_rad + np.linspace(0.0, angle, 24)
            curves["turn"] = start + _RADIUS_M * np.column_stack([np.cos(bearing), np.sin(bearing), 0.0 * bearing])
        for kind, curve_m in curves.items():
            style = {"color": DESCENT_RGB, "ambient": 0.7, "smooth_shading": False}
            plotter.add_mesh(_arrow(curve_m), name=f"descent/{camera.name}/{kind}", **style)


def _arrow(curve_m: np.ndarray) -> PolyData:
    pyvista = load_pyvista()
    length_m = np.linalg.norm(np.diff(curve_m, axis=0), axis=1).sum()
    tip_m = min(3.0 * _TIP_M, 0.6 * float(length_m))
    ahead = (curve_m[-1] - curve_m[-2]) / np.linalg.norm(curve_m[-1] - curve_m[-2])
    shaft = pyvista.lines_from_points(curve_m).tube(radius=_SHAFT_M, n_sides=12)
    middle_m = curve_m[-1] + 0.5 * tip_m * ahead
    tip = pyvista.Cone(center=middle_m, direction=ahead, height=tip_m, radius=_TIP_M, resolution=20)
    return pyvista.merge([shaft, tip])


_ARROW_M = 0.32
"""Length of the arrow of a further camera [m]."""


def add_further_cameras(
    plotter: Plotter, further: FurtherCameras | None, *, at: tuple[float, float] = (0.325, 0.87)
) -> None:
    """Add what each further camera would bring: arrows of the best of all places, dots of the others, and a scale."""
    pyvista, parts, most = load_pyvista(), [], 0.0
    if further is not None and len(further):
        most, best = 100.0 * float(further.gain.max()), further.best_places()
        arrow = {"shaft_radius": 0.06, "tip_radius": 0.16, "tip_length": 0.36}
        arrow = pyvista.Arrow(**arrow, shaft_resolution=12, tip_resolution=16).scale(_ARROW_M)
        dot = pyvista.Sphere(radius=0.022, theta_resolution=10, phi_resolution=10)
        for chosen, shape in ((best, arrow), (np.setdiff1d(np.arange(len(further)), best), dot)):
            shown = further[chosen]
            points = pyvista.PolyData(shown.position_m)
            points.point_data["gain_of_100"] = 100.0 * shown.gain
            points.point_data["direction"] = shown.direction
            if len(shown):
                parts.append(points.glyph(geom=shape, orient="direction", scale=False))
    surface = pyvista.merge(parts) if parts else None
    _add_gains(plotter, surface, most, name="further_cameras", at=at, ambient=0.5)
