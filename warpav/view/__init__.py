"""All that draws, in 2D and 3D; `plot` is its front door."""

from warpav.view.output import Canvas
from warpav.view.plotting import drawing_of, draws, kinds_of, plot

__all__ = ["Canvas", "drawing_of", "draws", "kinds_of", "plot"]
