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
# # Bring your own vehicle and scenes
#
# **My vehicle is a van, my scenes are files. Where on its roof should four cameras go?** The embedded town has a car
# and streets of its own. This notebook takes a delivery van whose mesh has the usual mistakes, puts it into a folder of
# scenes, and optimises four cameras on it.

# %% tags=["parameters"]
train_seeds, test_seeds = range(18), range(18, 24)
fit_seeds, held_out_seeds = range(500000, 500020), range(500050, 500058)  # scenes that show what the detector finds

# %%
import json
import os
import struct
import tempfile
from pathlib import Path

import numpy as np

import warpav as wa

folder = tempfile.TemporaryDirectory()  # for the files of this notebook
os.chdir(folder.name)

# %% [markdown]
# You have a mesh already. Ours has to be made: in **centimetres**, with **y forward**, as many CAD programs export it.


# %%
def write_ply(path, vertex, triangle, rgb):
    """A mesh in one of the formats that are read."""
    properties = [f"property float {axis}" for axis in "xyz"] + [
        f"property uchar {name}" for name in ("red", "green", "blue")
    ]
    head = ["ply", "format ascii 1.0", f"element vertex {len(vertex)}", *properties]
    head += [f"element face {len(triangle)}", "property list uchar int vertex_indices", "end_header"]
    rows = [
        f"{x:.2f} {y:.2f} {z:.2f} {r:.0f} {g:.0f} {b:.0f}" for (x, y, z), (r, g, b) in zip(vertex, rgb, strict=True)
    ]
    Path(path).write_text("\n".join([*head, *rows, *("3 {} {} {}".format(*corner) for corner in triangle)]) + "\n")


made = wa.read_vehicle("panel_van")  # metres, x forward, y left, z up
x, y, z = made.vertex_m.T
in_the_file = 100.0 * np.stack([-y, x, z], axis=1)
write_ply("van.ply", in_the_file, made.triangle, made.vertex_rgb)

# %% [markdown]
# ## Four cameras on the van
#
# `wa.read_vehicle` takes the mesh into the vehicle's frame: metres, x forward, y left, z up, and the origin on the
# ground below the centre of the rear axle, which it finds by the wheels. Scenes are files too:

# %%
van = wa.read_vehicle("van.ply", up="z", forward="y", scale=0.01)
wa.write_scenes(wa.town([*train_seeds, *test_seeds]), "scenes")
scenes = wa.read_scenes("scenes")  # a file, a folder or a pattern
train, test = scenes[: len(train_seeds)], scenes[len(train_seeds) :]

# %% [markdown]
# The optimiser lowers the expected share of road users that no camera detects. How probable a detection is depends on
# what a camera sees, and from where: a van is higher than a car. This model is fitted once for each detector, camera
# and vehicle. An optimisation does it by itself, on 80 embedded scenes. Here fewer have to do:

# %%
fitted = wa.fit(wa.Config(), fit_seeds, held_out_seeds, ego=van)
placement = wa.Placement(train, cameras=4, ego=van, probability=fitted.model)
result = wa.optimise(placement)
wa.plot(result, scene=test[0])

# %%
print(f"area under the curve of the fit: {fitted.scores.auc:.3f} on other scenes (1 is perfect, 0.5 chance)")
result.rig

# %%
evaluation = wa.evaluate({"found": result.rig, "by hand": result.start}, test, placement)
evaluation.table()

# %% [markdown]
# *Objective* is what was lowered. Six test scenes do not show which rig is better; they show that van, scenes and
# detector work together. Use as many of your own scenes as you have: those that the optimiser sees decide how well its
# result carries over to others.
#
# ## Is the vehicle right?
#
# Coloured areas can carry a camera: they are part of the surface and face upwards. The windscreen and the rounded edges
# cannot. Look at the image: a van that drives backwards is also the same on its left and right. If your roof has rails
# or a hatch, cut them out of the mesh.

# %%
wa.plot(van, mount_surface=placement.mount.surface)

# %% [markdown]
# How do you know what is wrong with a file? The shape says it: vehicles are two to twenty metres long, their sides are
# alike, and wheels are below. Read in the usual way of its format, this file has a problem, and the problem has a
# remedy. A mesh that is wrong does not get into an optimisation either:

# %%
for use in (lambda: wa.read_vehicle("van.ply"), lambda: wa.Placement(train, ego=(in_the_file, made.triangle))):
    try:
        use()
    except wa.InputError as error:
        print(error)

# %% [markdown]
# ## What is in a scene's file?
#
# A scene is one GLB file with the nodes `environment`, `ego` and `vehicle_<id>`. Each vehicle has its class and its
# 3D box as extras ([the format](../warpav/scene/_glb.py)). Yours may come from a simulator, from a reconstruction
# (`warpav scenes reconstruct`) or from Blender. Read with nothing of warpav:

# %%
data = Path("scenes/scene_0.glb").read_bytes()
content = json.loads(data[20 : 20 + struct.unpack_from("<I", data, 12)[0]])
for node in sorted(content["nodes"], key=lambda node: node["name"]):
    extras = node.get("extras", {})
    if extras.get("role") in ("environment", "ego"):
        parts = content["meshes"][node["mesh"]]["primitives"]
        corners = sum(content["accessors"][part["indices"]]["count"] for part in parts)
        print(f"{node['name']:12} {corners // 3:6} triangles")
    elif extras.get("role") == "vehicle":
        box = ", ".join(f"{value:.1f}" for value in [*extras["box_center_m"], *extras["box_size_m"]])
        print(f"{node['name']:12} {extras['class']:10} box centre and size [m]: {box}")

# %% [markdown]
# Whatever writes such nodes makes scenes for warpav.
#
# ## What to do next
#
# - `result.save("runs/van", test=test)` keeps the run with a report that opens in a browser.
# - On the command line: `warpav vehicle check van.ply --scale 0.01 --up z --forward y --out van_ego.glb`, and then
#   `warpav optimise scenes.source=folder scenes.folder=scenes scenes.ego=van_ego.glb`.
# - Use [your own detector](05_own_detector.ipynb).
# - [Keep some cameras of a rig, and export it](../docs/guide/exchange.md).
