"""Vehicles in USD files (extra ``usd``): all that a renderer shows, as parts with colours at their vertices.

Composing a stage opens every file that a layer names. So all layers are looked at before, each on its own: one that
lies outside the folder of the file, is not there, or is no USD, is refused. What a ``usdz`` packs is unpacked first,
so that its folder is its own.
"""

from __future__ import annotations

import io
import re
import tempfile
import zipfile
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from warpav.core.bounded_files import (
    DATA_SET_BYTES_MAX,
    LEVELS_MAX,
    NODES_MAX,
    bounded_memory,
    is_inner_path,
    read_bytes,
    usd_library,
)
from warpav.scene._mesh_colours import GREY_RGB, TRIANGLES_MAX, FileFinder, Texture, TexturedMesh, srgb

USD_FORMATS = ("usd", "usda", "usdc", "usdz")
_LAYERS_MAX, _LINKS_MAX = 1000, 4
_COLOUR_INPUTS = ("diffuseColor", "diffuse_color_constant", "base_color", "baseColor")  # Preview, Omniverse, MaterialX
_TEXTURE_INPUTS = ("diffuse_texture",)  # of Omniverse, which hides the constant colour

Part = tuple[str, tuple[TexturedMesh, Texture | None]]
"""Path in the stage; the mesh in the stage's axes and units, and its texture."""


@dataclass(frozen=True)
class Stage:
    """What a renderer shows of a stage, its axis that points up (``y`` or ``z``) and metres of its unit."""

    parts: list[Part]
    up: str
    metres: float
    notes: list[str]
    about: dict[str, Any]  # its ``customLayerData``
    extras: dict[str, dict[str, Any]]  # ``customData`` of prims that have some, by their paths


def read_stage(path: Path) -> Stage:
    """The meshes of a USD file.

    Raises:
        InputError: It needs usd-core, which is not installed.
        ValueError: It cannot be read; the text says why.
    """
    pxr = usd_library(f"{path}: vehicle")
    _quiet = pxr.UsdUtils.CoalescingDiagnosticDelegate()  # else USD prints on stderr what is raised or noted here
    pxr.Work.SetConcurrencyLimit(1)  # the stacks of threads would count as memory
    with bounded_memory(), _unpacked(path) as file:
        try:
            layers = _checked_layers(file)
            stage = pxr.Usd.Stage.Open(str(file))
        except pxr.Tf.ErrorException as error:
            raise ValueError(re.sub(r"pxrInternal\w+::", "", str(error.args[0].commentary))[:200]) from None
        wrong = next(iter(stage.GetCompositionErrors()), None)
        if wrong is not None:
            raise ValueError(f"a reference that is not resolved: {wrong}"[:300])
        metres, up = pxr.UsdGeom.GetStageMetersPerUnit(stage), str(pxr.UsdGeom.GetStageUpAxis(stage))
        if not 0.0 < metres < 1e6 or up not in ("Y", "Z"):
            raise ValueError(f"metersPerUnit {metres:g} and upAxis {up}, expected a positive number and Y or Z")
        _check_frames(layers, metres, up)
        transforms = pxr.UsdGeom.XformCache(pxr.Usd.TimeCode.EarliestTime())
        reader = _Reader(FileFinder(file), file.parent.resolve(), transforms)
        if not pxr.UsdGeom.StageHasAuthoredMetersPerUnit(stage):
            reader.note("it states no metersPerUnit, which means centimetres in USD")
        reader.read(stage.GetPseudoRoot(), np.eye(4))
        notes = [f"{text}{f' ({count} times)' if count > 1 else ''}" for text, count in reader.seen.items()]
        prims = pxr.Usd.PrimRange.Stage(stage, pxr.Usd.TraverseInstanceProxies())
        extras = {str(prim.GetPath()): _plain(data) for prim in prims if (data := prim.GetCustomData())}
        about = _plain(stage.GetRootLayer().customLayerData)
        return Stage(reader.parts, up.lower(), metres, [*notes, *reader.finder.notes], about, extras)


def _plain(value: Any) -> Any:  # noqa: ANN401
    """Data of a stage as JSON would have it."""
    if isinstance(value, dict):
        return {str(key): _plain(each) for key, each in value.items()}
    return value if isinstance(value, str | int | float) else np.asarray(value).tolist()


