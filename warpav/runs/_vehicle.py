"""``warpav vehicle``: whether a mesh can carry cameras, how to fix what is wrong with it, and zones proposed for it."""

from __future__ import annotations

import shlex
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from warpav.core.errors import ArgumentError, InputError
from warpav.raster.mesh import Mesh
from warpav.rig import MountSurface, chart_of, kinds_of_names, parts_of, propose_zones, write_zones
from warpav.runs._mounts import mount_surface
from warpav.runs.config import Config
from warpav.scene import (
    Examination,
    Reading,
    VehicleFile,
    VehicleProblem,
    examine,
    file_of,
    read_vehicle,
    read_vehicle_file,
    vehicle_about,
    vehicle_names,
    write_vehicle,
)
from warpav.view import plot

_BONNET_BELOW = 0.07
_BONNET_BELOW_M = 0.15
"""A part of the mountable zone that is lower than the roof by this share of its height, and by this at least, does not
belong to it."""

_BONNET_SHARE = 0.8
"""A bonnet is lower than this share of the roof's height; the top of a lorry's cab is not."""


@dataclass(frozen=True)
class _VehicleReport:
    """What was found out about a vehicle."""

    lines: tuple[str, ...]  # what was found
    problems: tuple[str, ...]  # what keeps it from being used, one line each
    # Options of this check, by name, with which it writes a vehicle that can be used; None: it can be used as it is, or
    # no options fix it.
    fix: dict[str, str] | None = None


@dataclass(frozen=True)
class _ZonePart:
    """A part of the mountable zone that hangs together."""

    name: str  # ``roof``, ``bonnet``, ``front`` (such as a lorry's cab) or ``rear``
    area_m2: float  # its area seen from above [m2]
    height_m: float  # mean height above the ground [m]


def shipped_vehicles() -> Iterator[str]:
    for name in vehicle_names():
        about = vehicle_about(name)
        length, width, height = np.ptp(read_vehicle(name).bounds_m(), axis=0)
        yield f"{name}: {about.title}, {length:.2f} x {width:.2f} x {height:.2f} m (length, width, height)"
        yield f"  source: {about.source}"
        yield f"  licence: {about.licence}"


def check_vehicle(
    path: Path,
    config: Config,
    *,
    up: str | None = None,
    forward: str | None = None,
    scale: float | None = None,
    rear_axle_m: float | None = None,
    out: Path | None = None,
    image: Path | None = None,
) -> _VehicleReport:
    """Examine a vehicle as it is read with some options, write it fixed, draw it."""
    if out is not None and out.suffix.lower() != ".glb":
        raise ArgumentError("out", f"expected a name that ends in .glb, got {out.name!r}", place=out)
    file = read_vehicle_file(file_of(path), vertices_max=None)  # what is said counts the file's own triangles
    _keep(file, out=out, image=image)
    given = {"up": up, "forward": forward, "scale": scale}
    stated = frozenset(name for name, value in given.items() if value is not None)
    reading = file.usual.changed(up=up, forward=forward, scale=scale)
    found = examine(file, reading, stated=stated, rear_axle_m=rear_axle_m)
    lines = [str(path), *_file_lines(file, reading, found)]
    problems = list(found.problems)
    remedies = {name: value for problem in problems for name, value in (problem.remedy or {}).items()}
    surface = None
    shown, shown_by = found, reading
    if remedies:
        # what is said of its place and its roof is only right once it is read right
        words = ", ".join(f"{name.replace('-', ' ')} {value}" for name, value in remedies.items())
        lines.append(f"  read with {words} it is:")
        shown_by = reading.changed(
            up=remedies.get("up"),
            forward=remedies.get("forward"),
            scale=float(remedies["scale"]) if "scale" in remedies else None,
        )
        axle = float(remedies["rear-axle"]) if "rear-axle" in remedies else rear_axle_m
        shown = examine(file, shown_by, stated=stated | set(remedies), rear_axle_m=axle)
    drawn = _with_colours(shown, path, shown_by)  # as `scenes.ego` has it: glass is told by its colour
    try:
        surface = mount_surface(config, drawn.corrected)
    except InputError as error:
        problems.append(VehicleProblem(f"mount surface: {str(error).removeprefix('ego mesh: ')}", None))
    lines += _shape_lines(shown)
    if surface is not None:
        lines += _mount_lines(surface, drawn.corrected)
    lines += [f"  {'note':9} {hint}" for hint in dict.fromkeys((*found.hints, *shown.hints))]
    is_as_read = reading == file.usual and rear_axle_m is None
    needs_writing = not is_as_read or bool(found.problems)
    is_fixable = all(problem.remedy == {} for problem in problems)
    if image is not None:
        axle_m = [x + drawn.shift_m[0] for x in (drawn.wheels.axle_m if drawn.wheels else ())]
        plot(drawn.corrected, mount_surface=surface, axle_m=axle_m, title=path.name, out=image)
        lines.append(f"wrote {image}")
    if out is not None and is_fixable:
        write_vehicle(_with_colours(found, path, reading).corrected, out, source=path.name)
        lines.append(f"wrote {out}; use it with {shlex.join([f'scenes.ego={out}'])}")
        return _VehicleReport(tuple(lines), ())
    found_wrong = tuple(f"{path}: {problem.text}" for problem in problems)
    if needs_writing and all(problem.remedy is not None for problem in problems):
        fix = {**{name: str(value) for name, value in given.items() if value is not None}, **remedies}
        if rear_axle_m is not None:
            fix.setdefault("rear-axle", f"{rear_axle_m:g}")
        return _VehicleReport(tuple(lines), found_wrong, fix)
    if not found_wrong:
        lines.append(f"it can be used as it is: {shlex.join([f'scenes.ego={path}'])}")
    return _VehicleReport(tuple(lines), found_wrong)


