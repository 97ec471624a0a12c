"""Vehicles of other makers in traffic: meshes from files in the places of some of the vehicles of a scene.

Places, sizes, categories and velocities stay those of the scene: a mesh is stretched to length, width without mirrors,
and height of the vehicle in whose place it stands, its wheels stay round, and where one paint dominates, it is painted
anew. Light is baked into the colours as into those of the town's own vehicles. Everything is drawn by seed.
"""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import BeforeValidator, ConfigDict, Field

from warpav.core.cache import digest
from warpav.core.errors import InputError
from warpav.core.records import Record, read_record
from warpav.core.yaml_file import read_yaml
from warpav.raster.mesh import Mesh
from warpav.scene._own_vehicle import AXES, FORMATS, examine, read_vehicle_file
from warpav.scene._vehicle_shape import body_width_m, points_on, wheels_of
from warpav.scene.town._paint import drawn_paint, lit_rgb, sky_share_at
from warpav.scene.town._placed_vehicle import Exchange
from warpav.scene.town._surface_builder import NORMAL_STEPS, corner_normals
from warpav.scene.town._vehicle_shapes import VARIANT_COUNT, body_size_m
from warpav.scene.town._vehicle_specs import VEHICLE_SPECS
from warpav.scene.traffic._road_users import stretched
from warpav.scene.vehicles import SHIPPED, vehicle_folder

CATEGORIES = tuple(VEHICLE_SPECS)  # vehicles in whose places others can stand
USUAL_SHARE = 0.5  # of the vehicles in whose places others could stand, those that others do stand in
_STRETCH = (0.8, 1.25)  # how much more or less than a vehicle as a whole its length, width or height may grow
_TRIANGLES_MAX = (4_300, 1_200)
"""Triangles of a mesh near the ego vehicle, and of one that stands for a coarse mesh: no more than the town's own."""

_ALIKE = (0.8, 1.25)  # of length, width and height of a category's own vehicles, without a word about the category
_VERTICES_MAX = 2_400  # up to which triangles are split for their textures
_COARSE_BELOW = 2_000  # triangles of an own mesh that is coarse
_STREAM = 0xF1EE7
_INWARDS = 0.35  # of the way from a corner to the middle of its triangle
_PAINT_SHARE = 0.4  # of the surface that one colour takes up, if it is a paint that others could replace
_PAINT_CELL, _PAINT_REACH, _DARK = 32, 24, 60  # of 255
_WHITE_ALBEDO = 0.85
_PAINT_MIRROR, _GLASS_MIRROR, _OTHER_MIRROR = 0.13, 0.12, 0.03
_GLASS_ABOVE = 0.45  # of the height: what is dark there is glass
_TOUCHING = 0.04  # of the height, below which there is nothing but tyres
_WHEEL_ROOM = 1.25  # of a tyre's radius, with the arch around it


@dataclass(frozen=True)
class Fleet:
    """Vehicles of other makers, and how many of a scene's vehicles they stand in for."""

    paths: tuple[Path | str, ...]  # `SHIPPED`, mesh files, and folders of these
    share: float  # probability that a vehicle is exchanged if any mesh of its category fits, 0..1
    content: str  # hash of the meshes, so that scenes with others are other scenes

    def exchange(self, *key: int) -> Exchange:
        """What puts meshes into the places of a scene's own; the same key gives the same ones, in any process."""
        bodies = _bodies(self.paths)
        if _content(bodies) != self.content:
            raise InputError(f"{self.paths[0]}: vehicles: expected the files of before, got others; begin again")

        def exchanged(number: int, category: str, own: Mesh, size_m: np.ndarray) -> Mesh:
            rng = np.random.default_rng([_STREAM, *key, number])
            is_drawn = rng.random() < self.share
            fitting = [body for body in bodies if category in body.categories and body.fits(size_m)]
            if not is_drawn or not fitting:
                return own
            body = fitting[int(rng.integers(len(fitting)))]
            paint = drawn_paint(category, rng)
            return body.mesh(size_m, paint, coarse=len(own.triangle) < _COARSE_BELOW)

        return exchanged


def fleet_of(paths: Sequence[Path | str], share: float = USUAL_SHARE) -> Fleet:
    """The vehicles of files and folders.

    A YAML file of the same name beside a mesh may say its ``category``, one or a list out of `CATEGORIES`, and the axes
    ``up`` and ``forward`` and the ``scale`` of the file, as ``warpav vehicle check`` takes them. Without a word about
    its category, a mesh is of those whose own vehicles are about as long, wide and high.
    """
    paths = tuple(paths)
    return Fleet(paths, share, _content(_bodies(paths)))


