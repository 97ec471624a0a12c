"""Rigs in the files of other tools: `convert` knows all formats, imports and exports."""
