"""Every layout of ONNX detectors: recognised for a reason, fed as it wants, decoded to the boxes it means."""

import json
import re
from typing import get_args

import cv2
import numpy as np
import pytest
import warp as wp
from hypothesis import given
from hypothesis import strategies as st

from warpav.cli.app import main
from warpav.core.errors import InputError
from warpav.detection import OnnxDetector
from warpav.detection.families import FAMILIES
from warpav.detection.families._family import COCO_80, COCO_91, ImagePlacement, Letterbox
from warpav.runs.config import DetectorConfig

pytest.importorskip("onnx")

from tests.detection.tiny_networks import SIDE_PX, boxes_of, numbers_of, write_network

wp.init()

LABELS = ("car", "pedestrian", "cyclist")
NAMES = {"names": str(dict(enumerate(LABELS)))}
ULTRALYTICS = NAMES | {"description": "Ultralytics YOLO11n model", "task": "detect", "stride": "32"}
PLACEMENT = {
    "ultralytics": "centred",
    "ultralytics-end2end": "centred",
    "ultralytics-rtdetr": "stretched",
    "yolox": "top left",
    "yolox-decoded": "top left",
    "yolov5": "centred",
    "torchvision": "top left",
    "rtdetr": "stretched",
    "rtdetr-single": "stretched",
}
# What a file of each family holds, how it is opened, and what its reason speaks of.
CASES = {
    "ultralytics": ({"metadata": NAMES}, {}, "4 \\+ 3 numbers"),
    "ultralytics-end2end": ({"metadata": ULTRALYTICS | {"end2end": "True"}}, {}, "ultralytics export"),
    "ultralytics-rtdetr": ({"metadata": ULTRALYTICS | {"head": "RTDETRDecoder"}}, {}, "ultralytics' RT-DETR"),
    "yolox": ({}, {"labels": LABELS}, "offsets"),
    "yolox-decoded": ({}, {"labels": LABELS}, "follow the cells"),
    "yolov5": ({"metadata": NAMES | {"stride": "32"}}, {}, "3 boxes a cell"),
    "torchvision": ({"classes": (1, 2), "has_batch": False}, {"labels": LABELS}, "boxes, labels and scores"),
    "rtdetr": ({}, {"labels": LABELS}, "orig_target_sizes"),
    "rtdetr-single": ({}, {"labels": LABELS, "family": "rtdetr-single"}, "detector.format"),
}
EVERY = pytest.mark.parametrize("name", CASES)


def pictures(rng, count, height_px=48, width_px=80):
    """Smooth pictures, another colour in every corner, so that place and order of channels matter."""
    corners = rng.integers(0, 256, (count, 2, 2, 3), np.uint8)
    return np.stack([cv2.resize(each, (width_px, height_px), interpolation=cv2.INTER_LINEAR) for each in corners])


def packed(images_rgb, placement, side_px=SIDE_PX):
    """What a network must get, white being 1, channels still RGB, and its scale and offset in x and y."""
    height_px, width_px = images_rgb.shape[1:3]
    factor = side_px / max(height_px, width_px)
    size = np.array([round(width_px * factor), round(height_px * factor)])
    if placement == "stretched":
        size = np.array([side_px, side_px])
    offset = (side_px - size) // 2 if placement == "centred" else np.array([0, 0])
    canvas = np.full((len(images_rgb), side_px, side_px, 3), 114, np.uint8)
    for image_rgb, target in zip(images_rgb, canvas, strict=True):
        rows, columns = (slice(offset[k], offset[k] + size[k]) for k in (1, 0))
        target[rows, columns] = cv2.resize(image_rgb, tuple(size.tolist()))
    return canvas.transpose(0, 3, 1, 2) / 255.0, size / [width_px, height_px], offset


def expected(images_rgb, name):
    """Boxes [image, 2, 4] in pixels of the images, and confidence [image, 2]."""
    network_input, scale, offset = packed(images_rgb, PLACEMENT[name])
    if name.startswith("yolox"):
        network_input = network_input[:, ::-1]
    box_px, confidence = boxes_of(numbers_of(network_input))
    return (box_px - np.tile(offset, 2)) / np.tile(scale, 2), confidence


