# ---
# jupyter:
#   jupytext:
#     formats: ipynb,py:percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # Inspect and export a rig
#
# **A vehicle has two cameras that have to stay, one in the grille and one above the rear number plate. Where on the
# roof should two more sit, what do all four see, and how does the result get into Autoware, CARLA and ROS?** This
# notebook writes the rig in Python, looks at its blind spots, optimises two cameras around the other two, and checks
# that every exported file holds the same poses.

# %% tags=["parameters"]
train_seeds, test_seeds = range(60), range(5000, 5010)

# %%
import math
import tempfile
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

import warpav as wa

train, test = wa.town(train_seeds), wa.town(test_seeds)

# %% [markdown]
# ## The rig as it is
#
# Positions are in the ego frame: metres, x forward, y left, z up, from the ground below the rear axle. Yaw is positive
# to the left, pitch nose down. `wa.read_rig` reads a rig from YAML, `wa.preset("nuscenes")` gives a known vehicle's,
# `wa.import_rig` reads the files of other tools. This one is short enough to write by hand:

# %%
lens = wa.CameraModel(width_px=256, height_px=256, fov_rad=math.radians(90))


def camera(name, position_m, yaw_deg):
    return wa.Camera(name, np.array(position_m), math.radians(yaw_deg), pitch_rad=0.0, roll_rad=0.0, model=lens)


start = wa.Rig(
    [
        camera("front", [3.75, 0.0, 0.7], 0),
        camera("rear", [-1.05, 0.0, 0.85], 180),
        camera("roof_1", [0.6, 0.3, 1.78], 90),
        camera("roof_2", [0.6, -0.3, 1.78], -90),
    ]
)
start

# %% [markdown]
# ## What it does not see
#
# A `Placement` joins the rig with traffic, vehicle and detector. `freeze` names the cameras that keep their poses,
# wherever they are; the others may move over roof and bonnet.
#
# Where would a child of 1.1 m be seen by no camera (red), by one, by two, by more?

# %%
placement = wa.Placement(train, start=start, freeze=["front", "rear"])
wa.plot(start, scene=test[0], coverage=wa.coverage(start, test[0]))

# %% [markdown]
# ## Two stay, two move

# %%
result = wa.optimise(placement)
wa.plot(result, scene=test[0])

# %%
result.rig

# %% [markdown]
# The frozen cameras are where they were, to the last digit. Did the other two gain anything? The evaluation takes
# scenes that the optimiser has not seen:

# %%
evaluation = wa.evaluate({"optimised": result.rig, "start": start}, test, placement)
evaluation.table()

# %%
difference = evaluation.difference("optimised", "start")
print(
    f"recall, optimised - start: {difference.mean:+.3f} "
    f"(95 % interval over {difference.scenes} scenes: {difference.low:+.3f} to {difference.high:+.3f})"
)

# %% [markdown]
# Ten scenes are few. Where the interval contains 0, they cannot tell the two rigs apart; the published results use
# fifty.
#
# ## What it sees
#
# One test scene: which vehicles does the detector find, which does it miss, which are hidden? `evaluation.objects`
# has this for every vehicle, with the cameras that see and detect it.

# %%
seen = [each for each in evaluation.objects if each.scene == test[0].name]
wa.plot(result.rig, scene=test[0], outcomes=[each.outcome["optimised"] for each in seen])

# %%
for each in sorted(seen, key=lambda each: each.distance_m):
    cameras = ", ".join(each.detected_by["optimised"]) or "none"
    print(f"{each.category:10} at {each.distance_m:4.1f} m, {each.bearing_deg:+4.0f} deg: detected by {cameras}")

# %% [markdown]
# What every camera sees, each in its own colour. The sides of its view end where something hides what lies behind:

# %%
wa.plot(result.rig, scene=test[0], visibility=True)

# %% [markdown]
# `warpav inspect` shows the same in a window in which you can drag cameras over the roof.
#
# ## Into other tools
#
# Formats differ in axes, signs and origin. The origin of CARLA's vehicles lies near their middle, so `origin_m` says
# where that is on this vehicle: here 1.36 m before the rear axle.

# %%
folder = tempfile.TemporaryDirectory()
target = Path(folder.name)
middle_m = (1.36, 0.0, 0.0)
exports = {  # format: where to, and its origin in the ego frame
    "autoware": (target / "sensor_kit", None),
    "urdf": (target / "car.urdf", None),
    "carla-ros-bridge": (target / "objects.json", middle_m),
    "carla-python": (target / "sensors.json", middle_m),
}
for name, (file, origin_m) in exports.items():
    files = wa.export_rig(result.rig, name, file, origin_m=origin_m)
    print(f"{name:17}", *(each.relative_to(target) for each in files))
print()
print((target / "sensors.json").read_text())

# %% [markdown]
# The two dialects of CARLA use the same keys with different meanings: y points left for the ROS bridge and right for
# the Python interface, and yaw and pitch turn the other way. A rig read in the wrong dialect is mirrored, and is
# almost right. So warpav never guesses the dialect.
#
# ## Do the files agree?
#
# Import everything again and compare the poses:

# %%
for name, (file, origin_m) in exports.items():
    again = wa.import_rig(file, name, origin_m=origin_m)
    shift_m, turn_rad = 0.0, 0.0
    for one, other in zip(result.rig.cameras, again.cameras, strict=True):
        assert one.name == other.name
        difference = np.linalg.inv(one.ego_from_camera) @ other.ego_from_camera
        shift_m = max(shift_m, np.linalg.norm(difference[:3, 3]))
        turn_rad = max(turn_rad, Rotation.from_matrix(difference[:3, :3]).magnitude())
    print(f"{name:17} off by at most {1e6 * shift_m:.2f} µm and {np.degrees(turn_rad):.0e} degrees")

# %% [markdown]
# The differences are rounding in the files.
#
# ## What to do next
#
# - Images are small here so that the run is short. For your cameras give `CameraModel` their true size and lens.
# - Keep the rig with `wa.write_rig(result.rig, "rig.yaml")`, or the whole run with `result.save("runs/mine")`, and
#   open it with `warpav inspect runs/mine`.
# - AlpaSim, OpenCV, KITTI, nuScenes, Argoverse 2, camera_info and Kalibr work in the same way: [which format holds
#   what](../warpav/rig/design.md).
# - Place the cameras for [your own detector](04_own_detector.ipynb).