@dataclass(frozen=True, eq=False)
class _Look:
    """A surface with what its colours are computed of."""

    # Positions, x and y from the middle of the vehicle, z from the ground [m], float64 [vertex, 3].
    vertex_m: np.ndarray
    triangle: np.ndarray  # vertex indices, int32 [triangle, 3]
    normal: np.ndarray  # unit shading normals, float64 [vertex, 3]
    sky: np.ndarray  # share of the sky's light, 0..1, float64 [vertex]
    albedo: np.ndarray  # linear, float64 [vertex, 3]
    mirror: np.ndarray  # strength of reflections, float64 [vertex]
    paint: np.ndarray  # brightness of what is painted, relative to the paint; 0 elsewhere, float64 [vertex]


@dataclass(frozen=True, eq=False)
class _Body:
    """A vehicle that can stand in the places of others."""

    categories: tuple[str, ...]  # of the vehicles in whose places it can stand
    size_m: np.ndarray  # length, width without mirrors, and height [m], float64 [3]
    wheel_m: tuple[tuple[float, float], ...]  # stretches of x in which wheels are [m], ascending
    looks: tuple[_Look, _Look]  # fine, and coarse
    content: str  # hash of all this

    def fits(self, size_m: np.ndarray) -> bool:
        """Whether it can be stretched to a size, [3], within `_STRETCH`."""
        factor = np.asarray(size_m) / self.size_m
        return bool(factor.max() / factor.min() <= _STRETCH[1] / _STRETCH[0])

    def mesh(self, size_m: np.ndarray, paint: np.ndarray, *, coarse: bool) -> Mesh:
        """Its mesh in the vehicle frame, of a size [m], [3], in a paint, linear albedo [3]."""
        look = self.looks[int(coarse)]
        factor = np.asarray(size_m, np.float64) / self.size_m
        vertex_m = look.vertex_m * factor
        vertex_m[:, 0] = stretched(look.vertex_m[:, 0], self.wheel_m, float(size_m[0]), float(factor[2]))
        is_paint = look.paint[:, None] > 0.0
        albedo = np.where(is_paint, np.minimum(paint * look.paint[:, None], 1.0), look.albedo)
        rgb = lit_rgb(look.normal, look.sky, albedo, look.mirror)
        return Mesh(vertex_m.astype(np.float32), look.triangle, rgb)


def _bodies(paths: tuple[Path | str, ...]) -> tuple[_Body, ...]:
    """The vehicles of files and folders, read once in a process as long as the files stay as they are."""
    files = [file for path in paths for file in _mesh_files(path)]
    return tuple(_body(file, _stamp(file), _stamp(file.with_suffix(".yaml"))) for file in files)


def _stamp(file: Path) -> tuple[int, int] | None:
    """What changes with a file; None where there is none."""
    if not file.is_file():
        return None
    about = file.stat()
    return about.st_mtime_ns, about.st_size


def _content(bodies: Sequence[_Body]) -> str:
    return digest(*(body.content for body in bodies))


def _mesh_files(path: Path | str) -> list[Path]:
    """The mesh files that a user means, by name."""
    folder = vehicle_folder() if path == SHIPPED else Path(path).expanduser()
    if folder.is_file():
        return [folder]
    if not folder.is_dir():
        near = difflib.get_close_matches(str(path), [SHIPPED], 1, 0.6)
        hint = f"; did you mean {near[0]}?" if near else ""
        raise InputError(f"{path}: vehicles: expected {SHIPPED}, a mesh file or a folder, got no such file{hint}")
    files = (file for file in folder.rglob("*") if file.suffix.lower().removeprefix(".") in FORMATS)
    found = sorted((file for file in files if file.is_file()), key=lambda file: file.relative_to(folder).as_posix())
    if not found:
        raise InputError(f"{path}: vehicles: expected mesh files ({', '.join(FORMATS)}), got none in this folder")
    return found


