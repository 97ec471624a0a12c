"""Every loss against the printed formula, and its gradient against finite differences of that formula."""

import functools
import math
from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp

from tests.driving_scene import flat_surface, roof
from tests.kernels.test_mount_pose import oracle as placed_by_oracle
from tests.optimisation.objectives import thesis_losses
from tests.oracle import thesis
from warpav.optimisation import CameraMount, LossOptions, Reference, SceneOnTape, losses_of
from warpav.optimisation.losses._lagrangian import lagrangian_of
from warpav.raster.areas import AMODAL_AREA, BOX_AREA, LEFT, MEASURE_COUNT, RIGHT, VISIBLE_AREA, Measures
from warpav.raster.camera import CameraModel
from warpav.thesis import BoundsAndSpacing

WIDTH, HEIGHT = 32, 8
THESIS_LOSSES = ("in_frame_rotation", "detected_area", "surface_blockage", "object_visibility", "angular_coverage")
MODEL = CameraModel(WIDTH, HEIGHT, math.pi / 2)
SURFACE = flat_surface([-2.0, -1.0], [2.0, 1.0])


def differences(function, value, step):
    """Central differences of a scalar function, double precision."""
    gradient = np.zeros_like(value, float)
    for i in np.ndindex(value.shape):
        high, low = value.astype(float), value.astype(float)
        high[i] += step
        low[i] -= step
        gradient[i] = (function(high) - function(low)) / (2 * step)
    return gradient


# --- constraints -----------------------------------------------------------------------------------------------------


def constraint_losses(pose, device, surface, min_spacing_m=0.5, weight=(1.0, 0.0)):
    """Losses, and the gradient of their weighted sum to the mount pose."""
    mount = CameraMount(surface, camera=MODEL, height_offset_m=0.25, device=device)
    array = wp.array(np.asarray(pose, np.float32), dtype=float, device=device, requires_grad=True)
    tape = wp.Tape()
    with tape:
        views = mount.place(array)
        loss = BoundsAndSpacing(surface, min_spacing_m=min_spacing_m).losses_of(views, mount.rotation_count)
    tape.backward(grads={loss: wp.array(np.array(weight, np.float32), dtype=float, device=device)})
    return loss.numpy(), array.grad.numpy()


def scattered_poses(rng, camera_count):
    """Cameras, some of them beyond the bounds of `SURFACE`."""
    return np.c_[rng.uniform([-3.0, -2.0], [3.0, 2.0], (camera_count, 2)), rng.normal(size=(camera_count, 5))].astype(
        np.float32
    )


@pytest.mark.equation(5, 6)
def test_out_of_bounds_loss_matches_oracle(device, rng):
    low, high = SURFACE.bounds_m
    for _ in range(10):
        pose = scattered_poses(rng, 5)
        loss, gradient = constraint_losses(pose, device, SURFACE)
        assert loss[0] == pytest.approx(thesis.out_of_bounds_loss(pose[:, :2], low, high), rel=1e-5)
        expected = differences(functools.partial(thesis.out_of_bounds_loss, low_m=low, high_m=high), pose[:, :2], 1e-6)
        np.testing.assert_allclose(gradient[:, :2], expected, rtol=1e-4, atol=1e-5)
        assert not gradient[:, 2:].any()


@pytest.mark.equation(7, 8, 9)
@pytest.mark.parametrize("surface", [SURFACE, roof()], ids=["flat", "curved"])
@pytest.mark.parametrize("camera_count", [2, 3, 5])
def test_camera_spacing_loss_matches_oracle(device, rng, surface, camera_count):
    def loss_at(place):
        pose = np.c_[place, np.zeros((camera_count, 5))]
        return thesis.camera_distancing_loss(placed_by_oracle(pose, surface, MODEL)[0][::4], 0.5)

    origin, cell, reached = surface.origin_m, surface.cell_m, 0
    for _ in range(10):
        low, high = surface.bounds_m
        place = rng.uniform(0.5 * (low + high) - 0.35, 0.5 * (low + high) + 0.35, (camera_count, 2))
        # off the lines between cells, where the slope of the surface jumps
        place = origin + (np.floor((place - origin) / cell) + rng.uniform(0.2, 0.8, place.shape)) * cell
        pose = np.c_[place, np.zeros((camera_count, 5))].astype(np.float32)
        loss, gradient = constraint_losses(pose, device, surface, weight=(0.0, 1.0))
        assert loss[1] == pytest.approx(loss_at(pose[:, :2].astype(float)), rel=1e-4, abs=1e-6)
        np.testing.assert_allclose(gradient[:, :2], differences(loss_at, pose[:, :2], 1e-6), atol=2e-3)
        reached += loss[1] > 0.0
    assert reached >= 5


