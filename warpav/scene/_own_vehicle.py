"""A user's own vehicle: read from any mesh file, analysed by its shape, corrected, and written as GLB.

Mesh files rarely state their units, and their axes vary. The shape is more reliable: vehicles are symmetric, longer
than they are high, and have wheels below. `examine` compares the shape with the reading of the file, `write_vehicle`
writes the vehicle in the ego frame.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from warpav.core.errors import ArgumentError, InputError
from warpav.raster.mesh import Mesh
from warpav.scene._glb import EGO_NODE, ENVIRONMENT_NODE, STEP_FORMATS, bounded_mesh, write_nodes
from warpav.scene._mesh_colours import (
    GREY_RGB,
    TRIANGLES_MAX,
    VERTICES_MAX,
    FileFinder,
    Texture,
    TexturedMesh,
    follow_textures,
    shaded,
    simulator_model,
    srgb,
    texture_of,
    vertex_rgb,
)
from warpav.scene._urdf import read_urdf
from warpav.scene._usd import USD_FORMATS, read_stage
from warpav.scene._vehicle_shape import ALIKE, Shape, Wheels, points_on, shape_of, wheels_of
from warpav.scene.vehicles import file_of, nearest_name, vehicle_names

if TYPE_CHECKING:
    import trimesh

_SCHEMA = "warpav-vehicle/1"
AXES = ("x", "y", "z", "-x", "-y", "-z")
FORMATS = ("glb", "gltf", "obj", "dae", "ply", "stl", "off", *USD_FORMATS, *STEP_FORMATS, "urdf")
_USUAL_LENGTH_M = (3.0, 7.0)
_POSSIBLE_LENGTH_M = (2.0, 20.0)
_STATED_LENGTH_M = (0.2, 40.0)
_UNITS = (("metres", 1.0), ("centimetres", 0.01), ("millimetres", 0.001), ("inches", 0.0254), ("feet", 0.3048))

# least and greatest extents across and upwards; mirrors and aerials count, and a sports car is 1.1 m high
_POSSIBLE_WIDTH_M, _POSSIBLE_HEIGHT_M = (1.0, 3.5), (1.1, 4.6)
_TYPICAL_SIZE_M = {  # length, width with mirrors, and height of usual vehicles
    "a car": (4.5, 2.0, 1.5),
    "an SUV": (4.8, 2.15, 1.8),
    "a pickup": (5.6, 2.3, 1.9),
    "a van": (5.5, 2.3, 2.4),
    "a lorry": (8.0, 2.6, 3.3),
    "a bus": (12.0, 2.8, 3.3),
}
_GROUND_TOLERANCE_M = 0.05
_AXLE_TOLERANCE_M = 0.1
_MANY_TRIANGLES = 300_000
_HOLDS = 3.0  # times as large as a vehicle is what stands around it


@dataclass(frozen=True)
class Reading:
    """How the numbers of a file become metres in the ego frame."""

    up: str  # the file's axis that points up, out of `AXES`
    forward: str  # the file's axis that points to the front, likewise
    scale: float = 1.0  # metres for each unit of the file, positive

    def __post_init__(self) -> None:
        for name in ("up", "forward"):
            if getattr(self, name) not in AXES:
                raise ArgumentError(name, f"expected one of {', '.join(AXES)}, got {getattr(self, name)!r}")
        if self.up[-1] == self.forward[-1]:
            raise ArgumentError("forward", f"expected an axis across {self.up}, which points up, got {self.forward!r}")
        if not 0.0 < self.scale < math.inf:
            raise ArgumentError("scale", f"expected a positive number, got {self.scale!r}")

    def changed(self, *, up: str | None = None, forward: str | None = None, scale: float | None = None) -> Reading:
        """The reading with other axes or another scale; the front's axis gives way to a new one that points up."""
        new_up = up or self.up
        new_forward = forward or self.forward
        if forward is None and new_up[-1:] == new_forward[-1]:
            new_forward = "x" if new_up[-1:] != "x" else "y"
        return Reading(new_up, new_forward, self.scale if scale is None else scale)

    @property
    def ego_from_file(self) -> np.ndarray:
        """Rotation from the file's axes to the ego frame's, float64 [3, 3]; its entries are -1, 0 and 1."""
        up, forward = _unit(self.up), _unit(self.forward)
        return np.stack([forward, np.cross(up, forward), up])