@lru_cache(maxsize=256)
def _body(path: Path, _stamp: tuple[int, int] | None, _stated_stamp: tuple[int, int] | None) -> _Body:
    from warpav.scene.reconstruction._surface import decimated

    place = path.with_suffix(".yaml")
    data, line_of = read_yaml(place) if place.is_file() else ({}, {})
    stated = read_record(_Stated, data, str(place), line_of=line_of)
    file = read_vehicle_file(path, vertices_max=_VERTICES_MAX)
    axes = stated.model_dump(include={"up", "forward", "scale"}, exclude_none=True)
    try:
        reading = file.usual.changed(**axes)
    except InputError as error:
        raise InputError(f"{path.with_suffix('.yaml')}: {error}") from None
    found = examine(file, reading, stated=frozenset(axes))
    for problem in found.problems:
        if problem.remedy != {}:  # what has to be shifted is shifted
            remedy = {name: value for name, value in (problem.remedy or {}).items() if name in _Stated.model_fields}
            advice = ", ".join(f"{name}: {value}" for name, value in remedy.items())
            hint = f"; write {advice} into {path.with_suffix('.yaml').name} beside it" if advice else ""
            raise InputError(f"{path}: {problem.text.replace('`', '')}{hint}")
    mesh = found.corrected
    low, high = mesh.bounds_m().astype(np.float64)
    mesh = mesh.transformed(np.eye(3), -np.append(0.5 * (low + high)[:2], low[2]))
    point_m = points_on(mesh)
    size_m = np.array([high[0] - low[0], body_width_m(point_m), high[2] - low[2]])
    categories = tuple(dict.fromkeys(stated.category or _categories_of(path, size_m)))
    fine, coarse = (decimated(mesh, count) for count in _TRIANGLES_MAX)
    look = _look(fine)
    arrays = [array.tobytes() for array in (mesh.vertex_m, mesh.triangle, mesh.vertex_rgb)]
    looks = (look, look if coarse is fine else _look(coarse))
    return _Body(categories, size_m, _wheels(point_m), looks, digest(categories, *arrays))


class _Stated(Record):
    """What the YAML file beside a mesh says."""

    model_config = ConfigDict(extra="forbid")

    category: (
        Annotated[
            list[Literal[*CATEGORIES]],  # pyright: ignore[reportInvalidTypeForm]
            Field(min_length=1),
            BeforeValidator(lambda one: one if isinstance(one, list) else [one]),
        ]
        | None
    ) = None  # type: ignore[valid-type]
    up: Literal[*AXES] | None = None  # type: ignore[valid-type]
    forward: Literal[*AXES] | None = None  # type: ignore[valid-type]
    scale: float | None = Field(None, gt=0.0, allow_inf_nan=False)


def _categories_of(path: Path, size_m: np.ndarray) -> tuple[str, ...]:
    """Categories whose own vehicles are of about this size."""
    low, high = _ALIKE
    shapes = {name: [body_size_m(name, variant) for variant in range(VARIANT_COUNT)] for name in CATEGORIES}
    found = tuple(
        name
        for name, sizes in shapes.items()
        if any(((size_m / size >= low) & (size_m / size <= high)).all() for size in sizes)
    )
    if not found:
        length, width, height = size_m
        raise InputError(
            f"{path}: vehicles: expected the size of one of {', '.join(CATEGORIES)}, got {length:.2f} m long, "
            f"{width:.2f} m wide and {height:.2f} m high; write category: {CATEGORIES[0]} or another into "
            f"{path.with_suffix('.yaml').name} beside it"
        )
    return found


def _look(mesh: Mesh) -> _Look:
    """A mesh with normals, whose vertices are shared where neither place, colour nor normal differ, and its light."""
    place_m, weld = np.unique(mesh.vertex_m.astype(np.float64), axis=0, return_inverse=True)
    weld = weld.reshape(-1)
    corner = weld[mesh.triangle]
    is_whole = (corner != np.roll(corner, 1, axis=1)).all(axis=1)
    corner, rgb = corner[is_whole], mesh.vertex_rgb[mesh.triangle[is_whole]].astype(np.int64)
    inside_out = _is_inside_out(place_m, corner)
    corner = np.where(inside_out[:, None], corner[:, ::-1], corner)
    rgb = np.where(inside_out[:, None, None], rgb[:, ::-1], rgb)
    normal = corner_normals(place_m, corner).reshape(-1, 3)
    row = np.concatenate(
        [corner.reshape(-1, 1), rgb.reshape(-1, 3), np.round(normal * NORMAL_STEPS).astype(np.int64)], axis=1
    )
    _, first, index = np.unique(row, axis=0, return_index=True, return_inverse=True)
    vertex_m, normal, vertex_rgb = place_m[corner.reshape(-1)[first]], normal[first], rgb.reshape(-1, 3)[first]
    triangle = index.reshape(-1, 3).astype(np.int32)
    sky = _sky(place_m[corner], normal[index.reshape(-1, 3)], index.reshape(-1, 3))
    paint = _paint_of(vertex_m, triangle, vertex_rgb)
    is_glass = (vertex_rgb.max(axis=1) < _DARK) & (vertex_m[:, 2] > _GLASS_ABOVE * place_m[:, 2].max())
    mirror = np.where(paint > 0.0, _PAINT_MIRROR, np.where(is_glass, _GLASS_MIRROR, _OTHER_MIRROR))
    albedo = _WHITE_ALBEDO * (vertex_rgb / 255.0) ** 2.2
    return _Look(vertex_m, triangle, normal, sky, albedo, mirror, paint)


