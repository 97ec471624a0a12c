"""What lies beside a mesh file: textures and materials, as colours at its vertices, and a simulator's ``model.sdf``.

Files name their textures as the machine of their author had them. `FileFinder` looks for them where they usually lie
beside the mesh, and remembers what it did not find.

Triangles are split until the colours at vertices, linear in between, follow the textures: where one is large beside the
detail of its texture, its edges are halved, in all triangles that share them, those first where most area has most
error. The surface stays as it is.
"""

from __future__ import annotations

import io
import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import TYPE_CHECKING, Any
from urllib.parse import unquote

import numpy as np

from warpav.core.bounded_files import DATA_SET_BYTES_MAX, is_inner_path, parse_xml, read_bytes
from warpav.core.errors import InputError
from warpav.raster.mesh import Mesh
from warpav.scene.town._paint import lit_rgb
from warpav.scene.town._surface_builder import corner_normals

if TYPE_CHECKING:
    from PIL.Image import Image

TRIANGLES_MAX = 5_000_000  # triangles of a file, counted at every node that shows them
GREY_RGB = np.array([150, 152, 156], np.uint8)  # of what has no colour
_MATERIAL_SUFFIX = ".mtl"
_IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".tga", ".bmp", ".tif", ".tiff", ".webp", ".gif", ".dds")
_TEXTURE_FOLDERS = (".", "textures", "images", "../textures", "../materials/textures", "../materials", "../images")
_MESH_FOLDERS = ("meshes", "../meshes", "../meshes/visual")  # of robots
_SCHEMES = ("model://", "package://", "file://")
_ANCESTOR_COUNT = 5
_MAP_OPTION = re.compile(r"^-\w+(\s+(on|off|[-+]?[\d.]+))*\s+")


class FileFinder:
    """The files that a mesh file names: materials, textures, buffers. It is a resolver as trimesh takes them."""

    def __init__(self, mesh: Path) -> None:
        self.mesh = mesh
        self.file_name = mesh.name
        self.missing: list[str] = []
        self.found: set[Path] = set()

    @property
    def notes(self) -> tuple[str, ...]:
        """What is missing, a line for each file."""
        return tuple(
            f"{'materials' if name.lower().endswith(_MATERIAL_SUFFIX) else 'texture'} {name} not found, or not "
            "readable: grey instead"
            for name in dict.fromkeys(self.missing)
        )

    @property
    def lacks_materials(self) -> bool:
        return any(name.lower().endswith(_MATERIAL_SUFFIX) for name in self.missing)

    def find(self, name: str) -> Path | None:
        """The file of this name: where the mesh file says, else in the usual folders beside it; None without one."""
        file = next((found for each in self._candidates(_plain(name)) if (found := _on_disk(each))), None)
        self.found |= set() if file is None else {file.resolve()}
        return file

    def image(self, name: str) -> Image | None:
        """The image of this name; None, and remembered as missing, if it is not there or cannot be read."""
        from PIL import Image

        path = self.find(name)
        if path is not None:
            try:
                with Image.open(path) as image:
                    return image.convert("RGB")
            except Exception:  # whatever Pillow raises for what is no image
                pass
        self.missing.append(_plain(name))
        return None

    def get(self, name: str) -> bytes:
        """What the file of this name holds; of images that are not there a grey one, of materials none."""
        if _plain(name).lower().endswith(_IMAGE_SUFFIXES):
            from PIL import Image

            image = self.image(name) or Image.new("RGB", (1, 1), tuple(GREY_RGB.tolist()))
            data = io.BytesIO()
            image.save(data, "PNG")
            return data.getvalue()
        path = self.find(name)
        if path is not None:
            return read_bytes(path, "a part of a mesh file", bytes_max=DATA_SET_BYTES_MAX)
        if name.lower().endswith(_MATERIAL_SUFFIX):
            self.missing.append(_plain(name))
            return b""
        raise FileNotFoundError(f"{name} is not beside it")

    def __getitem__(self, name: str) -> bytes:
        return self.get(name)

    def _candidates(self, name: str) -> Iterator[Path]:
        folder = self.mesh.absolute().parent
        scheme = next((each for each in _SCHEMES if name.startswith(each)), None)
        if not is_inner_path(name.removeprefix(scheme or "").lstrip("/" if scheme else "")):
            pass  # names that lead out of the folder are looked up by their last part alone
        elif scheme is None:
            yield folder / name
        else:  # model://suv/materials/textures/wheels.png lies in a folder suv somewhere above, or this is suv renamed
            inside = name.removeprefix(scheme).lstrip("/")
            for above in (folder, *folder.parents)[:_ANCESTOR_COUNT]:
                yield above / inside
            for above in (folder, *folder.parents)[:2]:
                yield above / inside.partition("/")[2]
        last = PureWindowsPath(name).name  # with slashes and backslashes alike
        if is_inner_path(last):
            for each in (*_TEXTURE_FOLDERS, *_MESH_FOLDERS):
                yield folder / each / last


