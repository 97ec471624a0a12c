"""Types of the public names; ``__init__.py`` imports them (and Warp) when they are first used."""

from warpav.raster.areas import Areas as Areas
from warpav.raster.areas import Measures as Measures
from warpav.raster.camera import Cameras as Cameras
from warpav.raster.frame import Frame as Frame
from warpav.raster.mesh import Mesh as Mesh
from warpav.raster.renderer import render as render
from warpav.raster.scene import Scene as Scene
