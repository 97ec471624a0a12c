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
# **Which rig suits my detector, and how does warpav know what it finds?** Cameras are placed for a
# detector, so it should be yours: an ONNX file as its exporter left it (YOLOv8 to YOLO26 and RT-DETR of ultralytics,
# YOLOX, torchvision, RT-DETR, D-FINE), or any Python object that finds boxes in images.
#
# So that nothing has to be downloaded, *your* detector is a copy of the shipped one under another name. Put the path of
# your own file in its place, such as `yolo11n.onnx` from `yolo export model=yolo11n.pt format=onnx`.

# %% tags=["parameters"]
fit_seeds, held_out_seeds = range(500000, 500016), range(500050, 500058)
train_seeds, test_seeds = range(12), range(5000, 5006)

# %%
import math
import os
import shutil
import tempfile

import matplotlib.pyplot as plt
import numpy as np

import warpav as wa

folder = tempfile.TemporaryDirectory()
os.chdir(folder.name)
_ = shutil.copy(wa.read_detector().file.path, "mine.onnx")  # your own goes here

# %% [markdown]
# ## The rig
#
# The optimiser needs a smooth answer to a simple question: how probably does the detector find an object of which a
# view shows so and so much? The answer is fitted to what *your* detector finds in rendered scenes. An optimisation does
# this once by itself, on 80 scenes. Here fewer have to do:

# %%
config = wa.Config.load("quick", "detector.model=mine.onnx")
fitted = wa.fit(config, fit_seeds, held_out_seeds)
train, test = wa.town(train_seeds), wa.town(test_seeds)
placement = wa.Placement(train, detector="mine.onnx", probability=fitted.model)
result = wa.optimise(placement)
wa.plot(result, scene=test[0])

# %%
evaluation = wa.evaluate({"found": result.rig, "by hand": result.start}, test, placement)
wa.plot(evaluation)

# %%
evaluation.table()

# %% [markdown]
# A vehicle counts once, whichever camera detects it. The first row compares the rigs at as many false alarms, the row
# *at the detector's threshold* as it is used. The table separates the limits of the detector from those of the rig: a
# vehicle that is *visible to the rig* and not detected is a miss of the detector; one that is not visible no detector
# can find.
#
# ## Is the detector read as it should be?
#
# A street, seen by a camera on the roof, and the boxes of the detector:

# %%
detector = wa.read_detector("mine.onnx")
lens = wa.CameraModel(width_px=640, height_px=480, fov_rad=math.radians(70))
camera = wa.Camera("front", np.array([1.0, 0.0, 1.75]), yaw_rad=0.0, pitch_rad=0.05, roll_rad=0.0, model=lens)
image_rgb = wa.render(wa.Rig((camera,)), wa.town([5])[0])["front"].rgb
(found,) = detector.detect(image_rgb[None])

figure, axis = plt.subplots(figsize=(8, 6), layout="constrained")
axis.imshow(image_rgb)
axis.axis("off")
for (x0, y0, x1, y1), confidence, label in zip(found.box_px, found.confidence, found.label, strict=True):
    if confidence >= 0.25:
        axis.add_patch(plt.Rectangle((x0, y0), x1 - x0, y1 - y0, fill=False, edgecolor="yellow", linewidth=1.5))
        axis.text(x0, y0 - 5, f"{label} {confidence:.2f}", fontsize=9, color="yellow", weight="bold")
plt.show()

# %% [markdown]
# Boxes that sit on the cars, with the right names: then colours, sizes and labels were read as they should be. ONNX
# says how tensors are called, not what they mean: whether pixels are 0..1 or 0..255, RGB or BGR, whether boxes are
# corners or centres, which number is which class. This is what warpav took them for:

# %%
print(*wa.check_detector("mine.onnx"), sep="\n")  # times are those of this machine, now

