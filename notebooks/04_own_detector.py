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
# # Bring your own detector
#
# Cameras are placed for a detector, so it should be yours. warpav takes an ONNX file as it left its exporter: YOLOv8
# to YOLO26 and RT-DETR of ultralytics, YOLOX, torchvision, RT-DETR, D-FINE. This notebook takes one through
# everything that warpav does with it: how the file is read, what it finds, how its chances depend on what a camera
# sees, and how a rig is judged by it.
#
# So that nothing has to be downloaded, *your* detector is a copy of the shipped one under another name. Put the path
# of your own file in its place, such as `yolo11n.onnx` from `yolo export model=yolo11n.pt format=onnx`; everything
# below stays the same.

# %% tags=["parameters"]
import os

os.environ.update(
    FIT="500000..500015",  # scenes on which to fit
    HELD_OUT="500050..500057",  # others, to judge the fit
    TEST="1000..1005",
)

# %%
import shutil
import tempfile
from pathlib import Path

from IPython.display import Image

from warpav.detection.onnx_detector import BUILTIN_MODEL_PATH

folder = tempfile.TemporaryDirectory()  # what is written below goes here
shutil.copy(BUILTIN_MODEL_PATH, f"{folder.name}/mine.onnx")  # your own goes here
os.chdir(folder.name)

# %% [markdown]
# ## How is the file read?
#
# ONNX says how tensors are called, not what they mean: whether pixels are 0..1 or 0..255, RGB or BGR, stretched or
# padded, whether boxes are corners or centres, which number is which class. `warpav detector check` tells what it
# took them for and why, which labels count as which kind of road user, and what an image costs. A picture shows
# whether that is right; here it is one of a street, rendered through a camera on the roof.

# %% language="bash"
# warpav render 11 --rig highest --out views camera.width_px=640 camera.height_px=640 > views.txt
# warpav detector check mine.onnx --image views/camera_3_rgb.png --out boxes.png

# %%
Image("boxes.png", width=520)

# %% [markdown]
# Boxes that sit on the cars, with names that are right: then colours, sizes and labels were read as they should be.
# When they are not:
#
# | what you see | what helps |
# |---|---|
# | no boxes, or boxes all over | `detector.format=yolox` (or another family) says what the numbers mean |
# | good boxes, wrong names | `detector.labels=coco`, or a list of your own, in the order of the file |
# | a class is not counted | `detector.classes.vehicle=[car, tram]` says which labels are vehicles |
# | small cars are not found | `detector.input_px`, `camera.width_px` and `camera.height_px` |
#
# `warpav config show` prints these options with their defaults; all commands take them, as in `warpav optimise
# detector.model=mine.onnx detector.labels=coco`.
#
# ## What are its chances?
#
# A rig is optimised through a smooth question: how probably does the detector find an object of which a view shows so
# and so much? The answer is fitted to what *your* detector finds in scenes rendered for the purpose, once, and kept
# beside the file. A run does that by itself with 80 scenes; here fewer have to do:

# %% language="bash"
# warpav detector fit detector.model=mine.onnx --scenes $FIT --held-out $HELD_OUT

# %% [markdown]
# The area under the curve (AUC) says how well the probabilities order what is found before what is not, on scenes
# that the fit has not seen; 1 is perfect, .5 is chance. The calibration error says how far they are from the
# frequencies that they claim. Each curve below is one feature's share of the logit: what raises and what lowers your
# detector's chances.

# %%
Image(next(Path().glob("mine_p_detected_*_curves.png")), width=900)

# %%
Image(next(Path().glob("mine_p_detected_*_reliability.png")), width=520)

# %% [markdown]
# The more pixels and the larger the visible share, the better: these are the directions in which a descent moves
# cameras. If your curves rise only at hundreds of pixels, the images are too small for your detector, and no place on
# the roof mends that.
#
# ## A rig, judged by it
#
# All other commands take the detector the same way. The thesis's simplest rig, four cameras around the highest point
# of the roof, by your detector on scenes that it has not seen:

# %% language="bash"
# warpav evaluate highest detector.model=mine.onnx scenes.train_seeds=0 run.batch_size=1 scenes.test_seeds=$TEST \
#     --json highest.json

# %% [markdown]
# `recall of the rig` counts every vehicle once, whoever finds it. The table tells the detector's limits from the
# rig's: what is *visible to the rig* and not *recalled* is the detector's miss; what is not visible no detector can
# find.
#
# From here on: `warpav optimise detector.model=mine.onnx` places the cameras for it, and `warpav detector evaluate
# detector.model=mine.onnx --out figures` measures it alone on 144 held-out streets, direct and reconstructed
# (rendering them takes much longer than this notebook). The shipped detector's figures are in its [model
# card](../warpav/detection/models/MODEL_CARD.md).