# --- objectives ------------------------------------------------------------------------------------------------------


def placement_losses(
    value,
    assigned,
    pose,
    device,
    *,
    model=MODEL,
    jac_translation=None,
    jac_rotation=None,
    unblocked=None,
    weight=(1.0, 0.0),
    reference=Reference.NON_OCCLUDED,
    **settings,
):
    """Losses for measures [view, vehicle, measure], and the gradient of their weighted sum to the pose.

    ``unblocked`` holds values [view, vehicle] and Jacobians to shift and spin [view, vehicle, 3].
    """
    mount = CameraMount(SURFACE, camera=model, height_offset_m=0.25, device=device)
    array = wp.array(np.asarray(pose, np.float32), dtype=float, device=device, requires_grad=True)
    assigned = np.asarray(assigned, np.int32)
    tape = wp.Tape()
    with tape:
        views = mount.place(array)

    def measured(value, jac_translation, jac_rotation):
        zero = np.zeros((*value.shape, 3))
        return Measures(
            wp.array(value.astype(np.float32), dtype=float, device=device),
            wp.array(
                (zero if jac_translation is None else jac_translation).astype(np.float32), dtype=wp.vec3, device=device
            ),
            wp.array((zero if jac_rotation is None else jac_rotation).astype(np.float32), dtype=wp.vec3, device=device),
            wp.zeros(value.shape, dtype=float, device=device),
            wp.clone(views.position_ego_m, requires_grad=False),
            wp.clone(views.camera_from_ego, requires_grad=False),
            wp.clone(views.log_zoom, requires_grad=False),
        )

    measures = measured(value, jac_translation, jac_rotation)
    frame = SimpleNamespace(device=measures.value.device, view_count=len(value))
    scene = SimpleNamespace(vehicle_count=len(assigned))
    on_device = wp.array(assigned, dtype=wp.int32, device=device)
    nothing = wp.zeros((len(array), len(assigned)), dtype=float, device=device)
    on_tape = SceneOnTape(
        mount, frame, scene, views, measures, assigned, on_device, nothing, nothing, nothing, [], nothing
    )
    if unblocked is not None:
        on_tape.__dict__["unblocked"] = measured(*(numbers[:, :, None] for numbers in unblocked))
    losses = {}
    with tape:
        for _, loss in losses_of(LossOptions(thesis_losses(**settings), reference)):
            losses[loss.name] = loss.on_tape(on_tape)
    weight = dict(zip(THESIS_LOSSES, weight, strict=False))
    tape.backward(
        grads={
            loss: wp.array([float(weight.get(name, 0.0))], dtype=float, device=device) for name, loss in losses.items()
        }
    )
    values = [losses[name].numpy()[0] if name in losses else 0.0 for name in THESIS_LOSSES]
    return np.array(values, np.float32), array.grad.numpy()


def measures_of(silhouettes):
    """Measures of vehicles alone and unhidden, from silhouettes [camera, vehicle, rotation, row, column]."""
    cameras, vehicles, rotations, _, width = silhouettes.shape
    value = np.zeros((cameras * rotations, vehicles, MEASURE_COUNT))
    value[..., LEFT] = width
    for camera, k, a in np.ndindex(cameras, vehicles, rotations):
        mask = silhouettes[camera, k, a]
        value[camera * rotations + a, k, [AMODAL_AREA, VISIBLE_AREA]] = mask.sum()
        columns = np.flatnonzero(mask.any(axis=0))
        if len(columns):
            value[camera * rotations + a, k, [LEFT, RIGHT]] = columns[0], columns[-1] + 1
    return value