@contextmanager
def _unpacked(path: Path) -> Iterator[Path]:
    """The file of the stage, in a folder of its own where it is packed."""
    if path.suffix.lower() != ".usdz":
        yield path
        return
    content = read_bytes(path, "a readable usdz file", bytes_max=DATA_SET_BYTES_MAX)
    with tempfile.TemporaryDirectory(prefix="warpav-") as folder:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            members = archive.infolist()
            if any(member.compress_type or member.file_size > len(content) for member in members):
                raise ValueError("a usdz whose files are compressed, which USD forbids")
            strange = next((each.filename for each in members if not is_inner_path(each.filename)), None)
            if strange is not None or len(members) > _LAYERS_MAX or sum(m.file_size for m in members) > len(content):
                raise ValueError(f"a usdz with files that do not belong there, such as {strange}")
            archive.extractall(folder)
        first = next((each.filename for each in members if _is_layer(Path(each.filename))), None)
        if first is None:
            raise ValueError("a usdz without a USD layer")
        yield Path(folder) / first


def _is_layer(path: Path) -> bool:
    return path.suffix.lower()[1:] in USD_FORMATS[:3]


def _checked_layers(file: Path) -> list[Any]:
    """All layers of a stage, once it is known that they lie below its folder and do not become too many prims."""
    pxr = usd_library()

    folder = file.resolve().parent
    waiting, found, left = [file.resolve()], {}, DATA_SET_BYTES_MAX
    while waiting:
        path = waiting.pop()
        if path in found:
            continue
        left -= path.stat().st_size
        if left < 0 or len(found) >= _LAYERS_MAX:
            raise ValueError(f"layers of more than {DATA_SET_BYTES_MAX // 1_000_000} MB, or {_LAYERS_MAX} of them")
        layer = found[path] = pxr.Sdf.Layer.OpenAsAnonymous(str(path))
        for name in filter(None, sorted(layer.GetCompositionAssetDependencies())):  # the empty one is the layer's own
            place, target = f"{path.name}: the reference {name!r}", (path.parent / name).resolve()
            if not target.is_relative_to(folder):
                raise ValueError(f"{place} leads out of its folder; copy what it names beside the file")
            if not target.is_file():
                raise ValueError(f"{place} is not resolved, there is no such file")
            if not _is_layer(target):
                raise ValueError(f"{place} is no usd, usda or usdc file; unpack or convert it")
            waiting.append(target)
        layer.Traverse(pxr.Sdf.Path.absoluteRootPath, lambda at, layer=layer, path=path: _check_spec(layer, at, path))
    _Sizes(found).of(file.resolve(), "/", 0)
    return list(found.values())


@dataclass
class _Sizes:
    """How many prims places in layers become, before references that double again and again are followed."""

    layers: dict[Path, Any]
    known: dict[tuple[Path, str], int] = field(default_factory=dict)

    def of(self, file: Path, at: str, depth: int) -> int:
        """Prims at a place and below, with what references bring along as often as they bring it."""
        if (file, at) in self.known:
            return self.known[file, at]
        if depth > LEVELS_MAX:
            raise ValueError(f"more than {LEVELS_MAX} levels of prims and references")
        self.known[file, at] = 0  # a circle adds nothing: USD leaves it out
        layer = self.layers[file]
        spec = layer.GetPrimAtPath(at) if at != "/" else None
        size, below = 1, layer.rootPrims if spec is None and at == "/" else [] if spec is None else spec.nameChildren
        places = [(file, str(child.path)) for child in below]
        if spec is not None:
            for arc in (*spec.referenceList.GetAppliedItems(), *spec.payloadList.GetAppliedItems()):
                for each in self._with_sublayers(self._named(file, arc.assetPath) if arc.assetPath else file, 0):
                    places.append((each, str(arc.primPath) or f"/{self.layers[each].defaultPrim}"))
            for arc in (*spec.inheritPathList.GetAppliedItems(), *spec.specializesList.GetAppliedItems()):
                places.append((file, str(arc)))
            for variants in spec.variantSets.values():
                places += [(file, str(each.primSpec.path)) for each in variants.variants]
        elif at == "/":
            places += [(each, "/") for each in self._with_sublayers(file, 0)[1:]]
        for place in places:
            size += self.of(*place, depth + 1)
            if size > NODES_MAX:
                raise ValueError(f"more than {NODES_MAX:,} prims, references counted")
        self.known[file, at] = size
        return size

    @staticmethod
    def _named(file: Path, name: str) -> Path:
        return (file.parent / name).resolve()

    def _with_sublayers(self, file: Path, depth: int) -> list[Path]:
        if depth > LEVELS_MAX:
            raise ValueError(f"more than {LEVELS_MAX} levels of sublayers")
        below = [self._named(file, name) for name in self.layers[file].subLayerPaths]
        return [file, *(each for one in below for each in self._with_sublayers(one, depth + 1))]


