"""warpav: where cameras should sit on a vehicle, by gradient descent through a differentiable rasteriser.

Floors, top to bottom; an import only ever points downwards:

    cli > run > gallery, doctor, console, report > sources > figures, view > results > config > evaluate > optimise
    > objective > detection > render > rig, scene > geometry > yaml_file > errors, warpav_kernels
"""

__version__ = "0.1.0"
