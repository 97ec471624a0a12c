"""Warp device code of warpav: kernels and device functions. They compute and know only Warp; warpav launches them."""
