"""Zones for cameras on a vehicle: proposed, described and drawn."""

from __future__ import annotations

import io
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from warpav.core.errors import InputError
from warpav.raster.mesh import Mesh
from warpav.rig.chart import chart_of, propose_zones
from warpav.rig.keep_out import kinds_of_names, propose_keep_out
from warpav.rig.zone import Zone, write_zones
from warpav.runs.config import Config
from warpav.scene.own_vehicle import read_vehicle
from warpav.scene.part_names import part_names

# How far a pane may bulge out of the plane of its corners, along the vehicle [m].
_PANE_BULGE_M = 0.3


def propose(path: Path, config: Config, *, out: Path, image: Path | None = None) -> Iterator[str]:
    """Propose zones of a vehicle, write them, draw them; lines that say what there is."""
    from PIL import Image

    from warpav.view.output import check_suffix, write_whole
    from warpav.view.plotting import plot
    from warpav.view.vehicle_view import zones_image_rgb

    if image is not None:
        check_suffix(image)
    mesh = read_vehicle(path)
    names = part_names(path, mesh)
    kind = None if names is None else kinds_of_names(names)
    is_glass = None if kind is None or not (kind == "glass").any() else kind == "glass"
    boxes = propose_keep_out(mesh, kind)
    proposed = propose_zones(mesh, is_glass)
    panes = [(zone.name, _box_of_pane(zone.outline_m)) for zone in proposed if zone.outline_m is not None]
    boxes_of = {False: boxes, True: [*boxes, *panes]}
    zones = tuple(each for zone in proposed if (each := _kept_clear(zone, mesh, boxes_of[_holds_panes(zone)])))
    if not zones:
        raise InputError(f"{path}: expected a body that faces upwards, sideways, forwards or backwards, got none")
    mount = config.mount
    chart = chart_of(
        zones,
        mesh,
        cell_m=mount.cell_m,
        min_upward_normal=mount.min_upward_normal,
        min_zone_normal=mount.min_zone_normal,
    )
    write_zones(zones, out)
    counts = Counter(
        name for name, box in boxes_of[True] if any((box == each).all() for zone in zones for each in zone.keep_out_m)
    )
    if counts:
        yield "  kept out: " + ", ".join(f"{count} x {name}" for name, count in counts.items())
    for number, zone in enumerate(zones):
        inside = (chart.zone_of_cell == number) & np.asarray(chart.is_mountable)
        yield f"  {zone.name:11} {np.count_nonzero(inside) * chart.cell_m**2:.2f} m²"
    yield f"wrote {out}; edit it, and use it with mount.zones={out}"
    if image is not None:
        title = f"zones of {path.name}"
        if image.suffix.lower() == ".png":
            encoded = io.BytesIO()
            Image.fromarray(zones_image_rgb(mesh, chart, title=title)).save(encoded, format="PNG", optimize=True)
            write_whole(image, encoded.getvalue())
        else:
            plot(mesh, mount_surface=chart, title=title, out=image)
        yield f"wrote {image}"


def _box_of_pane(outline_m: np.ndarray) -> np.ndarray:
    """A box around a pane whose corners are known [m], [corner, 3]; panes bulge."""
    low_m, high_m = outline_m.min(axis=0), outline_m.max(axis=0)
    bulge_m = _PANE_BULGE_M * np.array([1.0, 0.0, 0.0])
    return np.round([low_m - bulge_m, high_m + bulge_m], 3)


def _holds_panes(zone: Zone) -> bool:
    """Whether a zone faces as windscreen and rear window do, and is on the outside."""
    return not zone.is_behind_glass and abs(zone.axes[2][0]) > 0.7


def _kept_clear(zone: Zone, mesh: Mesh, boxes: Sequence[tuple[str, np.ndarray]]) -> Zone | None:
    """A zone with the boxes that reach into it, which carry no camera; None where they leave nothing of it."""
    if zone.is_behind_glass:
        return zone
    chart = chart_of([zone], mesh, cell_m=0.04)
    assert chart.is_mountable is not None
    place_m = chart.origin_m + chart.cell_m * np.argwhere(chart.is_mountable)
    point_m = chart.point_m(place_m, chart.height_at_m(place_m))
    inside = [box for _, box in boxes if ((point_m >= box[0]) & (point_m <= box[1])).all(axis=1).any()]
    clear = replace(zone, keep_out_m=(*zone.keep_out_m, *inside))
    try:
        chart_of([clear], mesh, cell_m=0.04)
    except InputError:
        return None
    return clear
