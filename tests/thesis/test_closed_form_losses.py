"""All seven losses of the thesis in worlds whose losses and gradients to the poses are known by formula."""

import math

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from tests.driving_scene import ConstantDetector, flat_surface
from tests.kernels.test_mount_pose import oracle as placed_by_oracle
from tests.optimisation.objectives import OneScene, rig_objective
from tests.oracle import closed_forms, thesis
from tests.raster.bodies import cuboid, edges_of, scene_of
from tests.thesis.test_losses import THESIS_LOSSES, differences, placement_losses
from warpav.optimisation import X_M, Y_M, YAW_RAD, AssignedScene, CameraMount, LossSettings
from warpav.raster.areas import AMODAL_AREA, MEASURE_COUNT
from warpav.raster.camera import CameraModel
from warpav.raster.decide import Occlusion
from warpav.raster.renderer import Renderer
from warpav.scene import DeviceScene

MODEL = CameraModel(128, 128, math.pi / 2)
SURFACE = flat_surface([-1.0, -1.0], [1.0, 1.0], height_m=1.5)
MOVED = [X_M, Y_M, YAW_RAD]


def losses_in(scene, assigned, pose, device, name, *, box_px=None, supersampling=4, **options):
    """All losses of cameras on `SURFACE`, and the gradient of one of them to x, y and yaw [camera, 3]."""
    mount = CameraMount(SURFACE, camera=MODEL, height_offset_m=0.25, device=device)
    pose = np.asarray(pose, np.float32)
    renderer = Renderer(
        [MODEL] * (len(pose) * mount.rotation_count),
        supersampling=supersampling,
        occlusion=Occlusion.PAIRWISE,
        device=device,
        foreground_layer=True,
    )
    scene = AssignedScene(DeviceScene.pack(scene, device=device), np.array(assigned, np.int32))
    one = OneScene(mount, renderer, scene, len(pose), LossSettings(**{name: 1.0}).model_copy(update=options))
    box_px = np.zeros((len(pose), len(assigned), 4)) if box_px is None else box_px
    [loss], gradient = one.at(pose, box_px)
    return loss, gradient[:, MOVED]


def poses_of(pose):
    """``ego_from_camera`` of all views, [view, 4, 4]."""
    centre, rotation = placed_by_oracle(pose, SURFACE, MODEL)
    matrix = np.tile(np.eye(4), (len(centre), 1, 1))
    matrix[:, :3, :3] = rotation.transpose(0, 2, 1)
    matrix[:, :3, 3] = centre
    return matrix


def to_pose(area_and_derivative):
    """An area and its derivative to x, y and yaw: turning a level camera left spins the scene about its y axis."""
    area, derivative = area_and_derivative
    return area, derivative[[0, 1, 4]]


def area_of(mesh, view, window_px=None):
    """Area of a convex body and its derivative to x, y and yaw."""
    return to_pose(closed_forms.convex_area(mesh.vertex_m, edges_of(mesh), view, MODEL, window_px))


def quotient(above, below):
    """Of two values with derivatives."""
    return above[0] / below[0], (above[1] - above[0] / below[0] * below[1]) / below[0]


# --- constraints -----------------------------------------------------------------------------------------------------


# --- in-frame rotation -----------------------------------------------------------------------------------------------


# --- detected area, object visibility --------------------------------------------------------------------------------


def car_across_the_seam(yaw):
    """A car of which the camera at yaw sees a part ahead and a part in the view to its left."""
    bearing = yaw + math.radians(38.0)
    place = np.array([0.2 + 8.0 * math.cos(bearing), 0.1 + 8.0 * math.sin(bearing), 0.75])
    mesh = cuboid([4.2, 1.8, 1.5], place, (0.0, 0.0, yaw + 0.4))
    return mesh, np.array([[0.2, 0.1, yaw, 0.0, 0.0, 0.0, 0.0]])


def around(mesh, pose):
    """Area of a body in all directions."""
    parts = [area_of(mesh, view) for view in poses_of(pose)]
    return sum(part[0] for part in parts), sum(part[1] for part in parts)