def ends_of(value, yaw_rad):
    """Bearings of a vehicle's ends from its measures [rotation, measure]."""
    return thesis.merged_bearings(
        *value[:, [AMODAL_AREA, LEFT, RIGHT]].T, yaw_rad=yaw_rad, fov_rad=MODEL.fov_rad, width_px=WIDTH
    )


def band(left_column, column_count, rotations=4, rows=slice(2, 5)):
    """A silhouette [rotation, row, column] on the circle of all views, counted from the left end of view 0.

    View a + 1 lies to the left of view a, so column -1 is the last of view 1.
    """
    circle = np.zeros((HEIGHT, rotations * WIDTH), bool)
    circle[rows, (left_column + np.arange(column_count)) % (rotations * WIDTH)] = True
    parts = np.split(circle, rotations, axis=1)  # view 0, then what lies to its right: the last view, ...
    return np.stack([parts[-a % rotations] for a in range(rotations)])


def bearing_of(column):
    """Bearing of a place on that circle, relative to the camera's yaw, left positive."""
    return (0.5 * WIDTH - column) / WIDTH * math.pi / 2


@pytest.mark.equation(10, 11, 12, 13)
@pytest.mark.parametrize("yaw_rad", [0.0, 0.3, 3.1, -3.1, 40.0])
@pytest.mark.parametrize(
    ("left_column", "column_count"),
    [
        (8, 6),  # in frame
        (-3, 6),  # across the seam to the left, partly in frame
        (28, 9),  # across the seam to the right, partly in frame
        (40, 5),  # to the right
        (-20, 12),  # to the left
        (60, 9),  # across the seam between the views right and behind
        (76, 8),  # straight behind, across +-180 degrees
        (45, 70),  # a long one: right, behind and left
    ],
)
def test_in_frame_rotation_loss_of_one_vehicle(device, yaw_rad, left_column, column_count):
    pose = [[0.2, 0.1, yaw_rad, 0.0, 0.0, 0.0, 0.0]]
    silhouette = band(left_column, column_count)
    value = measures_of(silhouette[None, None])
    loss, gradient = placement_losses(value, [0], pose, device, epsilon=1e-2)
    visible = silhouette[0].any()
    # straight from where the vehicle was put, then again from the columns
    ends = [yaw_rad + bearing_of(left_column), yaw_rad + bearing_of(left_column + column_count)]
    expected = thesis.in_frame_rotation_loss([(*ends, yaw_rad, visible)], 1e-2)
    assert loss[0] == pytest.approx(expected, abs=2e-6)
    from_columns = ends_of(value[:, 0], yaw_rad)
    assert thesis.in_frame_rotation_loss([(*from_columns, yaw_rad, visible)], 1e-2) == pytest.approx(expected)

    # the bearings stay where they are while the camera turns
    def loss_at(yaw):
        return thesis.in_frame_rotation_loss([(*ends, yaw[0], visible)], 1e-2)

    if abs(thesis.rotational_difference(ends[0], yaw_rad) - thesis.rotational_difference(ends[1], yaw_rad)) > 1e-3:
        expected_gradient = differences(loss_at, np.array([yaw_rad]), 1e-6)[0]
        assert gradient[0, 2] == pytest.approx(expected_gradient, rel=1e-3)
    assert not gradient[0, [0, 1, 3, 4]].any()


def random_sight(rng, cameras, vehicles, rotations=4):
    """Random silhouettes and boxes, and the measures that they give."""
    silhouettes = rng.random((cameras, vehicles, rotations, HEIGHT, WIDTH)) < 0.3
    silhouettes[rng.random((cameras, vehicles, rotations)) < 0.5] = False
    boxes = np.zeros((cameras, vehicles, HEIGHT, WIDTH), bool)
    value = measures_of(silhouettes)
    for camera, k in np.ndindex(cameras, vehicles):
        if rng.random() < 0.7:
            x0, x1 = np.sort(rng.integers(0, WIDTH, 2))
            boxes[camera, k, 1:6, x0:x1] = True
        value[camera * rotations, k, BOX_AREA] = (silhouettes[camera, k, 0] & boxes[camera, k]).sum()
    return silhouettes, boxes, value


