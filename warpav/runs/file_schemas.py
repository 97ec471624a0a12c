"""JSON Schemas of the files that people write, by which editors complete and check them."""

from __future__ import annotations

from typing import Any

from warpav.core.records import schema_of
from warpav.rig.catalogue import ModulesForm
from warpav.rig.rig import RigForm
from warpav.rig.zone import ZonesForm
from warpav.runs.config import Config
from warpav.sight.read import RequirementsForm

_SCHEMAS = {
    "config": (Config, "configuration of a run"),
    "rig": (RigForm, "rig of cameras"),
    "modules": (ModulesForm, "catalogue of camera modules"),
    "zones": (ZonesForm, "zones of a vehicle's body that may carry cameras"),
    "requirements": (RequirementsForm, "requirements on the ground around a vehicle"),
}
FILES = tuple(_SCHEMAS)
"""Files that have a schema."""


def file_schema(of: str) -> dict[str, Any]:
    """The schema of one of `FILES`, draft 2020-12."""
    form, title = _SCHEMAS[of]
    return schema_of(form, of, title)
