"""The detection network in PyTorch, its loss, and that loss's gradient to the pose; collected where PyTorch is."""

import math

import numpy as np
import onnxruntime
import pytest
import torch
import warp as wp

from tests.driving_scene import ConstantDetector, camera_pose, on_device, packed_street, roof
from tests.optimisation.objectives import rig_objective, thesis_losses
from tests.oracle import clipped_edges
from tests.raster.test_gradients import YAW, X, Y, moved
from warpav.core.errors import InputError
from warpav.detection import BUILTIN_MODEL_PATH, ROAD_USERS, DifferentiableDetector, OnnxDetector
from warpav.detection._differentiable import MAX_ERROR, TorchNetwork
from warpav.detection._matching import largest_component_box
from warpav.optimisation import AssignedScene, CameraMount, PlacedViews, SceneOnTape
from warpav.raster.camera import CameraModel
from warpav.raster.decide import Occlusion
from warpav.raster.renderer import Renderer
from warpav.scene import DeviceScene, town_scene
from warpav.thesis import DetectorGradient

SIZE_PX = 256
MODEL = CameraModel(SIZE_PX, SIZE_PX, math.radians(90.0), 0.1)
CAMERAS = 4
TRUTH_SAMPLES = 8
# The footprint of a pixel 6 m away: over smaller steps the truth is the network's own roughness.
STEP_M, LEVER_M = 0.05, 10.0
SAME_SIDE_PX = 1.0


pytestmark = pytest.mark.usefixtures("one_thread")


def builtin_network(**options):
    detector = OnnxDetector("builtin")
    groups = np.full(len(detector.names), -1)
    groups[np.isin(detector.names, detector.road_users["vehicle"])] = ROAD_USERS.index("vehicle")
    return DifferentiableDetector(BUILTIN_MODEL_PATH, groups, **options)


def assert_same_as_onnxruntime(path, shape):
    images = np.random.default_rng(1).random(shape, np.float32)
    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    expected = session.run(None, {session.get_inputs()[0].name: images})[0]
    given = torch.from_numpy(images).requires_grad_()
    output = TorchNetwork(path)(given)
    assert output.shape == expected.shape
    error = np.abs(output.detach().numpy() - expected) / np.maximum(np.abs(expected), 1.0)
    assert error.max() < MAX_ERROR  # worst seen 7e-5
    output[:, 4:].sum().backward()
    assert torch.isfinite(given.grad).all()
    assert given.grad.abs().max() > 0.0


@pytest.mark.parametrize("shape", [(1, 3, 256, 256), (3, 3, 160, 224)])
def test_the_shipped_network_is_the_same_in_pytorch(shape):
    assert_same_as_onnxruntime(BUILTIN_MODEL_PATH, shape)


def test_a_network_of_others_is_the_same_in_pytorch(asset_folder):
    assert_same_as_onnxruntime(asset_folder / "yolox_nano_coco.onnx", (1, 3, 640, 640))


def test_an_operator_without_gradient_is_refused_by_name(tmp_path):
    import onnx
    from onnx import TensorProto, helper

    ends = [helper.make_tensor_value_info(n, TensorProto.FLOAT, [1, 3, 64, 64]) for n in ("images", "output0")]
    graph = helper.make_graph([helper.make_node("Round", ["images"], ["output0"])], "round", ends[:1], ends[1:])
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    onnx.save(model, str(tmp_path / "round.onnx"))
    with pytest.raises(InputError, match=r"round.onnx: .*cannot differentiate the operator Round"):
        TorchNetwork(tmp_path / "round.onnx")


def test_loss_is_bounded_and_low_where_the_cell_network_finds_the_object(cell_network):
    # the network sees a box in every 32 px cell, whose score is the cell's mean red
    detector = DifferentiableDetector(cell_network(("car",)), [0], phase_count=1)
    image = np.zeros((2, 96, 96, 3), np.float32)
    image[0, 32:64, 32:64, 0] = 1.0
    box_px = np.array([[32.0, 32, 64, 64], [32, 32, 64, 64], [40, 32, 72, 64]], np.float32)
    wanted = detector.loss(wp.array(image, dtype=wp.vec3), np.array([0, 1, 0]), box_px, np.zeros(3, int))
    found, empty, beside = wanted.loss
    # a sure and exact answer, but for the share of the neighbours: (0 + .01) / 1.01 and less
    assert found < 0.01 < beside < empty < 1.0