@pytest.mark.equation(4, 14, 15, 16)
@pytest.mark.parametrize("epsilon", [1e-5, 0.1])
@pytest.mark.parametrize("min_visibility", [0.5, 1.0])
def test_detected_area_loss_matches_oracle(device, rng, epsilon, min_visibility):
    seen_terms = []
    for _ in range(5):
        silhouettes, boxes, value = random_sight(rng, 2, 6)
        silhouettes[1, 3] = False  # never seen
        value[4:, 3] = 0.0
        assigned = np.array([0, 1, -1, 1, 0, 0])
        loss, _ = placement_losses(
            value, assigned, np.zeros((2, 7)), device, epsilon=epsilon, min_detected_area=min_visibility
        )
        items = [
            (silhouettes[camera, k], boxes[camera, k] if boxes[camera, k].any() else None)
            for k, camera in enumerate(assigned)
            if camera >= 0
        ]
        expected = thesis.detected_area_loss(items, min_visibility, epsilon)
        assert loss[1] == pytest.approx(expected, rel=1e-5)
        seen_terms += [thesis.detected_area_loss([item], min_visibility, epsilon) for item in items]
    assert 0.0 < min(seen_terms) < 0.85
    assert len(set(np.round(seen_terms, 4))) > 8


def test_hiding_a_vehicle_costs_nothing_as_printed_and_something_against_the_vehicle_alone(device):
    value = np.zeros((4, 1, MEASURE_COUNT))
    value[0, 0, AMODAL_AREA] = 100.0
    loss = {}
    for shown in (100.0, 50.0):
        value[0, 0, [VISIBLE_AREA, BOX_AREA]] = shown
        for reference in Reference:
            settings = {"reference": reference, "min_detected_area": 1.0, "epsilon": 0.0}
            loss[reference, shown] = placement_losses(value, [0], np.zeros((1, 7)), device, **settings)[0][1]
    assert loss[Reference.NON_OCCLUDED, 100.0] == loss[Reference.NON_OCCLUDED, 50.0] == 0.0
    assert loss[Reference.ALONE, 100.0] == 0.0
    assert loss[Reference.ALONE, 50.0] == pytest.approx(0.5)


@pytest.mark.equation(14, 16)
@pytest.mark.parametrize("reference", list(Reference))
def test_detected_area_gradient_matches_differences_through_the_measures(device, rng, reference):
    _, _, value = random_sight(rng, 2, 6)
    value[..., VISIBLE_AREA] += 20.0  # nothing on the edge of never seen
    value[..., AMODAL_AREA] += rng.uniform(25.0, 40.0, value.shape[:2])
    jac_translation = rng.normal(0.0, 30.0, (*value.shape, 3)).astype(np.float32)
    jac_rotation = rng.normal(0.0, 30.0, (*value.shape, 3)).astype(np.float32)
    assigned = np.array([0, 1, -1, 1, 0, 0])
    pose = np.c_[
        rng.uniform(-0.9, 0.9, (2, 2)), rng.uniform(-3, 3, 2), rng.uniform(-0.4, 0.4, (2, 2)), np.zeros((2, 2))
    ]
    pose = pose.astype(np.float32)
    loss, gradient = placement_losses(
        value,
        assigned,
        pose,
        device,
        jac_translation=jac_translation,
        jac_rotation=jac_rotation,
        weight=(0.0, 1.0),
        min_detected_area=0.9,
        epsilon=1e-2,
        reference=reference,
    )
    centre_0, rotation_0 = placed_by_oracle(pose, SURFACE, MODEL)

    def loss_at(numbers):
        centre, rotation = placed_by_oracle(numbers, SURFACE, MODEL)
        turn = rotation @ rotation_0.transpose(0, 2, 1)
        spin = 0.5 * np.stack(
            [turn[:, 2, 1] - turn[:, 1, 2], turn[:, 0, 2] - turn[:, 2, 0], turn[:, 1, 0] - turn[:, 0, 1]], axis=1
        )
        now = value + np.einsum("vkmi,vi->vkm", jac_translation, centre - centre_0)
        now = now + np.einsum("vkmi,vi->vkm", jac_rotation, spin)
        terms = []
        for k, camera in enumerate(assigned):
            if camera >= 0:
                against = VISIBLE_AREA if reference is Reference.NON_OCCLUDED else AMODAL_AREA
                whole = now[4 * camera : 4 * camera + 4, k, against].sum()
                ahead = now[4 * camera, k]
                inside, outside = ahead[BOX_AREA], ahead[VISIBLE_AREA] - ahead[BOX_AREA]
                visibility = (inside * thesis.soft_mask(1.0, 1e-2) + outside * thesis.soft_mask(0.0, 1e-2)) / whole
                terms.append(max(0.9 - visibility, 0.0) / 0.9)
        return np.mean(terms)

    assert loss[1] == pytest.approx(loss_at(pose.astype(float)), rel=1e-5)
    # worst seen 2e-4 of gradients of about 5
    np.testing.assert_allclose(gradient, differences(loss_at, pose, 1e-6), atol=2e-3)