@dataclass(frozen=True, eq=False)
class VehicleFile:
    """A mesh as stored in a file."""

    path: Path  # the file
    vertex: np.ndarray  # vertices in the file's own units and axes, float64 [vertex, 3]
    triangle: np.ndarray  # vertex indices [triangle, 3]
    vertex_rgb: np.ndarray  # colours, uint8 [vertex, 3]
    usual: Reading  # default reading of this file format
    is_declared: bool  # whether warpav wrote the file, so that its axes and origin are as the user stated them
    part: str  # part of the file, in words
    notes: tuple[str, ...] = ()  # what its owner should know of how it was read, such as textures that are missing
    # A part many times as large as all others, which it holds, and their size in the file's units and axes, [3]
    holder: tuple[str, np.ndarray] | None = None
    stated: frozenset[str] = frozenset()  # what of the usual reading the format itself settles
    read: frozenset[Path] = frozenset()  # the file and what lies beside it and belongs to it, such as textures

    def in_ego_frame(self, reading: Reading) -> Mesh:
        """The vehicle in the ego frame."""
        vertex_m = self.vertex @ (reading.scale * reading.ego_from_file).T
        return Mesh.create(vertex_m, self.triangle, self.vertex_rgb, name=str(self.path))


@dataclass(frozen=True)
class VehicleProblem:
    """A reason why a vehicle cannot be used as it is."""

    text: str  # what was expected and what was given
    # Options of ``warpav vehicle check`` that fix it, by name; empty if ``--out`` alone does, None if nothing does.
    remedy: dict[str, str] | None


@dataclass(frozen=True, eq=False)
class Examination:
    """Findings about a vehicle under a given reading."""

    mesh: Mesh  # in the ego frame, as read
    shift_m: np.ndarray  # translation that puts it on the ground with its rear axle above the origin [m], [3]
    shape: Shape  # axes inferred from its shape, in the ego frame
    wheels: Wheels | None  # where it touches the ground; None if not recognised
    problems: tuple[VehicleProblem, ...]  # reasons why it cannot be used
    hints: tuple[str, ...]  # notes for its owner
    open_edge_count: int  # edges of an odd number of triangles in the welded mesh: the rims of holes
    flat_triangle_count: int  # triangles without area

    @cached_property
    def corrected(self) -> Mesh:
        """The vehicle on the ground with its rear axle above the origin, without triangles that have no area."""
        mesh = self.mesh.transformed(np.eye(3), self.shift_m) if self.shift_m.any() else self.mesh
        if not self.flat_triangle_count:
            return mesh
        used, index = np.unique(mesh.triangle[~_is_flat(mesh)], return_inverse=True)
        triangle = index.reshape(-1, 3).astype(np.int32)
        return replace(mesh, vertex_m=mesh.vertex_m[used], triangle=triangle, vertex_rgb=mesh.vertex_rgb[used])


def read_vehicle(
    path: str | Path,
    *,
    up: str | None = None,
    forward: str | None = None,
    scale: float | None = None,
    rear_axle_m: float | None = None,
) -> Mesh:
    """A vehicle in the ego frame from a mesh file, on the ground with its rear axle above the origin.

    One of a single colour, or of none, gets light and shadow by its normals (`warpav.scene._mesh_colours.shaded`).

    Args:
        path: As of `read_vehicle_file`, or the name of a vehicle that ships with warpav, such as ``bus``.
        up: The file's axis that points up, out of `AXES`; None: what the file states, else z.
        forward: The file's axis that points to the front, likewise; None: what a ``model.sdf`` states, else x.
        scale: Metres for each unit of the file; None: what the file or a ``model.sdf`` states, else 1.
        rear_axle_m: Distance of the rear axle from the vehicle's rear end [m]; None: inferred from the wheels.

    Raises:
        InputError: The file cannot be read, or its shape contradicts the axes or the unit; the text names the arguments
            that agree with it.
    """
    file = read_vehicle_file(file_of(path))
    given = {"up": up, "forward": forward, "scale": scale}
    stated = frozenset(name for name, value in given.items() if value is not None)
    reading = file.usual.changed(up=up, forward=forward, scale=scale)
    found = examine(file, reading, stated=stated, rear_axle_m=rear_axle_m)
    for problem in found.problems:
        if problem.remedy == {}:  # the shift of the corrected mesh is the remedy
            continue
        remedies = {
            "rear_axle_m" if name == "rear-axle" else name: value if name in ("up", "forward") else float(value)
            for name, value in (problem.remedy or {}).items()
        }
        advice = ", ".join(f"{name}={value!r}" for name, value in remedies.items())
        raise InputError(f"{path}: {problem.text}" + (f"; read it with {advice}" if advice else ""))
    return shaded(found.corrected)


