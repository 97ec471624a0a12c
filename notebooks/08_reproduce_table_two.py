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
# # Reproduce table II
#
# **Does gradient descent find better rigs than the plainest rules, as the thesis behind warpav measured it?** Table II
# of the thesis compares three ways to find a rig of four cameras: gradient descent on its losses (SGD), the best of 100
# random rigs, and cameras around the highest point of the vehicle. This notebook sets the published runs of warpav
# beside the thesis, says what was not reproduced, and then does a small version.

# %% tags=["parameters"]
train_seeds, test_seeds = "0..19", "1000..1009"
iterations, runs, samples = 25, 2, 20

# %%
import csv

import matplotlib.pyplot as plt
import numpy as np

import warpav as wa

with open("../docs/results.csv") as file:
    rows = [row for row in csv.DictReader(file) if row["study"].startswith("table2") and row["seed"]]

# %% [markdown]
# ## Ours beside the thesis
#
# IFR is the loss of the thesis that keeps vehicles in the frame, DOA the one that enlarges their detected area. The
# number is the share of vehicles that at least one camera detects, the *TP detection rate* of the thesis. A dot is a
# run; squares are mean and standard deviation as table II of the thesis prints them.

# %%
thesis = {
    "SGD IFR+DOA": (0.7918, 0.0703),
    "SGD IFR+10*DOA": (0.8518, 0.0393),
    "Random IFR+DOA": (0.7737, 0.0863),
    "Random IFR+10*DOA": (0.7470, 0.1089),
    "Highest": (0.8961, None),
}
arms = ("sgd_ifr_doa", "sgd_ifr_10doa", "random_ifr_doa", "random_ifr_10doa", "highest_ifr_doa")
published = {
    name: [float(row["detection_rate"]) for row in rows if row["arm"] == arm]
    for name, arm in zip(thesis, arms, strict=True)
}


def draw(title, *experiments):
    _, axis = plt.subplots(figsize=(8.5, 3.6), layout="constrained")
    for k, (name, (mean, std)) in enumerate(thesis.items()):
        for shift, (label, colour, rates) in zip((-0.15, 0.0), experiments, strict=False):
            found = rates.get(name, [])
            axis.plot([k + shift] * len(found), found, "o", color=colour, alpha=0.7, label=None if k else label)
        axis.errorbar(k + 0.15, mean, std, fmt="s", color="gray", capsize=4, label=None if k else "thesis")
    axis.set(xticks=range(len(thesis)), ylabel="vehicles that some camera detects", ylim=(0.4, 1.0), title=title)
    axis.set_xticks(range(len(thesis)), [name.replace(" ", "\n") for name in thesis])
    axis.legend(loc="lower right")
    axis.grid(axis="y", alpha=0.3)
    plt.show()


draw("No: here the descent ends below random search", ("warpav, published", "tab:blue", published))
for name, (mean, _) in thesis.items():
    print(f"{name:18} warpav {np.mean(published[name]):.3f}   thesis {mean:.3f}")

# %% [markdown]
# ## What was not reproduced
#
# Other scenes, another vehicle, another detector: the numbers cannot agree, and need not. What can be compared is the
# order of the rows.
#
# - **Not reproduced: that the descent beats random search.** In the thesis both descents detect more than the best of
#   100 random rigs. Here both end below, in tables II and IV alike, wherever a camera comes to look at its own vehicle.
#   They differ a lot from run to run, in the thesis too.
# - **Not reproduced: one gradient.** That of angular coverage can only be .212 with four cameras of 90 degrees; the
#   thesis prints 2.116.
# - **The same:** cameras around the highest point, which take no search at all, detect more than both descents.
#
# [The method](../docs/method.md#what-it-reaches-and-what-not) has the rest, and the thirty-two points in which the text
# of the thesis is open. The published runs take more than half an hour on two cores, so they are part of the repository
# ([tables](../docs/results.md), [every run](../docs/results.csv)).
#
# ## A small version
#
# The same with fewer scenes, steps and runs. The configuration `thesis` has the numbers that the thesis prints,
# IFR+10*DOA among them.

# %%
config = wa.Config.load(
    "thesis",
    f"scenes.train_seeds={train_seeds}",
    f"scenes.test_seeds={test_seeds}",
    f"run.iterations={iterations}",
)
placement = wa.Placement.from_config(config)
rigs = {"Highest": wa.highest_rig(placement)}
for seed in range(runs):
    rigs[f"SGD IFR+10*DOA {seed}"] = wa.optimise(placement, seed=seed).found
    drawn = [wa.random_rig(placement, samples * seed + k) for k in range(samples)]
    values = [placement.value_and_grad(rig)[0] for rig in drawn]
    rigs[f"Random IFR+10*DOA {seed}"] = drawn[np.argmin(values)]
recall = wa.evaluate(rigs, list(wa.load_scenes(config, "test")), placement).recall
small = {name: [rate for run, rate in recall.items() if run.startswith(name)] for name in thesis}
draw("A small version", ("warpav, small version", "tab:orange", small), ("warpav, published", "tab:blue", published))

# %% [markdown]
# The small version takes 25 steps instead of 100 and the best of 20 random rigs instead of 100, on fewer scenes, twice.
# That is too little for a descent to get far from its random start, and too little to order the rows.
#
# ## What to do next
#
# - `method: thesis` is there to be compared with. `method: default`, which every other notebook uses, starts from the
#   best of many rigs and lowers another objective: [the two side by side](../docs/method.md#side-by-side).
# - The whole of it: `warpav dev experiment table2`; the other tables likewise, `table1` to `table5`.
# - `warpav dev experiment open` compares all search methods at one budget of renders ([results](../docs/results.md)).
