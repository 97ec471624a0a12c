"""What is painted on the body: its zones, each in a colour of its own, or what one more camera would bring where."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from warpav.view.opengl import load_pyvista_data
from warpav.view.palette import INK_RGB, Rgb, further_map, hex_colour, zone_rgb
from warpav.view.visibility_view import add_legend

if TYPE_CHECKING:
    from warpav.optimisation.further_camera import FurtherCameras
    from warpav.rig.mount_surface import MountSurface

    Plotter = Any
    PolyData = Any

LIFT_M = 0.03
"""By how much the mountable zone is drawn above the surface."""

GAIN_TITLE = "one more camera here: further objects found of 100"
"""Of the scale."""

WHOLE = "mountable zone"
"""What a surface without zones is called."""


def mountable_zone_to_pyvista(surface: MountSurface, *, lift_m: float = 0.0) -> PolyData:
    """The cells that can carry a camera as ``pyvista.PolyData``, one square each.

    A zone that carries several modules is there once. Of symmetric rigs the right halves of zones are there too.

    Cell data: ``height_m`` above the ground, ``border_distance_m`` to the nearest position that carries none, and
    ``zone``, the number of its zone among `zone_names`.
    """
    is_shown = surface.inside.copy()
    number = np.zeros(surface.height_m.shape, int)
    if surface.zones:
        names = zone_names(surface)
        own = [zone.name for zone in surface.zones]
        is_shown &= np.array([own.index(name) == k for k, name in enumerate(own)])[surface.zone_of_cell]
        number = np.array([names.index(name) for name in own])[surface.zone_of_cell]
    cell = np.argwhere(is_shown)
    half_m = 0.5 * surface.cell_m
    middle_m = surface.origin_m + cell * surface.cell_m
    corner = np.array([[-half_m, -half_m], [half_m, -half_m], [half_m, half_m], [-half_m, half_m]])
    corner_m = (middle_m[:, None] + corner).reshape(-1, 2)
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
    zone = load_pyvista_data().PolyData.from_regular_faces(point_m, np.arange(len(point_m)).reshape(-1, 4))
    for name, each in data.items():
        zone.cell_data[name] = each
    return zone


def zone_names(surface: MountSurface) -> list[str]:
    """Names of a surface's zones in their order, each once."""
    return list(dict.fromkeys(zone.name for zone in surface.zones)) or [WHOLE]


def add_zones(
    plotter: Plotter, surface: MountSurface | None, *, name: str = "zones", legend_bottom: float = 0.025
) -> None:
    """Paint the cells that can carry a camera, every zone in a colour of its own; what was painted before goes."""
    for each in [each for each in plotter.actors if each == name or each.startswith(f"{name}/")]:
        plotter.remove_actor(each)
    if surface is None:
        return
    names = zone_names(surface)
    painted = mountable_zone_to_pyvista(surface, lift_m=LIFT_M)
    palette = np.array([zone_rgb(k) for k in range(len(names))], np.uint8)
    painted.cell_data["RGB"] = palette[painted.cell_data["zone"]]
    plotter.add_mesh(painted, scalars="RGB", rgb=True, lighting=False, name=name)
    labels: dict[str, Rgb] = {each: zone_rgb(k) for k, each in enumerate(names)}
    add_legend(plotter, labels, name=f"{name}/legend", bottom=legend_bottom)


def gain_to_pyvista(surface: MountSurface, further: FurtherCameras, *, lift_m: float = 0.0) -> PolyData:
    """`mountable_zone_to_pyvista`, with the cell data ``gain_of_100``: what the best further camera near would bring.

    That is one of the same zone within 0.2 m of the square's middle along the surface, however far above it cameras
    stand; NaN where the search has asked for none there.
    """
    from scipy.spatial import KDTree

    from warpav.optimisation.further_camera import PLACE_M

    painted = mountable_zone_to_pyvista(surface, lift_m=lift_m)
    gain_of_100 = np.full(painted.n_cells, np.nan)
    if len(further):
        names = zone_names(surface)
        own = np.array([names.index(zone.name) for zone in surface.zones] or [0])
        middle_m = painted.points.reshape(-1, 4, 3).mean(axis=1)
        left_m = surface.left_of(further.position_m)
        place_m, _ = surface.place_of(left_m)
        zone = own[surface.zone_at(place_m)]
        cells = KDTree(surface.place_of(surface.left_of(middle_m))[0])
        for camera in np.argsort(further.gain, kind="stable"):  # the best last, which so prevails
            near = np.array(cells.query_ball_point(place_m[camera], PLACE_M), int)
            gain_of_100[near[painted.cell_data["zone"][near] == zone[camera]]] = 100.0 * further.gain[camera]
    painted.cell_data["gain_of_100"] = gain_of_100
    return painted


def add_gain(
    plotter: Plotter,
    surface: MountSurface,
    further: FurtherCameras | None,
    *,
    name: str = "gain",
    scale_at: tuple[float, float] = (0.62, 0.025),
) -> None:
    """Paint the body in the colours of what one more camera would bring there; what was painted before goes.

    Where the search has asked for no camera, nothing is painted: what is not known is not made up from neighbours.
    """
    plotter.remove_actor(name)
    if GAIN_TITLE in plotter.scalar_bars:
        plotter.remove_scalar_bar(GAIN_TITLE)
    if further is None or not len(further):
        return
    painted = gain_to_pyvista(surface, further, lift_m=LIFT_M)
    painted = painted.extract_cells(np.isfinite(painted.cell_data["gain_of_100"])).extract_surface(algorithm=None)
    if not painted.n_cells:
        return
    plotter.add_mesh(
        painted,
        scalars="gain_of_100",
        cmap=further_map(),
        clim=(0.0, max(100.0 * float(further.gain.max()), 1e-9)),
        lighting=False,
        name=name,
        scalar_bar_args=scale_of_gain(plotter, GAIN_TITLE, scale_at),
    )
    lift_title(plotter, GAIN_TITLE)


def scale_of_gain(plotter: Plotter, title: str, scale_at: tuple[float, float]) -> dict[str, Any]:
    """How pyvista draws the scale of what one more camera would bring: its title clear of its numbers."""
    font_size = max(9, round(16 * min(1.0, plotter.window_size[0] / 1280)))
    return {
        "title": title,
        "color": hex_colour(INK_RGB),
        "fmt": "%.1f",
        "n_labels": 3,
        "position_x": scale_at[0],
        "position_y": scale_at[1],
        "width": 0.35,
        "height": 0.115,
        "title_font_size": font_size,
        "label_font_size": font_size,
    }


def lift_title(plotter: Plotter, title: str) -> None:
    """Move the title of a scale away from its numbers, which it touches as VTK sets it."""
    plotter.scalar_bars[title].SetTitle(f"{title}\n ")