def read_vehicle_file(path: str | Path, *, vertices_max: int | None = VERTICES_MAX) -> VehicleFile:
    """Read the mesh of a vehicle as stored; of a scene that warpav wrote, its ego vehicle.

    Textures become vertex colours, where they are finer than the triangles with more triangles of the same surface
    (`warpav.scene._mesh_colours`). Unit and axes are those that the file states (COLLADA, up in glTF), or that the
    ``model.sdf`` of a simulator beside it states; else the ego frame's. A robot (URDF) is all that its links show.
    """
    path = Path(path).expanduser()
    if not path.is_file():
        expected = f"a mesh file ({', '.join(FORMATS)})"
        if not path.suffix:  # a name rather than a file
            expected = f"one of {', '.join(vehicle_names())}, or {expected}"
        near = nearest_name(path.stem)
        hint = "" if near is None else f"; did you mean {near}?"
        raise InputError(f"{path}: vehicle: expected {expected}, got no such file{hint}")
    suffix = path.suffix.lower().removeprefix(".")
    if suffix not in FORMATS:  # of archives no bound is known
        raise InputError(
            f"{path}: vehicle: expected a mesh file ({', '.join(FORMATS)}), got the suffix {path.suffix!r}; export it "
            "as GLB, or OBJ beside its textures"
        )
    source = _source(path, suffix)
    found, usual, is_scene, is_own = source.parts, source.usual, source.is_scene, source.is_own
    parts = [part for _, part in found]
    if not parts:
        raise InputError(f"{path}: vehicle: expected a mesh with triangles, got none; export the faces of the vehicle")
    notes = source.notes
    model = None if is_scene or is_own or suffix == "urdf" else simulator_model(path)
    if model is not None:
        usual = usual.changed(forward=model.forward, scale=usual.scale * model.scale)
        turned = f" and that {model.forward} points forward" if model.forward is not None else ""
        notes.append(f"{model.path.name} beside it states a scale of {model.scale:g}{turned}")
    whole, textures = _joined(parts)
    if vertices_max is not None:
        whole = follow_textures(whole, textures, vertices_max=vertices_max)
    return VehicleFile(
        path,
        whole.vertex,
        whole.triangle,
        np.round(whole.rgb).astype(np.uint8),
        usual,
        is_scene or is_own,
        "ego vehicle of a scene" if is_scene else f"{len(parts)} part{'s' if len(parts) > 1 else ''}",
        tuple(notes),
        _holder([(name, mesh.vertex[np.unique(mesh.triangle)]) for name, (mesh, _) in found]),
        frozenset({"up", "forward", "scale"} if suffix == "urdf" else ()),
        frozenset({path.resolve(), *source.read}),
    )


@dataclass(frozen=True, eq=False)
class _Source:
    """The parts of a file by their names, and how it is to be read."""

    parts: Sequence[tuple[str, tuple[TexturedMesh, Texture | None]]]
    usual: Reading
    notes: list[str]
    is_scene: bool = False
    is_own: bool = False
    read: frozenset[Path] = frozenset()  # files beside it


def _source(path: Path, suffix: str) -> _Source:
    import trimesh

    content, unread = bounded_mesh(path, suffix, f"{path}: vehicle")
    finder = FileFinder(path)
    # glTF and COLLADA define their up axis; USD says it; the other formats do not: the ego frame
    usual = Reading("y" if suffix in ("glb", "gltf") else "z", "x")
    is_scene = is_own = False
    try:
        if suffix == "urdf":
            return _robot(path, finder)
        if suffix in USD_FORMATS:
            stage = read_stage(path)
            found, usual, unread = stage.parts, Reading(stage.up, "x", stage.metres), stage.notes
        else:
            if suffix == "dae":
                up, metres = _collada_frame(path)
                usual = usual.changed(up=up, scale=metres)
            # the resolver has all that trimesh asks of one
            is_step = suffix in STEP_FORMATS  # which is a GLB by now
            source = trimesh.util.wrap_as_stream(content) if is_step or suffix == "glb" else path
            suffix = "glb" if is_step else suffix
            file = trimesh.load_scene(source, suffix, process=False, resolver=finder)  # pyright: ignore[reportArgumentType]
            nodes = [str(name) for name in file.graph.nodes_geometry]
            is_scene = EGO_NODE in nodes and ENVIRONMENT_NODE in nodes
            is_own = (file.metadata or {}).get("schema") == _SCHEMA
            names = [name for name in nodes if not is_scene or name == EGO_NODE]
            count = sum(len(getattr(file.geometry[file.graph.get(name)[1]], "faces", ())) for name in names)
            if count > TRIANGLES_MAX:
                raise ValueError(f"{count:,} triangles in all nodes, of at most {TRIANGLES_MAX:,}")
            found = [(name, part) for name in names if (part := _part(file, name, finder)) is not None]
            if is_step:  # its colours became linear light on the way
                found = [(name, (replace(m, rgb=255.0 * srgb(m.rgb / 255.0)), None)) for name, (m, _) in found]
    except InputError:
        raise
    except Exception as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise InputError(
            f"{path}: vehicle: expected a readable {suffix} file, got: {reason}; export it again"
        ) from None
    return _Source(found, usual, [*unread, *finder.notes], is_scene, is_own, frozenset(finder.found))


