"""Floor 8: pyvista pictures of rigs and scenes."""
