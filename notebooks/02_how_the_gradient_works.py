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
# # How the gradient works
#
# **A camera moves a little: how many pixels of a car does it gain or lose?** To move cameras by gradient descent,
# warpav has to answer this exactly, for every vehicle in every view. But each sample of a render only says *yes* or
# *no*: this is the car, or it is not. Yes and no have no derivative. This notebook shows where the derivative is
# instead, computes it in a few lines of NumPy, compares the renderer's with central differences over many poses, and
# follows it up to the objective of a rig.

# %% tags=["parameters"]
scene_seed = 3
pose_count, truth_samples, step_count = 50, 4, 25

# %%
import dataclasses
import math

import matplotlib.pyplot as plt
import numpy as np

import warpav as wa
from warpav import raster

street = wa.town([scene_seed])[0]
names = [f"{vehicle.category} {vehicle.instance_id}" for vehicle in street.vehicles]
scene = raster.Scene(
    dict(zip(names, [vehicle.mesh for vehicle in street.vehicles], strict=True)),
    occluders=[street.environment, street.ego, *(other.mesh for other in street.others)],
    background_rgb=(200, 215, 230),
)

# %% [markdown]
# ## What moves is the outline
#
# A camera on the roof of our car, turned 45 degrees to the left. We follow the lorry, which stands behind a parked
# car. Its *silhouette* is the set of pixels in which the lorry is nearest to the camera.
#
# When the camera moves, pixels inside the silhouette stay inside. The area changes only along the outline, and by as
# much as the outline sweeps over. So we need the motion of the outline at each of its points. Whose motion? That of
# the surface *in front*: where the lorry ends against the sky, the edge of the lorry moves; where the parked car covers
# the lorry, the edge of the car moves, and it moves faster, because it is nearer.
#
# A point $q$ in the axes of the camera moves by $-R\,s$ when the camera shifts by $s$. Its pixel $u = f q_x / q_z + c$
# moves accordingly:

# %%
lens = wa.CameraModel(width_px=512, height_px=512, fov_rad=math.radians(40))
camera = wa.Camera("left", np.array([0.6, 0.2, 1.8]), math.radians(45), pitch_rad=0.05, roll_rad=0.0, model=lens)
focal_px = lens.intrinsics[0, 0]


def render(lens, ego_from_camera, samples=1):
    """A frame of one view for each pose [view, 4, 4]."""
    cameras = raster.Cameras([lens.intrinsics] * len(ego_from_camera), width_px=lens.width_px, height_px=lens.height_px)
    return raster.render(scene, cameras, np.linalg.inv(ego_from_camera), samples)


def outline(silhouette, depth_m):
    """Ends of the segments of the outline [px], silhouette on their right, and depth of what is in front there [m]."""
    lines = plt.Figure().subplots().contour(silhouette.astype(float), [0.5]).allsegs[0]
    start, end = (np.concatenate([line[which] for line in lines]) for which in (slice(-1), slice(1, None)))
    column, row = np.rint((start + end) / 2).astype(int).T
    around_m = np.lib.stride_tricks.sliding_window_view(np.pad(depth_m, 1, mode="edge"), (3, 3))
    nearest_m = around_m.min(axis=(2, 3))  # of the surfaces that meet there
    return start + 0.5, end + 0.5, nearest_m[row, column]  # pixel centres lie at +0.5


def motion(point_px, depth_m, shift_m):
    """How points of the image move [px] when the camera shifts by ``shift_m`` in the ego frame."""
    across = (point_px - lens.intrinsics[:2, 2]) / focal_px
    away = -camera.ego_from_camera[:3, :3].T @ shift_m
    return focal_px * (away[:2] - across * away[2]) / depth_m[:, None]


here = camera.ego_from_camera[None]
frame = render(lens, here)
lorry = next(k for k, name in enumerate(names) if name.startswith("lorry"))
silhouette = frame.object_id.numpy()[0] == lorry
start, end, depth_m = outline(silhouette, frame.depth_m.numpy()[0])
middle = (start + end) / 2
to_the_left = motion(middle, depth_m, np.array([0.0, 0.3, 0.0]))