def _corner_rgb(uv: np.ndarray, image: Image) -> np.ndarray:
    """Colours of a texture at positions, [corner, 2], of the nearest texel, the texture repeated beyond its borders."""
    texel_rgb = np.asarray(image.convert("RGB"), np.uint8)
    size = np.array([texel_rgb.shape[1], texel_rgb.shape[0]])
    uv = np.asarray(uv, np.float64)[:, :2]
    is_number = np.isfinite(uv).all(axis=1, keepdims=True)
    uv = np.where(is_number, uv, 0.0)
    is_inside = (uv >= 0.0) & (uv <= 1.0)
    # 1 is the last texel's border, not the first one's again
    share = np.where(is_inside, uv, uv - np.floor(uv))
    share[:, 1] = 1.0 - share[:, 1]
    column, row = np.minimum((share * size).astype(np.int64), size - 1).T
    return np.where(is_number, texel_rgb[row, column], GREY_RGB)


@dataclass(frozen=True, eq=False)
class Texture:
    """An image that a material lays over a mesh."""

    image: Image  # the image
    linear_factor: np.ndarray | None = None  # what multiplies its linear light, float64 [3]; None: nothing does

    @property
    def size_px(self) -> tuple[int, int]:
        """Columns and rows."""
        return self.image.size

    def rgb(self, uv: np.ndarray) -> np.ndarray:
        """Colours at positions, see `_corner_rgb`, uint8 [corner, 3]."""
        found = _corner_rgb(uv, self.image)
        if self.linear_factor is None:
            return found
        value = found.astype(np.float64) / 255.0
        light = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4) * self.linear_factor
        return np.round(255.0 * srgb(light)).astype(np.uint8)


def srgb(light: np.ndarray) -> np.ndarray:
    """Linear light as sRGB, both 0 to 1, in any shape; what is beyond is cut off."""
    value = np.clip(light, 0.0, 1.0)
    return np.where(value <= 0.0031308, 12.92 * value, 1.055 * value ** (1.0 / 2.4) - 0.055)


def texture_of(geometry: Any, *, is_plain: bool = False) -> Texture | None:  # noqa: ANN401 (trimesh has few type hints)
    """The texture of a trimesh; None where it has none, or positions in it that do not fit."""
    visual = geometry.visual
    try:
        if is_plain or visual.kind != "texture" or np.shape(visual.uv) != (len(geometry.vertices), 2):
            return None
        material = visual.material
        if hasattr(material, "baseColorFactor"):
            # glTF: the factor of a texture multiplies its linear light
            image, factor = material.baseColorTexture, np.ones(3)
            if material.baseColorFactor is not None:
                stated = np.asarray(material.baseColorFactor)
                factor = (stated.astype(np.float64) / (255.0 if stated.dtype == np.uint8 else 1.0))[:3]
        else:
            image, factor = getattr(material, "image", None), None  # Kd is .588 where exporters mean the texture alone
        return None if image is None else Texture(image.convert("RGB"), factor)
    except Exception:  # a visual that is broken is no reason not to use the shape
        return None


def vertex_rgb(geometry: Any, *, is_plain: bool = False) -> np.ndarray:  # noqa: ANN401 (trimesh has few type hints)
    """Colours of a trimesh at its vertices, uint8 [vertex, 3]: its own, its texture's, its material's, or grey."""
    count = len(geometry.vertices)
    grey = np.tile(GREY_RGB, (count, 1))
    visual = geometry.visual
    texture = texture_of(geometry, is_plain=is_plain)
    try:
        if texture is not None:
            return texture.rgb(visual.uv)
        if visual.kind != "texture":
            return _per_vertex(visual.vertex_colors, count)
        # plain colours as they are: who writes them seldom means linear light
        return grey if is_plain else _per_vertex(np.asarray(visual.material.main_color), count)
    except Exception:  # a visual that is broken is no reason not to use the shape
        return grey


