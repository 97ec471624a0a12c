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
# # The rasteriser on its own
#
# **Can a renderer that only says yes or no for each sample find the pose of an object from its silhouette?** Yes,
# because `warpav.raster` differentiates what lies between the samples: the outlines. It takes meshes and cameras, and
# knows nothing of vehicles. This notebook finds a pose by gradient descent, with NVIDIA Warp and with PyTorch, and
# checks area and derivative against a closed form.

# %% tags=["parameters"]
step_count = 60

# %%
import math

import matplotlib.pyplot as plt
import numpy as np
import warp as wp

from warpav import raster

# %% [markdown]
# ## One mesh, one camera
#
# A mesh has vertices [m], triangles and colours. Objects have names and are measured one by one; occluders only hide
# them. A camera is a matrix of intrinsics, a pose a matrix that maps world to camera coordinates (x right, y down, z
# forward). Meshes usually come from files; here a profile, a closed curve of radius and height, turns about the z axis:


# %%
def turned_profile(profile_m, rgb, sections=64):
    """The surface that a profile [point, 2] makes about the z axis, coloured by how far it faces sideways."""
    angle = np.linspace(0, 2 * math.pi, sections, endpoint=False)
    radius_m, z_m = np.asarray(profile_m, float).T
    vertex_m = np.stack(
        [np.outer(np.cos(angle), radius_m), np.outer(np.sin(angle), radius_m), z_m + 0 * angle[:, None]], -1
    )
    k, count = np.arange(sections)[:, None], len(z_m)
    one, other = k * count + np.arange(count), (k + 1) % sections * count + np.arange(count)
    after = np.roll(np.arange(count), -1)
    triangle = np.concatenate(
        [np.stack([one, other, other[:, after]], -1), np.stack([one, other[:, after], one[:, after]], -1)]
    )
    shade = 0.75 + 0.25 * np.repeat(np.cos(angle - 1.0), count)
    return vertex_m.reshape(-1, 3), triangle.reshape(-1, 3), np.outer(shade, rgb)


def circle(radius_m, centre_m=0.0, points=48):
    """A profile around ``centre_m`` from the axis; a half circle where that is 0."""
    angle = np.linspace(-math.pi / 2, math.pi / 2, points) if not centre_m else np.arange(points) * 2 * math.pi / points
    return np.stack([centre_m + radius_m * np.cos(angle), radius_m * np.sin(angle)], axis=-1)


def rotation(vector):
    """The matrix of a rotation vector (Rodrigues)."""
    angle = np.linalg.norm(vector)
    x, y, z = np.asarray(vector, float) / max(angle, 1e-12)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross


def pose_matrix(rotation_vector, translation_m):
    """camera_from_world of one view, [1, 4, 4]."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation(rotation_vector), translation_m
    return matrix[None]


body_m, body, body_rgb = turned_profile([[0, -0.6], [0.5, -0.6], [0.5, 0.6], [0, 0.6]], [200, 110, 70])
handle_m, handle, handle_rgb = turned_profile(circle(0.09, 0.35), [200, 110, 70])
handle_m = handle_m @ rotation([math.pi / 2, 0, 0]).T + [0.55, 0.0, 0.05]
cup = raster.Mesh(
    np.concatenate([body_m, handle_m]),
    np.concatenate([body, handle + len(body_m)]),
    np.concatenate([body_rgb, handle_rgb]),
)
pole_m, pole, pole_rgb = turned_profile([[0, -1.5], [0.09, -1.5], [0.09, 1.5], [0, 1.5]], [90, 70, 50])
scene = raster.Scene(
    {"cup": cup},
    occluders=[raster.Mesh(pole_m + np.array([0.05, -0.9, 0]), pole, pole_rgb)],
    background_rgb=(235, 240, 245),
)
focal_px, size_px = 160.0, 128
intrinsics = np.array([[focal_px, 0, size_px / 2], [0, focal_px, size_px / 2], [0, 0, 1]])
camera = raster.Cameras(intrinsics[None], width_px=size_px, height_px=size_px)
true_pose = pose_matrix([1.9, 0.3, -0.2], [-0.1, 0.1, 3.0])
frame = raster.render(scene, camera, true_pose, samples=4)

# %% [markdown]
# ## A pose from a silhouette, with Warp
#
# We see only the silhouette of the cup, behind the pole, and guess a pose that is off by some 15 degrees and half a
# metre. The loss is the mean squared difference of the two silhouettes. On a `wp.Tape`, `frame.silhouettes(pose)` is a
# function of the pose; its gradient comes from the outlines.

# %%
target = frame.silhouettes().numpy()
guessed = np.array([2.1, 0.2, 0.0, -0.3, 0.3, 3.4])  # rotation vector and translation [m]
guess = pose_matrix(guessed[:3], guessed[3:])


def loss_and_gradient(pose):
    """Mean squared difference of silhouettes, and its gradient to ``camera_from_world`` [view, 4, 4]."""
    variable = wp.array(pose, dtype=float, requires_grad=True)
    frame = raster.render(scene, camera, variable, samples=2)
    with wp.Tape() as tape:
        silhouette = frame.silhouettes(variable)
    difference = silhouette.numpy() - target
    tape.backward(grads={silhouette: wp.array(2.0 * difference / difference.size, dtype=float)})
    return (difference**2).mean(), variable.grad.numpy(), silhouette.numpy()[0, 0]


def to_twist(pose, gradient):
    """The gradient to a small rotation about the camera's axes (3), and to the translation (3)."""
    moment = gradient[0, :3, :3] @ pose[0, :3, :3].T
    rotation = [moment[2, 1] - moment[1, 2], moment[0, 2] - moment[2, 0], moment[1, 0] - moment[0, 1]]
    return np.concatenate([rotation, gradient[0, :3, 3]])