# worst seen of the losses of areas: .0016 of the loss, .005 of the gradient (of the blockage .014)
@pytest.mark.equation(4, 14, 15, 16)
@pytest.mark.parametrize("yaw", [0.0, 2.1])
@pytest.mark.parametrize("epsilon", [1e-5, 0.2])
def test_detected_area_of_a_box_shaped_car(device, yaw, epsilon):
    car, pose = car_across_the_seam(yaw)
    box_px = np.array([8.5, 60.0, 128.0, 80.3])  # through the car: left, and above its lower edge
    view = poses_of(pose)[0]
    inside, whole = area_of(car, view, box_px), area_of(car, view)
    detected = tuple((1 - epsilon) * a + epsilon * b for a, b in zip(inside, whole, strict=True))
    visibility, slope = quotient(detected, around(car, pose))
    assert 0.1 < visibility < 0.8
    loss, gradient = losses_in(
        scene_of([car]),
        [0],
        pose,
        device,
        "detected_area",
        box_px=box_px[None, None],
        min_detected_area=0.9,
        epsilon=epsilon,
    )
    assert loss == pytest.approx((0.9 - visibility) / 0.9, abs=3e-3)
    np.testing.assert_allclose(gradient[0], -slope / 0.9, atol=0.01 * np.linalg.norm(slope))


@pytest.mark.equation(15, 16, 24)
@pytest.mark.parametrize("yaw", [0.0, 2.1])
def test_object_visibility_of_a_box_shaped_car(device, yaw):
    car, pose = car_across_the_seam(yaw)
    visibility, slope = quotient(area_of(car, poses_of(pose)[0]), around(car, pose))
    assert 0.1 < visibility < 0.8
    options = {"min_detected_area": 0.9, "detected_area": 0.0}
    loss, gradient = losses_in(scene_of([car]), [0], pose, device, "object_visibility", **options)
    assert loss == pytest.approx((0.9 - visibility) / 0.9, abs=3e-3)
    np.testing.assert_allclose(gradient[0], -slope / 0.9, atol=0.01 * np.linalg.norm(slope))


# --- surface blockage ------------------------------------------------------------------------------------------------

# one camera looks over the long edge of the bonnet, the other stands nearer to it and sees more
BONNET = cuboid([1.6, 1.0, 0.6], [1.9, 0.2, 1.2])
BLOCKED = cuboid([4.2, 1.8, 1.5], [12.0, 0.8, 0.75], (0.0, 0.0, 0.3))
BEHIND = np.array([[0.1, 0.4, 0.05, 0.0, 0.0, 0.0, 0.0], [0.8, 0.3, -0.02, 0.0, 0.0, 0.0, 0.0]])


def unblocked(view, car=BLOCKED, ego=BONNET):
    """Share of the car that the ego vehicle leaves free, and its derivative to x, y and yaw."""
    bodies = ((mesh.vertex_m, edges_of(mesh)) for mesh in (car, ego))
    return quotient(to_pose(closed_forms.unblocked_area(*bodies, view, MODEL)), area_of(car, view))


@pytest.mark.equation(17, 18, 19)
@pytest.mark.parametrize("order", [[0, 1], [1, 0]])
def test_surface_blockage_behind_a_bonnet(device, order):
    pose = BEHIND[order]
    shares = [unblocked(view) for view in poses_of(pose)[::4]]
    clearest = int(np.argmax([share for share, _ in shares]))
    assert clearest == order.index(1)
    visibility, slope = shares[clearest]
    assert 0.2 < shares[1 - clearest][0] + 0.05 < visibility < 0.8
    # two more vehicles: one beyond the bonnet's side, wholly free; one behind the cameras, in no frame
    free, behind = cuboid([4.2, 1.8, 1.5], [14.0, -7.0, 0.75]), cuboid([4.2, 1.8, 1.5], [-9.0, 0.0, 0.75])
    scene = scene_of([BLOCKED, free, behind], ego=BONNET)
    options = {"min_unblocked_area": 0.9, "detected_area": 0.0}
    loss, gradient = losses_in(scene, [0, 1, 0], pose, device, "surface_blockage", **options)
    assert loss == pytest.approx(((0.9 - visibility) / 0.9 + 0.0 + 1.0) / 3.0, abs=0.01)
    np.testing.assert_allclose(gradient[clearest], -slope / 0.9 / 3.0, atol=0.02 * np.linalg.norm(slope) / 3.0)
    assert not gradient[1 - clearest].any()


