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
# A camera moves a little; how many pixels of a car does it gain or lose? To move cameras by gradient descent, warpav
# has to answer that exactly, for every vehicle in every view. A render answers for each sample only *yes* or *no*:
# this is the car, or it is not. Yes and no have no derivative. This notebook shows where the derivative is instead,
# computes it in a few lines of NumPy, compares the renderer's with central differences over many poses, and follows
# it down to a camera on the roof.

# %% tags=["parameters"]
scene_seed = 3
pose_count = 50
truth_supersampling = 4

# %%
import math

import contourpy
import matplotlib.pyplot as plt
import numpy as np
from scipy.ndimage import minimum_filter

from warpav.core.warp_setup import load_warp
from warpav.detection.images import render_images
from warpav.raster.areas import VISIBLE_AREA
from warpav.raster.camera import CameraModel
from warpav.raster.renderer import Renderer
from warpav.rig.rig import RigCamera
from warpav.runs.config import load_config
from warpav.scene.device_scene import DeviceScene
from warpav.scene.town.town import town_scene

wp = load_warp()
scene = town_scene(scene_seed)
packed = DeviceScene.pack(scene)  # the triangles, sorted and ready for the renderer

# %% [markdown]
# ## A camera and a silhouette
#
# A street with a camera on the roof of our car, turned 45 degrees to the left. We follow the lorry, which stands
# behind a parked car. Its *silhouette* is the set of pixels in which the lorry is nearest to the camera. Frames: x
# points forward, y left, z up, in metres; columns and rows of the image are counted in pixels.

# %%
lens = CameraModel(width_px=512, height_px=512, fov_rad=math.radians(40))
camera = RigCamera("left", [0.6, 0.2, 1.8], yaw_rad=math.radians(45), pitch_rad=0.05, roll_rad=0.0, model=lens)

image = render_images(scene, [camera])[0]
lorry = next(k for k, each in enumerate(scene.vehicles) if each.category == "lorry")
silhouette = image.object_index == 2 + lorry  # 0 is the street, 1 our own car, then the vehicles

print(
    f"the lorry shows {image.visible_area_px[lorry]:.0f} px², alone it would show {image.amodal_area_px[lorry]:.0f} px²"
)

# %% [markdown]
# ## What moves is the outline
#
# When the camera moves, pixels inside the silhouette stay inside. The area changes only along the outline, and by as
# much as the outline sweeps over. So we need, at every point of the outline, its motion in the image. Whose motion?
# That of the surface *in front*: where the lorry ends against the sky, the lorry's own edge moves; where the parked
# car covers the lorry, the outline is the car's edge and moves with the nearer car, much faster.
#
# A point $q$ of the world, in the camera's axes, moves by $-R\,s$ when the camera shifts by $s$. Its pixel $u = f q_x
# / q_z + c$ moves accordingly:

# %%
camera_from_ego = camera.ego_from_camera[:3, :3].T
focal_px = lens.intrinsics[0, 0]


def outline():
    """Ends of the outline's segments [px], silhouette on their right, and depth of what is in front there [m]."""
    lines = contourpy.contour_generator(z=silhouette.astype(float)).lines(0.5)
    start, end = (np.concatenate([line[which] for line in lines]) for which in (slice(-1), slice(1, None)))
    column, row = np.rint((start + end) / 2).astype(int).T
    nearest_m = minimum_filter(image.depth_m, size=3)  # of the surfaces that meet there
    return start + 0.5, end + 0.5, nearest_m[row, column]  # pixel centres lie at +0.5


def motion(point_px, depth_m, shift_m):
    """How points of the image move [px] when the camera shifts by ``shift_m`` in the ego frame."""
    across = (point_px - lens.intrinsics[:2, 2]) / focal_px
    away = -camera_from_ego @ shift_m
    return focal_px * (away[:2] - across * away[2]) / depth_m[:, None]


start, end, depth_m = outline()
middle = (start + end) / 2
to_the_left = motion(middle, depth_m, np.array([0.0, 0.3, 0.0]))