def _robot(path: Path, finder: FileFinder) -> _Source:
    """The links of a robot; those that show the same mesh read it once."""
    found: list[tuple[str, tuple[TexturedMesh, Texture | None]]] = []
    notes, read = [], {}
    for visual in read_urdf(path):
        if visual.solid is not None:
            solid = visual.solid
            grey = np.tile(GREY_RGB.astype(np.float64), (len(solid.vertices), 1))
            none = np.full(len(solid.faces), -1)
            uv = np.zeros((len(solid.vertices), 2))
            mesh = TexturedMesh(np.asarray(solid.vertices), np.asarray(solid.faces), grey, uv, none)
            parts: list[tuple[TexturedMesh, Texture | None]] = [(mesh, None)]
        else:
            name = visual.mesh or ""
            if name not in read:
                file = finder.find(name)
                suffix = "" if file is None else file.suffix.lower().removeprefix(".")
                if file is None or suffix not in FORMATS or suffix == "urdf":
                    what = "no such file there" if file is None else f"the suffix {file.suffix!r}"
                    raise ValueError(f"link {visual.link!r}: expected the mesh file {name!r} beside it, got {what}")
                read[name] = _source(file, suffix)
                notes += [f"{file.name}: {text}" for text in read[name].notes]
            source = read[name]
            turn = source.usual.ego_from_file
            parts = [
                (replace(mesh, vertex=mesh.vertex @ (source.usual.scale * turn).T), texture)
                for _, (mesh, texture) in source.parts
            ]
        matrix = visual.root_from_shape
        for mesh, texture in parts:
            triangle = mesh.triangle[:, ::-1] if np.linalg.det(matrix[:3, :3]) < 0.0 else mesh.triangle
            rgb = mesh.rgb if visual.rgb is None else np.tile(visual.rgb, (len(mesh.rgb), 1))
            number = mesh.texture_of if visual.rgb is None else np.full(len(triangle), -1)
            vertex = mesh.vertex @ matrix[:3, :3].T + matrix[:3, 3]
            moved = replace(mesh, vertex=vertex, triangle=triangle, rgb=rgb, texture_of=number)
            found.append((visual.link, (moved, texture if visual.rgb is None else None)))
        if sum(len(mesh.triangle) for _, (mesh, _) in found) > TRIANGLES_MAX:
            raise ValueError(f"more than {TRIANGLES_MAX:,} triangles in all links")
    files = finder.found.union(*(source.read for source in read.values()))
    return _Source(found, Reading("z", "x"), list(dict.fromkeys(notes)), read=frozenset(files))


def write_vehicle(mesh: Mesh, path: str | Path, *, source: str = "") -> None:
    """Write a vehicle as GLB with one node ``ego``, as scenes have it; the file appears once it is complete."""
    path = Path(path)
    if path.suffix.lower() != ".glb":
        raise InputError(f"{path}: vehicle: expected a name that ends in .glb, got {path.name!r}")
    write_nodes(path, _SCHEMA, {"source": source}, [(EGO_NODE, mesh, {"role": "ego"})])


