"""Training of the shipped detector, on a scale that fits a test; collected where PyTorch is installed."""

import math
import os
import signal
from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.driving_scene import roof, street
from warpav.core.errors import InputError
from warpav.detection import ROAD_USERS, Detections, OnnxDetector, TrainingOptions, evaluate, train_detector
from warpav.detection.training import CLASS_NAMES
from warpav.detection.training import _data as data
from warpav.detection.training import _train as train_module
from warpav.detection.training._loss import TargetBoxes, _move, _warp, assign_cells, detection_loss, pairwise_iou
from warpav.detection.training._network import TownNetwork, export_network
from warpav.detection.training._train import DeviceData, Training
from warpav.raster.camera import Lens
from warpav.runs._detector_training import tables

SIDE_PX = 64


pytestmark = pytest.mark.usefixtures("one_thread")


def _labelled_images(rng, count=4):
    """Grey images with one coloured rectangle of each of two classes."""
    labels = data.empty_labels(count)
    images_rgb = np.full((count, SIDE_PX, SIDE_PX, 3), 90, np.uint8)
    for image in range(count):
        for k, channel in enumerate((0, 2)):
            x0, y0 = rng.integers(2, 14, 2) + np.array([30 * k, 20 * k])
            width, height = rng.integers(12, 18, 2)
            images_rgb[image, y0 : y0 + height, x0 : x0 + width, channel] = 230
            labels.box_px[image, k] = [x0, y0, x0 + width, y0 + height]
            labels.class_index[image, k] = k
            labels.visible_fraction[image, k] = 1.0
            labels.distance_m[image, k] = 10.0
    return data.LabelledImages(images_rgb, labels)


def _truth(box_px, class_index, ignored=None):
    class_index = torch.tensor([class_index])
    none = torch.zeros_like(class_index, dtype=torch.bool)
    return TargetBoxes(torch.tensor([box_px], dtype=torch.float32), class_index, none if ignored is None else ignored)


