"""``warpav vehicle check``: whether a mesh can carry the cameras, what is wrong with it, and how to fix that."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from warpav.core.errors import ArgumentError, InputError
from warpav.raster.mesh import Mesh
from warpav.rig.mount_surface import MountSurface
from warpav.runs.config import Config
from warpav.runs.mounts import mount_surface
from warpav.scene.own_vehicle import (
    Examination,
    Reading,
    VehicleFile,
    VehicleProblem,
    examine,
    read_vehicle_file,
    write_vehicle,
)
from warpav.scene.vehicles import file_of

BONNET_BELOW_M = 0.15
"""A part of the mountable zone that is lower than the roof by this does not belong to it."""

BONNET_SHARE = 0.8
"""A bonnet is lower than this share of the roof's height; the top of a lorry's cab is not."""


@dataclass(frozen=True)
class VehicleReport:
    """What was found out about a vehicle.

    Attributes:
        lines: What was found.
        problems: What keeps it from being used, one line each.
        fix: Options of this check, by name, with which it writes a vehicle that can be used; None: it can be used as it
            is, or no options fix it.
    """

    lines: tuple[str, ...]
    problems: tuple[str, ...]
    fix: dict[str, str] | None = None


@dataclass(frozen=True)
class ZonePart:
    """A part of the mountable zone that hangs together.

    Attributes:
        name: ``roof``, ``bonnet``, ``front`` (such as a lorry's cab) or ``rear``.
        area_m2: Its area seen from above [m2].
        height_m: Mean height above the ground [m].
    """

    name: str
    area_m2: float
    height_m: float


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
) -> VehicleReport:
    """Examine a vehicle as it is read with some options, write it fixed, draw it.

    Args:
        path: A mesh file, or the name of a vehicle that ships with warpav.
        config: Its section ``mount`` says where cameras may stand.
        up: The file's axis that points up; None: glTF's y, of other formats z.
        forward: The file's axis that points to the front; None: x.
        scale: Metres for each unit of the file; None: 1.
        rear_axle_m: Distance of the rear axle from the vehicle's rear end [m]; None: it is below the rear wheels.
        out: GLB file to write the vehicle to, as ``scenes.ego`` takes it.
        image: PNG file to draw it into.

    Raises:
        InputError: The file holds no vehicle, or a file cannot be written.
    """
    if out is not None and out.suffix.lower() != ".glb":
        raise ArgumentError("out", f"expected a name that ends in .glb, got {out.name!r}", place=out)
    file = read_vehicle_file(file_of(path))
    given = {"up": up, "forward": forward, "scale": scale}
    stated = frozenset(name for name, value in given.items() if value is not None)
    reading = file.usual.changed(up=up, forward=forward, scale=scale)
    found = examine(file, reading, stated=stated, rear_axle_m=rear_axle_m)
    lines = [str(path), *_file_lines(file, reading, found)]
    problems = list(found.problems)
    remedies = {name: value for problem in problems for name, value in (problem.remedy or {}).items()}
    surface = None
    shown = found
    if remedies:
        # what is said of its place and its roof is only right once it is read right
        words = ", ".join(f"{name.replace('-', ' ')} {value}" for name, value in remedies.items())
        lines.append(f"  read with {words} it is:")
        better = reading.changed(
            up=remedies.get("up"),
            forward=remedies.get("forward"),
            scale=float(remedies["scale"]) if "scale" in remedies else None,
        )
        axle = float(remedies["rear-axle"]) if "rear-axle" in remedies else rear_axle_m
        shown = examine(file, better, stated=stated | set(remedies), rear_axle_m=axle)
    try:
        surface = mount_surface(config, shown.corrected)
    except InputError as error:
        problems.append(VehicleProblem(f"mount surface: {str(error).removeprefix('ego mesh: ')}", None))
    lines += _shape_lines(shown)
    if surface is not None:
        lines += _mount_lines(surface, shown.corrected)
    lines += [f"  {'note':9} {hint}" for hint in dict.fromkeys((*found.hints, *shown.hints))]
    is_as_read = reading == file.usual and rear_axle_m is None
    needs_writing = not is_as_read or bool(found.problems)
    is_fixable = all(problem.remedy == {} for problem in problems)
    if image is not None:
        lines.append(f"wrote {_draw(shown, surface, image, path.name)}")
    if out is not None and is_fixable:
        write_vehicle(found.corrected, out, source=path.name)
        lines.append(f"wrote {out}; use it with scenes.ego={out}")
        return VehicleReport(tuple(lines), ())
    found_wrong = tuple(f"{path}: {problem.text}" for problem in problems)
    if needs_writing and all(problem.remedy is not None for problem in problems):
        fix = {**{name: str(value) for name, value in given.items() if value is not None}, **remedies}
        if rear_axle_m is not None:
            fix.setdefault("rear-axle", f"{rear_axle_m:g}")
        return VehicleReport(tuple(lines), found_wrong, fix)
    if not found_wrong:
        lines.append(f"it can be used as it is: scenes.ego={path}")
    return VehicleReport(tuple(lines), found_wrong)


def zone_parts(surface: MountSurface, vehicle: Mesh) -> list[ZonePart]:
    """The parts of the mountable zone, the largest first.

    The part with the highest point is the roof. What is lower than it by `BONNET_BELOW_M` is bonnet or front before the
    roof's centre, and rear behind it.

    Args:
        surface: Of the vehicle.
        vehicle: In the ego frame.
    """
    from scipy import ndimage

    is_mountable = np.ones(surface.height_m.shape, bool) if surface.is_mountable is None else surface.is_mountable
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
            name, roof_x_m = "roof", centre_x_m
        elif height_m > highest_m - BONNET_BELOW_M:
            name = "roof"
        elif centre_x_m < roof_x_m:
            name = "rear"
        else:
            name = "bonnet" if height_m < BONNET_SHARE * highest_m else "front"
        parts.append(ZonePart(name, float(np.count_nonzero(inside)) * surface.cell_m**2, height_m))
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
    yield _row("wheels", f"axles at x = {axles} m; the origin belongs below the rear one")


def _mount_lines(surface: MountSurface, vehicle: Mesh) -> Iterator[str]:
    parts = zone_parts(surface, vehicle)
    total = sum(part.area_m2 for part in parts)
    shown = ", ".join(f"{part.name} {part.area_m2:.2f} m2 at {part.height_m:.2f} m" for part in parts[:5])
    yield _row("cameras", f"{total:.2f} m2 can carry them: {shown}" + (", ..." if len(parts) > 5 else ""))
    names = {part.name for part in parts}
    if "bonnet" not in names:
        yield _row("", "no bonnet was found: a van, a bus, or a bonnet steeper than mount.min_zone_normal allows")
    x, y, z = surface.highest_point_m()
    yield _row("highest", f"{z:.2f} m, at x {x:.2f}, y {y:.2f}")


def _draw(found: Examination, surface: MountSurface | None, image: Path, title: str) -> Path:
    from warpav.view import plot

    axles: Sequence[float] = found.wheels.axle_m if found.wheels else ()
    axle_m = [x + found.shift_m[0] for x in axles]
    return plot(found.corrected, mount_surface=surface, axle_m=axle_m, title=title, out=image)


def _row(name: str, text: str) -> str:
    return f"  {name:9} {text}"
