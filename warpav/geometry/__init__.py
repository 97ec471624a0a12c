"""Floor 1: frames, meshes and the mount surface, in plain NumPy."""
