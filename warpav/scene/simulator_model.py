"""What a simulator's model says of its mesh: the scale and the direction that ``model.sdf`` beside it states."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from warpav.core.bounded_files import parse_xml, read_bytes
from warpav.core.errors import InputError

MODEL_FILE = "model.sdf"

_ANGLE_TOLERANCE_RAD = 1e-3


@dataclass(frozen=True)
class SimulatorModel:
    """How a model uses a mesh."""

    path: Path  # the model's file
    scale: float  # factor from the mesh's numbers, in its own unit, to metres
    # The mesh's axis that points to the front, where the model turns the mesh to face along x; else None.
    forward: str | None


def simulator_model(mesh: Path) -> SimulatorModel | None:
    """The model of a mesh file, in its folder or in the one above; None where no model names it, or none can be read.

    Of several uses of the mesh the first one counts. Models that do not turn their mesh say nothing about its front:
    some face along x, others do not.
    """
    for folder in (mesh.absolute().parent, mesh.absolute().parent.parent):
        path = folder / MODEL_FILE
        try:
            root = parse_xml(read_bytes(path, "a model"), str(path), "a model")
        except InputError:
            continue
        for visual in (*root.iter("visual"), *root.iter("collision")):
            shape = visual.find("geometry/mesh")
            if shape is None or PurePosixPath(shape.findtext("uri", "").strip()).name != mesh.name:
                continue
            try:
                return SimulatorModel(path, _scale(shape), _forward(visual))
            except ValueError:
                continue
    return None


def _scale(shape: ET.Element) -> float:
    """The scale, the same along all axes."""
    value = [float(each) for each in shape.findtext("scale", "1 1 1").split()]
    if len(value) != 3 or not 0.0 < value[0] < math.inf or max(value) - min(value) > 1e-9 * value[0]:
        raise ValueError(value)
    return value[0]


def _forward(visual: ET.Element) -> str | None:
    pose = [float(each) for each in visual.findtext("pose", "0 0 0 0 0 0").split()]
    if len(pose) != 6 or max(abs(pose[3]), abs(pose[4])) > _ANGLE_TOLERANCE_RAD:
        return None
    quarter = round(pose[5] / (0.5 * math.pi))
    if abs(pose[5] - quarter * 0.5 * math.pi) > _ANGLE_TOLERANCE_RAD:
        return None
    return (None, "-y", "-x", "y")[quarter % 4]
