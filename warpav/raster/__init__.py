"""The rasteriser: meshes and cameras in; object ids, depths, colours, areas and their derivatives out."""