def test_gradients_of_the_loss_are_those_of_differences(cell_network, rng):
    detector = DifferentiableDetector(cell_network(("car", "person", "bus")), [0, -1, 0], phase_count=3)
    image = rng.uniform(0.1, 0.9, (2, 96, 96, 3)).astype(np.float32)
    box_px = np.array([[30.0, 35, 60, 66], [5, 40, 37, 80], [50, 20, 90, 60]], np.float32)
    where, group, weight = np.array([0, 1, 1]), np.zeros(3, int), np.array([1.0, 2.0, 0.5])

    def total(image, box_px):
        return float(detector.loss(wp.array(image, dtype=wp.vec3), where, box_px, group).loss @ weight)

    result = detector.loss(wp.array(image, dtype=wp.vec3), where, box_px, group, weight=weight)
    for _ in range(3):
        change = rng.normal(size=image.shape).astype(np.float32)
        slope = (total(image + 1e-2 * change, box_px) - total(image - 1e-2 * change, box_px)) / 2e-2
        assert slope == pytest.approx(float((result.image_gradient.numpy() * change).sum()), abs=2e-3)
        change = rng.normal(size=box_px.shape).astype(np.float32)
        slope = (total(image, box_px + 0.1 * change) - total(image, box_px - 0.1 * change)) / 0.2
        assert slope == pytest.approx(float((result.box_gradient * change).sum()), abs=2e-3)


# The gradient to the pose


def camera_poses(seed):
    rng = np.random.default_rng(seed)
    return np.stack(
        [
            camera_pose(
                np.array([rng.uniform(-0.5, 1.5), rng.uniform(-0.6, 0.6), rng.uniform(1.6, 2.0)]),
                rng.uniform(-math.pi, math.pi),
                rng.uniform(0.0, 0.1),
                0.0,
            )
            for _ in range(CAMERAS)
        ]
    )


def visible_boxes(frame):
    """Boxes of what is seen of every vehicle, [view, vehicle, 4]; NaN where too little is."""
    samples = frame.supersampling
    box_px = np.full((frame.view_count, frame.scene.object_count, 4), np.nan)
    for camera, masks in enumerate(frame.visible_masks(range(frame.view_count))):
        for vehicle, (left, top, mask) in enumerate(masks):
            if mask.any():
                box = largest_component_box(mask, min_area_px=16 * samples * samples)
                if box is not None:
                    box_px[camera, vehicle] = (box + np.array([left, top, left, top])) / samples
    return box_px


def exact_boxes(scene, poses):
    """Boxes of the vehicles alone inside the image, [view, vehicle, 4]; NaN out of sight."""
    return np.array([clipped_edges.boxes([each.mesh for each in scene.vehicles], pose, MODEL) for pose in poses])


def gradients_at(seed, detector, supersampling, cameras=range(CAMERAS)):
    """Ours and the truth, per metre and per radian, [camera, (x, y, yaw)], of the cameras that see a vehicle.

    The loss is the mean over the vehicles that a camera sees.
    """
    host = town_scene(seed)
    scene, poses = DeviceScene.pack(host), camera_poses(seed)[list(cameras)]
    renderer = Renderer([MODEL] * len(poses), supersampling=supersampling)
    position, rotation = on_device(poses, "cpu")
    frame = renderer.render(scene.raster, position, rotation)
    truth_px, measures = visible_boxes(frame), frame.measure()
    alone_px = measures.value.numpy()[..., 3:7][..., [0, 2, 1, 3]]
    exact_px = exact_boxes(host, poses)
    ours, truth = [], []
    for camera in range(len(poses)):
        seen = np.isfinite(truth_px[camera, :, 0])
        if not seen.any():
            continue
        assigned = np.where(seen, camera, -1)
        for array in (position, rotation):
            array.requires_grad = True
            array.grad.zero_()
        tape = wp.Tape()
        with tape:
            on_tape = SceneOnTape(
                None,
                frame,
                scene,
                PlacedViews(position, position, rotation, wp.zeros(len(poses), dtype=float)),
                measures,
                assigned,
                *[None] * 4,
                list(range(len(poses))),
                None,
                truth_box_px=truth_px,
            )
            _, gradients = DetectorGradient(detector).on_host(on_tape, 1.0, tape)
        tape.backward(grads=gradients)
        turned = poses[camera, :3, :3].T @ np.cross([0.0, 0.0, 1.0], np.eye(3))
        yaw = (rotation.grad.numpy()[camera].astype(float) * turned).sum()
        ours.append([*position.grad.numpy()[camera, :2], yaw])
        truth.append(np.full(3, np.nan))
    fine = Renderer([MODEL] * len(poses), supersampling=TRUTH_SAMPLES)
    looking = [camera for camera in range(len(poses)) if np.isfinite(truth_px[camera, :, 0]).any()]
    for column, direction in enumerate((X, Y, YAW)):
        step = STEP_M if direction != YAW else STEP_M / LEVER_M
        looks = []
        for sign in (1.0, -1.0):
            at = moved(poses, direction, sign * step)
            colours = fine.render(scene.raster, *on_device(at, "cpu")).colours()
            looks.append((colours, exact_boxes(host, at)))
        for row, camera in enumerate(looking):
            values = []
            vehicles = np.nonzero(np.isfinite(truth_px[camera, :, 0]))[0]
            for image, moved_px in looks:
                # hidden sides are held, as in the loss
                moves = np.abs(truth_px[camera] - alone_px[camera]) <= SAME_SIDE_PX
                change_px = np.where(moves, moved_px[camera] - exact_px[camera], 0.0)
                box_px = (truth_px[camera] + change_px)[vehicles]
                where, group = np.full(len(vehicles), camera), scene.road_user_index[vehicles]
                values.append(float(detector.loss(image, where, box_px, group).loss.mean()))
            truth[row][column] = (values[0] - values[1]) / (2.0 * step)
    return np.array(ours).reshape(-1, 3), np.array(truth).reshape(-1, 3)


