"""What lies beside a mesh file: textures and materials, as colours at its vertices, and a simulator's ``model.sdf``.

Files name their textures as the machine of their author had them. `FileFinder` looks for them where they usually lie
beside the mesh, and remembers what it did not find.
"""

from __future__ import annotations

import io
import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import TYPE_CHECKING, Any
from urllib.parse import unquote

import numpy as np

from warpav.core.bounded_files import DATA_SET_BYTES_MAX, is_inner_path, parse_xml, read_bytes
from warpav.core.errors import InputError

if TYPE_CHECKING:
    from PIL.Image import Image

GREY_RGB = np.array([150, 152, 156], np.uint8)  # of what has no colour
_MATERIAL_SUFFIX = ".mtl"
_IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".tga", ".bmp", ".tif", ".tiff", ".webp", ".gif", ".dds")
_TEXTURE_FOLDERS = (".", "textures", "images", "../textures", "../materials/textures", "../materials", "../images")
_SCHEMES = ("model://", "package://", "file://")
_ANCESTOR_COUNT = 5
_MAP_OPTION = re.compile(r"^-\w+(\s+(on|off|[-+]?[\d.]+))*\s+")


class FileFinder:
    """The files that a mesh file names: materials, textures, buffers. It is a resolver as trimesh takes them."""

    def __init__(self, mesh: Path) -> None:
        self.mesh = mesh
        self.file_name = mesh.name
        self.missing: list[str] = []

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
        """Whether the file of the materials is not there."""
        return any(name.lower().endswith(_MATERIAL_SUFFIX) for name in self.missing)

    def find(self, name: str) -> Path | None:
        """The file of this name: where the mesh file says, else in the usual folders beside it; None without one."""
        return next((found for each in self._candidates(_plain(name)) if (found := _on_disk(each))), None)

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
            for each in _TEXTURE_FOLDERS:
                yield folder / each / last


def corner_rgb(uv: np.ndarray, image: Image) -> np.ndarray:
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
        """Colours at positions, see `corner_rgb`, uint8 [corner, 3]."""
        found = corner_rgb(uv, self.image)
        if self.linear_factor is None:
            return found
        value = found.astype(np.float64) / 255.0
        light = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4) * self.linear_factor
        value = np.clip(light, 0.0, 1.0)
        value = np.where(value <= 0.0031308, 12.92 * value, 1.055 * value ** (1.0 / 2.4) - 0.055)
        return np.round(255.0 * value).astype(np.uint8)


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
