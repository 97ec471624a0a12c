"""Pyvista pictures of rigs and scenes. Importing a module of this package does not import pyvista."""
