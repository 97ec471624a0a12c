"""Floor 6: ``warpav bench``, the renderer measured on one workload, beside other renderers and a truth."""