figure, axes = plt.subplots(1, 2, figsize=(10, 3.8), layout="constrained")
axes[0].imshow(frame.rgb.numpy()[0])
axes[0].set_title("what the camera sees")
axes[1].imshow(np.where(silhouette, 0.82, 1.0), cmap="gray", vmin=0, vmax=1)
arrow = slice(None, None, 7)  # not all of them
drawn = {"angles": "xy", "scale_units": "xy", "scale": 1, "cmap": "viridis", "width": 0.005}
arrows = axes[1].quiver(*middle[arrow].T, *to_the_left[arrow].T, depth_m[arrow], **drawn)
areas = frame.areas()
per_m = areas.jacobian.numpy()[0, lorry, 1]  # to the position: x forward, y left, z up
axes[1].set_title(
    "how the lorry's outline moves when the camera moves\n"
    f"0.3 m to the left: its visible area changes by {per_m:+.0f} px² a metre"
)
figure.colorbar(arrows, label="depth of the surface in front [m]", shrink=0.8)
low, high = middle.min(axis=0) - 30, middle.max(axis=0) + 30
for axis in axes:
    axis.set(xlim=(low[0], high[0]), ylim=(high[1], low[1]))
    axis.axis("off")
plt.show()

visible_px, alone_px = areas.visible.numpy()[0, lorry], areas.amodal.numpy()[0, lorry]
print(f"the lorry shows {visible_px:.0f} px², alone it would show {alone_px:.0f} px²")

# %% [markdown]
# The dark arrows belong to the parked car: it is nearer, so its edge moves farther across the image.
#
# A segment from $A$ to $B$ that moves by $(\mathrm{d}u, \mathrm{d}v)$ sweeps the area $(B-A)_v\,\mathrm{d}u -
# (B-A)_u\,\mathrm{d}v$ (silhouette on its right). Summed over the outline, this is the derivative of the visible area
# (Reynolds' transport theorem). In NumPy it is one line. The renderer does the same on every outline of every vehicle
# in every view at once, and locates the outline between the samples instead of along pixels ([the gradient on one
# page](../kernels/README.md#the-gradient-on-one-page)). Third, for comparison, the plainest answer: move the camera by
# 2 cm to either side, render 16 samples a pixel, and count.


# %%
def swept_area(moved):
    along = end - start
    return (along[:, 1] * moved[:, 0] - along[:, 0] * moved[:, 1]).sum()


def shifted(ego_from_camera, axis, step_m):
    moved = np.array(ego_from_camera)
    moved[..., axis, 3] += step_m
    return moved


exact = areas.jacobian.numpy()[0, lorry]  # to the position (3), to a rotation (3), to the logarithm of the focal length
print("derivative of the lorry's visible area [px²/m]")
print("             NumPy outline   warpav   differences")
for axis, name in enumerate(["x forward", "y left", "z up"]):
    by_hand = swept_area(motion(middle, depth_m, np.eye(3)[axis]))
    high, low = (
        render(lens, shifted(here, axis, step_m), 4).areas().visible.numpy()[0, lorry] for step_m in (0.02, -0.02)
    )
    print(f"{name:12} {by_hand:13.0f} {exact[axis]:8.0f} {(high - low) / 0.04:13.0f}")

# %% [markdown]
# The NumPy outline runs along whole pixels and guesses what is in front, and is already close. The renderer's
# derivative needs one render at one sample a pixel; the differences need six, with sixteen.
#
# ## Is it right everywhere?
#
# One pose proves little. So: cameras all over the roof in all directions, every vehicle that any of them sees, and the
# derivative to x, y and yaw. The truth is again central differences of supersampled
# renders. They know nothing about outlines, and the derivative knows nothing about supersampling.