figure, axes = plt.subplots(1, 2, figsize=(10, 3.8), layout="constrained")
axes[0].imshow(image.rgb)
axes[0].set_title("what the camera sees")
axes[1].imshow(np.where(silhouette, 0.82, 1.0), cmap="gray", vmin=0, vmax=1)
arrow = slice(None, None, 7)  # not all of them
drawn = {"angles": "xy", "scale_units": "xy", "scale": 1, "cmap": "viridis", "width": 0.005}
arrows = axes[1].quiver(*middle[arrow].T, *to_the_left[arrow].T, depth_m[arrow], **drawn)
axes[1].set_title("the lorry, and how its outline moves\nwhen the camera moves 0.3 m to the left")
figure.colorbar(arrows, label="depth of the surface in front [m]", shrink=0.8)
low, high = middle.min(axis=0) - 30, middle.max(axis=0) + 30
for axis in axes:
    axis.set(xlim=(low[0], high[0]), ylim=(high[1], low[1]))
    axis.axis("off")
plt.show()

# %% [markdown]
# The dark arrows belong to the parked car, which is nearer: its edge moves farther over the image.
#
# A segment from $A$ to $B$ that moves by $(\mathrm{d}u, \mathrm{d}v)$ sweeps the area $(B-A)_v\,\mathrm{d}u -
# (B-A)_u\,\mathrm{d}v$ (the silhouette on its right). Summed over the outline this is the derivative of the visible
# area (Reynolds' transport theorem). In NumPy it is one line; the renderer does the same on every outline of every
# vehicle in every view at once, with the outline solved between the samples instead of drawn along pixels ([the
# gradient on one page](../kernels/design.md#the-gradient-on-one-page)). Third, for comparison, the plainest answer:
# move the camera by 2 cm to either side, render 16 samples a pixel, and count.


# %%
def swept_area(moved):
    along = end - start
    return (along[:, 1] * moved[:, 0] - along[:, 0] * moved[:, 1]).sum()


def on_device(ego_from_camera):
    """Poses [view, 4, 4] as the renderer takes them."""
    ego_from_camera = np.asarray(ego_from_camera, np.float32)
    rotation = np.ascontiguousarray(ego_from_camera[:, :3, :3].transpose(0, 2, 1))
    return wp.array(ego_from_camera[:, :3, 3], dtype=wp.vec3), wp.array(rotation, dtype=wp.mat33)


def measure(lens, ego_from_camera, supersampling=1):
    """Areas and their Jacobians of every vehicle in every view."""
    renderer = Renderer([lens] * len(ego_from_camera), supersampling=supersampling)
    return renderer.render(packed.raster, *on_device(ego_from_camera)).measure()


def shifted(ego_from_camera, axis, step_m):
    moved = np.array(ego_from_camera)
    moved[..., axis, 3] += step_m
    return moved


here = camera.ego_from_camera[None]
exact = measure(lens, here).jac_translation.numpy()[0, lorry, VISIBLE_AREA]
print("derivative of the lorry's visible area [px²/m]")
print("             NumPy outline   warpav   differences")
for axis, name in enumerate(["x forward", "y left", "z up"]):
    by_hand = swept_area(motion(middle, depth_m, np.eye(3)[axis]))
    high, low = (
        measure(lens, shifted(here, axis, step_m), 4).value.numpy()[0, lorry, VISIBLE_AREA] for step_m in (0.02, -0.02)
    )
    print(f"{name:12} {by_hand:13.0f} {exact[axis]:8.0f} {(high - low) / 0.04:13.0f}")

# %% [markdown]
# The NumPy outline runs along whole pixels and guesses what is in front, and is already close. The renderer's
# derivative needs one render at one sample a pixel; the differences need six, with sixteen.
#
# ## Is it right everywhere?
#
# One pose proves little. So: cameras all over the roof in all directions, every vehicle that any of them sees, and
# the derivative to x, y and yaw, which are the numbers that warpav optimises first. The truth is again central
# differences of supersampled renders. Nothing in them knows about outlines, and nothing in the derivative knows about
# supersampling.