def _keep(file: VehicleFile, **target: Path | None) -> None:
    """Refuse to write over the vehicle's own files, such as its textures."""
    for name, path in target.items():
        if path is not None and path.resolve() in file.read:
            raise ArgumentError(name, "expected another file than those that the vehicle is read from", place=path)


def _with_colours(found: Examination, path: str | Path, reading: Reading) -> Examination:
    return replace(found, mesh=read_vehicle_file(file_of(path)).in_ego_frame(reading))


def _zone_parts(surface: MountSurface, vehicle: Mesh) -> list[_ZonePart]:
    """The parts of the mountable zone, the largest first.

    The part with the highest point is the roof. What is lower than it by `_BONNET_BELOW` is bonnet or front before the
    roof's centre, and rear behind it.
    """
    from scipy import ndimage

    is_mountable = surface.inside
    label = np.zeros(surface.height_m.shape, np.int32)
    ndimage.label(is_mountable, structure=np.ones((3, 3)), output=label)
    low, high = vehicle.bounds_m().astype(np.float64)
    highest_m = np.where(is_mountable, surface.height_m, -np.inf).max()
    x_m = surface.origin_m[0] + np.arange(len(label)) * surface.cell_m
    parts = []
    roof_x_m = 0.5 * (low[0] + high[0])
    for number in sorted(range(1, label.max() + 1), key=lambda number: -surface.height_m[label == number].max()):
        inside = label == number
        height_m, centre_x_m = float(surface.height_m[inside].mean()), float(x_m[np.nonzero(inside)[0]].mean())
        if surface.height_m[inside].max() >= highest_m - 1e-6:
            name = "roof"
            roof_x_m = centre_x_m
        elif height_m > highest_m - max(_BONNET_BELOW_M, _BONNET_BELOW * highest_m):
            name = "roof"
        elif centre_x_m < roof_x_m:
            name = "rear"
        else:
            name = "bonnet" if height_m < _BONNET_SHARE * highest_m else "front"
        parts.append(_ZonePart(name, float(np.count_nonzero(inside)) * surface.cell_m**2, height_m))
    return sorted(parts, key=lambda part: -part.area_m2)


def _file_lines(file: VehicleFile, reading: Reading, found: Examination) -> Iterator[str]:
    yield _row("file", f"{file.part}, {len(file.triangle)} triangles, {len(file.vertex)} vertices")
    scale = "metres" if reading.scale == 1.0 else f"{reading.scale:g} m a unit"
    yield _row("read as", f"{reading.up} up, {reading.forward} forward, {scale}")
    length, width, height = np.ptp(found.mesh.bounds_m().astype(np.float64), axis=0)
    yield _row("size", f"{length:.4g} x {width:.4g} x {height:.4g} m (length, width, height)")
    closed = "watertight" if found.open_edge_count == 0 else f"{found.open_edge_count} open edges"
    yield _row("faces", f"{closed}, {found.flat_triangle_count or 'none'} without area")


def _shape_lines(found: Examination) -> Iterator[str]:
    mesh = found.mesh
    low, high = mesh.bounds_m().astype(np.float64)
    alike = "left and right are alike" if found.shape.forward is not None else "left and right are not alike"
    yield _row("sides", alike)
    yield _row("ground", f"lowest point at z = {low[2]:+.3f} m, highest at {high[2]:.3f} m")
    if found.wheels is None:
        yield _row("wheels", "none to be seen")
        return
    axles = ", ".join(f"{x:.2f}" for x in found.wheels.axle_m)
    yield _row("wheels", f"axles at x = {axles} m of the file; the origin belongs below the rear one, as --out has it")


