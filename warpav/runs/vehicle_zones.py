"""Zones for cameras on a vehicle: proposed, described and drawn."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from warpav.core.errors import InputError
from warpav.rig.chart import chart_of, propose_zones
from warpav.rig.zone import write_zones
from warpav.runs.config import Config
from warpav.scene.own_vehicle import read_vehicle


def propose(path: Path, config: Config, *, out: Path, image: Path | None = None) -> Iterator[str]:
    """Propose zones of a vehicle, write them, draw them; lines that say what there is.

    Args:
        path: A mesh file as ``scenes.ego`` takes it.
        config: Its section ``mount`` says how fine zones are, and how steep.
        out: YAML file to write them to.
        image: PNG file to draw them into.

    Raises:
        InputError: The file holds no vehicle, no zone was found, or a file cannot be written.
    """
    from warpav.view.plotting import plot

    mesh = read_vehicle(path)
    zones = propose_zones(mesh)
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
    for number, zone in enumerate(zones):
        inside = (chart.zone_of_cell == number) & np.asarray(chart.is_mountable)
        yield f"  {zone.name:9} {np.count_nonzero(inside) * chart.cell_m**2:.2f} m2"
    yield f"wrote {out}; edit it, and use it with mount.zones={out}"
    if image is not None:
        plot(mesh, mount_surface=chart, title=f"zones of {path.name}", out=image)
        yield f"wrote {image}"
