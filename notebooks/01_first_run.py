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

os.environ["OPTIONS"] = ""  # of the command, such as run.iterations=20
train_seeds, test_seeds, iterations = range(20), range(5000, 5010), 50  # of the second question

# %%
import json
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import warpav as wa

published = json.loads(Path("../docs/results/open.json").read_text())
folder = tempfile.TemporaryDirectory()  # for the files of this notebook
os.chdir(folder.name)

# %% [markdown]
# ## One command
#
# It builds 40 street scenes, takes the best of 16 starting rigs through 100 gradient steps, and compares the result
# on ten scenes that it has not seen. Every option has the form `key=value`; `warpav config show` lists them.

# %% language="bash"
# warpav optimise run.out=first $OPTIONS

# %% [markdown]
# White dots are the start of the cameras, tubes their trajectories, and arrows show where the last step still pulls:

# %%
run = wa.read_run("first")
wa.plot(run)

# %% [markdown]
# The cameras stay on roof and bonnet, 25 cm above the sheet metal, and off the glass and the rounded edges. This is
# the rig, in metres and degrees from the ground below the rear axle:

# %%
run.rig()

# %% [markdown]
# How to read the tables that the command printed:
#
# - **recall of the rig** is the share of all vehicles that at least one camera detects. It is the number to compare.
# - **objective** is what the optimiser lowers: the expected share of vehicles that no camera detects ([its
#   definition](../docs/method.md#the-default-method)).
# - **AP50** and **false alarms** count boxes in single images, not vehicles around the car.
#
# The columns are the *optimised* rig, the *start* of the optimisation, four cameras around the *highest* point of
# the roof, and the best of 20 *random* rigs.
#
# ## A question of your own, in Python
#
# Would three cameras do? The command line is a thin layer on a Python API. Scenes, a placement, an optimisation and
# an evaluation are one line each, and nothing is written to disk:

# %%
train, test = wa.town(train_seeds), wa.town(test_seeds)
placement = wa.Placement(train, cameras=3)
result = wa.optimise(placement, iterations=iterations)
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
# Ten scenes are few, so the repository holds a larger experiment: 50 unseen scenes, and ten runs of each search
# method at the same budget of renders.

# %%
arms = {
    "gradient": "warpav, method: default",
    "highest": "around the highest point",
    "random": "best of random rigs",
    "cma": "CMA-ES",
    "thesis_gradient": "losses and steps of the thesis",
}
figure, axis = plt.subplots(figsize=(8, 2.8), layout="constrained")
for row, (arm, name) in enumerate(arms.items()):
    recall = [run["tp_detection_rate"] for run in published["runs"] if run["arm"] == arm]
    axis.plot(recall, [row] * len(recall), "o", color="tab:blue", alpha=0.4)
    axis.plot(np.mean(recall), row, "|", color="black", markersize=18)
    spread = f" ± {np.std(recall, ddof=1):.3f} from run to run" if len(recall) > 1 else ""
    print(f"{name:25} {np.mean(recall):.3f}{spread}")
axis.set(
    yticks=range(len(arms)), yticklabels=arms.values(), xlabel="recall of the rig (a dot is a run, a line the mean)"
)
axis.invert_yaxis()
axis.grid(axis="x", alpha=0.3)
plt.show()

# %% [markdown]
# The lead is a few per cent, and steady from run to run. [All results](../docs/results.md) come with their commands,
# seeds and intervals, and so do the [limits of the method](../docs/method.md#what-it-reaches-and-what-not). The
# traffic is synthetic, and the shipped detector was trained on nothing else.
#
# ## What to do next
#
# - Before you drill holes, use [your own vehicle and scenes](03_own_vehicle_and_scenes.ipynb) and [your own
#   detector](04_own_detector.ipynb).
# - You have cameras already? [Keep some and place the rest](06_inspect_and_export.ipynb), then export the rig.
# - You wonder how pixels can have a derivative? [How the gradient works](02_how_the_gradient_works.ipynb).
