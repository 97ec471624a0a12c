"""warpav: which cameras a vehicle should carry and where, by search with a bound and by gradients.

This is the public API; every name is imported when it is first used. ``warpav.raster`` is the rasteriser on its own.

The packages below this one stand in layers, which ``pyproject.toml`` lists under ``[tool.importlinter]``: imports only
point downwards.
"""

import os

from warpav.core.face import face_of

# onnxruntime opens connections to its maker's telemetry as soon as it is imported, and reads this only then. Here it is
# set before any import through warpav; processes that warpav starts inherit it.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")

__version__ = "0.1.0"

__all__, __getattr__ = face_of(__name__)  # pyright: ignore[reportUnsupportedDunderAll]


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