def _check_spec(layer: Any, at: Any, path: Path) -> None:  # noqa: ANN401 (usd-core has no type hints)
    spec = layer.GetPrimAtPath(at) if at.IsPrimPath() else None
    if spec is not None and spec.HasInfo("clips"):
        raise ValueError(f"{path.name}: value clips at {at}, which are not read; flatten the stage")


def _check_frames(layers: list[Any], metres: float, up: str) -> None:
    """Refuse layers of another unit or axis, which USD joins as they are, unless something in them converts it."""
    for layer in layers:
        info = layer.pseudoRoot
        other_metres = info.GetInfo("metersPerUnit") if info.HasInfo("metersPerUnit") else metres
        other_up = info.GetInfo("upAxis") if info.HasInfo("upAxis") else up
        same = abs(other_metres - metres) <= 1e-6 * metres and other_up == up
        if not same and not any("unitsResolve" in each.ExportToString() for each in layers):
            raise ValueError(
                f"layers of {other_metres:g} m a unit with {other_up} up in a stage of {metres:g} m with {up} up, "
                "which USD does not convert; convert them to one"
            )


@dataclass
class _Reader:
    """Collects the parts of a stage; ``seen`` counts what is not read."""

    finder: FileFinder
    folder: Path
    transforms: Any
    parts: list[Part] = field(default_factory=list)
    seen: Counter[str] = field(default_factory=Counter)
    prims_left: int = NODES_MAX
    triangles_left: int = TRIANGLES_MAX

    def note(self, text: str) -> None:
        self.seen[text] += 1

    def read(self, root: Any, stage_from_root: np.ndarray) -> None:  # noqa: ANN401
        """Everything below a prim, whose own frame lies so in the stage; row vectors, [4, 4]."""
        pxr = usd_library()

        prims = iter(pxr.Usd.PrimRange(root, pxr.Usd.TraverseInstanceProxies()))
        for prim in prims:
            self.prims_left -= 1
            if self.prims_left < 0:
                raise ValueError(f"more than {NODES_MAX:,} prims, instances counted")
            if not prim.IsA(pxr.UsdGeom.Imageable):
                continue
            imageable = pxr.UsdGeom.Imageable(prim)
            is_shown = imageable.ComputeVisibility(pxr.Usd.TimeCode.EarliestTime()) != pxr.UsdGeom.Tokens.invisible
            purpose = imageable.ComputePurpose()
            if not is_shown or purpose in (pxr.UsdGeom.Tokens.proxy, pxr.UsdGeom.Tokens.guide):
                if prim.IsA(pxr.UsdGeom.Gprim):
                    self.note(f"{'a part of the purpose ' + purpose if is_shown else 'an invisible part'} is left out")
                continue
            matrix = self._relative(prim, root) @ stage_from_root
            if prim.IsA(pxr.UsdGeom.PointInstancer):
                prims.PruneChildren()
                self._instances(pxr.UsdGeom.PointInstancer(prim), matrix)
            elif prim.IsA(pxr.UsdGeom.Mesh):
                if prim.HasAPI(pxr.UsdSkel.BindingAPI):
                    self.note("skeletons are not applied: what is bound to one may lie elsewhere")
                self._mesh(pxr.UsdGeom.Mesh(prim), matrix)
            elif prim.IsA(pxr.UsdGeom.Gprim):
                self.note(f"a {prim.GetTypeName()} is not read, only meshes are")

    def _relative(self, prim: Any, root: Any) -> np.ndarray:  # noqa: ANN401
        if root.IsPseudoRoot():
            return np.array(self.transforms.GetLocalToWorldTransform(prim))
        return np.array(self.transforms.ComputeRelativeTransform(prim, root)[0])

    def _instances(self, instancer: Any, stage_from_instancer: np.ndarray) -> None:  # noqa: ANN401
        time = self.transforms.GetTime()
        targets = instancer.GetPrototypesRel().GetForwardedTargets()
        which = instancer.GetProtoIndicesAttr().Get(time) or []
        matrices = instancer.ComputeInstanceTransformsAtTime(time, time)
        mask = instancer.ComputeMaskAtTime(time) or [True] * len(which)
        shown = [index for index, is_shown in zip(which, mask, strict=True) if is_shown]
        if len(shown) != len(matrices) or any(not 0 <= index < len(targets) for index in shown):
            raise ValueError(f"{instancer.GetPath()}: instances whose places and prototypes do not fit")
        for index, matrix in zip(shown, matrices, strict=True):
            prototype = instancer.GetPrim().GetStage().GetPrimAtPath(targets[index])
            if not prototype:
                raise ValueError(f"{instancer.GetPath()}: the prototype {targets[index]} is not there")
            self.read(prototype, np.array(matrix) @ stage_from_instancer)

    def _mesh(self, mesh: Any, matrix: np.ndarray) -> None:  # noqa: ANN401
        """The parts of a mesh, one for every material of its faces."""
        pxr = usd_library()

        time, place = self.transforms.GetTime(), str(mesh.GetPath())
        get = lambda attribute, kind: np.array([] if (value := attribute.Get(time)) is None else value, kind)  # noqa: E731
        point = get(mesh.GetPointsAttr(), np.float64).reshape(-1, 3)
        count, corner = get(mesh.GetFaceVertexCountsAttr(), np.int64), get(mesh.GetFaceVertexIndicesAttr(), np.int64)
        if not len(count):
            return
        is_right = count.min() >= 0 and count.sum() == len(corner) and corner.min(initial=0) >= 0
        if not is_right or corner.max(initial=-1) >= len(point) or not np.isfinite(point).all():
            raise ValueError(f"{place}: faces of vertices that are not there, or vertices that are no numbers")
        self.triangles_left -= int(np.maximum(count - 2, 0).sum())
        if self.triangles_left < 0:
            raise ValueError(f"more than {TRIANGLES_MAX:,} triangles, instances counted")
        scheme = mesh.GetSubdivisionSchemeAttr()
        if scheme.IsAuthored() and scheme.Get() != pxr.UsdGeom.Tokens.none:
            self.note("a subdivision surface is read as the mesh that controls it")
        face, fan = _fans(count)
        is_left = mesh.GetOrientationAttr().Get(time) == pxr.UsdGeom.Tokens.leftHanded
        if is_left != (np.linalg.det(matrix[:3, :3]) < 0.0):
            fan = fan[:, ::-1]
        kept = ~np.isin(face, get(mesh.GetHoleIndicesAttr(), np.int64))
        material = np.full(len(count), 0)
        owners = [mesh.GetPrim()]
        for subset in pxr.UsdShade.MaterialBindingAPI(mesh.GetPrim()).GetMaterialBindSubsets():
            inside = get(subset.GetIndicesAttr(), np.int64)
            if len(inside) and not 0 <= inside.min() <= inside.max() < len(count):
                raise ValueError(f"{subset.GetPath()}: faces that are not there")
            material[inside] = len(owners)
            owners.append(subset.GetPrim())
        corners = _Corners(mesh, time, np.repeat(np.arange(len(count)), count), corner)
        for number, owner in enumerate(owners):
            some = fan[kept & (material[face] == number)]
            if not len(some):
                continue
            used, triangle = np.unique(some, return_inverse=True)
            uv, rgb, texture = self._look(owner, corners, used)
            row = np.column_stack([corner[used], uv, rgb])
            unique, again = np.unique(row, axis=0, return_inverse=True)
            vertex = point[unique[:, 0].astype(np.int64)] @ matrix[:3, :3] + matrix[3, :3]
            triangle = again.reshape(-1)[triangle.reshape(-1, 3)]
            number_of = np.full(len(triangle), -1 if texture is None else 0)
            part = TexturedMesh(vertex, triangle, unique[:, 3:], unique[:, 1:3], number_of)
            self.parts.append((place, (part, texture)))

    def _look(self, owner: Any, corners: _Corners, used: np.ndarray) -> tuple[np.ndarray, np.ndarray, Texture | None]:  # noqa: ANN401
        """Positions in a texture, colours, 0 to 255, and the texture, of some corners of faces."""
        pxr = usd_library()

        uv = np.zeros((len(used), 2))
        material, _ = pxr.UsdShade.MaterialBindingAPI(owner).ComputeBoundMaterial()
        if material:
            surfaces = (material.ComputeSurfaceSource(context)[0] for context in ("", "mdl", "mtlx"))
            surface = next(filter(None, surfaces), None)
            colour, file, name = (None, None, None) if surface is None else _diffuse(surface)
            image = None if file is None else self._image(file)
            found = None if image is None else corners.values(name or "st", used, 2)
            if image is not None and found is not None:
                texture = Texture(image, colour)
                return found, texture.rgb(found).astype(np.float64), texture
            if file is None and colour is not None:
                return uv, np.tile(np.round(255.0 * srgb(colour)), (len(used), 1)), None
            if file is None and name is None:
                self.note("a material states no colour that is read: the mesh's own, or grey")
        shown = corners.values("displayColor", used, 3)
        return uv, np.tile(GREY_RGB, (len(used), 1)) if shown is None else np.round(255.0 * srgb(shown)), None

    def _image(self, file: Any) -> Any:  # noqa: ANN401
        """The image that an asset means; one that lies elsewhere is looked for beside the stage."""
        found = Path(file.resolvedPath) if file.resolvedPath else None
        inside = found is not None and found.resolve().is_relative_to(self.folder)
        return self.finder.image(str(found.resolve().relative_to(self.folder)) if inside and found else file.path)


