"""The thesis's method, to read beside its text; the default method imports nothing of it.

Section III.B is `segregation`, III.C `descent`; Eqs. 5 to 9 are `constraints`, 10 to 24 `losses`, the kernels of both
`warpav_kernels.thesis.losses`; Eq. 1 is `warpav.optimisation.losses._lagrangian`, 2 and 3 `warpav.raster.camera`.
The tables are in `tables`; `starts` and `detector_gradient` go beyond the text.
"""
