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
train_seeds, test_seeds = range(12), range(5000, 5040)
pool_cameras, steps, front_cameras = 48, 40, "2..4"

# %%
import math
import os
import tempfile
from itertools import pairwise
from pathlib import Path

import warpav as wa

folder = tempfile.TemporaryDirectory()  # for the files of this notebook
os.chdir(folder.name)
train, test = wa.town(train_seeds), wa.town(test_seeds)
car = train[0].ego

# %% [markdown]
# ## One rig
#
# One wide camera, two at the sides, four fisheyes. A *zone* is a part of the body on which a camera can be mounted;
# `symmetric` makes mirrored pairs of cameras, and single ones stand in the middle. `requirements` says what has to be
# seen near the body, wherever traffic happens to be: `near_field` puts a post as high as a child of four on every half
# metre of the ground within 5 m, and asks that 99 % of the posts are seen. The search draws a pool of cameras in the
# zones, selects the best rig of them, polishes it along the gradient, and asks for the cameras that would help it more.

# %%
zones = wa.propose_zones(car)
wa.write_zones(zones, "zones.yaml")
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
wa.plot(result.rig, ego=car, requirements=result.requirements, zoom=1.6)

# %% [markdown]
# A disc is a post that is seen, the bluer the more cameras see it, and a cross is one that is not. In words, with the
# objective, which joins what is expected to be missed in traffic with what is missed near the body:

# %%
print(result.requirements.table())
print(result.requirements.shortfall or "as much is seen as was asked for")
print(f"by hand {result.start_objective:.4f}, found {result.objective:.4f}")
print(f"bound {result.bound:.4f}: no rig of the pool's {result.pool_cameras} cameras is below")

# %% [markdown]
# The bound holds for these scenes and for cameras of this pool. Of other cameras and other scenes it says nothing; a
# polished rig may even be below it, for its cameras have left the pool. In traffic that the search has not seen, beside
# the best rig by hand of the same modules:

# %%
evaluation = wa.evaluate({"found": result.rig, "by hand": result.start}, test, placement)
apart = evaluation.difference("found", "by hand")
print(f"found less by hand: {apart.mean:+.1f} misses per 100, 95 % interval {apart.low:+.1f} to {apart.high:+.1f}")
evaluation.table()

# %% [markdown]
# An interval with 0 in it tells no rig from the other by what the detector misses: twelve scenes to search on are few.
# But the rig that was found sees the near field as asked, and less of its own body.
#
# ## Where cameras may stand
#
# `wa.propose_zones` keeps zones off wheels, lamps and plates (`warpav vehicle zones car.glb` does the same). What it
# wrote is a text file to be edited: your designers know where a housing fits. Painted below are the zones that some of
# our modules fits, of mirrored pairs the left half, and `..._middle`, the strip where single cameras stand.

# %%
for zone in wa.read_zones("zones.yaml"):
    low_mm, high_mm = (round(1000 * end) for end in zone.stand_off_m)
    place = "behind the glass" if zone.is_behind_glass else "off the skin"
    kinds, kept_out = ", ".join(zone.kinds or [zone.name]), len(zone.keep_out_m)
    print(f"{zone.name:11} {low_mm:2} to {high_mm:3} mm {place:17} boxes kept out: {kept_out}  kinds: {kinds}")
wa.plot(car, mount_surface=placement.mount.surface)

# %% [markdown]
# A camera behind the glass stands in the cabin and looks through the pane; pillars, scuttle and roof hide from it what
# they hide. The [guide](../docs/guide/series_car.md#zones) has all keys.
#
# ## What can be bought
#
# A catalogue lists camera modules, and the kinds of zones that each fits. The one that ships is of no maker, and its
# prices mean nothing but an order; [write your own](../docs/guide/series_car.md#your-own-catalogue).