def _mount_lines(surface: MountSurface, vehicle: Mesh) -> Iterator[str]:
    parts = _zone_parts(surface, vehicle)
    total = sum(part.area_m2 for part in parts)
    shown = ", ".join(f"{part.name} {part.area_m2:.2f} m² at {part.height_m:.2f} m" for part in parts[:5])
    yield _row("cameras", f"{total:.2f} m² can carry them: {shown}" + (", ..." if len(parts) > 5 else ""))
    if not any(part.name == "bonnet" for part in parts):
        yield _row("", "no bonnet was found: a van, a bus, or a bonnet steeper than mount.min_zone_normal allows")
    for note in surface.notes:
        yield _row("", note)
    x, y, z = surface.highest_point_m()
    yield _row("highest", f"{z:.2f} m, at x {x:.2f}, y {y:.2f}")


def _row(name: str, text: str) -> str:
    return f"  {name:9} {text}"


def propose(path: Path, config: Config, *, out: Path, image: Path | None = None) -> Iterator[str]:
    """Propose zones of a vehicle, write them, draw them; lines that say what there is."""
    from warpav.view import check_suffix, save_rgb, zones_image_rgb

    if image is not None:
        check_suffix(image)
    try:
        mesh = read_vehicle(path)
    except InputError as error:
        text, advice, _ = str(error).partition("; read it with ")
        how = f"; {shlex.join(['warpav', 'vehicle', 'check', str(path)])} says how to fix it" if advice else ""
        raise InputError(f"{text}{how}") from None
    _keep(read_vehicle_file(file_of(path), vertices_max=None), image=image)
    names = part_names(path, mesh)
    kind = None if names is None else kinds_of_names(names)
    parts = parts_of(mesh, kind)
    zones = propose_zones(mesh, parts)
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
        name for name, _, box in parts.keep_out if any(box is each for zone in zones for each in zone.keep_out_m)
    )
    if counts:
        yield "  kept out: " + ", ".join(f"{count} x {name}" for name, count in counts.items())
    for number, zone in enumerate(zones):
        inside = (chart.zone_of_cell == number) & chart.inside
        yield f"  {zone.name:11} {np.count_nonzero(inside) * chart.cell_m**2:.2f} m²"
    lost = [f"the triangles of the {pane.name} reach beyond it" for pane in parts.panes if pane not in zones]
    untold = "; ".join(filter(None, (parts.untold, *lost)))
    if untold:
        yield f"  not told    {untold}: look at a picture, and edit keep_out_m"
    yield f"wrote {out}; edit it, and use it with {shlex.join([f'mount.zones={out}'])}"
    if image is not None:
        title = f"zones of {path.name}"
        if image.suffix.lower() == ".png":
            save_rgb(zones_image_rgb(mesh, chart, title=title), image)
        else:
            plot(mesh, mount_surface=chart, title=title, out=image)
        yield f"wrote {image}"


_SAME_M = 1e-3
"""A triangle of the file and one of the vehicle whose middles are so near are one [m]."""


def part_names(path: str | Path, mesh: Mesh, *, forward: str | None = None) -> list[str] | None:
    """Names of node, geometry and material of every triangle of a vehicle, each as one text; returns [triangle].

    None where there are others than those of the file, and of formats that trimesh does not read.
    """
    import trimesh
    from scipy.spatial import KDTree

    file = read_vehicle_file(file_of(path))
    if file.path.suffix.lower().removeprefix(".") not in trimesh.available_formats():
        return None
    loaded = trimesh.load_scene(file.path, process=False)
    names: list[str] = []
    for node in loaded.graph.nodes_geometry:
        geometry_name = loaded.graph.get(node)[1]
        geometry: Any = loaded.geometry[geometry_name]
        material = getattr(getattr(geometry, "visual", None), "material", None)
        text = " ".join((str(node), str(geometry_name), str(getattr(material, "name", None) or "")))
        names += [text] * len(getattr(geometry, "faces", ()))
    if len(names) != len(file.triangle):
        return None
    found = examine(file, file.usual.changed(forward=forward))
    middle_m = found.mesh.vertex_m[found.mesh.triangle].mean(axis=1) + found.shift_m
    away_m, nearest = KDTree(middle_m).query(mesh.vertex_m[mesh.triangle].mean(axis=1))
    if np.max(away_m) > _SAME_M:
        return None
    return [names[k] for k in np.asarray(nearest)]