def opened(tmp_path, name, file=None, **options):
    content, defaults, _ = CASES[name]
    path = write_network(tmp_path / "mine.onnx", name, **(content | (file or {})))
    return OnnxDetector(path, targets=None, **(defaults | options))


def check(found, images_rgb, name, *, atol_px, atol):
    """Two boxes an image, the car first or the pedestrian, whichever is surer."""
    box_px, confidence = expected(images_rgb, name)
    assert len(found) == len(images_rgb)
    for k, each in enumerate(found):
        order = np.argsort(-confidence[k])
        np.testing.assert_allclose(each.box_px, box_px[k, order], atol=atol_px)
        np.testing.assert_allclose(each.confidence, confidence[k, order], atol=atol)
        assert each.label == tuple(("car", "pedestrian")[it] for it in order)
        assert each.road_user_index.tolist() == order.tolist()


@EVERY
def test_boxes_are_those_that_the_network_means(tmp_path, rng, name):
    detector = opened(tmp_path, name)
    assert detector.family.name == name
    assert re.search(CASES[name][2], detector.reason)
    images = pictures(rng, 3)
    # worst seen 4e-5 px and 3e-7: single precision
    check(detector.detect(images), images, name, atol_px=2e-3, atol=2e-5)


@EVERY
def test_a_dynamic_size_follows_the_image_or_the_setting(tmp_path, rng, name):
    images = pictures(rng, 2, SIDE_PX, SIDE_PX)
    is_square = PLACEMENT[name] == "stretched"
    size = {"input_px": SIDE_PX} if is_square else {}
    if name.startswith("yolo"):
        # These networks are made for one size, whatever they say, so that no try at another tells how they are.
        with pytest.raises(InputError, match="its layout could be one of yolox, yolox-decoded"):
            opened(tmp_path, name, {"size_px": None})
        size = {"family": name}
    detector = opened(tmp_path, name, {"size_px": None}, **size)
    assert detector.input_size_px(SIDE_PX, SIDE_PX) == (SIDE_PX, SIDE_PX)
    check(detector.detect(images), images, name, atol_px=2e-3, atol=2e-5)
    if not is_square:
        assert detector.input_size_px(50, 70) == ((50, 70) if name == "torchvision" else (64, 96))
    else:
        assert opened(tmp_path, name, {"size_px": None}).input_size_px(50, 70) == (640, 640)


@EVERY
def test_tensors_are_read_where_that_is_possible(tmp_path, rng, name):
    detector = opened(tmp_path, name)
    images = pictures(rng, 2, SIDE_PX, SIDE_PX)
    assert detector.takes_tensor(SIDE_PX, SIDE_PX) == (not name.startswith("yolox"))
    assert not detector.takes_tensor(SIDE_PX, 2 * SIDE_PX)
    if detector.takes_tensor(SIDE_PX, SIDE_PX):
        planes = np.ascontiguousarray(images.transpose(0, 3, 1, 2)).astype(np.float32) / 255.0
        check(detector.detect_tensor(planes), images, name, atol_px=2e-3, atol=2e-5)


@EVERY
def test_only_targets_are_reported(tmp_path, rng, name):
    content, defaults, _ = CASES[name]
    path = write_network(tmp_path / "mine.onnx", name, **content)
    images = pictures(rng, 1)
    (every,) = OnnxDetector(path, targets=None, **defaults).detect(images)
    for target, label in (("vehicle", "car"), ("pedestrian", "pedestrian")):
        (found,) = OnnxDetector(path, targets=[target], **defaults).detect(images)
        assert found.label == (label,)
        np.testing.assert_array_equal(found.box_px[0], every.box_px[every.label.index(label)])