# %%
rng = np.random.default_rng(0)
small_lens = CameraModel(width_px=256, height_px=256, fov_rad=math.radians(80))
cameras = [
    RigCamera(
        f"camera_{k}",
        [rng.uniform(-0.2, 1.2), rng.uniform(-0.4, 0.4), rng.uniform(1.7, 2.0)],
        yaw_rad=rng.uniform(-math.pi, math.pi),
        pitch_rad=rng.uniform(-0.05, 0.15),
        roll_rad=0.0,
        model=small_lens,
    )
    for k in range(pose_count)
]
poses = np.stack([camera.ego_from_camera for camera in cameras])


def turned(ego_from_camera, step_rad):
    """Poses turned to the left about the vertical."""
    cos, sin = math.cos(step_rad), math.sin(step_rad)
    moved = np.array(ego_from_camera)
    moved[:, :3, :3] = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]]) @ moved[:, :3, :3]
    return moved


def areas(ego_from_camera):
    """Visible areas [px²] at many samples a pixel, ten views at a time, [view, vehicle]."""
    parts = np.array_split(ego_from_camera, math.ceil(len(ego_from_camera) / 10))
    found = [measure(small_lens, part, truth_supersampling).value.numpy()[..., VISIBLE_AREA] for part in parts]
    return np.concatenate(found)


measures = measure(small_lens, poses)
jac_translation, jac_rotation = (
    array.numpy()[:, :, VISIBLE_AREA] for array in (measures.jac_translation, measures.jac_rotation)
)
per_yaw = -np.einsum("vki,vi->vk", jac_rotation, poses[:, 2, :3])  # turning the camera left turns the world right
derivative = np.stack([jac_translation[..., 0], jac_translation[..., 1], per_yaw], axis=-1)

step_m, step_rad = 0.06, 0.006
difference = np.stack(
    [
        (areas(shifted(poses, 0, step_m)) - areas(shifted(poses, 0, -step_m))) / (2 * step_m),
        (areas(shifted(poses, 1, step_m)) - areas(shifted(poses, 1, -step_m))) / (2 * step_m),
        (areas(turned(poses, step_rad)) - areas(turned(poses, -step_rad))) / (2 * step_rad),
    ],
    axis=-1,
)

# %%
area_px = measures.value.numpy()[:, :, VISIBLE_AREA]
length = np.linalg.norm(difference, axis=-1)
counted = (area_px > 100) & (length > 20)  # what is smaller drowns in the grain of the truth's own samples
cosine = (derivative * difference).sum(axis=-1)[counted] / (length * np.linalg.norm(derivative, axis=-1))[counted]

figure, axes = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
for k, name in enumerate(["x [px²/m]", "y [px²/m]", "yaw [px²/rad]"]):
    axes[0].plot(difference[counted][:, k], derivative[counted][:, k], ".", label=name, alpha=0.6)
ends = np.array([difference[counted].min(), difference[counted].max()])
axes[0].plot(ends, ends, color="black", linewidth=0.6, zorder=0)
axes[0].set(xscale="symlog", yscale="symlog", xlabel="central difference", ylabel="derivative from one hard render")
axes[0].legend()
axes[1].plot(np.sort(1.0 - cosine), np.linspace(0.0, 1.0, len(cosine)))
axes[1].set(xscale="log", xlabel="1 - cosine between the two", ylabel="share of silhouettes", ylim=(0, 1))
axes[1].grid(alpha=0.3)
plt.show()

print(f"{counted.sum()} silhouettes in {pose_count} views: median cosine {np.median(cosine):.5f}, ", end="")
print(f"one in ten below {np.quantile(cosine, 0.1):.4f}")

# %% [markdown]
# A few points lie off the line, and it is worth asking who is wrong there. Take the one with the largest error to x,
# and walk along x in steps of 5 mm: areas of supersampled renders on the way, and the derivative of a plain render at
# each place.

# %%
error = np.where(counted, np.abs(derivative - difference)[..., 0], 0.0)
view, vehicle = np.unravel_index(np.argmax(error), error.shape)
there = poses[view : view + 1]
way_m = np.linspace(-step_m, step_m, 25)


