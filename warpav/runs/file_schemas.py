"""JSON Schemas of the files that people write, by which editors complete and check them."""

from __future__ import annotations

from typing import Any

from warpav.core.json_schema import document
from warpav.rig.catalogue import modules_schema
from warpav.rig.rig import rig_schema
from warpav.rig.zone import zones_schema
from warpav.runs.config import Config
from warpav.sight.read import requirements_schema

_SCHEMAS = {"rig": rig_schema, "modules": modules_schema, "zones": zones_schema, "requirements": requirements_schema}
FILES = ("config", *_SCHEMAS)
"""Files that have a schema."""


def file_schema(of: str) -> dict[str, Any]:
    """The schema of one of `FILES`, draft 2020-12."""
    if of == "config":
        return document("config", "configuration of a run", Config.model_json_schema())
    return _SCHEMAS[of]()