def test_every_family_is_a_choice_of_the_configuration():
    choices = get_args(DetectorConfig.model_fields["format"].annotation)
    assert choices == ("auto", *(family.name for family in FAMILIES))
    assert set(CASES) == {family.name for family in FAMILIES}


@pytest.mark.parametrize("stated", [{}, {"batch": "2"}, {"batch": "2", "args": "{'nms': True, 'batch': 2}"}])
@pytest.mark.parametrize("symbolic", [False, True])
def test_a_suppression_inside_gets_as_many_images_as_it_was_exported_for(tmp_path, rng, stated, symbolic):
    metadata = ULTRALYTICS | ({"args": "{'batch': 1, 'nms': True}"} | stated)
    content = {"metadata": metadata, "images_max": int(stated.get("batch", 1)), "symbolic": symbolic}
    detector = opened(tmp_path, "ultralytics-end2end", content)
    assert (detector.family.name, detector.family.batch) == ("ultralytics-end2end", content["images_max"])
    images = pictures(rng, 5)
    check(detector.detect(images), images, "ultralytics-end2end", atol_px=2e-3, atol=2e-5)


def test_an_output_without_any_number_is_read_as_it_is_said_to_be(tmp_path, rng):
    images = pictures(rng, 2)
    content = {"symbolic": True, "metadata": NAMES}
    for name in ("ultralytics-end2end", "rtdetr-single"):
        detector = opened(tmp_path, name, content, family=name, labels=None)
        check(detector.detect(images), images, name, atol_px=2e-3, atol=2e-5)
    detector = opened(tmp_path, "ultralytics", content | {"metadata": ULTRALYTICS})
    assert detector.family.name == "ultralytics"
    check(detector.detect(images), images, "ultralytics", atol_px=2e-3, atol=2e-5)


def test_names_may_be_json_and_the_stride_is_that_of_the_file(tmp_path, rng):
    metadata = {"names": json.dumps(dict(enumerate(LABELS))), "stride": "64"}
    detector = opened(tmp_path, "ultralytics", {"metadata": metadata, "size_px": None})
    assert detector.names == LABELS
    assert detector.input_size_px(64, 96) == (64, 128)


def test_a_transposed_output_is_recognised(tmp_path, rng):
    images = pictures(rng, 2)
    detector = opened(tmp_path, "ultralytics", {"transposed": True})
    assert detector.family.name == "ultralytics"
    check(detector.detect(images), images, "ultralytics", atol_px=2e-3, atol=2e-5)


@pytest.mark.parametrize("transposed", [False, True])
def test_eighty_classes_without_labels_are_coco(tmp_path, rng, transposed):
    content = {"metadata": {}, "class_count": 80, "classes": (2, 0), "transposed": transposed}
    detector = opened(tmp_path, "ultralytics", content)
    assert detector.file.labels_origin == "COCO, for there are 80 classes"
    (found,) = detector.detect(pictures(rng, 1))
    assert set(found.label) == {"car", "person"}
    assert detector.road_users["vehicle"] == ("car", "motorcycle", "bus", "truck")
    assert "cyclist" not in detector.road_users  # a bicycle alone is no cyclist


@pytest.mark.parametrize("name", ["yolox", "yolox-decoded"])
def test_yolox_without_labels_is_coco(tmp_path, rng, name):
    path = write_network(tmp_path / "mine.onnx", name, class_count=80, classes=(7, 0))
    detector = OnnxDetector(path)
    assert detector.family.name == name
    (found,) = detector.detect(pictures(rng, 1))
    assert found.label == ("truck",)


@pytest.mark.parametrize("has_batch", [False, True])
@pytest.mark.parametrize("order", [("boxes", "labels", "scores"), ("boxes", "scores", "labels")])
def test_torchvision_in_any_order_with_or_without_a_batch(tmp_path, rng, order, has_batch):
    images = pictures(rng, 3)
    content = {"order": order, "has_batch": has_batch}
    check(opened(tmp_path, "torchvision", content).detect(images), images, "torchvision", atol_px=2e-3, atol=2e-5)


