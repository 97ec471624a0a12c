"""Rigs in the files of other tools: `_convert` knows all formats, imports and exports."""
