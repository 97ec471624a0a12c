"""Rigs in the files of other tools: `_convert` imports and exports those of all formats."""

RIG_FORMATS = {
    "nuscenes": "_data_sets",
    "argoverse2": "_data_sets",
    "urdf": "_ros",
    "camera-info": "_ros",
    "autoware": "_ros",
    "carla-ros-bridge": "_carla",
    "carla-python": "_carla",
    "kitti": "_data_sets",
    "opencv": "_calibration",
    "alpasim": "_alpasim",
    "driveworks": "_driveworks",
    "kalibr": "_calibration",
    "usd": "_usd",
}
"""Where the formats are, by name; each module has its `RigFormat` rows in ``FORMATS``."""
IMPORTED_ONLY, EXPORTED_ONLY = ("kalibr",), ("camera-info", "usd")
