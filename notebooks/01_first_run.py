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
# Where should four cameras sit on the roof and the bonnet of a car, so that an object detector sees the traffic best?
# One command answers that for an embedded town, an embedded car and a shipped detector. This notebook runs it, reads
# what it leaves behind, and says what to believe of it.

# %% tags=["parameters"]
import os

os.environ.update(OPTIONS="")  # such as run.iterations=20 rig.cameras=6

# %%
import json
import tempfile
from pathlib import Path

import numpy as np
from IPython.display import Image

from warpav.runs.run_folder import RunFolder

open_experiment = json.loads(Path("../docs/results/open.json").read_text())
folder = tempfile.TemporaryDirectory()  # what is written below goes here
os.chdir(folder.name)

# %% [markdown]
# ## Run it
#
# Without more words, `warpav optimise` builds 40 street scenes, looks at 16 rigs, takes 100 gradient steps from the
# best of them, and judges the result on ten scenes that it has not seen. Every option is `key=value`; `warpav config
# show` lists them.

# %% language="bash"
# warpav optimise run.out=first $OPTIONS

# %% [markdown]
# The first table compares the *optimised* rig with the one that it *started* from, with cameras around the *highest*
# point of the roof, and with the best of 20 *random* rigs. `recall of the rig` is the share of vehicles that at least
# one camera detects, `objective` what was lowered: the share of vehicles expected to be missed ([how it is
# made](../docs/method.md#the-default-method)). AP50 and false alarms count boxes in images, not vehicles around the
# car. The second table says where the found and the missed ones stand.
#
# ## Look at it
#
# White dots are where the cameras began, tubes the way that they took, arrows where the last step still pulls.

# %%
run = RunFolder.open("first")
Image(run.plot("run.png"), width=800)

# %% [markdown]
# Cameras stand 25 cm above roof or bonnet, wherever the vehicle's height map says that a mount could be: not on
# glass, not on rounded edges. That height map is the ground on which they are moved:

# %%
Image("first/figures/rig_top_view.png", width=800)

# %% [markdown]
# What the four cameras see of a test scene, with the detector's boxes: above the start, below the result.

# %%
Image("first/figures/detections.png", width=900)

# %% [markdown]
# The run folder holds all of it, for people and for programs: the rig (`rig_best.yaml`), every iteration
# (`events.jsonl`), the metrics (`evaluation.json`), the pictures, and a report that opens in a browser
# (`report.html`). `warpav inspect first` opens the rig in a window.

# %%
for name in sorted(path.name for path in Path("first").iterdir()):
    print(name)

# %% [markdown]
# ## What to believe of it
#
# The objective fell on the scenes that were trained on. Does that help on others? Ten test scenes are few: one
# vehicle more or less is one per cent, and the intervals that the run prints, of resampled sets of scenes, say how
# little that proves. So the repository holds a larger experiment, 50 test scenes and ten runs of every way to find a
# rig, at the same budget of renders:

# %%
arms = {
    "gradient": "warpav, method: default",
    "highest": "around the highest point",
    "random": "best of random rigs",
    "cma": "CMA-ES",
    "thesis_gradient": "the thesis's method",
}
runs = open_experiment["runs"]
print(f"recall of the rig on {runs[0]['objects']} vehicles of scenes {open_experiment['options']['scenes.test_seeds']}")
for arm, name in arms.items():
    recall = [run["tp_detection_rate"] for run in runs if run["arm"] == arm]
    spread = f" ± {np.std(recall, ddof=1):.3f} from run to run" if len(recall) > 1 else ""
    print(f"{name:26} {np.mean(recall):.3f}{spread}")

# %% [markdown]
# A lead of a few per cent, then, steady from run to run: worth having, and not a miracle. [All
# results](../docs/results.md) come with their commands, seeds and intervals, and [what was not
# reached](../docs/method.md#what-it-reaches-and-what-not) is said as well. And the traffic is synthetic, the detector
# has seen nothing else: before you drill holes, bring [your own vehicle and scenes](03_own_vehicle_and_scenes.ipynb)
# and [your own detector](04_own_detector.ipynb).
