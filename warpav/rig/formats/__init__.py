"""Rigs in the files of other tools: one module a format; `formats` knows them all, imports and exports."""