@pytest.mark.equation(17, 18, 19)
@pytest.mark.parametrize("min_visibility", [0.5, 1.0])
def test_surface_blockage_matches_the_oracle_on_masks(device, rng, min_visibility):
    cameras, vehicles, rotations = 3, 6, 4
    for _ in range(5):
        alone = rng.random((vehicles, cameras, 8, 8)) < 0.3
        alone[rng.random((vehicles, cameras)) < 0.4] = False
        ego = rng.random((cameras, 8, 8)) < rng.uniform(0.3, 0.9, cameras)[:, None, None]
        value = np.zeros((cameras * rotations, vehicles, MEASURE_COUNT))
        free = np.zeros((cameras * rotations, vehicles))
        value[::rotations, :, AMODAL_AREA] = alone.sum(axis=(2, 3)).T
        free[::rotations] = (alone & ~ego).sum(axis=(2, 3)).T
        still = np.zeros((*free.shape, 3))
        assigned = np.array([0, 1, -1, 2, 0, 1])
        loss, _ = placement_losses(
            value,
            assigned,
            np.zeros((cameras, 7)),
            device,
            unblocked=[free, still, still],
            surface_blockage=1.0,
            min_unblocked_area=min_visibility,
        )
        items = [(alone[k], ego) for k in np.flatnonzero(assigned >= 0)]
        expected = thesis.surface_blockage_loss(items, min_visibility)
        assert loss[THESIS_LOSSES.index("surface_blockage")] == pytest.approx(expected, rel=1e-5, abs=1e-7)


# --- angular coverage ------------------------------------------------------------------------------------------------


def angular_coverage(yaw_rad, device, fov_rad=0.5 * math.pi):
    """Loss and its gradient to every yaw."""
    pose = np.zeros((len(yaw_rad), 7))
    pose[:, YAW_RAD] = yaw_rad
    value = np.zeros((len(yaw_rad) * round(2.0 * math.pi / fov_rad), 1, MEASURE_COUNT))
    loss, gradient = placement_losses(
        value,
        [-1],
        pose,
        device,
        model=CameraModel(32, 8, fov_rad),
        weight=[name == "angular_coverage" for name in THESIS_LOSSES],
        angular_coverage=1.0,
    )
    assert not gradient[:, [i for i in range(7) if i != YAW_RAD]].any()
    return loss[THESIS_LOSSES.index("angular_coverage")], gradient[:, YAW_RAD]


@pytest.mark.equation(20, 21, 22, 23)
@given(st.data())
@settings(max_examples=60)
def test_angular_coverage_matches_the_text_step_by_step(data):
    count = data.draw(st.integers(1, 7))
    fov_rad = math.radians(data.draw(st.sampled_from([45.0, 60.0, 90.0, 120.0])))
    yaw = np.array(data.draw(st.lists(st.floats(-9.0, 9.0), min_size=count, max_size=count)))
    yaw = yaw.astype(np.float32).astype(float)
    loss, gradient = angular_coverage(yaw, "cpu", fov_rad)
    assert loss == pytest.approx(thesis.angular_coverage_loss(yaw, fov_rad), abs=1e-5)
    # off the kinks, where two ranges begin together or one begins where another ends
    apart = (yaw[:, None] - yaw)[~np.eye(count, dtype=bool)] % (2.0 * math.pi)
    for kink in (0.0, fov_rad, 2.0 * math.pi - fov_rad, 2.0 * math.pi):
        assume(not (np.abs(apart - kink) < 1e-3).any())
    expected = differences(lambda yaw: thesis.angular_coverage_loss(yaw, fov_rad), yaw, 1e-4)
    np.testing.assert_allclose(gradient, expected, atol=1e-5)


# --- scaling ---------------------------------------------------------------------------------------------------------


@pytest.mark.equation(1)
def test_constraints_are_scaled_like_the_largest_objective():
    scales = {"in_frame_rotation": 1.0, "detected_area": 2.0, "surface_blockage": 7.0, "object_visibility": 3.0}
    mount = CameraMount(SURFACE, camera=MODEL, height_offset_m=0.25)
    objective = rig_objective(mount, ConstantDetector.silent(2), camera_count=2, settings=LossSettings(**scales))
    assert {loss.name: weight for weight, loss in objective.losses} == scales
    assert objective.constraint_scale == 7.0
