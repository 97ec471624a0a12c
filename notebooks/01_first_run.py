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
# traffic as possible?** One command answers this for an embedded town, an embedded car and a shipped detector. This
# notebook runs the command, looks at the result, asks a second question in Python, and ends with what the numbers
# prove.

# %% tags=["parameters"]
import os

os.environ["OPTIONS"] = ""  # of the command, such as rig.cameras=6
train_seeds, test_seeds = range(60), range(5000, 5010)  # of the second question

# %%
import csv
import tempfile

import matplotlib.pyplot as plt
import numpy as np
from IPython.display import Image

import warpav as wa

with open("../docs/results.csv") as file:
    published = [row for row in csv.DictReader(file) if row["study"] == "4x90" and row["seed"]]
folder = tempfile.TemporaryDirectory()  # for the files of this notebook
os.chdir(folder.name)

# %% [markdown]
# ## One command
#
# It builds 70 street scenes and searches in 60 of them:
#
# 1. It renders a *pool* of 112 single cameras, spread over roof, bonnet and directions, once in every scene.
# 2. It *selects* the four of them that miss least together, and proves a bound that no four of the pool can beat.
# 3. It *polishes* these four: the gradient moves and turns all of them at once.
# 4. It looks for cameras that the pool lacks (*pricing*), adds them, and selects and polishes again.
#
# Then it compares the result on ten scenes that it has not seen. Every option has the form `key=value`;
# `warpav config show` lists them.

# %% language="bash"
# warpav optimise run.out=first $OPTIONS

# %% [markdown]
# White dots are the cameras of the start. Tubes lead through the rigs that were found: long ones to the selected
# cameras, short ones along the polish.

# %%
run = wa.read_run("first")
wa.plot(run)

# %% [markdown]
# The cameras stay on roof and bonnet, 25 cm above the sheet metal, and off the glass and the rounded edges; they may
# look up by 10 degrees and down by 20. This is the rig, in metres and degrees from the ground below the rear axle:

# %%
run.rig()

# %% [markdown]
# How to read the tables that the command printed:
#
# - **recall of the rig** is the share of all vehicles that at least one camera detects. It is the number to compare.
# - **objective** is the expected share of vehicles that no camera detects ([its
#   definition](../docs/method.md#the-default-method)). The search lowers it, and beside it with a tenth of its weight
#   the share of the [ground near the vehicle](../docs/guide/series_car.md) on which no camera sees a child, which the
#   table *seen near the vehicle* shows.
# - **AP50** and **false alarms** count boxes in single images, not vehicles around the car.
#
# The columns are the *optimised* rig, the best rig *by hand* that the search began with, and four cameras around the
# *highest* point of the roof.
#
# ## How far from the best?
#
# A *camera render* is one camera in one scene. The blue line is the objective of the best rig so far, over the camera
# renders that were spent; the dashed line is the bound. No rig of the pool's cameras lies below it:

# %%
Image("first/figures/search.png")

# %%
certificate = run.evaluation()["certificate"]
for k, each in enumerate(certificate["bounds"], start=1):
    print(f"selection {k}: no rig of {each['pool_cameras']:3} cameras is below {each['bound']:.4f}")
print(f"found: {certificate['objective']:.4f} on the {certificate['scenes']} scenes of the search")

# %% [markdown]
# The polish may go below a bound, because it moves cameras to where the pool has none. All cameras that it has
# tried join the pool, so the next bound is over more cameras, and lower. It holds for these cameras and these scenes,
# not for all places on the roof, and not for other traffic: compare the objective in the table of the test scenes.
#
# ## A question of your own, in Python
#
# Would three cameras do? The command line is a thin layer on a Python API. Scenes, a placement and an optimisation are
# one line each, and no run folder is written:

# %%
train, test = wa.town(train_seeds), wa.town(test_seeds)
placement = wa.Placement(train, cameras=3)
result = wa.optimise(placement)
print(f"three cameras: objective {result.objective:.4f}, gap to the bound {result.gap:.4f}")

# %% [markdown]
# The search knows what each camera of its pool would add to these three. The best fourth cameras, with the further
# vehicles that they are expected to find, of 100:

# %%
result.further_cameras[:5]

# %% [markdown]
# If all four may move, as in the first run, more can be had:

# %%
missed = result.records[-1].terms["expected_miss_rate"]
together = run.events()[-1]["terms"]["expected_miss_rate"]
print(f"three cameras               {100 * missed:.2f} expected misses of 100")
print(f"and the best fourth         {100 * (missed - result.further_cameras.gain[0]):.2f}")
print(f"four, searched for together {100 * together:.2f}")

# %% [markdown]
# On the test scenes, by the detector itself:

# %%
evaluation = wa.evaluate({"three": result.rig, "four": run.rig()}, test, placement)
wa.plot(evaluation)

# %% [markdown]
# Dots are the recall in each group of vehicles; the number of vehicles stands beside its name. The bars are 95 %
# intervals of the first rig: with few vehicles they are wide. All metrics, side by side:

# %%
evaluation.table()

# %%
difference = evaluation.difference("four", "three")
print(
    f"recall, four cameras - three: {difference.mean:+.3f} "
    f"(95 % interval over {difference.scenes} scenes: {difference.low:+.3f} to {difference.high:+.3f})"
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
# - Another seed draws another pool: `warpav optimise run.seed=1`. More cameras in it: `optimiser.pool_cameras=200`.
# - You wonder how pixels can have a derivative? [How the gradient works](02_how_the_gradient_works.ipynb).