def examine(
    file: VehicleFile, reading: Reading, *, stated: frozenset[str] = frozenset(), rear_axle_m: float | None = None
) -> Examination:
    """Compare the reading of a file with the shape of the vehicle."""
    mesh = file.in_ego_frame(reading)
    stated |= {name for name in file.stated if getattr(reading, name) == getattr(file.usual, name)}
    point_m = points_on(mesh)
    size_m = np.ptp(mesh.bounds_m().astype(np.float64), axis=0)
    shape = shape_of(point_m)
    found = _Findings(reading, stated, file.is_declared, file.holder, [], list(file.notes))
    found.look_at_unit(_ordered(size_m, shape))
    found.look_at_axes(shape, size_m)
    wheels = None
    shift_m = np.zeros(3)
    if not found.problems:  # further checks need correct axes and units
        wheels = wheels_of(point_m)
        shift_m = found.look_at_place(mesh, wheels, rear_axle_m)
    open_edges, flat = _open_edge_count(mesh), int(np.count_nonzero(_is_flat(mesh)))
    if open_edges:
        found.hints.append(f"not watertight ({open_edges} open edges): usable, but cameras may see through gaps")
    if flat:
        found.hints.append(f"{flat} of {len(mesh.triangle)} triangles have no area; `out` removes them")
    if len(mesh.triangle) > _MANY_TRIANGLES:
        found.hints.append(
            f"{len(mesh.triangle)} triangles slow every render, and about 10 000 are sufficient; decimate the mesh, "
            "for example in Blender or MeshLab"
        )
    return Examination(mesh, shift_m, shape, wheels, tuple(found.problems), tuple(found.hints), open_edges, flat)


def is_plausible(size_m: np.ndarray) -> bool:
    """Whether a vehicle may have this length, width and height [m], [3]."""
    ranges = (_POSSIBLE_LENGTH_M, _POSSIBLE_WIDTH_M, _POSSIBLE_HEIGHT_M)
    return all(low <= value <= high for value, (low, high) in zip(size_m, ranges, strict=True))


def _scale_of(size: np.ndarray) -> tuple[str, float]:
    """Which vehicle, or which unit, makes a size, [3], plausible, and the metres of one.

    Without a unit that makes the whole size plausible the usual vehicle of most nearly these proportions; its length
    determines the scale, as widths may include mirrors and heights aerials. People choose round scales: the nearest one
    of a single digit is taken if it changes the length by less than 8 %.
    """
    for minimum_m, maximum_m in (_USUAL_LENGTH_M, _POSSIBLE_LENGTH_M):
        for name, metres in _UNITS:
            if minimum_m <= size[0] * metres <= maximum_m and is_plausible(size * metres):
                return name, metres
    factor = {kind: np.log(np.array(typical_m) / size) for kind, typical_m in _TYPICAL_SIZE_M.items()}
    kind = min(factor, key=lambda kind: float(np.ptp(factor[kind])))
    scale = _TYPICAL_SIZE_M[kind][0] / float(size[0])
    short, exact = float(f"{scale:.1g}"), float(f"{scale:.4g}")
    return kind, short if abs(short / scale - 1.0) < 0.08 else exact


def _ordered(size_m: np.ndarray, shape: Shape) -> np.ndarray:
    """Length, width and height of a vehicle whose axes may be wrong; the greatest extent is the length if in doubt."""
    if shape.up is not None and shape.forward is not None:
        forward, up = "xyz".index(shape.forward[-1]), "xyz".index(shape.up[-1])
        return size_m[[forward, 3 - forward - up, up]]
    low, middle, high = np.sort(size_m)
    return np.array([high, middle, low] if is_plausible(np.array([high, middle, low])) else [high, low, middle])


def _size_text(size_m: np.ndarray) -> str:
    length, width, height = (f"{value:.2f}" for value in size_m)
    return f"{length} m long, {width} m wide and {height} m high"


