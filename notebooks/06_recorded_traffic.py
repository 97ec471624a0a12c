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
# # From recorded traffic to a rig
#
# **A drone filmed a crossing in Tianjin. Of the vehicles that were really there, how many do four cameras on a car
# miss, and does it pay to search for their places, or will the highest point of the roof do?** Positions, speeds and
# sizes come from the recording SinD, which ships with warpav; bodies, paint and houses are drawn around them.

# %% tags=["parameters"]
train_seeds, test_seeds, pool_cameras = "0..59", "5000..5079", 112

# %%
import matplotlib.pyplot as plt
import numpy as np

import warpav as wa

# %% [markdown]
# ## The answer
#
# A scene is one moment, seen from one of the cars, whose place the ego vehicle takes. Four cameras of 90 degrees may
# stand anywhere on roof and bonnet. The obvious rig stands on the highest point and looks all round. Both before the
# detector, in recordings that the search has not seen:

# %%
config = wa.Config.load(
    "quick",
    "scenes.source=traffic",
    f"scenes.train_seeds={train_seeds}",
    f"scenes.test_seeds={test_seeds}",
    f"optimiser.pool_cameras={pool_cameras}",
)
train, test = (list(wa.load_scenes(config, split)) for split in ("train", "test"))
placement = wa.Placement(train, config=config)
result = wa.optimise(placement)
rigs = {"found": result.rig, "highest": wa.highest_rig(placement), "by hand": result.start}
evaluation = wa.evaluate(rigs, test, placement)
wa.plot(evaluation)

# %% [markdown]
# Dots are the share detected of each group; bars are 95 % intervals of the first rig. Most of what all miss is far
# away. How many they miss at equal false alarms, of everything, whatever hides it and however far away it is, and of
# what is *attainable*: what at least one of 128 cameras, spread over roof and bonnet, is likely to detect. The
# differences have 95 % intervals over the scenes:

# %%
texts = {"misses_at_equal_false_alarms": "of all vehicles", "attainable_misses_per_100": "of attainable ones"}
for metric, text in texts.items():
    missed = {name: getattr(metrics, metric) for name, metrics in evaluation.metrics.items()}
    print(f"misses per 100 {text:18}: " + ", ".join(f"{name} {value:.1f}" for name, value in missed.items()))
    for other in ("highest", "by hand"):
        fewer = evaluation.difference(other, "found", metric)
        print(f"    fewer than {other:8} {fewer.mean:+.1f} ({fewer.low:+.1f} to {fewer.high:+.1f})")

# %% [markdown]
# An interval above 0 says that the search was worth it on this crossing, one that holds 0 that these scenes cannot tell
# the two rigs apart. Here it beats the highest point, and the best rig by hand does as well. Of other crossings neither
# says anything, for all scenes are of one. All metrics:

# %%
evaluation.table()

# %% [markdown]
# ## Moments become scenes
#
# A seed chooses moment and car, and draws what no drone records: bodies, paint, clothes, houses, cars that are parked
# on plots. Seeds of the search have moments of the first ten recordings, those of the test moments of the other five,
# so no moment is in both.

# %%
moment = test[0]


def show(images, width_in=11.0):
    """Images by name, in a row."""
    _, axes = plt.subplots(1, len(images), figsize=(width_in, 1.1 * width_in / len(images)), squeeze=False)
    for each, (name, image) in zip(axes[0], images.items(), strict=True):
        each.imshow(image.rgb)
        each.set_title(name)
        each.set_axis_off()
    plt.tight_layout()
    plt.show()


middle_m = moment.ego.bounds_m().mean(axis=0)
eye_m, drone_m = middle_m + np.array([0.0, 0.0, 1.0]), middle_m + np.array([0.0, 0.0, 60.0])
wide, narrow = (wa.CameraModel(480, 480, np.radians(fov_deg)) for fov_deg in (90, 65))
views = wa.Rig(
    (
        wa.Camera("drone", drone_m, pitch_rad=np.radians(89.9), model=narrow),
        wa.Camera("ahead", eye_m, model=wide),
        wa.Camera("behind", eye_m, yaw_rad=np.pi, model=wide),
    )
)
print(moment.source)
show(wa.render(views, moment, supersampling=2))

# %% [markdown]
# How many road users there are in the test scenes, and how far away:

# %%
for kind in ("vehicle", "pedestrian", "cyclist"):
    place_m = [user.box.center_m for scene in test for user in scene.road_users if user.road_user == kind]
    distance_m = np.linalg.norm(np.array(place_m)[:, :2] - middle_m[:2], axis=1)
    print(f"{kind:10} {len(place_m) / len(test):4.1f} a scene, half of them within {np.median(distance_m):.0f} m")

# %% [markdown]
# Many stand behind each other, and many so far away that an image of 256 x 256 pixels has little of them: no rig finds
# them all. We search for vehicles, motorcycles among them; `scenes.targets` takes the others too.
#
# ## The search
#
# It draws a pool of cameras, selects the best four, and polishes them along the gradient. What it lowers is the
# expected share of vehicles that no camera detects, and with a tenth of its weight what is not seen near the car.
# How likely the shipped detector is to find a vehicle of such traffic is known from a fit that ships with warpav.

# %%
print(f"by hand {result.start_objective:.4f}, found {result.objective:.4f}, bound of the pool {result.bound:.4f}")

# %% [markdown]
# The rig in the moment above, which it was not searched for. Green is detected, orange is seen and missed, violet is
# hidden from all four cameras:

# %%
outcomes = [seen.outcome["found"] for seen in evaluation.objects if seen.scene == moment.name]
wa.plot(result.rig, scene=moment, outcomes=outcomes, zoom=0.28)

# %%
show(wa.render(result.rig, moment, supersampling=2))

# %% [markdown]
# The same moment through the cameras of the rig: what is far away is a few pixels high.
#
# ## What to do next
#
# - The same on the command line: `warpav optimise scenes.source=traffic`.
# - Your own recordings, as JSON, CommonRoad XML or Argoverse 2 logs: `scenes.recordings`, and `wa.read_scenes` for
#   single files; the [guide](../docs/guide/traffic.md#recorded-traffic) has the formats and what is refused.
# - Does another vehicle, image or lens change the answer? See [your own vehicle](04_own_vehicle_and_scenes.ipynb), and
#   `camera.width_px=640` for road users that are far away.
# - Streets that are as busy but are not one crossing: [levels of the town](../docs/guide/traffic.md), and
#   [vehicles of other makers](../docs/guide/traffic.md#vehicles-of-other-makers) in either.
# - Would other detectors agree? [A panel of them](../docs/guide/own_detector.md) judges the same rigs.
