"""The networks of a folder, as a panel of detectors: each under a name and at the image size that is its own."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from warpav.core.errors import InputError
from warpav.runs.config import Config, changed_config, flow_text
from warpav.runs.networks import load_detector

if TYPE_CHECKING:
    from warpav.detection.onnx_detector import OnnxDetector

NETWORK_OPTIONS = ("detector.model", "detector.format", "detector.labels", "detector.classes", "detector.input_px")
"""Options that say what a network is: a panel asks the files."""


@dataclass(frozen=True)
class PanelNetwork:
    """A network of a panel.

    Attributes:
        name: The name of its file in lower-case letters, digits and underscores.
        file: Its ONNX file, absolute.
        width_px: Width of the images that it judges.
        height_px: Their height.
    """

    name: str
    file: Path
    width_px: int
    height_px: int

    @property
    def overrides(self) -> tuple[str, ...]:
        """What makes a configuration that of this network."""
        return (
            *_network_overrides(self.file),
            f"camera.width_px={self.width_px}",
            f"camera.height_px={self.height_px}",
        )

    def config(self, config: Config) -> Config:
        """The configuration with this network as its detector.

        Raises:
            InputError: The options do not fit each other.
        """
        return changed_config(config, self.overrides)


def networks_in(folder: Path, config: Config) -> list[PanelNetwork]:
    """The ONNX files of a folder, by name, each tried on an image.

    A file that fixes its input gets images that fill it, in the proportions of the configured camera; one that takes
    any size gets images of the configured size.

    Args:
        folder: The folder; its own folders are left aside.
        config: How to use them, all but `NETWORK_OPTIONS`.

    Raises:
        InputError: There is no such folder, or no network in it; two have one name; or one is no detector of the
            targets.
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
        detector = load_detector(changed_config(config, _network_overrides(file)))
        found.append(PanelNetwork(name, file, *_image_size_px(detector, config)))
    return found


def check_panel_options(option_names: Sequence[str]) -> None:
    """Reject options that a panel takes from its files.

    Raises:
        InputError: One of them is.
    """
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