@dataclass(frozen=True, eq=False)
class _Findings:
    """What is found about a vehicle under a reading, as far as it is known which of its axes and scale are stated."""

    reading: Reading
    stated: frozenset[str]
    is_declared: bool
    holder: tuple[str, np.ndarray] | None
    problems: list[VehicleProblem]
    hints: list[str]

    def _problem(self, text: str, remedy: dict[str, str] | None) -> None:
        self.problems.append(VehicleProblem(text, remedy))

    def look_at_unit(self, size_m: np.ndarray) -> None:
        """Whether a vehicle may have a size, its length, width and height [m], [3]."""
        minimum_m, maximum_m = _POSSIBLE_LENGTH_M
        if is_plausible(size_m) or not size_m.min() > 0.0:
            return
        is_stated = "scale" in self.stated
        name, factor = _scale_of(size_m)
        scale = self.reading.scale * factor
        with_scale = " with this `scale`" if is_stated else ""
        better = _size_text(size_m * factor)
        if minimum_m <= size_m[0] <= maximum_m:
            text = f"units: a vehicle {_size_text(size_m)}{with_scale} is doubtful, "
            text += f"expected a width of {_POSSIBLE_WIDTH_M[0]:g} to {_POSSIBLE_WIDTH_M[1]:g} m and a height of "
            text += f"{_POSSIBLE_HEIGHT_M[0]:g} to {_POSSIBLE_HEIGHT_M[1]:g} m"
            if is_stated or self.is_declared:
                self.hints.append(f"{text}; accepted as stated")
            elif not is_plausible(size_m * factor):
                self.hints.append(f"{text}; `scale` changes it")
            else:
                self._problem(f"{text}; with `scale` {scale:g} it is {better}, as {name}", {"scale": f"{scale:g}"})
            return
        text = f"units: expected a vehicle of {minimum_m:g} to {maximum_m:g} m, got {size_m[0]:.4g} m"
        if self.holder is not None:
            part, held = self.holder
            inside = " x ".join(f"{value * self.reading.scale:.4g}" for value in held)
            self._problem(f"{text}: the part {part!r} holds all others, which are {inside} m; leave it out", None)
            return
        if name in dict(_UNITS):
            self._problem(f"{text}{with_scale}, which is right in {name}", {"scale": f"{scale:g}"})
            return
        least_m, most_m = _STATED_LENGTH_M
        if (is_stated or self.is_declared) and least_m <= size_m[0] <= most_m:
            self.hints.append(f"{text}; accepted as stated")
            return
        text += f", implausible in any common unit; with `scale` {scale:.4g} it is {better}, as {name}"
        self._problem(text, {"scale": f"{scale:.4g}"})

    def look_at_axes(self, shape: Shape, size_m: np.ndarray) -> None:
        """Whether the shape has the axes of the ego frame under this reading."""
        if shape.up is None or shape.forward is None:
            what = "no axis of symmetry found" if shape.asymmetry > ALIKE else "its shape is ambiguous"
            self.hints.append(f"{what}; check the axes in a figure (`image`)")
            return
        has_axes = shape.up[-1] == "z" and shape.forward[-1] == "x"
        up, forward = (_in_file(axis, self.reading) for axis in (shape.up, shape.forward))
        if has_axes and not (shape.is_up_sure and shape.up == "-z"):
            is_backwards = shape.is_forward_sure and shape.forward == "-x"
            if is_backwards and not self.is_declared and "forward" not in self.stated:
                text = "the cabin is nearer to the assumed front, as in pickups and lorries, or in vehicles that face "
                text += "backwards: if the image shows one of these"
                if shape.has_mirrors:
                    text = "the mirrors are nearer to the assumed rear, as in vehicles that face backwards: if the "
                    text += "image shows one"
                self.hints.append(f"{text}, add `forward` {forward}")
            return
        if not shape.is_up_sure and shape.up[-1] == "z":
            up = self.reading.up
        if shape.forward[-1] == "x" and not shape.is_forward_sure:
            forward = self.reading.forward
        axes = (("up", up), ("forward", forward))
        remedy = {name: value for name, value in axes if value != getattr(self.reading, name)}
        length, width, height = (f"{value:.4g}" for value in size_m)
        what = "is upside down" if has_axes else f"is {length} long, {width} wide and {height} high"
        text = f"axes: expected wheels below and lateral symmetry; read with {self.reading.up} up and "
        text += f"{self.reading.forward} forward it {what}"
        if self.is_declared or {"up", "forward"} <= self.stated:
            self.hints.append(f"{text}; accepted as stated")
            return
        self._problem(text, remedy)
        if "forward" in remedy and not shape.has_mirrors:
            other = forward.removeprefix("-") if forward.startswith("-") else f"-{forward}"
            why = "the front is guessed from the cabin, which pickups and lorries have nearer to it"
            why = why if shape.is_forward_sure else "front and rear look alike"
            self.hints.append(f"{why}: if the image shows it backwards, give `forward` {other} instead")

    def look_at_place(self, mesh: Mesh, wheels: Wheels | None, rear_axle_m: float | None) -> np.ndarray:
        """Translation of the vehicle onto the ground and its rear axle [m], [3]."""
        low, high = mesh.bounds_m().astype(np.float64)
        length_m = high[0] - low[0]
        shift_m = np.zeros(3)
        if abs(low[2]) > _GROUND_TOLERANCE_M:
            shift_m[2] = -low[2]
            self._problem(f"ground: expected its lowest point at z = 0, got {low[2]:+.3f} m", {})
        if rear_axle_m is not None:
            if not 0.0 <= rear_axle_m <= length_m:
                expected = f"expected a distance from the rear end of up to {length_m:.2f} m"
                raise ArgumentError("rear_axle", f"{expected}, got {rear_axle_m:g}")
            centre_y_m = 0.5 * float(low[1] + high[1]) if wheels is None else wheels.centre_y_m
            target_m = np.array([low[0] + rear_axle_m, centre_y_m])
            if np.abs(target_m).max() > 1e-6:
                shift_m[:2] = -target_m
                self._problem("origin: expected below the rear axle as stated by `rear_axle`", {})
            return shift_m
        is_inside = bool((low[:2] <= 0.0).all() and (high[:2] >= 0.0).all())
        if self.is_declared and is_inside:
            return shift_m
        if wheels is None:
            if is_inside:
                text = "no wheels found, so the origin below the rear axle cannot be verified; "
                self.hints.append(f"{text}`rear_axle` 0.9 would put it 0.9 m before the rear end")
                return shift_m
            text = "origin: expected it below the vehicle, got "
            text += f"x {low[0]:.2f} to {high[0]:.2f} m, y {low[1]:.2f} to {high[1]:.2f} m, and no wheels found; "
            text += "`rear_axle` gives the distance of the rear axle from the rear end"
            self._problem(text, {"rear-axle": f"{0.2 * length_m:.2f}"})
            return shift_m
        x, y = wheels.axle_m[0], wheels.centre_y_m
        if abs(x) > _AXLE_TOLERANCE_M or abs(y) > _GROUND_TOLERANCE_M:
            shift_m[:2] = -x, -y
            text = "origin: expected below the centre of the rear axle, got that at"
            self._problem(f"{text} x {x:+.2f} m, y {y:+.2f} m", {})
        count = len(wheels.axle_m)
        if count > 2:
            self.hints.append(f"{count} axles: the rearmost one counts as the rear axle; `rear_axle` overrides it")
        return shift_m


