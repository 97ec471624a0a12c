"""Camera rigs of known vehicles, one YAML file each; the head of a file names its source and licence."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from warpav.core.errors import InputError
from warpav.core.records import nearest
from warpav.raster.mesh import Mesh
from warpav.rig._on_body import Body, MovedRig, put_on_body
from warpav.rig._rig import Rig, read_rig

HAND_RIGS = ("corners", "cross", "edge", "highest")
"""Names of rigs by hand, which need a vehicle to stand on; ``highest`` is the thesis's baseline."""

_FOLDER = Path(__file__).parent
_MESHES = (".glb", ".gltf", ".obj", ".ply", ".stl", ".dae", ".off", ".step", ".stp")

_BODIES = {
    # length, width without mirrors, height and wheelbase, as the vehicles' makers state them
    "nuscenes": Body.of_size(4.084, 1.730, 1.562, wheelbase_m=2.588),  # Renault Zoe
    "argoverse2": Body.of_size(4.872, 1.852, 1.473, wheelbase_m=2.850),  # Ford Fusion Hybrid
    "edgar": Body.of_size(4.973, 1.941, 1.903, wheelbase_m=3.124),  # Volkswagen T7 Multivan, the shorter one
    # of layouts that no preset has (warpav/experiments/layouts)
    "robotaxi": Body.of_size(4.682, 1.895, 1.566, wheelbase_m=2.990),
    "series": Body.of_size(4.720, 1.850, 1.443, wheelbase_m=2.875),
}
"""Bodies that presets and layouts were made for; unidrive_6x60 is of no vehicle."""

AS_BUILT = {"nuscenes": "", "argoverse2": "ring", "edgar": "basler_sr"}
"""Presets of vehicles that were built, and how the names of their cameras that look all round begin."""


def preset_names() -> list[str]:
    """Names of the shipped rigs, sorted, such as ``nuscenes``."""
    return sorted(file.stem for file in _FOLDER.glob("*.yaml"))


def preset_rig(name: str) -> Rig:
    """The shipped rig of this name.

    Args:
        name: One of :func:`preset_names`.

    Returns:
        The rig, in the ego frame of its own vehicle; the comment at the top of its file describes the origin.

    Raises:
        InputError: There is no such rig.
    """
    return read_rig(_preset_file(name))


def preset_on_vehicle(name: str, vehicle: Mesh, rig: Rig | None = None) -> MovedRig:
    """The shipped rig of this name on another vehicle, as its makers put it on theirs; see `put_on_body`.

    ``rig``: another one that was made for the same vehicle.
    """
    return put_on_body(preset_rig(name) if rig is None else rig, vehicle, made_for=_BODIES.get(name))


def _preset_file(name: str) -> Path:
    names = preset_names()
    if name not in names:
        raise InputError(f"rig preset: expected one of {', '.join(names)}, got {name!r}{nearest(name, names)}")
    return _FOLDER / f"{name}.yaml"


@dataclass(frozen=True)
class _PresetAbout:
    """Information in the comment at the top of a preset file."""

    title: str
    source: str
    licence: str


def preset_about(name: str) -> _PresetAbout:
    """What is known of a shipped rig; ``name`` is one of :func:`preset_names`."""
    head: dict[str, str] = {}
    key = "title"
    for line in (_FOLDER / f"{name}.yaml").read_text(encoding="utf-8").splitlines():
        if not line.startswith("#") or line.startswith("# Cameras in the vehicle's frame"):
            break
        text = line.removeprefix("#").strip()
        word, colon, rest = text.partition(": ")
        if colon and word in ("Source", "Licence", "Notes"):
            key, text = word.lower(), rest
        head[key] = f"{head[key]} {text}" if key in head else text
    return _PresetAbout(head["title"], head["source"], head["licence"])


def is_preset(source: str) -> bool:
    """Whether a preset has this name."""
    return source in preset_names()


def find_rig_file(source: str) -> Path:
    """The file of a rig YAML or a preset."""
    file = Path(source).expanduser()
    if file.is_file():
        if file.suffix.lower() in _MESHES:
            raise InputError(f"{source}: rig: expected a rig YAML, got a mesh; give a vehicle as scenes.ego={source}")
        return file
    names = preset_names()
    if source in names:
        return _preset_file(source)
    raise InputError(
        f"{source}: rig: expected a rig YAML, a run folder, a preset ({', '.join(names)}) or one by hand "
        f"({', '.join(HAND_RIGS)}), got no file of that name{nearest(source, [*names, *HAND_RIGS])}"
    )
