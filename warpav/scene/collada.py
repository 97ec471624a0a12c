"""COLLADA (.dae): the triangles of its scene with texture colours at the corners, its unit and its axis upwards."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from warpav.core.errors import InputError
from warpav.scene.mesh_colours import GREY_RGB, FileFinder, corner_rgb

_MAX_DEPTH = 64
"""Nodes within nodes; instances of nodes may form a ring."""

_UP_AXES = {"X_UP": "x", "Y_UP": "y", "Z_UP": "z"}

Part = tuple[np.ndarray, np.ndarray, np.ndarray]


@dataclass(frozen=True, eq=False)
class ColladaFile:
    """What a COLLADA file holds.

    Attributes:
        parts: Vertices in the file's units and axes, float64 [vertex, 3], triangles [triangle, 3] and vertex colours,
            uint8 [vertex, 3], of every group of faces.
        metres: The file's unit [m].
        up: ``x``, ``y`` or ``z``.
    """

    parts: list[Part]
    metres: float
    up: str


@dataclass(frozen=True)
class _Material:
    colour_rgb: np.ndarray
    image: str | None = None
    channel: str | None = None


def read_collada(path: Path, finder: FileFinder) -> ColladaFile:
    """Read the scene of a file; skinned meshes as they are bound.

    Args:
        path: The file.
        finder: Finds its textures.

    Raises:
        InputError: It is no COLLADA file.
        ValueError: What it refers to is not in it.
    """
    try:
        root = ET.parse(path).getroot()
    except ET.ParseError as error:
        raise InputError(f"{path}: vehicle: expected a readable dae file, got: {error}; export it again") from None
    if root.tag.rpartition("}")[2] != "COLLADA":
        raise InputError(f"{path}: vehicle: expected a COLLADA file, got the element {root.tag}; export it again")
    return _Reader(root, finder).file()


class _Reader:
    def __init__(self, root: ET.Element, finder: FileFinder) -> None:
        self._root = root
        self._finder = finder
        self._by_id = {element.get("id"): element for element in root.iter() if element.get("id")}

    def file(self) -> ColladaFile:
        unit = self._root.find("{*}asset/{*}unit")
        metres = float(unit.get("meter", 1.0)) if unit is not None else 1.0
        up = self._root.findtext("{*}asset/{*}up_axis", "Y_UP").strip()
        instance = self._root.find("{*}scene/{*}instance_visual_scene")
        parts: list[Part] = []
        if instance is not None:
            for node in self._target(instance).findall("{*}node"):
                parts += self._of_node(node, np.eye(4), 0)
        else:
            for geometry in self._root.findall("{*}library_geometries/{*}geometry"):
                parts += self._of_geometry(geometry, {}, {})
        return ColladaFile(parts, metres if metres > 0.0 else 1.0, _UP_AXES.get(up, "y"))

    def _target(self, element: ET.Element, name: str = "url") -> ET.Element:
        found = self._by_id.get(element.get(name, "").removeprefix("#"))
        if found is None:
            raise ValueError(f"no element {element.get(name)!r}, to which a {element.tag.rpartition('}')[2]} refers")
        return found

    def _of_node(self, node: ET.Element, file_from_parent: np.ndarray, depth: int) -> Iterator[Part]:
        if depth > _MAX_DEPTH:
            raise ValueError(f"more than {_MAX_DEPTH} nodes within nodes")
        file_from_node = file_from_parent @ _transform(node)
        for child in node:
            kind = child.tag.rpartition("}")[2]
            if kind == "node":
                yield from self._of_node(child, file_from_node, depth + 1)
            elif kind == "instance_node":
                yield from self._of_node(self._target(child), file_from_node, depth + 1)
            elif kind in ("instance_geometry", "instance_controller"):
                geometry, bound = self._target(child), file_from_node
                if kind == "instance_controller":
                    skin = geometry.find("{*}skin")
                    if skin is None:
                        continue
                    geometry = self._target(skin, "source")
                    shape = skin.findtext("{*}bind_shape_matrix")
                    bound = bound if shape is None else bound @ _numbers(shape).reshape(4, 4)
                materials, sets = self._bindings(child)
                for vertex, triangle, colour in self._of_geometry(geometry, materials, sets):
                    is_mirrored = np.linalg.det(bound[:3, :3]) < 0.0
                    yield (
                        vertex @ bound[:3, :3].T + bound[:3, 3],
                        triangle[:, ::-1] if is_mirrored else triangle,
                        colour,
                    )

    def _bindings(self, instance: ET.Element) -> tuple[dict[str, _Material], dict[str, dict[str, int]]]:
        """Materials of an instance by symbol, and the sets of texture coordinates that their channels mean."""
        materials, sets = {}, {}
        for bound in instance.iterfind(".//{*}instance_material"):
            symbol = bound.get("symbol", "")
            materials[symbol] = self._material(self._target(bound, "target"))
            sets[symbol] = {
                each.get("semantic", ""): int(each.get("input_set", 0))
                for each in bound.findall("{*}bind_vertex_input")
            }
        return materials, sets

    def _material(self, material: ET.Element) -> _Material:
        instance = material.find("{*}instance_effect")
        effect = None if instance is None else self._target(instance)
        diffuse = None if effect is None else effect.find(".//{*}technique//{*}diffuse")
        if effect is None or diffuse is None:
            return _Material(GREY_RGB)
        texture, colour = diffuse.find("{*}texture"), diffuse.findtext("{*}color")
        plain = GREY_RGB
        if colour is not None:
            plain = np.round(255.0 * np.clip(_numbers(colour)[:3], 0.0, 1.0)).astype(np.uint8)
        if texture is None:
            return _Material(plain)
        name = self._image_name(effect, texture.get("texture", ""))
        return _Material(plain, name, texture.get("texcoord"))

    def _image_name(self, effect: ET.Element, sampler: str) -> str:
        """The file of a texture: its sampler names a surface, that an image, that a file; each may be left out."""
        parameter = {each.get("sid"): each for each in effect.iter() if each.tag.endswith("}newparam")}
        name = sampler
        for path in ("{*}sampler2D/{*}source", "{*}surface/{*}init_from"):
            name = parameter[name].findtext(path, name).strip() if name in parameter else name
        reference = None if sampler not in parameter else parameter[sampler].find("{*}sampler2D/{*}instance_image")
        if reference is not None:  # COLLADA 1.5
            name = reference.get("url", "").removeprefix("#")
        image = self._by_id.get(name)
        if image is None:
            return name
        return (image.findtext("{*}init_from/{*}ref") or image.findtext("{*}init_from") or name).strip()

    def _of_geometry(
        self, geometry: ET.Element, materials: dict[str, _Material], sets: dict[str, dict[str, int]]
    ) -> Iterator[Part]:
        for group in geometry.findall("{*}mesh/*"):
            kind = group.tag.rpartition("}")[2]
            if kind not in ("triangles", "polylist", "polygons", "tristrips", "trifans"):
                continue
            symbol = group.get("material", "")
            material = materials.get(symbol, _Material(GREY_RGB))
            part = self._of_group(group, kind, material, sets.get(symbol, {}))
            if part is not None:
                yield part

    def _of_group(self, group: ET.Element, kind: str, material: _Material, sets: dict[str, int]) -> Part | None:
        inputs = group.findall("{*}input")
        width = 1 + max((int(each.get("offset", 0)) for each in inputs), default=0)
        index, triangle = _faces(group, kind, width)
        if not len(triangle):
            return None
        position = coordinate = colour = None
        wanted = sets.get(material.channel or "")
        for each in sorted(inputs, key=lambda each: int(each.get("set", 0)), reverse=True):
            corner = index[:, int(each.get("offset", 0))]
            semantic = each.get("semantic")
            if semantic == "VERTEX":
                for inner in self._target(each, "source").findall("{*}input"):
                    if inner.get("semantic") == "POSITION":
                        position = _rows(self._source(inner), corner)
            elif semantic == "TEXCOORD":
                if coordinate is None or wanted is None or int(each.get("set", 0)) == wanted:
                    coordinate = _rows(self._source(each), corner)[:, :2]
            elif semantic == "COLOR":
                colour = _rows(self._source(each), corner)[:, :3]
        if position is None:
            raise ValueError(f"{kind} without positions")
        image = None if material.image is None else self._finder.image(material.image)
        if image is not None and coordinate is not None:
            corner_colour_rgb = corner_rgb(coordinate, image)
        elif material.image is None and colour is not None:
            corner_colour_rgb = np.round(255.0 * np.clip(colour, 0.0, 1.0)).astype(np.uint8)
        else:
            corner_colour_rgb = np.tile(GREY_RGB if material.image else material.colour_rgb, (len(position), 1))
        return _welded(position, corner_colour_rgb, triangle)

    def _source(self, element: ET.Element) -> np.ndarray:
        """The rows of the source of an input, float64 [row, value]."""
        source = self._target(element, "source")
        accessor = source.find("{*}technique_common/{*}accessor")
        if accessor is None:
            raise ValueError(f"source {source.get('id')!r} without an accessor")
        value = _numbers(self._target(accessor, "source").text or "")
        stride, start = int(accessor.get("stride", 1)), int(accessor.get("offset", 0))
        count = int(accessor.get("count", 0))
        if len(value) < start + count * stride:
            raise ValueError(f"source {source.get('id')!r} of {len(value)} numbers instead of {start + count * stride}")
        return value[start : start + count * stride].reshape(count, stride)


def _faces(group: ET.Element, kind: str, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Indices of every corner [corner, input] and the corners of every triangle [triangle, 3]."""
    lists = [_numbers(each.text or "", np.int64) for each in group.findall("{*}p")]
    if kind == "polygons":
        lists += [_numbers(each.findtext("{*}p", ""), np.int64) for each in group.findall("{*}ph")]  # without holes
    lists = [each.reshape(-1, width) for each in lists if len(each)]
    if not lists:
        return np.zeros((0, width), np.int64), np.zeros((0, 3), np.int64)
    index = np.concatenate(lists)
    sizes = [len(each) for each in lists]
    if kind == "triangles":
        return index, np.arange(len(index) // 3 * 3).reshape(-1, 3)
    if kind == "polylist":
        sizes = _numbers(group.findtext("{*}vcount", ""), np.int64).tolist()
        if sum(sizes) != len(index):
            raise ValueError(f"polylist of {len(index)} corners instead of {sum(sizes)}")
    triangles, start = [], 0
    for size in sizes:
        for k in range(size - 2):
            if kind == "tristrips":
                triangles.append((start + k + k % 2, start + k + 1 - k % 2, start + k + 2))
            else:
                triangles.append((start, start + k + 1, start + k + 2))
        start += size
    return index, np.array(triangles, np.int64).reshape(-1, 3)


def _welded(position: np.ndarray, colour_rgb: np.ndarray, triangle: np.ndarray) -> Part:
    """Corners that share place and colour become one vertex."""
    _, first, index = np.unique(
        np.concatenate([position, colour_rgb], axis=1), axis=0, return_index=True, return_inverse=True
    )
    return position[first], index.reshape(-1)[triangle], colour_rgb[first]


def _rows(source: np.ndarray, index: np.ndarray) -> np.ndarray:
    if len(index) and not 0 <= index.min() <= index.max() < len(source):
        raise ValueError(f"index {index.max()} into {len(source)} rows")
    return source[index]


def _transform(node: ET.Element) -> np.ndarray:
    """Node to parent, float64 [4, 4]: its elements one after the other."""
    result = np.eye(4)
    for element in node:
        kind = element.tag.rpartition("}")[2]
        if kind not in ("matrix", "translate", "rotate", "scale"):
            continue
        value = _numbers(element.text or "")
        step = np.eye(4)
        if kind == "matrix":
            step = value.reshape(4, 4)
        elif kind == "translate":
            step[:3, 3] = value
        elif kind == "scale":
            step[:3, :3] = np.diag(value)
        else:
            axis, angle = value[:3] / max(float(np.linalg.norm(value[:3])), 1e-300), np.radians(value[3])
            cross = np.cross(np.eye(3), axis)
            step[:3, :3] = (
                np.cos(angle) * np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * np.outer(axis, axis)
            )
        result = result @ step
    return result


def _numbers(text: str, dtype: type = np.float64) -> np.ndarray:
    return np.array(text.split(), dtype)