def on_the_way(samples):
    measures = [measure(small_lens, shifted(there, 0, x), samples) for x in way_m]
    values = [(each.value.numpy()[0, vehicle], each.jac_translation.numpy()[0, vehicle]) for each in measures]
    return np.array([(value[VISIBLE_AREA], jac_translation[VISIBLE_AREA][0]) for value, jac_translation in values]).T


walked_px, _ = on_the_way(2 * truth_supersampling)
_, walked_derivative = on_the_way(1)
figure, axis = plt.subplots(figsize=(7, 3.4), layout="constrained")
axis.plot(1e3 * way_m, np.gradient(walked_px, way_m), ".-", label="differences of neighbouring areas")
axis.plot(1e3 * way_m, walked_derivative, ".-", label="derivative from one hard render")
axis.axhline(difference[view, vehicle, 0], color="gray", linestyle="--", label="difference over the whole way")
axis.set(xlabel="moved along x [mm]", ylabel="derivative [px²/m]")
axis.legend()
plt.show()

# %% [markdown]
# The derivative itself changes along the way, for the vehicle is partly hidden there. The difference over the whole
# way is its mean, and the derivative belongs to the middle: both are right, and answer different questions. The steps
# of the orange line are those of one sample a pixel; `camera.supersampling` takes more.
#
# ## From the area to the roof
#
# A camera cannot stand anywhere: its height follows from the roof below it. So what is optimised are x, y and yaw on
# the roof, and everything from there to the measured area has to be differentiated. The renderer hands
# [`wp.Tape`](https://nvidia.github.io/warp/) a function whose value is the rendered area and whose derivative is the
# Jacobian from above; the tape does the rest, through the rotation and the height map. Here the quantity at its end
# is the area of our lorry, as seen by a camera that stands on the roof and looks almost straight ahead, so that the
# image's left border cuts through the lorry:

# %%
from warpav.runs.mounts import camera_mount

config = load_config("quick", ["camera.fov_deg=80"])
mount = camera_mount(config, scene.ego)  # the height map of roof and bonnet, and how high above it cameras stand
mount_pose = np.array([[0.6, 0.2, math.radians(5), 0.0, 0.0, 0.0, 0.0]], np.float32)  # x, y, yaw, pitch, roll, ...


def lorry_area(mount_pose, supersampling):
    """Visible area of the lorry from the roof [px²]; what is recorded on the active tape is exact to first order."""
    views = mount.place(mount_pose, rotation_count=1)
    renderer = Renderer([mount.camera], supersampling=supersampling)
    frame = renderer.render(packed.raster, views.position_ego_m, views.camera_from_ego)
    return frame.measure().on_tape(views.position_ego_m, views.camera_from_ego)


pose = wp.array(mount_pose, dtype=float, requires_grad=True)
with wp.Tape() as tape:
    area = lorry_area(pose, supersampling=1)
seed = np.zeros(area.shape, np.float32)
seed[0, lorry, VISIBLE_AREA] = 1.0
tape.backward(grads={area: wp.array(seed, dtype=float)})

print("             wp.Tape   differences")
for axis, (name, step) in enumerate({"x [px²/m]": step_m, "y [px²/m]": step_m, "yaw [px²/rad]": step_rad}.items()):
    there = [mount_pose + sign * step * np.eye(7, dtype=np.float32)[axis] for sign in (1, -1)]
    high, low = (
        lorry_area(wp.array(p, dtype=float), truth_supersampling).numpy()[0, lorry, VISIBLE_AREA] for p in there
    )
    print(f"{name:13} {pose.grad.numpy()[0, axis]:6.0f} {(high - low) / (2 * step):13.0f}")

# %% [markdown]
# That is the whole of it: one hard render, an outline whose motion is known, and plain automatic differentiation of
# what follows. What follows in a run is a loss instead of an area: the share of road users that no camera is expected
# to find ([how it is made](../docs/method.md#the-default-method)), summed over all vehicles in all views of all
# scenes of a batch, and an optimiser that takes steps. `warpav doctor` repeats a check like this one on every device
# of your machine.