def _per_vertex(colour: object, count: int) -> np.ndarray:
    array = np.asarray(colour)
    if array.shape in ((count, 3), (count, 4)):
        return array[:, :3].astype(np.uint8)
    if array.shape in ((3,), (4,)):
        return np.tile(array[:3].astype(np.uint8), (count, 1))
    return np.tile(GREY_RGB, (count, 1))


def _plain(name: str) -> str:
    """A file's name without the options that OBJ's maps allow before it, and without percent signs of URIs."""
    name = name.strip().strip('"')
    while match := _MAP_OPTION.match(name):
        name = name[match.end() :]
    return unquote(name).replace("\\", "/")


def _on_disk(path: Path) -> Path | None:
    """The file, or one beside it whose name differs by upper and lower case alone."""
    try:
        if path.is_file():
            return path
        if not path.name or not path.parent.is_dir():
            return None
        return next((each for each in path.parent.iterdir() if each.name.lower() == path.name.lower()), None)
    except (OSError, ValueError):
        return None


_MODEL_FILE = "model.sdf"
_ANGLE_TOLERANCE_RAD = 1e-3


@dataclass(frozen=True)
class _SimulatorModel:
    """How a model uses a mesh."""

    path: Path  # the model's file
    scale: float  # factor from the mesh's numbers, in its own unit, to metres
    # The mesh's axis that points to the front, where the model turns the mesh to face along x; else None.
    forward: str | None


def simulator_model(mesh: Path) -> _SimulatorModel | None:
    """The model of a mesh file, in its folder or in the one above; None where no model names it, or none can be read.

    Of several uses of the mesh the first one counts. Models that do not turn their mesh say nothing about its front:
    some face along x, others do not.
    """
    for folder in (mesh.absolute().parent, mesh.absolute().parent.parent):
        path = folder / _MODEL_FILE
        try:
            root = parse_xml(read_bytes(path, "a model"), str(path), "a model")
        except InputError:
            continue
        for visual in (*root.iter("visual"), *root.iter("collision")):
            shape = visual.find("geometry/mesh")
            if shape is None or PurePosixPath(shape.findtext("uri", "").strip()).name != mesh.name:
                continue
            try:
                scale = [float(each) for each in shape.findtext("scale", "1 1 1").split()]
                pose = [float(each) for each in visual.findtext("pose", "0 0 0 0 0 0").split()]
            except ValueError:
                continue
            if len(scale) != 3 or not 0.0 < scale[0] < math.inf or max(scale) - min(scale) > 1e-9 * scale[0]:
                continue  # other along one axis than along another
            forward = None
            if len(pose) == 6 and max(abs(pose[3]), abs(pose[4])) <= _ANGLE_TOLERANCE_RAD and math.isfinite(pose[5]):
                quarter = round(pose[5] / (0.5 * math.pi))
                if abs(pose[5] - quarter * 0.5 * math.pi) <= _ANGLE_TOLERANCE_RAD:
                    forward = (None, "-y", "-x", "y")[quarter % 4]
            return _SimulatorModel(path, scale[0], forward)
    return None


VERTICES_MAX = 20_000  # vertices of a vehicle up to which triangles are split
_TOLERANCE = 6.0  # rms difference of colour and texture over a triangle, of 255, up to which it stays whole
_LEAST_TEXELS = 1.0
_ROUNDS_MAX = 200
_LATTICES = (4, 8, 16, 32)
_TEXELS_A_SAMPLE = 4.0


@dataclass(frozen=True, eq=False)
class TexturedMesh:
    """A mesh whose triangles have textures."""

    # Positions in any unit, float64 [vertex, 3]; vertices are split where positions in the texture differ.
    vertex: np.ndarray
    triangle: np.ndarray  # vertex indices, int64 [triangle, 3]
    rgb: np.ndarray  # colours at the vertices, 0..255, float64 [vertex, 3]
    uv: np.ndarray  # positions in the texture, float64 [vertex, 2]; of no meaning where a triangle has none
    texture_of: np.ndarray  # number of every triangle's texture, -1 for none, int64 [triangle]