def test_torchvision_counts_from_its_background(tmp_path, rng):
    path = write_network(tmp_path / "mine.onnx", "torchvision", classes=(3, 1), has_batch=False)
    detector = OnnxDetector(path, targets=None)
    assert detector.names == COCO_91
    assert COCO_91[3] == "car"
    assert COCO_91[90] == COCO_80[79] == "toothbrush"
    assert (len(COCO_80), len(COCO_91), COCO_91.count("N/A")) == (80, 91, 10)
    (found,) = detector.detect(pictures(rng, 1))
    assert set(found.label) == {"car", "person"}
    listed = OnnxDetector(path, targets=None, labels=["__background__", "person", "bicycle", "car"])
    assert listed.detect(pictures(rng, 1))[0].label
    with pytest.raises(InputError, match=r"mine\.onnx: gives class 3, expected 0 to 2, for it has 3 labels"):
        OnnxDetector(path, labels=["person", "car"]).detect(pictures(rng, 1))


def test_older_ultralytics_rtdetr_gives_scores_of_all_classes(tmp_path, rng):
    import onnx
    from onnx import helper

    path = write_network(tmp_path / "new.onnx", "ultralytics", metadata={}, transposed=True)
    model = onnx.load(str(path))
    cast = model.graph.node[-1]
    parts = helper.make_tensor("parts", onnx.TensorProto.FLOAT, [7], [1 / SIDE_PX] * 4 + [1.0] * 3)
    model.graph.initializer.append(parts)
    model.graph.node.insert(len(model.graph.node) - 1, helper.make_node("Mul", [cast.input[0], "parts"], ["scaled"]))
    model.graph.node[-1].input[0] = "scaled"
    helper.set_model_props(model, NAMES | {"description": "Ultralytics rtdetr-l model"})
    onnx.save(model, str(tmp_path / "old.onnx"))
    detector = OnnxDetector(tmp_path / "old.onnx", targets=None)
    assert detector.family.name == "ultralytics-rtdetr"
    images = pictures(rng, 2)
    check(detector.detect(images), images, "ultralytics-rtdetr", atol_px=2e-3, atol=2e-5)


# What cannot be told, or does not fit.


def test_six_numbers_without_metadata_are_refused_with_the_choices(tmp_path):
    path = write_network(tmp_path / "mine.onnx", "ultralytics-end2end")
    with pytest.raises(
        InputError,
        match=r"mine\.onnx: its layout could be one of .*ultralytics-end2end, ultralytics-rtdetr, .*rtdetr-single",
    ) as error:
        OnnxDetector(path)
    assert "output0 [?, 2, 6] float32" in str(error.value)
    assert "detector.format" in str(error.value)
    assert "\n" not in str(error.value)
    assert OnnxDetector(path, family="ultralytics-end2end").file.labels_origin.startswith("COCO (assumed")


def test_outputs_of_no_family_are_listed(tmp_path):
    path = write_network(tmp_path / "mine.onnx", "ultralytics", metadata=NAMES, add_output=True)
    with pytest.raises(
        InputError, match=r"mine\.onnx: unknown layout, got .*extra \[\?, 2, 4\] float32.*expected one of"
    ):
        OnnxDetector(path)


@pytest.mark.parametrize("name", [name for name in CASES if name != "ultralytics"])
def test_a_format_that_does_not_fit_is_refused(tmp_path, name):
    path = write_network(tmp_path / "mine.onnx", "ultralytics", metadata=NAMES)
    with pytest.raises(
        InputError, match=rf"mine\.onnx: detector\.format={name}: expected .*output0 \[\?, 7, 2\] float32, 3 labels"
    ):
        OnnxDetector(path, family=name)


def test_a_format_that_nobody_knows_is_refused(tmp_path):
    path = write_network(tmp_path / "mine.onnx", "ultralytics", metadata=NAMES)
    with pytest.raises(InputError, match=r"detector\.format: expected auto or one of ultralytics,.*got 'yolo'"):
        OnnxDetector(path, family="yolo")


