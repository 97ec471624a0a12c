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
# beside the thesis, and then does a small version of them.

# %% tags=["parameters"]
arms, runs = "sgd_ifr_doa,sgd_ifr_10doa,random_ifr_doa,highest_ifr_doa", 2
train_seeds, test_seeds, iterations = "0..19", "1000..1009", 25

# %%
import csv
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from IPython.display import Markdown

import warpav as wa
from warpav.core.progress import NullProgress
from warpav.experiments.experiment import run_study
from warpav.experiments.study import find_study
from warpav.thesis.tables import thesis_table


def read_runs(path):
    with open(path) as file:
        return [row for row in csv.DictReader(file) if row["study"].startswith("table2") and row["seed"]]


published = read_runs("../docs/results.csv")

# %% [markdown]
# ## Ours beside the thesis
#
# An *arm* is a way to find a rig: a method with its losses. IFR is the loss of the thesis that keeps vehicles in the
# frame, DOA the one that enlarges their detected area. The number is the share of vehicles that at least one camera
# detects, the *TP detection rate* of the thesis. A dot is a run; squares are mean and standard deviation in the thesis.

# %%
labels = {
    "sgd_ifr_doa": ("SGD", "IFR+DOA"),
    "sgd_ifr_10doa": ("SGD", "IFR+10*DOA"),
    "random_ifr_doa": ("Random", "IFR+DOA"),
    "highest_ifr_doa": ("Highest", "IFR+DOA*"),
}
thesis = {(row["method"], row["loss"]): row["tp_detection_rate"] for row in thesis_table("II")["rows"]}


def rates(experiment, arm):
    return [float(run["detection_rate"]) for run in experiment if run["arm"] == arm]


def draw(*experiments):
    _, axis = plt.subplots(figsize=(8, 3.6), layout="constrained")
    shifts = np.linspace(-0.2, 0.2, len(experiments) + 1)
    for k, (arm, label) in enumerate(labels.items()):
        for shift, (name, colour, experiment) in zip(shifts, experiments, strict=False):
            found = rates(experiment, arm)
            axis.plot([k + shift] * len(found), found, "o", color=colour, alpha=0.7, label=None if k else name)
        mean, std = thesis[label]["mean"], thesis[label]["std"]
        axis.errorbar(k + 0.2, mean, std, fmt="s", color="gray", capsize=4, label=None if k else "thesis")
    axis.set(xticks=range(len(labels)), xticklabels=[" ".join(label) for label in labels.values()])
    axis.set(ylabel="vehicles that some camera detects", ylim=(0.4, 1.0))
    axis.legend(loc="lower right")
    axis.grid(axis="y", alpha=0.3)
    plt.show()


draw(("warpav, published", "tab:blue", published))
for arm, label in labels.items():
    print(f"{' '.join(label):20} warpav {np.mean(rates(published, arm)):.3f}   thesis {thesis[label]['mean']:.3f}")

# %% [markdown]
# Other scenes, another vehicle, another detector: the numbers cannot agree, and need not. What can be compared is the
# order of the arms. In the thesis and here, cameras around the highest point detect more than both descents, and the
# descents differ a lot from run to run. Random search does better here than in the thesis.
#
# The published runs take more than half an hour on two cores, so they are part of the repository
# ([tables](../docs/results.md), [every run](../docs/results.csv)).

# %% [markdown]
# ## A small version
#
# The same comparison with fewer scenes, steps and runs. The configuration `thesis` has the numbers that the thesis
# prints. An experiment that was interrupted goes on where it stopped, when it is called again with the same folder.

# %%
config = wa.Config.load(
    "thesis",
    f"scenes.train_seeds={train_seeds}",
    f"scenes.test_seeds={test_seeds}",
    f"run.iterations={iterations}",
)
folder = tempfile.TemporaryDirectory()
study = find_study("table2", quick=True)
done = run_study(
    study,
    config,
    arms=study.arms_of(arms),
    runs=runs,
    out=Path(folder.name) / "table2",
    progress=NullProgress(),
)
Markdown((done.folder / "table.md").read_text())

# %% [markdown]
# Rows *ours* come from the runs above, rows *thesis* are printed in the thesis. Both versions and the thesis in one
# figure:

# %%
small = read_runs(done.folder / "rows.csv")  # of the same form as the published file
draw(("warpav, small version", "tab:orange", small), ("warpav, published", "tab:blue", published))

# %% [markdown]
# The small version takes 25 steps instead of 100, on fewer scenes, twice. That is too little for a descent to get far
# from its random start, and too little to order the arms.
#
# ## What to do next
#
# - `method: thesis` is there to be compared with. `method: default`, which every other notebook uses, starts from the
#   best of many rigs and lowers another objective: [the two side by side](../docs/method.md#side-by-side).
# - The other tables have commands of the same form: `warpav experiment table1` to `table5`.
# - `warpav experiment open` compares all search methods at one budget of renders ([results](../docs/results.md)).