def _collada_frame(path: Path) -> tuple[str, float]:
    """Axis that points up, out of `AXES`, and unit [m] of a COLLADA file, which trimesh does not apply."""
    from collada import Collada
    from collada.common import DaeUnsupportedError

    # trimesh leaves out what is broken; here it is an error
    document: Any = Collada(str(path), ignore=[DaeUnsupportedError])
    tag = document.tag
    if document.scene is None:
        raise ValueError("no scene")
    if document.xmlnode.find(f".//{tag('instance_controller')}") is not None:
        raise ValueError("meshes bound to a skeleton, which has to be applied first")
    for geometry in document.geometries:
        for name, source in geometry.sourceById.items():
            if not isinstance(source, dict):
                count = int(source.xmlnode.find(f".//{tag('accessor')}").get("count"))
                if len(source) != count:  # pycollada looks at neither count, stride nor offset
                    raise ValueError(f"source {name!r} of {len(source)} rows instead of {count}")
        for faces in geometry.primitives:
            if len(faces.index) and faces.index.min() < 0:
                raise ValueError(f"index {faces.index.min()}")
            position = faces.sources["VERTEX"][0][4]
            if "nan" in (position.xmlnode.findtext(tag("float_array")) or "").lower():  # pycollada makes 0 of them
                raise ValueError(f"source {position.id!r} with values that are no numbers")
    up = document.xmlnode.findtext(f"{tag('asset')}/{tag('up_axis')}", "").strip()
    metres = document.assetInfo.unitmeter or 1.0
    return {"X_UP": "x", "Z_UP": "z"}.get(up, "y"), metres if metres > 0.0 else 1.0