# %% [markdown]
# When the image is not right:
#
# | what you see | what helps |
# |---|---|
# | no boxes, or boxes all over | `detector.format=yolox` (or another family) says what the numbers mean |
# | good boxes, wrong names | `detector.labels=coco`, or a list of your own, in the order of the file |
# | a class is not counted | `detector.classes.vehicle=[car, tram]` says which labels are vehicles |
# | small cars are not found | `detector.input_px`, `camera.width_px` and `camera.height_px` |
#
# In Python these options go into `wa.Config.load("quick", "detector.model=mine.onnx", "detector.labels=coco")`, and all
# commands take them.
#
# ## How probable is a detection?
#
# What the fit from above has learned, and whether it is right:

# %%
predicted, detected, low, high = np.array(
    [[each.predicted, each.detected, each.low, each.high] for each in fitted.scores.bins]
).T
figure, axes = plt.subplots(1, 4, figsize=(12, 3.2), layout="constrained")
for axis, index, label in zip(
    axes, range(3), ["visible area [px²]", "visible share", "share in the frame"], strict=False
):
    feature = fitted.known.feature[:, index]
    value = np.linspace(*np.quantile(feature, [0.002, 0.998]), 100)
    shown = value if index else np.expm1(value)  # the area is fitted by its logarithm
    axis.plot(shown, fitted.model.curve(index, value))
    axis.set(xlabel=label, ylabel="" if index else "added to the logit")
    axis.grid(alpha=0.3)
    axis.sharey(axes[0])
axes[0].set_xscale("log")
axes[3].plot([0, 1], [0, 1], color="gray", linewidth=0.8)
axes[3].errorbar(predicted, detected, np.maximum([detected - low, high - detected], 0.0), fmt="o", markersize=4)
axes[3].set(xlabel="predicted probability", ylabel="share detected, 95 % interval", title="on other scenes")
plt.show()
print(f"area under the curve {fitted.scores.auc:.3f}, calibration error {fitted.scores.calibration_error:.3f}")

# %% [markdown]
# The three curves on the left show what raises the probability and by how much: here the visible area first, then the
# visible share. These are the directions in which an optimisation moves cameras. If your curve rises only at
# thousands of pixels, the images are too small for your detector, and no place on the roof helps. (There are five more
# features: aspect, distance from the border, contrast, and how high above and how upright an object is seen.)
#
# On the right the check on scenes that the fit has not seen. The area under the curve says how well the probabilities
# put what is found before what is not: 1 is perfect, 0.5 is chance. The calibration error is their mean distance from
# the diagonal.
#
# ## A detector that is no ONNX file
#
# Any object will do that has `names`, its labels, and `detect`, which takes images and gives `wa.Detections` for each.
# Here it is a wrapper that drops every box of fewer than 20 pixels in height, as a detector for large objects would:


# %%
class LargeObjects:
    def __init__(self, detector, least_px=20.0):
        self.detector, self.least_px = detector, least_px
        self.names = detector.names

    def detect(self, images_rgb):
        return [self.large(found) for found in self.detector.detect(images_rgb)]

    def large(self, found):
        kept = found.box_px[:, 3] - found.box_px[:, 1] >= self.least_px
        return wa.Detections(
            found.box_px[kept],
            found.confidence[kept],
            found.class_index[kept],
            found.names,
            found.road_user_index[kept],
        )


other = wa.Placement(train, detector=LargeObjects(detector), probability=fitted.model)
for name, one in (("all objects", placement), ("large objects", other)):
    missed = wa.evaluate(result.rig, test, one).misses["rig"]
    print(f"{name:14} the same rig misses {missed:.1f} of 100")

# %% [markdown]
# The probability is borrowed from the whole detector here. That is right for a comparison of one rig, where only real
# detections count; for an optimisation leave `probability` out, and it is fitted for your object.
#
# ## What to do next
#
# - `warpav optimise detector.model=mine.onnx` is the same on the command line, and `warpav detector evaluate
#   detector.model=mine.onnx --out figures` measures the detector alone on 236 scenes that no detector of ours has
#   seen. The shipped detector's figures are in its [model card](../warpav/detection/models/MODEL_CARD.md).
# - Use [your own vehicle and scenes](04_own_vehicle_and_scenes.ipynb).
# - [Keep some cameras of a rig, and export it](../docs/guide/exchange.md).
