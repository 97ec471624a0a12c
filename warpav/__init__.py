"""warpav: where cameras should sit on a vehicle, by gradient descent through a differentiable rasteriser.

Floors, top to bottom; an import only ever points downwards:

    cli > run, method_figures > experiment > problem > gallery, inspection, scene_commands, scene_figures, bench,
    doctor, console, report > sources > collection > figures, view > results > config > blind_ground > evaluate
    > optimise > objective > detection > render > reconstruction > capture > rig, scene > geometry > recipe, executor,
    warp_setup > yaml_file, replacing > errors, warpav_kernels
"""

import os

# onnxruntime opens connections to its maker's telemetry as soon as it is imported, and reads this only then. Here it is
# set before any import through warpav; processes that warpav starts inherit it.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")

__version__ = "0.1.0"