def _part(file: trimesh.Scene, name: str, finder: FileFinder) -> tuple[TexturedMesh, Texture | None] | None:
    """A node of a file, in the file's frame, and its texture; None where it has no triangles."""
    matrix, geometry_name = file.graph.get(name)
    geometry: Any = file.geometry[geometry_name]
    if not hasattr(geometry, "faces") or len(geometry.faces) == 0:
        return None
    vertex = np.asarray(geometry.vertices, np.float64)
    matrix = np.asarray(matrix, np.float64)
    if not np.array_equal(matrix, np.eye(4)):
        vertex = vertex @ matrix[:3, :3].T + matrix[:3, 3]
    triangle = np.asarray(geometry.faces, np.int64)
    if vertex.ndim != 2 or vertex.shape[1] != 3 or triangle.min() < 0 or triangle.max() >= len(vertex):
        raise ValueError("vertices without three coordinates, or faces of vertices that are not there")
    if np.linalg.det(matrix[:3, :3]) < 0.0:
        triangle = triangle[:, ::-1]
    texture = texture_of(geometry, is_plain=finder.lacks_materials)
    uv = np.zeros((len(vertex), 2)) if texture is None else np.asarray(geometry.visual.uv, np.float64)
    rgb = vertex_rgb(geometry, is_plain=finder.lacks_materials).astype(np.float64)
    return TexturedMesh(vertex, triangle, rgb, uv, np.full(len(triangle), -1 if texture is None else 0)), texture


def _holder(parts: list[tuple[str, np.ndarray]]) -> tuple[str, np.ndarray] | None:
    """The part that holds all others and is several times as large along every axis, and their size, [3]."""
    ends = {name: np.stack([vertex.min(axis=0), vertex.max(axis=0)]) for name, vertex in parts}
    for name, own in ends.items():
        others = [each for other, each in ends.items() if other != name]
        if others:
            low, high = np.min([each[0] for each in others], axis=0), np.max([each[1] for each in others], axis=0)
            is_inside = (own[0] <= low + 1e-6 * np.abs(low)).all() and (own[1] >= high - 1e-6 * np.abs(high)).all()
            if is_inside and (np.ptp(own, axis=0) > _HOLDS * (high - low)).all():
                return name, high - low
    return None


def _joined(parts: list[tuple[TexturedMesh, Texture | None]]) -> tuple[TexturedMesh, list[Texture]]:
    meshes, textures = [mesh for mesh, _ in parts], [texture for _, texture in parts]
    first = np.cumsum([0, *(len(mesh.vertex) for mesh in meshes)])
    number = np.cumsum([texture is not None for texture in textures]) - 1
    whole = TexturedMesh(
        np.concatenate([mesh.vertex for mesh in meshes]),
        np.concatenate([mesh.triangle + start for mesh, start in zip(meshes, first, strict=False)]),
        np.concatenate([mesh.rgb for mesh in meshes]),
        np.concatenate([mesh.uv for mesh in meshes]),
        np.concatenate([np.where(mesh.texture_of < 0, -1, k) for mesh, k in zip(meshes, number, strict=True)]),
    )
    return whole, [texture for texture in textures if texture is not None]


def _open_edge_count(mesh: Mesh) -> int:
    """Edges of an odd number of triangles after merging coincident vertices: the rims of holes."""
    size = float(np.ptp(mesh.vertex_m, axis=0).max())
    _, welded = np.unique(
        np.round(mesh.vertex_m / max(1e-6 * size, 1e-12)).astype(np.int64), axis=0, return_inverse=True
    )
    triangle = welded.reshape(-1)[mesh.triangle]
    kept = triangle[(triangle != np.roll(triangle, 1, axis=1)).all(axis=1)]
    edge = np.sort(np.stack([kept, np.roll(kept, -1, axis=1)], axis=-1).reshape(-1, 2), axis=1)
    _, count = np.unique(edge, axis=0, return_counts=True)
    return int(np.count_nonzero(count % 2))


def _is_flat(mesh: Mesh) -> np.ndarray:
    """Which triangles have no area, bool [triangle]."""
    corner = mesh.vertex_m.astype(np.float64)[mesh.triangle]
    side = corner[:, 1:] - corner[:, :1]
    doubled = np.linalg.norm(np.cross(side[:, 0], side[:, 1]), axis=1)
    return doubled <= 1e-9 * np.maximum((side**2).sum(axis=(1, 2)), 1e-300)


def _in_file(axis: str, reading: Reading) -> str:
    """The file's axis that corresponds to an axis of the ego frame under this reading."""
    found = reading.ego_from_file.T @ _unit(axis)
    number = int(np.abs(found).argmax())
    return ("-" if found[number] < 0.0 else "") + "xyz"[number]


def _unit(axis: str) -> np.ndarray:
    unit = np.zeros(3)
    unit["xyz".index(axis[-1])] = -1.0 if axis.startswith("-") else 1.0
    return unit
