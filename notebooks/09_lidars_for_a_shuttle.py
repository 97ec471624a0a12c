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
# # Two LiDARs and six cameras for a shuttle
#
# **A shuttle is to carry six cameras and two LiDARs. Where does each go, what do the LiDARs add, and how much of that
# rests on what we assume about them?** A LiDAR here finds a road user when enough points are expected on it; no network
# looks at its points ([how](../docs/guide/lidar.md)).

# %% tags=["parameters"]
train_seeds, test_seeds = range(10), range(5000, 5008)
pool_cameras, steps = 64, 30

# %%
import warpav as wa

shuttle = wa.read_vehicle("minibus")
train, test = wa.town(train_seeds, level="dense"), wa.town(test_seeds, level="dense")
lidar = wa.read_modules()["lidar_128_near"]
near_m, far_m = lidar.least_range_m, lidar.beams.range_m[0]
print(f"{lidar.beams.count} points a scan, from {near_m:g} m to {far_m:g} m at 10 % reflectivity")

# %% [markdown]
# ## One search for both
#
# Cameras and LiDARs are columns of one programme. The shuttle is symmetric, so they come in mirrored pairs.

# %%
config = wa.Config.load("quick", f"optimiser.pool_cameras={pool_cameras}", f"run.iterations={steps}")
placement = wa.Placement(
    train, ego="minibus", modules={"side_2mp_100": 6, "lidar_128_near": 2}, requirements=(), config=config
)
result = wa.optimise(placement)
print(result.rig)
print(f"by hand {result.start_objective:.4f}, found {result.objective:.4f}, bound {result.bound:.4f}")

# %% [markdown]
# One scan of each LiDAR in a scene that the search has not seen. What is on road users is in the LiDAR's colour:

# %%
scene = test[0].around(shuttle)
wa.plot(result.rig, kind="points", scene=scene)

# %% [markdown]
# ## What the LiDARs add
#
# The same rig with and without them. Beware: a LiDAR here raises no false alarms, and what has an even chance counts as
# found.

# %%
cameras = wa.Rig([camera for camera in result.rig.cameras if camera.model.beams is None])
evaluation = wa.evaluate({"all": result.rig, "cameras alone": cameras}, test, placement)
found = evaluation.difference("cameras alone", "all")
print(f"{found.mean:+.1f} of 100 fewer missed with LiDARs, 95 % interval {found.low:+.1f} to {found.high:+.1f}")
evaluation.table()

# %% [markdown]
# ## How much rests on the curve
#
# Five points for an even chance is a usual number, not yours. With twenty the same rig is expected to miss more:

# %%
for points in (5, 20, 80):
    doubtful = placement.with_config(placement.config.replace({"lidar.vehicle": points}))
    value, gradient = doubtful.value_and_grad(result.rig)
    print(f"{points:3} points for an even chance: objective {value:.4f}")

# %% [markdown]
# The gradient comes along: how the objective changes with the place of each sensor, as the outlines of what it sees
# say.

# %%
for name, by_number in gradient.items():
    print(f"{name:12} {by_number['x_m']:+.4f} a metre forwards, {by_number['y_m']:+.4f} to the left")

# %% [markdown]
# A sensor that would gain by moving outwards is held by the edge of its zone or by a design rule.
#
# ## What to do next
#
# - Fit the curve to what your detector finds: `warpav detector lidar found.csv`.
# - Write your LiDARs into a [catalogue](../docs/guide/lidar.md), with prices, and set `rig={"max_cost": ...}`.
# - Ask for the near ground too: `requirements="near_field"`, as for [a series car](07_series_car.ipynb).