class Adam:
    def __init__(self, rate, decay=(0.8, 0.95)):
        self.rate, self.decay, self.mean, self.square, self.count = rate, decay, 0.0, 0.0, 0

    def step(self, gradient):
        self.count += 1
        self.mean = self.decay[0] * self.mean + (1 - self.decay[0]) * gradient
        self.square = self.decay[1] * self.square + (1 - self.decay[1]) * gradient**2
        mean, square = (
            each / (1 - b**self.count) for each, b in zip((self.mean, self.square), self.decay, strict=True)
        )
        return -self.rate * mean / (np.sqrt(square) + 1e-12)


def pose_error(pose):
    """Angle [deg] and distance [mm] from the true pose."""
    cosine = (np.trace(pose[0, :3, :3] @ true_pose[0, :3, :3].T) - 1) / 2
    return math.degrees(math.acos(min(cosine, 1.0))), 1e3 * np.linalg.norm(pose[0, :3, 3] - true_pose[0, :3, 3])


pose, adam, losses, silhouettes = guess.copy(), Adam(rate=0.04), [], []
for count in range(step_count):
    loss, gradient, silhouette = loss_and_gradient(pose)
    adam.rate = 0.04 * (1 - count / step_count)
    step = adam.step(to_twist(pose, gradient))
    pose[0, :3, :3] = rotation(step[:3]) @ pose[0, :3, :3]
    pose[0, :3, 3] += step[3:]
    losses.append(loss)
    silhouettes.append(silhouette)


def overlay(silhouette):
    """Target in green, silhouette in magenta, both in grey."""
    seen, wanted = 0.75 * silhouette, 0.75 * target[0, 0]
    return 1 - np.stack([wanted, seen, wanted], axis=-1)


figure, axes = plt.subplots(1, 5, figsize=(12, 2.6), layout="constrained", width_ratios=[1, 1, 1, 1, 1.6])
for axis, index in zip(axes, np.linspace(0, len(silhouettes) - 1, 4).astype(int), strict=False):
    axis.imshow(overlay(silhouettes[index]))
    axis.set_title(f"step {index}")
    axis.axis("off")
axes[4].semilogy(losses)
axes[4].set(xlabel="step", ylabel="loss")
plt.show()
print("guess: off by {:.2f} degrees and {:.1f} mm".format(*pose_error(guess)))
print("found: off by {:.2f} degrees and {:.1f} mm".format(*pose_error(pose)))

# %% [markdown]
# Green is the target, magenta the render, grey where they agree.
#
# ## The same with PyTorch
#
# `warpav.raster.torch` (`pip install "warpav[torch]"`) has the same quantities as functions of tensors: `visible_area`,
# `silhouette`, `depth`, `rgb`. A pose is a tensor [view, 4, 4], or [view, 6]: rotation vector and translation. The rest
# is what you know of PyTorch.

# %%
try:
    import torch

    from warpav.raster import torch as wt
except ModuleNotFoundError:
    torch = None
    print("PyTorch is not installed here, so the cells below do nothing: pip install 'warpav[torch]'")

# %%
if torch is not None:
    variable = torch.tensor(guessed[None], dtype=torch.float32, requires_grad=True)
    wanted = torch.tensor(target)
    optimiser = torch.optim.Adam([variable], lr=0.04, betas=(0.8, 0.95))
    schedule = torch.optim.lr_scheduler.LinearLR(optimiser, 1.0, 0.01, step_count)
    for _ in range(step_count):
        optimiser.zero_grad()
        loss = (wt.silhouette(scene, camera, variable, samples=2) - wanted).square().mean()
        loss.backward()
        optimiser.step()
        schedule.step()
    found = variable.detach().numpy()[0].astype(float)
    print("found: off by {:.2f} degrees and {:.1f} mm".format(*pose_error(pose_matrix(found[:3], found[3:]))))

# %% [markdown]
# Is the gradient right there too? Colours of the whole image, against central differences of renders with 64 samples a
# pixel. The weights vary smoothly over the image, as a network's gradients do on the scale of a few pixels:

