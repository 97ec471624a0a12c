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
# A vehicle has cameras already, and two of them have to stay: one in the grille, one above the rear number plate.
# Where on the roof should two more sit? This notebook starts from that rig, lets warpav place the other two, looks at
# what the result sees and does not see, and hands it to Autoware, CARLA and ROS, with a check that every format says
# the same poses.

# %% tags=["parameters"]
import os
from pathlib import Path

os.environ.update(TRAIN="0..15", ITERATIONS="40", STARTS="16")
exported = Path(_dh[0]) / "exported"  # noqa: F821 (where Jupyter began); what is worth keeping goes there

# %%
import shutil
import tempfile

import numpy as np
from IPython.display import Image
from scipy.spatial.transform import Rotation

from warpav.rig.rig import read_rig
from warpav.runs.scene_set import load_scene

folder = tempfile.TemporaryDirectory()  # what is written below goes here
os.chdir(folder.name)

# %% [markdown]
# ## The rig as it is
#
# A rig file lists cameras with their places in the ego frame (metres; x forward, y left, z up, from the ground below
# the rear axle) and angles in degrees: yaw left-positive, pitch nose-down positive. `warpav rig import` makes such a
# file of another tool's, and `warpav rig presets` lists known vehicles such as nuScenes's. Ours is short enough to be
# written by hand. The two on the roof are named after no side, for they may end up on the other:

# %% language="bash"
# lens="fov_deg: 90, width_px: 256, height_px: 256"
# cat > mine.yaml << END
# frame: ego
# cameras:
#   - {name: front, position_m: [3.75, 0.0, 0.7], yaw_deg: 0, pitch_deg: 0, roll_deg: 0, $lens}
#   - {name: rear, position_m: [-1.05, 0.0, 0.85], yaw_deg: 180, pitch_deg: 0, roll_deg: 0, $lens}
#   - {name: roof_1, position_m: [0.6, 0.3, 1.78], yaw_deg: 90, pitch_deg: 0, roll_deg: 0, $lens}
#   - {name: roof_2, position_m: [0.6, -0.3, 1.78], yaw_deg: -90, pitch_deg: 0, roll_deg: 0, $lens}
# END
# warpav rig check mine.yaml

# %% [markdown]
# `rig check` lists the cameras, names what is odd about them, and says which formats can hold the rig. In a picture:

# %%
Image(read_rig("mine.yaml").plot("mine.png", scene=load_scene("1000")), width=800)

# %% [markdown]
# ## Two stay, two move
#
# `rig.freeze` names the cameras that stay as they are, wherever they stand; the others are optimised around them, on
# the roof or the bonnet:

# %% language="bash"
# warpav optimise rig.start=mine.yaml "rig.freeze=[front, rear]" rig.cameras=4 run.out=run \
#     scenes.train_seeds=$TRAIN scenes.test_seeds=1000..1005 run.iterations=$ITERATIONS \
#     optimiser.starts=$STARTS > progress.txt
# tail -n 5 progress.txt
# warpav rig check run

# %% [markdown]
# The fixed cameras stand where they stood, to the last digit. The objective on the training scenes falls a little, and
# so may the recall on the test scenes: the interval of its difference reaches 0, as six scenes are too few to tell this
# rig from the one it started from.
#
# ## What it sees
#
# `warpav inspect` opens a window when there is a display: go through the iterations, look through a camera, drag
# cameras over the roof while coverage follows, save the rig. With `--out` it draws a picture. First the blind spots:
# where would a child of 1.1 m be seen by no camera (red), by one, by two, by more?

# %% language="bash"
# warpav inspect run --show coverage --out coverage.png
# warpav inspect run --show outcomes --out outcomes.png
# warpav inspect run --show visibility --out visibility.png

# %%
Image("coverage.png", width=800)

# %% [markdown]
# Then a test scene: which vehicles does the detector find, which does it miss, which are hidden?

# %%
Image("outcomes.png", width=800)

# %% [markdown]
# And what every camera sees, up to what stands in its way:

# %%
Image("visibility.png", width=800)

# %% [markdown]
# ## Into other tools
#
# `rig export` takes a run folder, a rig file or a preset. Formats differ in axes, signs and in where their origin
# lies: CARLA's vehicles have theirs near the middle, so the option `--origin-m` says where that is on yours, here
# 1.36 m before the rear axle. Where it is not given, the file's origin is taken to be warpav's.

# %% language="bash"
# warpav rig export run --format autoware --out autoware
# warpav rig export run --format urdf --out car.urdf
# warpav rig export run --format carla-ros-bridge --out objects.json --origin-m 1.36 0 0
# warpav rig export run --format carla-python --out sensors.json --origin-m 1.36 0 0
# cat sensors.json

# %% [markdown]
# The two CARLA dialects use the same keys and mean different things: the ros-bridge's y points left, like ROS's, the
# Python interface's y points right, and yaw and pitch turn the other way. A rig that is loaded in the wrong one is
# mirrored, and looks almost right. So warpav never guesses the dialect; you name it.
#
# ## Do they say the same?
#
# Import everything again and compare:

# %% language="bash"
# warpav rig import autoware --format autoware --out autoware.yaml > import.txt
# warpav rig import car.urdf --format urdf --out urdf.yaml >> import.txt
# warpav rig import objects.json --format carla-ros-bridge --origin-m 1.36 0 0 --out carla-ros-bridge.yaml >> import.txt
# warpav rig import sensors.json --format carla-python --origin-m 1.36 0 0 --out carla-python.yaml >> import.txt

# %%
rig = read_rig("run/rig_best.yaml")
for name in ("autoware", "urdf", "carla-ros-bridge", "carla-python"):
    again = {camera.name: camera.ego_from_camera for camera in read_rig(f"{name}.yaml").cameras}
    shift_m, turn_rad = 0.0, 0.0
    for camera in rig.cameras:
        difference = np.linalg.inv(camera.ego_from_camera) @ again[camera.name]
        shift_m = max(shift_m, np.linalg.norm(difference[:3, 3]))
        turn_rad = max(turn_rad, Rotation.from_matrix(difference[:3, :3]).magnitude())
    print(
        f"{name:17} {len(again)} cameras, off by {1e6 * shift_m:.2f} µm and {np.degrees(turn_rad):.1e} degrees at most"
    )

# %% [markdown]
# That is rounding, so they can be handed over. The files, and the run that they come from, are kept beside this
# notebook, in the folder `exported`:

# %%
shutil.copytree(folder.name, exported, dirs_exist_ok=True)
print(*sorted(path.name for path in exported.iterdir()), sep="\n")

# %% [markdown]
# Images are small here so that a run is short; for your own cameras write their true size and lens
# into the rig file, and `camera.width_px`, `camera.height_px` into the run. Formats with lens models of their own
# (`opencv`, `kitti`, `nuscenes`, `argoverse2`, `camera-info`; `kalibr` to import) work the same way: [which hold
# what](../warpav/rig/design.md).
