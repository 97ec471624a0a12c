"""warpav: where cameras should sit on a vehicle, by gradient descent through a differentiable rasteriser.

Rooms, top to bottom; an import only ever points downwards (``[tool.importlinter]`` in ``pyproject.toml``):

    cli > experiments > runs > view > evaluation > optimisation > detection > rig, scene > raster > core, warpav_kernels
"""

import os

# onnxruntime opens connections to its maker's telemetry as soon as it is imported, and reads this only then. Here it is
# set before any import through warpav; processes that warpav starts inherit it.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")

__version__ = "0.1.0"