def _sky(point_m: np.ndarray, normal: np.ndarray, index: np.ndarray) -> np.ndarray:
    """Share of the sky's light at vertices; rays begin inside their triangles, as parts of meshes stick together."""
    inside_m = point_m + _INWARDS * (point_m.mean(axis=1, keepdims=True) - point_m)
    light = sky_share_at(point_m, inside_m.reshape(-1, 3), normal.reshape(-1, 3))
    across = np.cross(point_m[:, 1] - point_m[:, 0], point_m[:, 2] - point_m[:, 0])
    area = np.repeat(np.linalg.norm(across, axis=1) + 1e-12, 3)
    return np.bincount(index.reshape(-1), area * light) / np.bincount(index.reshape(-1), area)


def _is_inside_out(place_m: np.ndarray, corner: np.ndarray) -> np.ndarray:
    """Triangles whose back sees more of the sky than their front, in the middle and all in all, bool [triangle]."""
    point_m = place_m[corner]
    across = np.cross(point_m[:, 1] - point_m[:, 0], point_m[:, 2] - point_m[:, 0])
    normal = across / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-15)
    middle_m = point_m.mean(axis=1, keepdims=True)
    from_m = np.concatenate([middle_m, point_m + _INWARDS * (middle_m - point_m)], axis=1).reshape(-1, 3)
    normal = np.repeat(normal, 4, axis=0)
    front, back = (sky_share_at(point_m, from_m, sign * normal).reshape(-1, 4) for sign in (1.0, -1.0))
    return (back[:, 0] > front[:, 0] + 0.02) & (back.mean(axis=1) > front.mean(axis=1) + 0.02)


def _paint_of(vertex_m: np.ndarray, triangle: np.ndarray, rgb: np.ndarray) -> np.ndarray:
    """Brightness of vertices relative to the paint, 0 where another colour is; all 0 where no paint dominates."""
    corner_m = vertex_m[triangle]
    area = np.linalg.norm(np.cross(corner_m[:, 1] - corner_m[:, 0], corner_m[:, 2] - corner_m[:, 0]), axis=1)
    colour = rgb[triangle].mean(axis=1)
    cell, number = np.unique(colour.astype(np.int64) // _PAINT_CELL, axis=0, return_inverse=True)
    is_bright = cell.max(axis=1) * _PAINT_CELL >= _DARK
    weight = np.bincount(number.reshape(-1), area, len(cell)) * is_bright
    best = number.reshape(-1) == int(weight.argmax())
    if not weight.any():
        return np.zeros(len(rgb))
    paint = (area[best, None] * colour[best]).sum(axis=0) / area[best].sum()
    near = np.abs(colour - paint).max(axis=1) <= _PAINT_REACH
    if area[near].sum() < _PAINT_SHARE * area.sum():
        return np.zeros(len(rgb))
    brightness = np.clip(rgb.sum(axis=1) / paint.sum(), 0.5, 1.5) ** 2.2
    return np.where(np.abs(rgb - paint).max(axis=1) <= _PAINT_REACH, brightness, 0.0)


def _wheels(point_m: np.ndarray) -> tuple[tuple[float, float], ...]:
    """Stretches of x in which wheels and their arches are [m], ascending; none where none were recognised."""
    wheels = wheels_of(point_m)
    if wheels is None:
        return ()
    height_m = float(np.ptp(point_m[:, 2]))
    low_m = _TOUCHING * height_m
    x = point_m[point_m[:, 2] < low_m, 0]
    spans = []
    for axle_m in wheels.axle_m:
        half_m = float(np.abs(x[np.abs(x - axle_m) < 0.5 * height_m] - axle_m).max())  # half a chord of the tyre
        radius_m = min((half_m**2 + low_m**2) / (2.0 * low_m), 0.3 * height_m)
        spans.append((axle_m - _WHEEL_ROOM * radius_m, axle_m + _WHEEL_ROOM * radius_m))
    return tuple(spans)