def _grid(stride_px=4):
    line = torch.arange(SIDE_PX // stride_px) * stride_px + stride_px / 2
    y, x = torch.meshgrid(line, line, indexing="ij")
    return torch.stack([x, y], dim=-1).reshape(-1, 2)


def test_cells_answer_for_the_object_that_they_lie_in():
    center_px = _grid()
    truth = _truth([[8, 8, 28, 24], [34, 30, 37, 33], [40, 40, 60, 60], [0, 0, 0, 0]], [0, 1, 1, -1])
    truth.ignored[0, 2] = True
    box_px = torch.cat([center_px - 8, center_px + 8], dim=-1)[None]
    score_logit = torch.zeros(1, len(center_px), 2)
    object_index, target, counts = (each[0] for each in assign_cells(score_logit, box_px, center_px, truth))
    answers = target > 0
    for index in (0, 1):
        mine = answers & (object_index == index)
        assert 1 <= int(mine.sum()) <= 10
        middle_px = 0.5 * (truth.box_px[0, index, :2] + truth.box_px[0, index, 2:])
        half_px = (0.5 * (truth.box_px[0, index, 2:] - truth.box_px[0, index, :2])).clamp(min=4.0)
        assert ((center_px[mine] - middle_px).abs() < half_px).all()
    # The best cell is to score the best IoU that any chosen cell reaches.
    iou = pairwise_iou(truth.box_px, box_px)[0, 0]
    assert target[object_index == 0].max() == pytest.approx(float(iou.max()))
    in_ignored = ((center_px > 40) & (center_px < 60)).all(dim=1)
    assert not counts[in_ignored].any()
    assert counts[~in_ignored].all()


def test_the_loss_falls_towards_the_truth():
    center_px = _grid()
    truth = _truth([[8, 8, 28, 24]], [1])
    inside = ((center_px > torch.tensor([8, 8])) & (center_px < torch.tensor([28, 24]))).all(dim=1)
    good_box = torch.tensor([8.0, 8, 28, 24]).expand(1, len(center_px), 4)
    good_score = torch.full((1, len(center_px), 2), -8.0)
    good_score[0, inside, 1] = 8.0
    good = sum(detection_loss(good_score, good_box, center_px, truth))
    for score, box in ((-good_score, good_box), (good_score.flip(2), good_box), (good_score, good_box + 5.0)):
        assert sum(detection_loss(score, box, center_px, truth)) > good + 0.1
    nothing = detection_loss(torch.full_like(good_score, -8.0), good_box, center_px, _truth([[0, 0, 0, 0]], [-1]))
    assert sum(nothing) < 1e-3


@pytest.mark.parametrize("flipped", [False, True])
@pytest.mark.parametrize(("zoom", "shift"), [(1.0, 0.0), (0.5, 0.3), (1.6, -0.4)])
def test_boxes_move_with_the_pixels(flipped, zoom, shift):
    box = [12, 20, 36, 44]
    image = torch.zeros(1, 3, SIDE_PX, SIDE_PX)
    image[:, :, box[1] : box[3], box[0] : box[2]] = 1.0
    size_px = torch.tensor([SIDE_PX, SIDE_PX], dtype=torch.float32)
    zooms, shifts, flips = torch.tensor([zoom]), torch.tensor([[shift, shift / 2]]), torch.tensor([flipped])
    moved = _move(_truth([box], [0]), zooms, shifts * size_px, flips, size_px)
    row, column = np.nonzero(_warp(image, zooms, shifts, flips)[0, 0].numpy() > 0.5)
    seen_px = [column.min(), row.min(), column.max() + 1, row.max() + 1]
    np.testing.assert_allclose(moved.box_px[0, 0], seen_px, atol=0.51)


def test_training_learns_and_goes_on_from_a_checkpoint(rng, tmp_path):
    torch_data = DeviceData.load([_labelled_images(rng, 1), _labelled_images(rng, 3)], torch.device("cpu"))
    assert torch_data.images_rgb.shape == (4, SIDE_PX, SIDE_PX, 3)
    training = Training(torch.device("cpu"), step_count=16)
    losses = [float(sum(training.train_step(torch_data, 4))) for _ in range(10)]
    assert np.mean(losses[-3:]) < 0.95 * np.mean(losses[:3])
    training.save(tmp_path / "checkpoint.pt")

    other = Training(torch.device("cpu"), step_count=16, seed=1)
    other.load(tmp_path / "checkpoint.pt")
    assert (other.step, other.step_count) == (10, 16)
    for name, value in training.average.state_dict().items():
        torch.testing.assert_close(other.average.state_dict()[name], value)
    assert math.isfinite(float(sum(other.train_step(torch_data, 4))))


@pytest.mark.parametrize(
    ("steps", "content", "message"),
    [
        (17, None, "expected a training of 17 steps, got one of 16; train into another folder"),
        (16, b"", "expected a checkpoint of this training, got another file"),
        (16, b"PK nothing of the kind", "expected a checkpoint of this training, got another file"),
    ],
)
def test_a_checkpoint_of_another_training_is_refused_before_images_are_made(tmp_path, steps, content, message):
    file = tmp_path / "checkpoint.pt"
    Training(torch.device("cpu"), step_count=16).save(file)
    if content is not None:
        file.write_bytes(content)
    with pytest.raises(InputError, match=message):
        train_detector(tmp_path, TrainingOptions(steps=steps), image_folder=tmp_path / "images")
    assert not (tmp_path / "images").exists()


def test_the_exported_network_is_the_network(rng, tmp_path):
    network = TownNetwork()
    assert sum(value.numel() for value in network.parameters()) <= 2e6
    with torch.no_grad():
        for value in network.parameters():
            value.add_(0.02 * torch.randn_like(value))
    path = tmp_path / "network.onnx"
    assert export_network(network, path) < 1e-3
    assert path.stat().st_size < 8e6
    detector = OnnxDetector(path, confidence_min=0.0, targets=None)
    assert detector.names == CLASS_NAMES
    assert all(len(found) for found in detector.detect(_labelled_images(rng, 2).images_rgb))


class _Told:
    """A detector that answers with given boxes, labels and confidences."""

    names = CLASS_NAMES

    def __init__(self, *answers):
        self._answers = list(answers)

    def detect(self, images_rgb):
        answers = [self._answers.pop(0) for _ in images_rgb]
        return [
            Detections(
                np.array([box for box, _, _ in answer], np.float32).reshape(-1, 4),
                np.array([confidence for _, _, confidence in answer], np.float32),
                np.array([CLASS_NAMES.index(name) for _, name, _ in answer], np.int32),
                CLASS_NAMES,
                np.array([ROAD_USERS.index(name) if name in ROAD_USERS else 0 for _, name, _ in answer], np.int32),
            )
            for answer in answers
        ]


def test_a_detector_is_judged_by_road_user():
    labels = data.empty_labels(2)
    # A car that is found as a van, a bus that is missed, a pedestrian that is found, and one that need not be.
    labels.box_px[0, :4] = [[4, 4, 34, 24], [36, 4, 60, 40], [4, 30, 12, 54], [20, 30, 28, 54]]
    labels.class_index[0, :4] = [CLASS_NAMES.index(name) for name in ("car", "bus", "pedestrian", "pedestrian")]
    labels.ignored[0, 3] = True
    labels.distance_m[0, :4] = [7.0, 12.0, 7.0, 7.0]
    labels.visible_fraction[0, :4] = [1.0, 0.6, 1.0, 1.0]
    found = [([4, 4, 34, 24], "van", 0.9), ([4, 30, 12, 54], "pedestrian", 0.8), ([21, 30, 28, 54], "pedestrian", 0.7)]
    detector = _Told(found, [([10, 10, 30, 30], "car", 0.6), ([10, 10, 20, 30], "pedestrian", 0.2)])
    report = evaluate(detector, data.LabelledImages(np.zeros((2, SIDE_PX, SIDE_PX, 3), np.uint8), labels))
    assert report["images"] == 2
    vehicles, pedestrians = report["vehicle"], report["pedestrian"]
    assert (vehicles["objects"], pedestrians["objects"]) == (2, 1)
    assert "cyclist" not in report
    assert (vehicles["recall"], vehicles["precision"], vehicles["right_label"]) == (0.5, 0.5, 0.0)
    assert (pedestrians["recall"], pedestrians["precision"], pedestrians["ap50"]) == (1.0, 1.0, 1.0)
    assert vehicles["ap50"] == pytest.approx(51 / 101, abs=1e-4)
    assert (vehicles["ap50_moderate"], pedestrians["ap50_moderate"]) == (0.0, None)  # the bus; 24 px are too few
    assert vehicles["false_alarms_per_image"] == 0.5
    assert vehicles["recall_by_distance_m"]["0-10"] == 1.0
    # the false alarm is less confident than the one vehicle of this bin, and comes before the miss of the next
    assert vehicles["ap50_by_distance_m"]["0-10"] == 1.0
    assert vehicles["ap50_by_distance_m"]["10-20"] == 0.0
    assert vehicles["ap50_by_visible_fraction"]["0.75-inf"] == 1.0
    assert vehicles["recall_by_distance_m"]["10-20"] == 0.0
    text = tables({"direct": {"64": report}})
    assert "| direct, 64 px | 2 | 2 | 2 | 0.505 | 0.000 | 0.505 | 0.500 | 0.500 | 0.500 | 0.000 |" in text
    assert "| | 0 to 10 m | 10 to 20 m | 20 to 40 m | 40 to 80 m | from 80 m |" in text
    assert "| direct, 64 px | 1.000 | 0.000 | - | - | - |" in text


def test_cameras_stand_around_the_ego_vehicle(rng):
    scene = street(3)
    low_m, high_m = scene.ego.bounds_m()
    surface = roof()
    cameras = data.sample_cameras(rng, surface, scene.ego.bounds_m(), side_px=64, count=60)
    for camera in cameras:
        position_m = camera.position_m
        beside = (position_m[:2] < low_m[:2]) | (position_m[:2] > high_m[:2])
        assert beside.any() or position_m[2] > surface.height_at_m(position_m[:2]) + 0.04
        assert (position_m > low_m - 0.31).all()
        assert (position_m[:2] < high_m[:2] + 0.31).all()
        assert 0.3 <= position_m[2] <= 3.0
        low_deg, high_deg = (130, 190) if camera.model.lens is Lens.FISHEYE else (25, 120)
        assert math.radians(low_deg) <= camera.model.fov_rad <= math.radians(high_deg)
    assert 1 <= sum(camera.model.lens is Lens.FISHEYE for camera in cameras) <= 20


def test_labels_are_those_of_the_rendered_objects():
    scene = street()
    person = replace(scene.vehicles[0], instance_id=77, category="pedestrian")
    scene = replace(scene, vehicles=scene.vehicles[1:], others=(person,))
    first = data.render_scene(scene, roof(), 3, views_per_scene={64: 8}, ignored_ids=[77], thread_count=1)[64]
    again = data.render_scene(scene, roof(), 3, views_per_scene={64: 8}, ignored_ids=[77])[64]
    np.testing.assert_array_equal(first.images_rgb, again.images_rgb)
    labels = first.labels
    exists = labels.class_index >= 0
    is_person = exists & (labels.class_index == CLASS_NAMES.index("pedestrian"))
    assert is_person.any()
    assert labels.ignored[is_person].all()
    assert (labels.class_index[exists & ~is_person] == CLASS_NAMES.index("car")).all()
    assert (exists & ~labels.ignored).any()
    assert (labels.box_px[exists][:, 2:] > labels.box_px[exists][:, :2]).all()
    assert (labels.visible_fraction[exists] > 0.0).all()
    assert (labels.distance_m[exists] > 1.0).all()


def test_scenes_of_training_and_tests_are_apart():
    subsets = {**data.TRAIN_SUBSETS, **data.TEST_SUBSETS}
    seeds = [seed for subset in subsets.values() for seed in subset.seeds]
    assert len(set(seeds)) == len(seeds)
    assert min(seeds) >= 1_000_000
    train, test = (
        {source.moment.file for source in replace(subsets[name], scene_count=200).sources()}
        for name in ("train_recorded", "test_recorded")
    )
    assert train
    assert test
    assert not train & test


@pytest.mark.slow
def test_people_are_cut_out_of_reconstructed_scenes():
    seed = 1_500_000
    scene = data.reconstructed_scene(seed)
    assert scene.others
    for person in scene.others:
        middle_m = person.mesh.vertex_m[person.mesh.triangle].mean(axis=1)
        assert person.box.contains(middle_m, margin_m=0.16).all()
        left_m = scene.environment.vertex_m[scene.environment.triangle].mean(axis=1)
        inside = person.box.contains(left_m, margin_m=0.14)
        foot_m = person.box.center_m[2] - 0.5 * person.box.size_m[2]
        assert (left_m[inside, 2] < foot_m + 0.1).all()


@pytest.mark.slow
def test_data_is_written_trained_on_and_gone_on_from(tmp_path, monkeypatch, caplog):
    few = {256: 2, 384: 1, 640: 1, 1280: 1}
    monkeypatch.setattr(train_module, "TRAIN_SUBSETS", {
        "train": data.Subset("dense", 1_000_000, 2, few),
        "train_recorded": data.Subset("search recordings", 1_000_100, 1, few),
    })  # fmt: skip
    options, folder = TrainingOptions(processes=1, steps=3, batch_size=2), tmp_path / "images"
    take_step = Training.train_step
    with monkeypatch.context() as stopped:
        stopped.setattr(Training, "train_step", lambda self, *given: (
            take_step(self, *given) if self.step < 2 else os.kill(os.getpid(), signal.SIGINT)
        ))  # fmt: skip
        with pytest.raises(KeyboardInterrupt):
            train_detector(tmp_path, options, image_folder=folder)
    with caplog.at_level("INFO"):
        file = train_detector(tmp_path, options, image_folder=folder)
    assert "going on from step 2 of 3" in caplog.text
    assert OnnxDetector(file).names == CLASS_NAMES
    monkeypatch.setitem(train_module.TRAIN_SUBSETS, "train", data.Subset("dense", 1_000_001, 2, few))
    with pytest.raises(InputError, match="expected images of 2 scenes from seed 1000001 on"):
        train_detector(tmp_path, options, image_folder=folder)
    read = data.load_images(tmp_path / "images" / "train")
    assert list(read) == [256, 384, 640, 1280]
    assert len(read[256].images_rgb) == 4
    assert read[256].images_rgb.any(axis=(1, 2, 3)).all()
    assert len(read[256].first(1).images_rgb) == 1