# %%
rng = np.random.default_rng(0)
small_lens = wa.CameraModel(width_px=256, height_px=256, fov_rad=math.radians(80))
poses = np.stack(
    [
        wa.Camera(
            f"camera_{k}",
            np.array([rng.uniform(-0.2, 1.2), rng.uniform(-0.4, 0.4), rng.uniform(1.7, 2.0)]),
            yaw_rad=rng.uniform(-math.pi, math.pi),
            pitch_rad=rng.uniform(-0.05, 0.15),
            roll_rad=0.0,
            model=small_lens,
        ).ego_from_camera
        for k in range(pose_count)
    ]
)


def turned(ego_from_camera, step_rad):
    """Poses turned to the left about the vertical."""
    cos, sin = math.cos(step_rad), math.sin(step_rad)
    moved = np.array(ego_from_camera)
    moved[:, :3, :3] = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]]) @ moved[:, :3, :3]
    return moved


def true_areas(ego_from_camera):
    """Visible areas [px²] at many samples a pixel, ten views at a time, [view, vehicle]."""
    parts = np.array_split(ego_from_camera, math.ceil(len(ego_from_camera) / 10))
    return np.concatenate([render(small_lens, part, truth_samples).areas().visible.numpy() for part in parts])


areas = render(small_lens, poses).areas()
jacobian = areas.jacobian.numpy()
per_yaw = -np.einsum("vki,vi->vk", jacobian[..., 3:6], poses[:, 2, :3])  # a camera turned left turns the world right
derivative = np.stack([jacobian[..., 0], jacobian[..., 1], per_yaw], axis=-1)

step_m, step_rad = 0.06, 0.006
difference = np.stack(
    [
        (true_areas(shifted(poses, 0, step_m)) - true_areas(shifted(poses, 0, -step_m))) / (2 * step_m),
        (true_areas(shifted(poses, 1, step_m)) - true_areas(shifted(poses, 1, -step_m))) / (2 * step_m),
        (true_areas(turned(poses, step_rad)) - true_areas(turned(poses, -step_rad))) / (2 * step_rad),
    ],
    axis=-1,
)

# %%
length = np.linalg.norm(difference, axis=-1)
counted = (areas.visible.numpy() > 100) & (length > 20)  # what is smaller drowns in the noise of the truth's samples
cosine = (derivative * difference).sum(axis=-1)[counted] / (length * np.linalg.norm(derivative, axis=-1))[counted]

figure, axes = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
for k, name in enumerate(["x [px²/m]", "y [px²/m]", "yaw [px²/rad]"]):
    axes[0].plot(difference[counted][:, k], derivative[counted][:, k], ".", label=name, alpha=0.6)
ends = np.array([difference[counted].min(), difference[counted].max()])
axes[0].plot(ends, ends, color="black", linewidth=0.6, zorder=0)
axes[0].set_xscale("symlog", linthresh=10.0)
axes[0].set_yscale("symlog", linthresh=10.0)
axes[0].set(xlabel="central difference", ylabel="derivative from one hard render")
axes[0].legend()
axes[1].plot(np.sort(1.0 - cosine), np.linspace(0.0, 1.0, len(cosine)))
axes[1].set(xscale="log", xlabel="1 - cosine between the two", ylabel="share of silhouettes", ylim=(0, 1))
axes[1].grid(alpha=0.3)
plt.show()

print(f"{counted.sum()} silhouettes in {pose_count} views: median cosine {np.median(cosine):.5f}, ", end="")
print(f"one in ten below {np.quantile(cosine, 0.1):.4f}")

# %% [markdown]
# A few points lie off the line. Which of the two is wrong there? Take the point with the largest error to x, and move
# along x in small steps: differences of neighbouring areas, supersampled, and the derivative of a plain render at each
# position.

# %%
error = np.where(counted, np.abs(derivative - difference)[..., 0], 0.0)
view, vehicle = np.unravel_index(np.argmax(error), error.shape)
along_m = np.linspace(-step_m, step_m, step_count)
moved = np.concatenate([shifted(poses[view : view + 1], 0, x) for x in along_m])
true_px = np.array([render(small_lens, pose[None], 8).areas().visible.numpy()[0, vehicle] for pose in moved])
derivatives = render(small_lens, moved).areas().jacobian.numpy()[:, vehicle, 0]

