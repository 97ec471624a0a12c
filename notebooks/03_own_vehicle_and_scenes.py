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
# The embedded town has an estate car and streets of its own. You have another vehicle, as a mesh out of some CAD or
# game program, and perhaps scenes. This notebook takes a delivery van whose file is wrong in the usual ways, finds
# out what is wrong, mends it, puts it into a folder of scenes, and optimises four cameras on its roof and bonnet.

# %% tags=["parameters"]
import os

os.environ.update(
    SCENES="0..23",  # seeds of the folder's scenes
    TRAIN="0..17",
    TEST="18..23",
    FIT="500000..500019",  # scenes on which to learn what the detector sees from the van
    HELD_OUT="500050..500057",
    ITERATIONS="60",
)

# %%
import tempfile

import numpy as np
import trimesh
from IPython.display import Image

from warpav.runs.progress import RunDisplay
from warpav.runs.run_folder import RunFolder
from warpav.runs.verdict import arm_table
from warpav.scene.glb import read_scene
from warpav.scene.town.vehicle_shapes import vehicle_mesh

folder = tempfile.TemporaryDirectory()  # what is written below goes here
os.chdir(folder.name)

# %% [markdown]
# ## A vehicle as it comes
#
# You have a file already. Ours has to be made: a van in **centimetres**, with **z up** and **y forward**, as many CAD
# programs write it, although a GLB is supposed to be in metres with y up.

# %%
van = vehicle_mesh("van", paint=np.array([0.05, 0.25, 0.35]))  # metres, x forward, y left, z up
x, y, z = van.vertex_m.T
in_the_file = 100.0 * np.stack([-y, x, z], axis=1)
_ = trimesh.Trimesh(in_the_file, van.triangle, vertex_colors=van.vertex_rgb, process=False).export("van.glb")

# %% [markdown]
# ## What is wrong with it
#
# `warpav vehicle check` reads GLB, glTF, OBJ, PLY and STL. It looks at the shape: vehicles are two to twenty metres
# long, left and right are alike, wheels are below. What it cannot use it names on the last lines, together with the
# command that mends it, and ends with status 2, so that a script stops.

# %% magic_args="--no-raise-error" language="bash"
# warpav vehicle check van.glb

# %% [markdown]
# The command that it proposes writes the vehicle in warpav's own frame: metres, x forward, y left, z up, with the
# origin on the ground below the middle of the rear axle, which it finds by the wheels. `--picture` draws what was
# understood. Look at it: a car that drives backwards is also left and right alike.

# %% language="bash"
# warpav vehicle check van.glb --scale 0.01 --up z --forward y --out van_ego.glb --picture van.png

# %%
Image("van.png", width=800)

# %% [markdown]
# Coloured are the places that can carry a camera: measured, and facing upwards enough (`mount.min_zone_normal`).
# Windscreen and rounded edges cannot. If your roof has rails or a hatch, cut them out of the mesh or raise
# `mount.margin_m`.
#
# ## A folder of scenes
#
# A scene is one GLB file, `scene_<seed>.glb`, that Blender opens: nodes `environment`, `ego` and `vehicle_<id>`, each
# vehicle with its class and its 3D box as extras ([all of it](../warpav/scene/glb.py)). Yours may come from a
# simulator, from a reconstruction (`warpav scenes reconstruct`) or from a modelling program. Ours are made by the
# command that builds the embedded town:

# %% language="bash"
# warpav scenes make --seeds $SCENES --out scenes | tail -n 2

# %% [markdown]
# What such a file holds, read with nothing of warpav:

# %%
scene = trimesh.load_scene("scenes/scene_0.glb")
for _, node, edge in sorted(scene.graph.to_edgelist(), key=lambda edge: edge[1]):
    extras = edge.get("metadata", {})
    if extras.get("role") in ("environment", "ego"):
        print(f"{node:12} {len(scene.geometry[edge['geometry']].faces):6} triangles")
    elif extras.get("role") == "vehicle":
        box = ", ".join(f"{value:.1f}" for value in [*extras["box_center_m"], *extras["box_size_m"]])
        print(f"{node:12} {extras['class']:10} box centre and size [m]: {box}")

# %%
Image(read_scene("scenes/scene_0.glb").plot("scene.png", zoom=0.7), width=800)

# %% [markdown]
# ## The van in these scenes
#
# `scenes.ego` puts your vehicle into the place of every scene's own, in all commands. `scenes.source=folder` reads a
# folder, and the seeds say which of its files are trained on, and on which the result is judged.
#
# One thing has to be learnt first. What a run lowers is the expected share of road users that no camera finds, and
# how probably the detector finds something depends on what it looks at, and from where: a van's roof is higher than a
# car's. This probability is fitted once for every detector, camera and vehicle, and kept; on embedded scenes if you
# have fewer than twenty of your own. A run does so by itself, on 80 scenes; here a few have to do:

# %% language="bash"
# warpav detector fit scenes.ego=van_ego.glb --scenes $FIT --held-out $HELD_OUT

# %% language="bash"
# warpav optimise scenes.source=folder scenes.folder=scenes scenes.ego=van_ego.glb \
#     scenes.train_seeds=$TRAIN scenes.test_seeds=$TEST run.iterations=$ITERATIONS run.batch_size=3 \
#     run.out=van > progress.txt
# tail -n 5 progress.txt

# %%
run = RunFolder.open("van")
Image(run.plot("run.png"), width=800)

# %%
RunDisplay().show(arm_table(run.evaluation()["arms"]))

# %% [markdown]
# *Objective* is what was lowered, the share of vehicles expected to be missed; `start` is the best of 16 rigs that
# were looked at before the first step. Six test scenes prove nothing about the arms' order; they show that van,
# folder and detector work together. With your own scenes, use as many as you have: those that are trained on decide
# how well the result carries over to others.
#
# Everything else takes the same two options: `warpav inspect van`, `warpav evaluate nuscenes scenes.ego=van_ego.glb
# ...`, or a configuration file of your own, from `warpav config copy quick mine.yaml`. Next: [your own
# detector](04_own_detector.ipynb).
