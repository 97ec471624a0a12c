"""A placement from a configuration."""

from __future__ import annotations

from warpav.rig.rig import Rig
from warpav.runs.config import Config
from warpav.runs.placement import Parts, Placement
from warpav.runs.rig_source import read_start
from warpav.runs.scene_set import load_scene_set


def build(config: Config, *, start: Rig | None = None) -> Placement:
    """The placement that a configuration describes; nothing is written.

    The rig of ``rig.start`` is read now, scenes and detector when they are first needed.

    Args:
        config: The configuration.
        start: The rig that ``rig.start`` means, where it has been read already.

    Raises:
        InputError: The rig of ``rig.start`` cannot be used.
    """
    parts = Parts(config, read_start(config) if start is None else start, config.rig.freeze)
    return Placement.of(parts, lambda progress: load_scene_set(config, progress))