@dataclass
class _Corners:
    """Primvars of a mesh at the corners of its faces."""

    mesh: Any
    time: Any
    face: np.ndarray
    vertex: np.ndarray

    def values(self, name: str, used: np.ndarray, width: int) -> np.ndarray | None:
        """A primvar at some corners, float64 [corner, width]; None without one, or one that does not fit."""
        pxr = usd_library()

        primvar = pxr.UsdGeom.PrimvarsAPI(self.mesh.GetPrim()).FindPrimvarWithInheritance(name)
        value = primvar.ComputeFlattened(self.time) if primvar and primvar.HasValue() else None
        array: np.ndarray = np.empty(0) if value is None else np.array(value, np.float64)
        if array.ndim != 2 or array.shape[1] < width or not np.isfinite(array).all():
            return None
        interpolation = str(primvar.GetInterpolation())
        index = {"faceVarying": used, "uniform": self.face[used], "constant": np.zeros(len(used), np.int64)}.get(
            interpolation, self.vertex[used]
        )
        return array[index, :width] if index.max(initial=0) < len(array) else None


def _diffuse(surface: Any) -> tuple[np.ndarray | None, Any, str | None]:  # noqa: ANN401
    """Colour of a surface in linear light, [3]; file of its texture, whose factor that is then; name of its uv."""
    pxr = usd_library()

    def source(shader: Any, name: str) -> Any:  # noqa: ANN401
        entry = shader.GetInput(name)
        return next(iter(pxr.UsdShade.Utils.GetValueProducingAttributes(entry)), None) if entry else None

    for name in (*_TEXTURE_INPUTS, *_COLOUR_INPUTS):
        attribute = source(surface, name)
        if attribute is None:
            continue
        value = attribute.Get()
        if isinstance(value, pxr.Sdf.AssetPath) and value.path:
            return np.ones(3), value, None
        if value is not None and not isinstance(value, pxr.Sdf.AssetPath) and len(value) >= 3:
            return np.array(value, np.float64)[:3], None, None
        shader = pxr.UsdShade.Shader(attribute.GetPrim())
        file = source(shader, "file")
        file = file.Get() if file is not None else None
        variable = source(shader, "varname")
        if file is None or not file.path:  # a colour at the vertices
            return None, None, None if variable is None else str(variable.Get())
        scale, place = source(shader, "scale"), source(shader, "st")
        for _ in range(_LINKS_MAX):  # through what turns and scales it
            if place is not None:
                reader = pxr.UsdShade.Shader(place.GetPrim())
                variable, place = source(reader, "varname"), source(reader, "in")
        factor = scale.Get() if scale is not None else None
        return np.ones(3) if factor is None else np.array(factor)[:3], file, str(variable.Get()) if variable else None
    return None, None, None


def _fans(count: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Faces with these numbers of corners as triangles: the face of each, and its corners, [triangle, 3]."""
    inside = np.maximum(count - 2, 0)
    face = np.repeat(np.arange(len(count)), inside)
    first = (np.cumsum(count) - count)[face]
    step = np.arange(len(face)) - (np.cumsum(inside) - inside)[face]
    return face, np.stack([first, first + step + 1, first + step + 2], axis=1)
