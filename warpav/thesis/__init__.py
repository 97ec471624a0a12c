"""The thesis's method, to read beside its text; the default method imports nothing of it.

Section III.B is `_segregation`, III.C `_descent`; Eqs. 5 to 9 are `_constraints`, 10 to 24 `_losses`, the kernels of
both `warpav_kernels.thesis.losses`; Eq. 1 is `warpav.optimisation.losses._lagrangian`, 2 and 3 `warpav.raster.camera`.
The tables are in `_tables`; `_starts` and `_detector_gradient` go beyond the text.
"""

from warpav.core.face import face_of

__all__, __getattr__ = face_of(__name__)  # pyright: ignore[reportUnsupportedDunderAll]
