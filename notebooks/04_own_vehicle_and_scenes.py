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
# **My vehicle is a van, my scenes are files. Where can cameras go on its roof, and where should they?** The embedded
# town has a car and streets of its own. This notebook takes a delivery van whose mesh has the usual mistakes, puts it
# into a folder of scenes, and optimises four cameras on it.

# %% tags=["parameters"]
train_seeds, test_seeds = range(18), range(18, 24)
fit_seeds, held_out_seeds = range(500000, 500020), range(500050, 500058)  # scenes that show what the detector finds

# %%
import os
import tempfile

import numpy as np
import trimesh

import warpav as wa
from warpav.rig.mount_surface import mount_surface_from_mesh
from warpav.scene.own_vehicle import Reading, examine, read_vehicle_file

folder = tempfile.TemporaryDirectory()  # for the files of this notebook
os.chdir(folder.name)

# %% [markdown]
# You have a mesh already. Ours has to be made: in **centimetres**, with **z up** and **y forward**, as many CAD
# programs export it, although a GLB file should be in metres with y up.

# %%
from warpav.scene.town.vehicle_shapes import vehicle_mesh

made = vehicle_mesh("van", paint=np.array([0.05, 0.25, 0.35]))  # metres, x forward, y left, z up
x, y, z = made.vertex_m.T
in_the_file = 100.0 * np.stack([-y, x, z], axis=1)
_ = trimesh.Trimesh(in_the_file, made.triangle, vertex_colors=made.vertex_rgb, process=False).export("van.glb")

# %% [markdown]
# ## Into the frame of the vehicle
#
# warpav wants metres, x forward, y left, z up, and the origin on the ground below the centre of the rear axle.
# `Reading` says what the axes and the unit of the file mean; `examine` finds the ground and the wheels, and moves the
# mesh to where it belongs. Coloured areas can carry a camera: they are part of the surface and face upwards. The
# windscreen and the rounded edges cannot.

# %%
found = examine(read_vehicle_file("van.glb"), Reading(up="z", forward="y", scale=0.01))
van = found.corrected
wa.plot(
    van, mount_surface=mount_surface_from_mesh(van), axle_m=[axle + found.shift_m[0] for axle in found.wheels.axle_m]
)

# %% [markdown]
# Look at the image: a van that drives backwards is also the same on its left and right. If your roof has rails or a
# hatch, cut them out of the mesh.
#
# How do you know what is wrong with a file? The shape says it: vehicles are two to twenty metres long, their sides are
# alike, and wheels are below. Read in the usual way of its format, this file has a problem, and the problem has a
# remedy:

# %%
file = read_vehicle_file("van.glb")
for problem in examine(file, file.usual).problems:
    print(problem.text, problem.remedy, sep="\n  ")

# %% [markdown]
# A mesh that is wrong does not get into an optimisation either:

# %%
try:
    wa.Placement(wa.town([0]), ego=(in_the_file, made.triangle))
except wa.InputError as error:
    print(error)

# %% [markdown]
# ## A folder of scenes
#
# A scene is one GLB file with the nodes `environment`, `ego` and `vehicle_<id>`. Each vehicle has its class and its
# 3D box as extras ([the format](../warpav/scene/glb.py)). Yours may come from a simulator, from a reconstruction
# (`warpav scenes reconstruct`) or from Blender. Ours are streets of the embedded town, written as files:

# %%
from warpav.scene.glb import write_scene

os.mkdir("scenes")
for seed, scene in zip([*train_seeds, *test_seeds], wa.town([*train_seeds, *test_seeds]), strict=True):
    write_scene(scene, f"scenes/scene_{seed:02d}.glb")

# %% [markdown]
# What such a file holds, read with nothing of warpav:

# %%
content = trimesh.load_scene("scenes/scene_00.glb")
for _, node, edge in sorted(content.graph.to_edgelist(), key=lambda edge: edge[1]):
    extras = edge.get("metadata", {})
    if extras.get("role") in ("environment", "ego"):
        print(f"{node:12} {len(content.geometry[edge['geometry']].faces):6} triangles")
    elif extras.get("role") == "vehicle":
        box = ", ".join(f"{value:.1f}" for value in [*extras["box_center_m"], *extras["box_size_m"]])
        print(f"{node:12} {extras['class']:10} box centre and size [m]: {box}")

# %% [markdown]
# `wa.read_scenes` reads a file, a folder or a pattern. Here the first scenes are for the optimiser, and the others
# for the evaluation:

# %%
scenes = wa.read_scenes("scenes")
train, test = scenes[: len(train_seeds)], scenes[len(train_seeds) :]
wa.plot(test[0], zoom=0.7)

# %% [markdown]
# ## What the detector finds from a van
#
# The optimiser lowers the expected share of road users that no camera detects. How probable a detection is depends on
# what a camera sees, and from where: the roof of a van is higher than that of a car. This model is fitted once for each
# detector, camera and vehicle. An optimisation does it by itself, on 80 embedded scenes. Here fewer have to do:

# %%
from warpav.core.progress import NullProgress
from warpav.runs.detector_fit import FitSeeds, fit

seeds = FitSeeds(tuple(fit_seeds), tuple(held_out_seeds))
fitted = fit(wa.Config(), seeds, ego=van, progress=NullProgress())
print(
    f"area under the curve, on {len(seeds.held_out)} other scenes: {fitted.scores.auc:.3f} (1 is perfect, 0.5 chance)"
)

# %% [markdown]
# ## Four cameras on the van
#
# `ego` puts your vehicle into the place of the scenes' own:

# %%
placement = wa.Placement(train, cameras=4, ego=van, probability=fitted.model)
result = wa.optimise(placement)
wa.plot(result, scene=test[0])

# %%
evaluation = wa.evaluate({"optimised": result.rig, "by_hand": result.start}, test, placement)
evaluation.table()

# %% [markdown]
# *Objective* is what was lowered. Six test scenes do not prove which rig is better; they show that van, scenes and
# detector work together. Use as many of your own scenes as you have: those that the optimiser sees decide how well its
# result carries over to others.
#
# ## What to do next
#
# - `result.save("runs/van", test=test)` keeps the run with a report that opens in a browser.
# - On the command line: `warpav vehicle check van.glb --scale 0.01 --up z --forward y --out van_ego.glb`, and then
#   `warpav optimise scenes.source=folder scenes.folder=scenes scenes.ego=van_ego.glb`.
# - Use [your own detector](05_own_detector.ipynb).
# - [Keep some cameras of a rig, and export it](../docs/guide/exchange.md).