def follow_textures(
    mesh: TexturedMesh, textures: Sequence[Texture], *, vertices_max: int = VERTICES_MAX
) -> TexturedMesh:
    """Split triangles until the colours follow the textures, or there are enough vertices."""
    size_px = np.array([texture.size_px for texture in textures], np.float64).reshape(-1, 2)
    error = _colour_errors(mesh, textures, np.arange(len(mesh.triangle)))
    for _ in range(_ROUNDS_MAX):
        left = vertices_max - len(mesh.vertex)
        texels = _edge_texels(mesh, size_px)
        longest = texels.max(axis=1)
        weight = np.where((error > _TOLERANCE) & (longest > _LEAST_TEXELS), error**2 * _areas(mesh), 0.0)
        worst = np.argsort(-weight, kind="stable")[: np.count_nonzero(weight)]
        if left < 1 or not len(worst):
            break
        worst = worst[: max(left // 8, 1)]  # a part of them at a time, so that the rest goes where it does most
        # a number for every edge, the same wherever two places are joined
        _, place = np.unique(mesh.vertex + 0.0, axis=0, return_inverse=True)
        place = place.reshape(-1)[mesh.triangle]
        ends = np.sort(np.stack([place, np.roll(place, -1, axis=1)], axis=-1), axis=-1)
        edge = ends[..., 0] * len(mesh.vertex) + ends[..., 1]
        wanted = edge[worst][texels[worst] > 0.5 * longest[worst][:, None]]
        finer, kept, new = _split(mesh, textures, np.isin(edge, wanted))
        if len(finer.vertex) > vertices_max:
            if len(worst) == 1:
                break
            wanted = edge[worst[:1]][texels[worst[:1]] > 0.5 * longest[worst[:1]][:, None]]
            finer, kept, new = _split(mesh, textures, np.isin(edge, wanted))
            if len(finer.vertex) > vertices_max:
                break
        mesh = finer
        error = np.concatenate([error[kept], _colour_errors(mesh, textures, new)])
    return mesh


def _colour_errors(mesh: TexturedMesh, textures: Sequence[Texture], index: np.ndarray) -> np.ndarray:
    """Rms difference of colour and texture on a lattice in triangles, of 255, [triangle]; 0 without a texture."""
    size_px = np.array([texture.size_px for texture in textures], np.float64).reshape(-1, 2)
    error = np.zeros(len(index))
    longest = _edge_texels(mesh, size_px, index).max(axis=1, initial=0.0)
    level = np.searchsorted(np.array(_LATTICES[:-1]) * _TEXELS_A_SAMPLE, longest, side="right")
    for number, texture in enumerate(textures):
        for step, lattice in enumerate(_LATTICES):
            some = np.flatnonzero((mesh.texture_of[index] == number) & (level == step))
            first, second = np.meshgrid(np.arange(lattice), np.arange(lattice), indexing="ij")
            inside = first + second < lattice
            pair = (np.stack([first[inside], second[inside]], axis=1) + 1.0 / 3.0) / lattice
            share = np.concatenate([pair, 1.0 - pair.sum(axis=1, keepdims=True)], axis=1)
            for part in np.array_split(some, max(len(some) * len(share) // 500_000, 1)):
                corner = mesh.triangle[index[part]]
                uv = np.einsum("sc,tcx->tsx", share, mesh.uv[corner])
                drawn = np.einsum("sc,tcx->tsx", share, mesh.rgb[corner])
                there = texture.rgb(uv.reshape(-1, 2)).reshape(drawn.shape)
                error[part] = np.sqrt(((drawn - there) ** 2).mean(axis=(1, 2)))
    return error


def _split(
    mesh: TexturedMesh, textures: Sequence[Texture], is_halved: np.ndarray
) -> tuple[TexturedMesh, np.ndarray, np.ndarray]:
    """The mesh with a vertex in the middle of some edges, bool [triangle, 3]; edge i runs from corner i to i + 1.

    Triangles that are kept come first; their numbers in the old mesh, and in the new one those of the others.
    """
    is_kept = ~is_halved.any(axis=1)
    triangle, is_halved, texture_of = (each[~is_kept] for each in (mesh.triangle, is_halved, mesh.texture_of))
    ends = np.sort(np.stack([triangle, np.roll(triangle, -1, axis=1)], axis=-1), axis=-1)
    found, number = np.unique(ends[is_halved], axis=0, return_inverse=True)
    middle = np.full(triangle.shape, -1)
    middle[is_halved] = len(mesh.vertex) + number.reshape(-1)
    # turned, so that halved edges come first
    first = np.where(is_halved.sum(axis=1) == 2, np.argmin(is_halved, axis=1) + 1, np.argmax(is_halved, axis=1))
    turn = (first[:, None] + np.arange(3)) % 3
    (a, b, c), (p, q, r) = (np.take_along_axis(each, turn, axis=1).T for each in (triangle, middle))
    halves = [((a, p, c), (p, b, c)), ((p, b, q), (a, p, q), (a, q, c)), ((a, p, r), (p, b, q), (r, q, c), (p, q, r))]
    pieces, owners = [], []
    for count, corners in enumerate(halves, start=1):
        some = np.flatnonzero(is_halved.sum(axis=1) == count)
        pieces += [np.stack(each, axis=1)[some] for each in corners]
        owners += [some] * len(corners)
    new_texture = texture_of[np.concatenate(owners)]
    uv, rgb = mesh.uv[found].mean(axis=1), mesh.rgb[found].mean(axis=1)
    whose = np.full(len(found), -1)
    whose[number.reshape(-1)] = np.broadcast_to(texture_of[:, None], triangle.shape)[is_halved]
    for k, texture in enumerate(textures):
        rgb[whose == k] = texture.rgb(uv[whose == k])
    kept = np.flatnonzero(is_kept)
    new = np.concatenate(pieces)
    split = TexturedMesh(
        np.concatenate([mesh.vertex, mesh.vertex[found].mean(axis=1)]),
        np.concatenate([mesh.triangle[kept], new]),
        np.concatenate([mesh.rgb, rgb]),
        np.concatenate([mesh.uv, uv]),
        np.concatenate([mesh.texture_of[kept], new_texture]),
    )
    return split, kept, len(kept) + np.arange(len(new))


def _edge_texels(mesh: TexturedMesh, size_px: np.ndarray, index: np.ndarray | None = None) -> np.ndarray:
    """Lengths of edges in the texture [px], float64 [triangle, 3]; 0 without one."""
    triangle, number = (
        (mesh.triangle, mesh.texture_of) if index is None else (mesh.triangle[index], mesh.texture_of[index])
    )
    if not len(size_px):
        return np.zeros(triangle.shape)
    uv_px = mesh.uv[triangle] * size_px[number][:, None]
    length = np.linalg.norm(np.roll(uv_px, -1, axis=1) - uv_px, axis=2)
    return np.where(np.isfinite(length) & (number >= 0)[:, None], length, 0.0)


def _areas(mesh: TexturedMesh) -> np.ndarray:
    corner = mesh.vertex[mesh.triangle]
    return 0.5 * np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1)


_ONE_COLOUR = 6  # of 255: what differs by less is one colour
_BLACK = 24  # of 255: what exporters write where a material says nothing
_WHITE_ALBEDO, _PAINT_MIRROR = 0.85, 0.13


def shaded(mesh: Mesh) -> Mesh:
    """A vehicle of one colour, in the ego frame, with the town's light in it, by normals alone; others as they are.

    Without that it has one brightness all over in the images of cameras, and no shape. Black becomes grey.
    """
    if np.ptp(mesh.vertex_rgb, axis=0).max() > _ONE_COLOUR:
        return mesh
    vertex_m, place = np.unique(mesh.vertex_m.astype(np.float64), axis=0, return_inverse=True)
    triangle = place.reshape(-1)[mesh.triangle]
    corner_m = vertex_m[triangle]
    across = np.cross(corner_m[:, 1] - corner_m[:, 0], corner_m[:, 2] - corner_m[:, 0])
    outwards = corner_m.mean(axis=1) - 0.5 * (vertex_m.min(axis=0) + vertex_m.max(axis=0))
    is_inside_out = (across * outwards).sum(axis=1) < 0.0
    triangle = np.where(is_inside_out[:, None], triangle[:, ::-1], triangle)
    normal = corner_normals(vertex_m, triangle).reshape(-1, 3)
    sky = 0.5 * (1.0 + normal[:, 2])
    rgb = GREY_RGB if mesh.vertex_rgb.max() < _BLACK else mesh.vertex_rgb.mean(axis=0)
    albedo = np.tile(_WHITE_ALBEDO * (np.asarray(rgb) / 255.0) ** 2.2, (len(sky), 1))
    lit = lit_rgb(normal, sky, albedo, np.full(len(sky), _PAINT_MIRROR))
    return Mesh.create(vertex_m[triangle.reshape(-1)], np.arange(triangle.size).reshape(-1, 3), lit)