def test_labels_come_from_a_list_or_a_file(tmp_path):
    path = write_network(tmp_path / "mine.onnx", "ultralytics", metadata={"names": "{0: 'a', 1: 'b', 2: 'c'}"})
    file = tmp_path / "labels.txt"
    file.write_text("car\nperson\nrider\n")
    for labels in (["car", "person", "rider"], file, str(file)):
        detector = OnnxDetector(path, labels=labels, targets=None)
        assert detector.file.labels_origin == "detector.labels"
        assert detector.road_users == {"vehicle": ("car",), "pedestrian": ("person",), "cyclist": ("rider",)}
    with pytest.raises(InputError, match=r"none of its labels \(a, b, c\) means a vehicle"):
        OnnxDetector(path)
    with pytest.raises(
        InputError, match=r"detector\.labels: .*nothing\.txt: expected a text file with one label a line, got"
    ):
        OnnxDetector(path, labels=tmp_path / "nothing.txt")
    file.write_text("car\n\nrider")
    with pytest.raises(InputError, match=r"detector\.labels: expected a label for every class, got an empty one"):
        OnnxDetector(path, labels=file)


def test_classes_are_chosen_by_name(tmp_path, rng):
    path = write_network(tmp_path / "mine.onnx", "ultralytics", metadata=NAMES)
    detector = OnnxDetector(path, targets=None, classes={"vehicle": ["Car", "pedestrian"], "cyclist": None})
    assert detector.road_users == {"vehicle": ("car", "pedestrian"), "cyclist": ("cyclist",)}
    (found,) = detector.detect(pictures(rng, 1))
    assert found.road_user_index.tolist() == [0, 0]
    with pytest.raises(
        InputError, match=r"detector\.classes\.vehicle: expected labels of .*got 'cra'; did you mean car"
    ):
        OnnxDetector(path, classes={"vehicle": ["cra"]})
    with pytest.raises(
        InputError, match=r"detector\.classes: expected 'car' in one list, got it in vehicle and cyclist"
    ):
        OnnxDetector(path, classes={"vehicle": ["car"], "cyclist": ["car"]})
    with pytest.raises(ValueError, match="targets must be some of"):
        OnnxDetector(path, targets=["dog"])


# Suppression and geometry.


def test_suppression_does_not_cross_kinds_of_road_users(tmp_path, rng):
    # a box that is a car and a pedestrian at once, from a network of scores
    path = write_network(tmp_path / "mine.onnx", "ultralytics", metadata=NAMES, classes=(0, 0))
    import onnx
    from onnx import numpy_helper

    model = onnx.load(str(path))
    for each in model.graph.initializer:
        if numpy_helper.to_array(each).shape == (2, 3):
            value = np.array([[1.0, 0.9, 0.0], [0.0, 0.0, 0.0]], np.float32)
            each.CopyFrom(numpy_helper.from_array(value, each.name))
    onnx.save(model, str(path))
    (found,) = OnnxDetector(path, targets=None).detect(pictures(rng, 1))
    assert found.label == ("car", "pedestrian")
    np.testing.assert_array_equal(found.box_px[0], found.box_px[1])
    (merged,) = OnnxDetector(path, classes={"vehicle": ["car", "pedestrian"]}).detect(pictures(rng, 1))
    assert merged.label == ("car",)


@pytest.mark.parametrize(("classes", "labels"), [((0, 0), ("car", "car")), ((0, 1), ("car",))])
def test_a_network_that_suppresses_is_trusted_within_a_label(tmp_path, rng, classes, labels):
    import onnx
    from onnx import numpy_helper

    metadata = ULTRALYTICS | {"names": "['car', 'truck']", "end2end": "True"}
    path = write_network(tmp_path / "mine.onnx", "ultralytics-end2end", metadata=metadata, classes=classes)
    model = onnx.load(str(path))
    for each in model.graph.initializer:
        value = numpy_helper.to_array(each).copy()
        if value.shape == (2, 4):
            value[1] = value[0]  # the second box lies on the first
            each.CopyFrom(numpy_helper.from_array(value, each.name))
    onnx.save(model, str(path))
    (found,) = OnnxDetector(path).detect(pictures(rng, 1))
    assert found.label == labels
    (found,) = OnnxDetector(path, nms_iou_max=1.0).detect(pictures(rng, 1))
    assert len(found) == 2


