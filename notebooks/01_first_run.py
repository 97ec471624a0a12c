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
# # A first run
#
# **Where should four cameras sit on the roof and the bonnet of a car, so that an object detector finds as much of the
# traffic as possible?** Four lines of Python answer this for an embedded town, an embedded car and a shipped detector.
# This notebook looks at the rig, asks a second question, and ends with what the numbers prove.

# %% tags=["parameters"]
train_seeds, test_seeds, pool_cameras = range(60), range(5000, 5010), 112

# %%
import csv

import matplotlib.pyplot as plt
import numpy as np

import warpav as wa

with open("../docs/results.csv") as file:
    published = [row for row in csv.DictReader(file) if row["study"] == "4x90" and row["seed"]]

# %% [markdown]
# ## Four lines
#
# A street scene has houses, parked cars, traffic and people around one car. The search sees 60 of them:

# %%
train, test = wa.town(train_seeds), wa.town(test_seeds)
placement = wa.Placement(train, cameras=4, config=wa.Config.load("quick", f"optimiser.pool_cameras={pool_cameras}"))
result = wa.optimise(placement)
wa.plot(result, scene=test[0])

# %% [markdown]
# White dots are the cameras of the start, the best rig that an engineer would draw by hand. Tubes lead to the rig that
# was found. The cameras stay on roof and bonnet, 25 cm above the sheet metal, and off the glass and the rounded edges;
# they may look up by 10 degrees and down by 20. In metres and degrees from the ground below the rear axle:

# %%
result.rig

# %% [markdown]
# What is it better at? Road users of ten scenes that the search has not seen, by the detector itself:

# %%
print(result.why(test))

# %% [markdown]
# Ten scenes have few road users, so here a handful decides. The last section has more.
#
# ## How far from the best?
#
# The search works in four steps:
#
# 1. It renders a *pool* of single cameras, spread over roof, bonnet and directions, once in every scene.
# 2. It *selects* the four of them that miss least together, and computes a bound that no four of the pool can beat.
# 3. It *polishes* these four: the gradient moves and turns all of them at once.
# 4. It looks for cameras that the pool lacks (*pricing*), adds them, and selects and polishes again.
#
# It lowers the *objective*: the expected share of vehicles that no camera detects ([its
# definition](../docs/method.md#the-default-method)), and beside it with a tenth of its weight the share of the
# [ground near the vehicle](../docs/guide/series_car.md) on which no camera sees a child. A *camera render* is one
# camera in one scene. The blue line is the best rig so far; no rig of the pool's cameras lies below the dashed line:

# %%
steps = [record for record in result.records if record.best_training_objective is not None]
_, axis = plt.subplots(figsize=(8, 3.2), layout="constrained")
renders = [record.camera_renders for record in steps]
axis.step(renders, [record.best_training_objective for record in steps], where="post", label="best rig so far")
bounds = result.certificate.bounds
axis.step(
    [*(each.camera_renders for each in bounds), renders[-1]],
    [*(each.bound for each in bounds), bounds[-1].bound],
    "k--",
    where="post",
    label="bound of the pool",
)
axis.set(xlabel="camera renders", ylabel="objective")
axis.legend()
plt.show()

for k, each in enumerate(bounds, start=1):
    print(f"selection {k}: no rig of {each.pool_cameras:3} cameras is below {each.bound:.4f}")
print(f"by hand {result.start_objective:.4f}, found {result.objective:.4f} on the {len(train)} scenes of the search")

# %% [markdown]
# The polish may go below a bound, because it moves cameras to where the pool has none. All cameras that it has
# tried join the pool, so the next bound is over more cameras, and lower. It holds for these cameras and these scenes,
# not for all places on the roof, and not for other traffic.
#
# ## Would three cameras do?

# %%
three = wa.optimise(wa.Placement(train, cameras=3, config=placement.config.replace({"rig.cameras": 3})))
print(f"three cameras: objective {three.objective:.4f}, gap to the bound {three.gap:.4f}")

