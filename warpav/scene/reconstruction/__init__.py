"""From captures to scenes: coloured point clouds of single objects, and triangle meshes through them."""
