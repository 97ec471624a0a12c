"""The networks of a folder, as a panel of detectors: each under a name and at the image size that is its own."""

from __future__ import annotations

import difflib
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from warpav.core.errors import InputError
from warpav.core.yaml_file import read_yaml
from warpav.runs.config import Config, changed_config, flow_text
from warpav.runs.networks import load_detector

if TYPE_CHECKING:
    from warpav.detection.onnx_detector import OnnxDetector

NETWORK_OPTIONS = ("detector.model", "detector.format", "detector.labels", "detector.classes", "detector.input_px")
"""Options that say what a network is: a panel asks the files."""

DESCRIBED = ("format", "labels", "classes", "input_px", "confidence_min", "nms_iou_max")
"""Options of the section ``detector`` that the description of a network may set."""

IMAGE_SIZE = ("width_px", "height_px")
"""Size of the images that a network judges, in its description."""


@dataclass(frozen=True)
class PanelNetwork:
    """A network of a panel."""

    name: str  # the name of its file in lower-case letters, digits and underscores
    file: Path  # its ONNX file, absolute
    width_px: int  # width of the images that it judges
    height_px: int  # their height
    described: tuple[str, ...] = ()  # options that its description sets, as overrides

    @property
    def overrides(self) -> tuple[str, ...]:
        """What makes a configuration that of this network."""
        return (
            *_network_overrides(self.file),
            *self.described,
            f"camera.width_px={self.width_px}",
            f"camera.height_px={self.height_px}",
        )

    def config(self, config: Config) -> Config:
        """The configuration with this network as its detector."""
        return changed_config(config, self.overrides)


def networks_in(folder: Path, config: Config) -> list[PanelNetwork]:
    """The ONNX files of a folder, by name, each tried on an image.

    A file that fixes its input gets images that fill it, in the proportions of the configured camera; one that takes
    any size gets images of the configured size. Beside ``name.onnx`` may lie ``name.yaml``, its description: options
    of the section ``detector`` (`DESCRIBED`) that the file itself does not tell, and the size of its images
    (`IMAGE_SIZE`).
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: expected a folder of ONNX files, got {'a file' if folder.exists() else 'none'}")
    files = sorted(file for file in folder.iterdir() if file.suffix.lower() == ".onnx" and file.is_file())
    if not files:
        raise InputError(f"{folder}: expected ONNX files such as yolox_nano_coco.onnx, got none")
    named: dict[str, Path] = {}
    for file in files:
        name = re.sub(r"[^a-z0-9]+", "_", file.stem.lower()).strip("_")
        if not name:
            raise InputError(f"{file}: expected a name with letters or digits, got none; rename the file")
        if name in named:
            raise InputError(
                f"{folder}: expected networks of different names, got {named[name].name} and {file.name}, both {name}; "
                "rename one of them"
            )
        named[name] = file.absolute()
    found = []
    for name, file in named.items():
        described, size_px = _description(file.with_suffix(".yaml"))
        detector = load_detector(changed_config(config, (*_network_overrides(file), *described)))
        found.append(PanelNetwork(name, file, *(size_px or _image_size_px(detector, config)), described))
    return found


def _description(file: Path) -> tuple[tuple[str, ...], tuple[int, int] | None]:
    """What the description of a network says, if there is one: overrides, and the size of its images."""
    if not file.is_file():
        return (), None
    data, line_of = read_yaml(file)
    known = (*DESCRIBED, *IMAGE_SIZE)
    if not isinstance(data, dict):
        raise InputError(f"{file}: expected options of a network such as input_px: 640, got {type(data).__name__}")
    for name in data:
        if name not in known:
            near = difflib.get_close_matches(name, known, 1)
            hint = f"; did you mean {near[0]}?" if near else ""
            raise InputError(f"{file}:{line_of[(name,)]}: expected one of {', '.join(known)}, got {name!r}{hint}")
    overrides = tuple(f"detector.{name}={flow_text(data[name])}" for name in DESCRIBED if name in data)
    width_px, height_px = (data.get(name) for name in IMAGE_SIZE)
    if width_px is None and height_px is None:
        return overrides, None
    if type(width_px) is not int or type(height_px) is not int or min(width_px, height_px) < 1:
        raise InputError(
            f"{file}: width_px and height_px: expected two whole numbers above 0, got {width_px} and {height_px}"
        )
    return overrides, (width_px, height_px)


def check_panel_options(option_names: Sequence[str]) -> None:
    """Reject options that a panel takes from its files."""
    for option in option_names:
        if option.startswith(NETWORK_OPTIONS):
            raise InputError(
                f"command line ({option}): expected an option that all networks of a panel share, got one that each "
                "file answers; leave it out"
            )


def _network_overrides(file: Path) -> tuple[str, ...]:
    return (
        f"detector.model={flow_text(str(file.absolute()))}",
        "detector.format=auto",
        "detector.labels=null",
        "detector.classes={}",
        "detector.input_px=null",
    )


def _image_size_px(detector: OnnxDetector, config: Config) -> tuple[int, int]:
    """Width and height of the images that a network judges."""
    width_px, height_px = config.camera.width_px, config.camera.height_px
    if detector.takes_any_size:
        return width_px, height_px
    rows, columns = detector.input_size_px(height_px, width_px)
    scale = min(columns / width_px, rows / height_px)
    return max(1, round(width_px * scale)), max(1, round(height_px * scale))