# %% [markdown]
# The search knows what each camera of its pool would add to these three. The best fourth cameras, with the further
# vehicles that they are expected to find, of 100:

# %%
three.further_cameras[:5]

# %% [markdown]
# On the test scenes, by the detector itself, beside the four from above:

# %%
evaluation = wa.evaluate({"three": three.rig, "four": result.rig, "four by hand": result.start}, test, placement)
wa.plot(evaluation)

# %% [markdown]
# Dots are the share that is detected of each group of vehicles, whose number stands beside its name. The bars are 95 %
# intervals of the first rig: with few vehicles they are wide. All metrics, side by side; the first counts at the
# confidence at which each rig raises as many false alarms:

# %%
evaluation.table()

# %%
for other in ("three", "four by hand"):
    fewer = evaluation.difference(other, "four")
    print(
        f"missed per 100 by four cameras, fewer than {other}: {fewer.mean:+.1f} "
        f"(95 % interval over {fewer.scenes} scenes: {fewer.low:+.1f} to {fewer.high:+.1f})"
    )

# %% [markdown]
# The interval says how far the difference may move with ten other scenes of the same kind. Where it contains 0,
# these scenes do not decide the question.
#
# ## How much is proven?
#
# Ten scenes are few, so the repository holds larger experiments. In this one, 100 scenes judge ten runs of each search
# method. All had the same budget of camera renders and the same 150 scenes to choose on, with level cameras.
# No search had seen the 100 scenes.

# %%
arms = {
    "default": "warpav",
    "pool_only": "warpav without descent",
    "sobol_selected": "Sobol cameras, selected",
    "random_selected": "random cameras, selected",
    "descent_only": "descent from one start",
    "sobol": "best Sobol rig",
    "highest": "around the highest point",
    "random": "best random rig",
    "greedy_cover": "greedy set cover",
    "cma": "CMA-ES",
    "differential_evolution": "differential evolution",
}
figure, axis = plt.subplots(figsize=(8, 3.8), layout="constrained")
for row, (arm, name) in enumerate(arms.items()):
    misses = [100 * float(run["objective"]) for run in published if run["arm"] == arm]
    axis.plot(misses, [row] * len(misses), "o", color="tab:orange" if row == 0 else "tab:blue", alpha=0.4)
    axis.plot(np.mean(misses), row, "|", color="black", markersize=18)
    spread = f" ± {np.std(misses, ddof=1):.2f} from run to run" if len(misses) > 1 else ""
    print(f"{name:25} {np.mean(misses):5.2f}{spread}")
axis.set(
    yticks=range(len(arms)),
    yticklabels=arms.values(),
    xlabel="expected misses per 100 vehicles (a dot is a run, a line the mean)",
)
axis.invert_yaxis()
axis.grid(axis="x", alpha=0.3)
plt.show()

# %% [markdown]
# The selection out of a pool brings most of the lead, whoever draws the pool; the descent brings the rest, and makes
# the runs alike. [All results](../docs/results.md) come with their commands,
# seeds and intervals, and so do the [limits of the method](../docs/method.md#what-it-reaches-and-what-not). The
# traffic is synthetic, and the shipped detector was trained on nothing else.
#
# ## What to do next
#
# - Before you drill holes, use [your own vehicle and scenes](04_own_vehicle_and_scenes.ipynb) and [your own
#   detector](05_own_detector.ipynb).
# - You have cameras already? [Keep some and place the rest](../docs/guide/exchange.md), then export the rig.
# - `result.save("runs/first", test=test)` writes a report that opens in a browser; `warpav optimise` does all of this
#   on the command line.
# - Another seed draws another pool: `wa.optimise(placement, seed=1)`.
# - You wonder how pixels can have a derivative? [How the gradient works](02_how_the_gradient_works.ipynb).