# %%
if torch is not None:
    row, column = torch.meshgrid(*[torch.linspace(0, math.pi, size_px)] * 2, indexing="ij")
    weight = torch.stack([row.cos(), column.cos(), (row + column).sin()], dim=-1)

    def weighted_colour(vector, samples):
        return (wt.rgb(scene, camera, vector[None], samples=samples)[0] * weight).sum()

    truth_at = torch.tensor(guessed, dtype=torch.float32)
    at = truth_at.clone().requires_grad_()
    weighted_colour(at, 2).backward()
    difference = []
    for k, step in enumerate([0.004] * 3 + [0.01] * 3):
        moved = step * torch.eye(6)[k]
        difference.append((weighted_colour(truth_at + moved, 8) - weighted_colour(truth_at - moved, 8)) / (2 * step))
    figure, axis = plt.subplots(figsize=(7, 3), layout="constrained")
    position = np.arange(6)
    axis.bar(position - 0.2, at.grad.numpy(), 0.4, label="backward, 4 samples a pixel")
    axis.bar(position + 0.2, [each.item() for each in difference], 0.4, label="central difference, 64 samples")
    axis.set(
        xticks=position, xticklabels=["turn x", "turn y", "turn z", "x", "y", "z"], ylabel="derivative of the colours"
    )
    axis.axhline(0, color="black", linewidth=0.6)
    axis.legend()
    plt.show()

# %% [markdown]
# Gradients reach poses and focal lengths. Vertices, colours and distortion have none yet.
#
# ## What a frame has

# %%
figure, axes = plt.subplots(1, 4, figsize=(11, 2.9), layout="constrained")
depth_m = frame.depth_m.numpy()[0]
shown = {
    "rgb": frame.rgb.numpy()[0],
    "depth_m": np.where(np.isfinite(depth_m), depth_m, np.nan),
    "object_id (-1 nothing, -2 occluder)": frame.object_id.numpy()[0],
    "silhouettes()": frame.silhouettes().numpy()[0, 0],
}
for axis, (title, image) in zip(axes, shown.items(), strict=True):
    drawn = axis.imshow(image)
    axis.set_title(title, fontsize=10)
    axis.axis("off")
    if image.ndim == 2:
        figure.colorbar(drawn, shrink=0.7)
plt.show()

areas = frame.areas()
print(f"visible {areas.visible.numpy()[0, 0]:.1f} px², alone {areas.amodal.numpy()[0, 0]:.1f} px²")

# %% [markdown]
# Everything is a Warp array on the device of the scene, `device="cuda:0"` included. `.numpy()` copies it to the host;
# with DLPack other libraries read it where it is.
#
# ## Is it right?
#
# A sphere of radius $r$ at distance $d$ on the optical axis has a silhouette of $A = \pi f^2 r^2 / (d^2 - r^2)$, with
# $f$ the focal length in pixels. So its derivative to the distance is $-2 \pi f^2 r^2 d / (d^2 - r^2)^2$, and that to
# $\ln f$ is $2A$. The frame has both, from one render at one sample a pixel:

# %%
ball_scene = raster.Scene({"ball": raster.Mesh(*turned_profile(circle(1.0, points=161), [200, 80, 60], sections=320))})
distance_m = np.linspace(3.0, 8.0, 21)
ball_cameras = raster.Cameras(np.tile(intrinsics, (len(distance_m), 1, 1)), width_px=size_px, height_px=size_px)
poses = np.concatenate([pose_matrix([0, 0, 0], [0, 0, d]) for d in distance_m])
measured = raster.render(ball_scene, ball_cameras, poses).areas()
area_px, jacobian = measured.visible.numpy()[:, 0], measured.jacobian.numpy()[:, 0]

closed = math.pi * focal_px**2 / (distance_m**2 - 1)
closed_slope = -2 * math.pi * focal_px**2 * distance_m / (distance_m**2 - 1) ** 2
slope = -jacobian[:, 2]  # to the centre of the camera along z, which looks at the ball from -d

figure, axes = plt.subplots(1, 2, figsize=(10, 3.4), layout="constrained")
for axis, exact, found, label in [
    (axes[0], closed, area_px, "area [px²]"),
    (axes[1], closed_slope, slope, "derivative to the distance [px²/m]"),
]:
    axis.plot(distance_m, exact, color="black", linewidth=0.8, label="closed form")
    axis.plot(distance_m, found, "o", color="tab:orange", markersize=4, label="one hard render")
    axis.set(xlabel="distance [m]", ylabel=label)
    axis.legend()
plt.show()

for name, found, exact in [
    ("area", area_px, closed),
    ("derivative to the distance", slope, closed_slope),
    ("derivative to ln f", jacobian[:, 6], 2 * closed),
]:
    print(f"{name:27} off by {100 * np.abs(found / exact - 1).mean():.2f} % on average")

# %% [markdown]
# The area is counted in whole samples, so it has their noise; `samples=4` takes sixteen a pixel. `jacobian` [view,
# object, 7] holds the derivatives of every visible area: to the centre of the camera, to a small rotation about its
# axes, and to the logarithm of the focal length.
#
# ## What to do next
#
# - See why this works: [how the gradient works](02_how_the_gradient_works.ipynb).
# - See what it is for: [a first run](01_first_run.ipynb) places cameras by it.
# - Fisheyes, Brown-Conrady lenses and panoramas: `raster.Cameras(..., lens="fisheye", distortion=[...])`.
