"""Rigs that are to bear errors of mounting against rigs that are not, on town scenes that neither was made on.

Left out of the ordinary run; ``pytest tests/benchmarks/test_mount_errors.py --benchmark-only --benchmark-json FILE``
runs it, a few minutes on a GPU, an hour on two cores. Extra figures are what rigs of both are expected to miss of 100
as designed and with errors by chance, which are others than those of the search, and the differences with 95 %
intervals over the scenes.
"""

import numpy as np
import pytest
import warp as wp

import warpav as wa
from warpav.core.devices import available_devices
from warpav.evaluation.statistics import paired_difference
from warpav.optimisation.mount_errors import COLUMNS, outside_skin
from warpav.optimisation.rig_values import single_cameras_of

CAMERAS, FOV_DEG = 6, 90.0
SCENES, UNSEEN, DRAWS = 40, range(20000, 20060), 64