figure, axis = plt.subplots(figsize=(7, 3.4), layout="constrained")
axis.plot(1e3 * along_m, np.gradient(true_px, along_m), ".-", label="differences of neighbouring areas")
axis.plot(1e3 * along_m, derivatives, ".-", label="derivative from one hard render")
axis.axhline(difference[view, vehicle, 0], color="gray", linestyle="--", label="difference over the whole distance")
axis.set(xlabel="moved along x [mm]", ylabel="derivative [px²/m]")
axis.legend()
plt.show()

# %% [markdown]
# The derivative itself changes on the way, because the vehicle is partly hidden there. The difference over the whole
# distance is its mean; the derivative belongs to the middle. Both are right, and answer different questions. The steps
# of the orange line are those of one sample a pixel; `camera.supersampling` takes more.
#
# ## From the area to the objective of a rig
#
# What is optimised is not an area but the *objective*: the expected share of road users that no camera detects ([its
# definition](../docs/method.md#the-default-method)). `wp.Tape` of NVIDIA Warp joins the Jacobians from above with the
# probability of detection on the one side, and with the rotation of the camera and the height map of the roof on the
# other. `value_and_grad` gives both ends. Here one camera of a rig turns; the gradient should be the slope of the
# objective at every angle:

# %%
placement = wa.Placement(wa.town(range(3)), cameras=4, rig={"symmetric": False})
around = [
    wa.Camera(name, np.array([x, y, 1.8]), math.radians(yaw), pitch_rad=0.0, roll_rad=0.0, model=wa.CameraModel())
    for name, x, y, yaw in [
        ("front", 0.9, 0, 0),
        ("left", 0.6, 0.4, 90),
        ("rear", 0.1, 0, 180),
        ("right", 0.6, -0.4, -90),
    ]
]
angles_deg = np.linspace(26, 46, 3 * step_count)
values, slopes = [], []
for angle_deg in angles_deg:
    front = dataclasses.replace(around[0], yaw_rad=math.radians(angle_deg))
    value, gradient = placement.value_and_grad(wa.Rig([front, *around[1:]]))
    values.append(value)
    slopes.append(gradient["front"]["yaw_rad"] * math.pi / 180)

figure, axis = plt.subplots(figsize=(7, 3.6), layout="constrained")
axis.plot(angles_deg, values, ".-", color="tab:blue", label="objective")
for k, (angle_deg, value, slope) in enumerate(zip(angles_deg, values, slopes, strict=True)):
    reach_deg = np.array([-1.0, 1.0]) * min(0.5, 0.012 / max(abs(slope), 1e-6))  # of the same length on the page
    label = None if k else "slope from the gradient"
    axis.plot(
        angle_deg + reach_deg, value + slope * reach_deg, color="tab:orange", linewidth=1.5, label=label, zorder=3
    )
axis.set(xlabel="yaw of the front camera [deg]", ylabel="expected share not detected")
axis.legend()
plt.show()

# %% [markdown]
# The steps are vehicles that leave the image. While the border of the image cuts a vehicle, there is a slope, and the
# gradient has it. On the plateaus between, nothing pulls: this is why a search sees many scenes, whose steps lie at
# other angles, and begins with a rig that is selected from a pool of cameras all over the vehicle.
#
# That is all of it: one hard render, an outline whose motion is known, and plain automatic differentiation of what
# follows. An optimiser that takes steps does the rest. `warpav doctor` repeats a check like this one on every device of
# your machine.
#
# ## What to do next
#
# - Use [the rasteriser on its own](03_rasteriser.ipynb), with Warp or PyTorch.
# - See the gradient at work: [a first run](01_first_run.ipynb).
# - `placement.detection_probabilities(rig)` gives the matrix [camera, object] below the objective.