# --- the Lagrangian --------------------------------------------------------------------------------------------------


def lagrangian(objective, constraint, multiplier, weights, device, *, damping=0.0, are_inequalities=False):
    arrays = [
        wp.array(np.array(numbers, np.float32), dtype=float, device=device, requires_grad=True)
        for numbers in (objective, constraint, multiplier)
    ]
    weight, scale = (
        wp.array(list(each), dtype=float, device=device) for each in (weights, [max(weights)] * len(constraint))
    )
    # the constraints come with every objective that takes part, scaled like the largest of them
    printed = {} if are_inequalities else {"scale": scale, "repeats": sum(each > 0.0 for each in weights)}
    tape = wp.Tape()
    with tape:
        total = lagrangian_of(*arrays, weight=weight, damping=damping, **printed)
    tape.backward(total)
    return float(total.numpy()[0]), [array.grad.numpy() for array in arrays]


@pytest.mark.equation(1)
@pytest.mark.parametrize("scales", [(1.0, 10.0), (2.0, 0.0), (0.0, 3.0)])
def test_lagrangian_matches_oracle(device, rng, scales):
    taking_part = [j for j in range(2) if scales[j] > 0.0]
    for _ in range(5):
        objective, constraint, multiplier = rng.uniform(0.0, 2.0, (3, 2))

        def total(numbers):
            o, c, m = numbers.reshape(3, 2)
            return thesis.lagrangian(o[taking_part], np.array(scales)[taking_part], m, c, [max(scales)] * 2)

        value, gradients = lagrangian(objective, constraint, multiplier, scales, device)
        numbers = np.r_[objective, constraint, multiplier]
        assert value == pytest.approx(total(numbers), rel=1e-5)
        np.testing.assert_allclose(np.concatenate(gradients), differences(total, numbers, 1e-5), rtol=1e-4, atol=1e-4)


INEQUALITIES = (1.0, 3.0)
DAMPING = 4.0


def test_damped_lagrangian_matches_its_formula(device, rng):
    scale, damping = np.array([1.0, 3.0]), DAMPING
    for _ in range(20):
        objective, excess, multiplier = rng.uniform(0.0, 2.0, 2), rng.uniform(-1.0, 1.0, 5), rng.uniform(0.0, 3.0, 5)
        multiplier[0] = 0.0

        def total(numbers):
            o, g, m = np.split(numbers, [2, 7])
            # the same with one square for each inequality, as Rockafellar writes it
            return scale @ o + ((np.maximum(m + damping * g, 0.0) ** 2 - m**2) / (2.0 * damping)).sum()

        value, gradients = lagrangian(
            objective, excess, multiplier, INEQUALITIES, device, damping=DAMPING, are_inequalities=True
        )
        numbers = np.r_[objective, excess, multiplier]
        assert value == pytest.approx(total(numbers), abs=1e-5)
        np.testing.assert_allclose(np.concatenate(gradients), differences(total, numbers, 1e-6), atol=1e-5)