# %%
catalogue = wa.read_modules()
for name in ("front_8mp_120", "side_2mp_100", "fisheye_1_3mp_190"):
    module = catalogue[name]
    model = module.camera_model()
    print(
        f"{name:18} {math.degrees(module.fov_rad):3.0f} deg, {model.width_px} x {model.height_px} px for the detector, "
        f"{module.pixels_per_degree:4.1f} px/deg, price {module.price.value:g}, fits {', '.join(module.zones)}"
    )

# %% [markdown]
# ## How many, at what cost
#
# `wa.front` finds the best rig of every number of cameras, all out of one pool, and judges each on the unseen scenes.
# It compares rigs by what they miss in traffic. Here it may take side cameras and fisheyes as it likes, and left and
# right need not be alike.

# %%
choice = {"side_2mp_100": "0..4", "fisheye_1_3mp_190": "0..4"}
numbers = wa.Placement(train, cameras=front_cameras, zones="zones.yaml", modules=choice, config=config)
front = wa.front(numbers, test)
print(front.table())
for fewer, more in pairwise(front.points):
    count, change = len(more.rig.cameras), more.expected_misses_per_100 - fewer.expected_misses_per_100
    print(f"{count} cameras: {change:+.2f} expected misses per 100, price {more.cost - fewer.cost:+.1f}")
front.plot()

# %% [markdown]
# With a `max_cost` and `by="cost"` the front goes along the price instead.
#
# ## What if a camera fails, is mounted a degree off, or is dirty
#
# Left, what each camera costs that is off by 2 cm or by a degree; right, what the loss of it costs. Both are misses
# per 100 road users, the errors in ten of the unseen scenes:

# %%
outage, some = evaluation.camera_outage["found"], test[:10]
tolerance = wa.robustness.mount_tolerance(result.rig, some, placement, sample_count=8)
without, off = outage.worst, tolerance.worst
print(f"worst to lose: {without.camera}, {without.difference_per_100:+.2f} misses per 100")
print(f"worst error of mounting: {off.degree} of {off.camera}, {off.worst:+.2f}")
wa.plot(tolerance, outages=outage)

# %% [markdown]
# Dirt that covers a tenth of an image, around its middle, on one camera after the other; and a boot full of luggage,
# which turns the nose up by a degree and lowers the car by 5 cm, in the same ten scenes:

# %%
print(wa.robustness.soiling(result.rig, some, placement, shape="disc", place=(0.5, 0.5), share=0.1).table())
print(wa.robustness.load_states(result.rig, some, placement, states={"luggage": (-1.0, -0.05)}).table())

# %% [markdown]
# Too much? `wa.Placement(..., robust={"camera_loss": "worst"})` lets the search
# [bear the loss of a camera](../docs/guide/series_car.md), and `robust={"mount_error_deg": 1.0}` errors of mounting.
#
# ## To the workshop
#
# A sheet to scale, with what every camera sees from above and from the side, and its place and angles:

# %%
wa.plot(result.rig, ego=car, kind="sheet")

# %% [markdown]
# And the files: the rig with its modules and the pane that they look through, and the same for Autoware. A rig file
# says which module each camera is, so it can be evaluated, inspected and exported wherever it is read.

# %%
wa.write_rig(result.rig, "series_car.yaml")
wa.export_rig(result.rig, "autoware", "sensor_kit")
for file in sorted(path for path in Path().rglob("*") if path.is_file()):
    print(file.as_posix())

# %% [markdown]
# The zones are among the files: a rig is as good as they are.
#
# ## What to do next
#
# - The same on the command line: [Plan the cameras of a series car](../docs/guide/series_car.md).
# - A real decision takes more: `warpav optimise surround` has ten cameras, more scenes and a larger pool.
# - Put your own [vehicle](04_own_vehicle_and_scenes.ipynb), catalogue, [requirements](../docs/guide/series_car.md)
#   and [detector](05_own_detector.ipynb) in the place of ours.
# - Drag the cameras over the zones, and see at once what they see: `result.save("runs/series", test=test)`, then
#   `warpav inspect runs/series`.