def cosines(ours, truth):
    """Cosines over x, y and yaw, where a turn counts as the arc that it moves what is LEVER_M away."""
    scale = np.array([1.0, 1.0, 1.0 / LEVER_M])
    ours, truth = ours * scale, truth * scale
    return (ours * truth).sum(axis=1) / np.linalg.norm(ours, axis=1) / np.linalg.norm(truth, axis=1)


@pytest.mark.slow
def test_gradient_to_the_pose_agrees_with_differences_of_finer_renders():
    detector = builtin_network()
    pairs = [gradients_at(seed, detector, 2) for seed in range(2300, 2313)]
    ours, truth = (np.concatenate(each) for each in zip(*pairs, strict=True))
    cosine = cosines(ours, truth)
    slope = np.linalg.norm(truth * [1.0, 1.0, 1.0 / LEVER_M], axis=1)
    assert len(cosine) >= 40  # 51
    assert np.median(cosine) >= 0.9  # measured .950
    assert np.median(cosine[slope >= np.median(slope)]) >= 0.95  # .979


# In the objective


def objective_with(detector, **scales):
    mount = CameraMount(roof(), camera=CameraModel(128, 128), height_offset_m=0.25)
    return rig_objective(
        mount,
        ConstantDetector.silent(2),
        camera_count=2,
        settings=thesis_losses(**scales),
        occlusion=Occlusion.EXACT,
        differentiable_detector=detector,
    )


POSE = np.array([[1.61, 0.31, 0.15, 0.0, 0.0, 0.0, 0.0], [0.43, -0.27, 3.35, 0.0, 0.0, 0.0, 0.0]], np.float32)


def test_the_loss_joins_the_objective_and_its_gradient():
    scene = AssignedScene(packed_street(), (np.arange(10) % 2).astype(np.int32))
    detector = builtin_network(phase_count=1)
    without = objective_with(detector, in_frame_rotation=1.0, detected_area=10.0)
    plain = without.evaluate(POSE, [scene], gradient=True)
    assert "detector_gradient" not in plain.terms
    joint = objective_with(detector, in_frame_rotation=1.0, detected_area=10.0, detector_gradient=3.0)
    first = joint.evaluate(POSE, [scene], gradient=True)
    second = joint.evaluate(POSE, [scene, scene], gradient=True)
    loss = first.terms["detector_gradient"]
    assert 0.0 < loss < 1.0
    assert first.objective == pytest.approx(plain.objective + 3.0 * loss, rel=1e-5)
    assert joint.evaluate(POSE, [scene]).terms["detector_gradient"] == pytest.approx(loss, rel=1e-5)
    np.testing.assert_allclose(second.gradient, first.gradient, rtol=1e-4, atol=1e-6)
    # three times the gradient of the loss on its own
    alone = objective_with(detector, in_frame_rotation=0.0, detected_area=0.0, detector_gradient=1.0)
    share = alone.evaluate(POSE, [scene], gradient=True).gradient
    assert np.abs(share[:, :3]).max() > 1e-3
    np.testing.assert_allclose(first.gradient, plain.gradient + 3.0 * share, rtol=1e-4, atol=1e-5)
    _, _, objective, _ = joint.observe_rig(joint.mount.rig(POSE), scene)
    assert objective == pytest.approx(first.objective, rel=1e-3)


def test_an_objective_without_the_network_is_refused():
    with pytest.raises(ValueError, match="expected a differentiable detector, got none"):
        objective_with(None, detector_gradient=1.0)
