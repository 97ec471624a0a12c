"""The configuration: one tree, read strictly from YAML and ``key=value`` overrides.

Every mistake is reported at once, one line each: where it stands, the field, what was expected, what came, a hint.
Units are part of the names; lengths and angles in files may also carry their own (``20 cm``, ``1.57 rad``).
Relative paths are relative to the working directory.

What a file leaves out comes from the file that its ``extends`` names; what that leaves out too is as in ``quick``, or
with ``method: thesis`` as in ``thesis``.
"""

from warpav.runs.config._explain import COMMAND_LINE, DescribedOption, described_options, option_values
from warpav.runs.config._fields import AUTO, BY_HAND, MOST_CAMERAS, NAMED_STARTS, START_TEXT, read_seeds
from warpav.runs.config._load import (
    Config,
    dump_config,
    file_schema,
    flow_text,
    load_config,
    overridden_option,
    overrides_from,
    placed_config,
    with_absolute_paths,
)
from warpav.runs.config._schema import (
    KEPT_FILES,
    USUAL_OPTIONS,
    DetectorConfig,
    RigConfig,
    RunConfig,
    SceneConfig,
    config_dir,
    config_names,
    find_config,
)

__all__ = [
    "AUTO",
    "BY_HAND",
    "COMMAND_LINE",
    "KEPT_FILES",
    "MOST_CAMERAS",
    "NAMED_STARTS",
    "START_TEXT",
    "USUAL_OPTIONS",
    "Config",
    "DescribedOption",
    "DetectorConfig",
    "RigConfig",
    "RunConfig",
    "SceneConfig",
    "config_dir",
    "config_names",
    "described_options",
    "dump_config",
    "file_schema",
    "find_config",
    "flow_text",
    "load_config",
    "option_values",
    "overridden_option",
    "overrides_from",
    "placed_config",
    "read_seeds",
    "with_absolute_paths",
]
