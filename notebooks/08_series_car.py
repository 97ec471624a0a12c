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
# # A series car: which modules, where, how many
#
# **We may buy a wide 8 MP camera for the windscreen, 2 MP cameras for the sides and small fisheyes. Where on the body
# do they sit, do they see a child beside the bumper, how many are worth their price, and what if one fails?** Nobody
# may put a mast on the roof: all cameras stand behind the windscreen or flush with the skin, and left and right are
# alike.

# %% tags=["parameters"]
train_seeds, test_seeds = range(16), range(5000, 5010)
pool_cameras, steps, front_cameras = 96, 100, "2..5"

# %%
import math
import os
import tempfile
from pathlib import Path

import trimesh

import warpav as wa

folder = tempfile.TemporaryDirectory()  # for the files of this notebook
os.chdir(folder.name)
train, test = wa.town(train_seeds), wa.town(test_seeds)
car = train[0].ego

# %% [markdown]
# ## Where cameras may stand
#
# A *zone* is a part of the body on which a camera can be mounted. You have the car as a file; `warpav vehicle zones`
# proposes zones and what they have to keep off: wheels, glass, lamps and plates.

# %%
body = trimesh.Trimesh(car.vertex_m, car.triangle, vertex_colors=car.vertex_rgb, process=False)
_ = body.export("car.ply")
# !warpav vehicle zones car.ply --out zones.yaml --image zones.png

# %%
from IPython.display import Image

Image("zones.png", width=700)

# %% [markdown]
# The proposal is a file to be edited. This is what it says of the windscreen, behind whose glass a camera stands in the
# cabin:

# %%
lines = Path("zones.yaml").read_text().splitlines()
first = lines.index("  windscreen:")
print("\n".join(lines[first : first + 14]))

# %% [markdown]
# ## What can be bought
#
# A catalogue lists camera modules. The one that ships is of no maker, and its prices mean nothing but an order.

# %%
catalogue = wa.read_modules()
chosen = ["front_8mp_120", "side_2mp_100", "fisheye_1_3mp_190"]
for name in chosen:
    module = catalogue[name]
    fov_deg = math.degrees(module.fov_rad)
    print(f"{name:18} {fov_deg:3.0f} deg, price {module.price.value:g}, fits {', '.join(module.zones)}")

# %% [markdown]
# ## One rig
#
# One wide camera, a pair at the sides, four fisheyes; mirrored pairs, or single ones in the middle. `requirements` says
# what has to be seen near the body, wherever traffic happens to be: `near_field` puts a post as high as a child of four
# on every half metre of the ground within 5 m, and asks that 99 % of them are seen.

# %%
config = wa.Config.load("quick", f"optimiser.pool_cameras={pool_cameras}", f"run.iterations={steps}")
placement = wa.Placement(
    train,
    zones="zones.yaml",
    modules={"front_8mp_120": 1, "side_2mp_100": 2, "fisheye_1_3mp_190": 4},
    rig={"symmetric": True},
    requirements="near_field",
    config=config,
)
result = wa.optimise(placement)
result.rig

# %%
print(
    f"objective {result.objective:.4f}; no rig of the pool's {result.pool_cameras} cameras is below {result.bound:.4f}"
)
wa.plot(result, scene=test[0])

# %% [markdown]
# The objective joins what is expected to be missed in traffic with what is missed near the body. Of the second alone:

# %%
print(result.requirements.table())
print(result.requirements.shortfall or "as much is seen as was asked for")

# %%
wa.plot(result.rig, ego=car, requirements=result.requirements)

# %% [markdown]
# In traffic that the search has not seen, beside the random rig of the same modules that it began with:

# %%
evaluation = wa.evaluate({"optimised": result.rig, "start": result.start}, test, placement)
evaluation.table()

# %% [markdown]
# ## How many, at what cost
#
# Each camera more brings less than the one before. `wa.front` finds the best rig of every number of cameras, all out of
# one pool, and judges them on the unseen scenes.

# %%
numbers = wa.Placement(
    train,
    cameras=front_cameras,
    zones="zones.yaml",
    modules={"side_2mp_100": "0..4", "fisheye_1_3mp_190": "0..4"},
    config=config,
)
front = wa.front(numbers, test)
front.table()

# %%
front.plot()

# %% [markdown]
# ## What if
#
# What each camera's loss costs, which error of mounting costs most, and what dirt in the middle of an image costs:

# %%
outage = evaluation.camera_outage["optimised"]
for each in outage.cameras:
    print(
        f"without {each.camera:26} {each.expected_misses_per_100:5.2f} per 100 missed, {each.difference_per_100:+.2f}"
    )

# %%
tolerance = wa.robustness.mount_tolerance(result.rig, test, placement, sample_count=8)
wa.plot(tolerance, outages=outage)

# %%
print(wa.robustness.soiling(result.rig, test, placement, shape="disc", place=(0.5, 0.5), share=0.1).table())

# %% [markdown]
# Too much? `wa.Placement(..., robust={"camera_loss": "worst"})` makes the search bear the loss of a camera, and
# `robust={"mount_error_m": 0.02, "mount_error_deg": 1.0}` errors of mounting.
#
# ## Into the workshop
#
# A sheet to scale, with what every camera sees from above and from the side:

# %%
wa.plot(result.rig, ego=car, sheet=True)

# %% [markdown]
# And the files: the rig with its modules, and the same for ROS.

# %%
wa.write_rig(result.rig, "series_car.yaml")
wa.export_rig(result.rig, "autoware", "sensor_kit")
print(*sorted(os.listdir()), sep="\n")

# %%
folder.cleanup()
