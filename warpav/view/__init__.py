"""All that draws, in 2D and 3D; `plot` is its front door."""

from warpav.view._plotting import drawing_of, draws, kinds_of, plot
from warpav.view.output import Canvas

__all__ = ["Canvas", "drawing_of", "draws", "kinds_of", "plot"]