@pytest.mark.parametrize("name", ["yolox", "yolox-decoded"])
def test_yolox_of_one_class_is_told_by_its_cells(tmp_path, rng, name):
    path = write_network(tmp_path / "mine.onnx", name, class_count=1, classes=(0, 0))
    detector = OnnxDetector(path, labels=["car"])
    assert detector.family.name == name
    (found,) = detector.detect(pictures(rng, 1))
    assert found.label == ("car", "car")
    with pytest.raises(InputError, match="could be one of"):
        OnnxDetector(path)


@given(
    st.integers(1, 900),
    st.integers(1, 900),
    st.sampled_from([(64, 64), (256, 256), (320, 640)]),
    st.sampled_from(list(ImagePlacement)),
    st.randoms(),
)
def test_packing_and_unpacking_boxes_is_the_identity(height_px, width_px, input_size_px, placement, random):
    letterbox = Letterbox.fit(height_px, width_px, input_size_px[0], input_size_px[1], placement)
    x0, x1 = sorted(random.uniform(0, width_px) for _ in range(2))
    y0, y1 = sorted(random.uniform(0, height_px) for _ in range(2))
    box_px = np.array([[x0, y0, x1, y1]])
    scale = np.array([letterbox.scaled_width_px / width_px, letterbox.scaled_height_px / height_px] * 2)
    box_input_px = box_px * scale + np.array([letterbox.left_px, letterbox.top_px] * 2)
    assert (box_input_px >= 0).all()
    assert (box_input_px[0, 2:] <= np.array(input_size_px[::-1]) + 1e-6).all()
    back_px = letterbox.unpack(box_input_px.astype(np.float32), height_px, width_px)
    np.testing.assert_allclose(back_px, box_px, atol=2e-3 / scale.min())


@pytest.mark.parametrize(
    ("placement", "rows"),
    [
        (ImagePlacement.CENTRED, slice(16, 48)),
        (ImagePlacement.TOP_LEFT, slice(0, 32)),
        (ImagePlacement.STRETCHED, slice(0, 64)),
    ],
)
def test_letterboxes_pad_grey_where_they_should(placement, rows):
    canvas = Letterbox.fit(128, 256, 64, 64, placement).canvas(np.full((1, 128, 256, 3), 255, np.uint8))
    is_image = np.zeros(64, bool)
    is_image[rows] = True
    assert (canvas[0, is_image] == 255).all()
    assert (canvas[0, ~is_image] == 114).all()


@pytest.mark.slow
@EVERY
def test_a_run_takes_every_family(tmp_path, name):
    build, opened, _ = CASES[name]
    file, out = write_network(tmp_path / "mine.onnx", name, **build), tmp_path / "run"
    options = [f"detector.model={file}", f"run.out={out}", f"detector.format={opened.get('family', 'auto')}"]
    if "labels" in opened:
        options.append(f"detector.labels=[{', '.join(opened['labels'])}]")
    small = [
        "scenes.train_seeds=[0]", "scenes.test_seeds=[1000]", "run.batch_size=1", "run.iterations=1", "rig.cameras=2",
        "camera.width_px=80", "camera.height_px=48", "baselines.random_samples=1", "optimiser.pool_cameras=16",
        "losses.probability=visible_share", "run.pictures=none",  # it finds next to nothing, which cannot be fitted
    ]  # fmt: skip
    assert main(["optimise", *small, *options]) == 0
    metrics = json.loads((out / "evaluation.json").read_text())["arms"]["optimised"]
    assert metrics["false_alarms_per_frame"] > 0.0  # its boxes were read, and show nothing
