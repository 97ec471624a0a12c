"""Floor 8: pyvista pictures of rigs and scenes. Importing a module of this package does not import pyvista."""
