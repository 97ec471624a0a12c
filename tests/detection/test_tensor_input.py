"""Images reach the network where they lie: the same detections as by way of the host, and nothing is copied."""

import numpy as np
import pytest
import warp as wp

from tests.driving_scene import ConstantDetector, camera_pose, on_device, packed_street
from warpav.core.errors import InputError
from warpav.detection.detector import TensorDetector
from warpav.detection.observe import detections_in, network_input_of
from warpav.detection.onnx_detector import OnnxDetector
from warpav.raster.camera import CameraModel
from warpav.raster.renderer import Renderer


@pytest.fixture(scope="module")
def detector():
    return OnnxDetector("builtin", confidence_min=0.05)


def pictures(device, size_px=256):
    scene = packed_street(device)
    poses = np.stack([camera_pose([1.0, 0.2, 1.8], yaw, 0.05) for yaw in (0.0, 0.4, 2.9)])
    renderer = Renderer([CameraModel(size_px, size_px)] * 3, device=device)
    frame = renderer.render(scene.raster, *on_device(poses, device))
    return frame.colours()


def same(one, other):
    assert len(one) == len(other)
    for a, b in zip(one, other, strict=True):
        np.testing.assert_array_equal(a.box_px, b.box_px)
        np.testing.assert_array_equal(a.confidence, b.confidence)
        np.testing.assert_array_equal(a.class_index, b.class_index)


def on_host(image):
    return (image.numpy() * 255.0 + 0.5).astype(np.uint8)


def test_detections_are_those_of_the_pictures(device, detector):
    image = pictures(device)
    expected = detector.detect(on_host(image))
    assert sum(map(len, expected)) > 3
    same(detections_in(network_input_of([image], detector), detector), expected)


def test_the_network_reads_the_array_where_it_lies(detector, monkeypatch):
    image = pictures("cpu")
    seen = []
    run = detector._run
    monkeypatch.setattr(detector, "_run", lambda array: (seen.append(array), run(array))[1])
    network_input = wp.zeros((3, 3, 256, 256), dtype=float)
    detector.detect_tensor(network_input)
    assert seen[0].ctypes.data == network_input.ptr
    same(detections_in(network_input_of([image], detector), detector), detector.detect(on_host(image)))


def test_another_library_s_tensor_is_taken(detector):
    class Capsule:
        """NumPy's array behind the protocol alone."""

        def __init__(self, array):
            self._array = array

        def __dlpack__(self, **options):
            return self._array.__dlpack__()

        def __dlpack_device__(self):
            return self._array.__dlpack_device__()

    rgb = np.random.default_rng(0).integers(0, 256, (2, 64, 96, 3), np.uint8)
    planes = np.ascontiguousarray(rgb.transpose(0, 3, 1, 2)).astype(np.float32) * np.float32(1.0 / 255.0)
    same(detector.detect_tensor(Capsule(planes)), detector.detect(rgb))


def test_sizes_that_need_padding_go_by_the_host(device, detector):
    image = pictures(device, size_px=72)
    assert not detector.takes_tensor(72, 72)
    same(detections_in(network_input_of([image], detector), detector), detector.detect(on_host(image)))


def test_detectors_that_know_no_tensors_are_served(device):
    silent = ConstantDetector.silent(3)
    assert not isinstance(silent, TensorDetector)
    assert [len(found) for found in detections_in(network_input_of([pictures(device)], silent), silent)] == [0, 0, 0]


@pytest.mark.parametrize("shape", [(1, 64, 64, 3), (3, 64, 64), (1, 3, 72, 72)])
def test_other_layouts_are_refused(detector, shape):
    with pytest.raises(ValueError, match=r"network_input must be|takes no images of 72 x 72"):
        detector.detect_tensor(wp.zeros(shape, dtype=float))


def test_no_images_no_detections(detector):
    assert detector.detect_tensor(wp.zeros((0, 3, 64, 64), dtype=float)) == []


def test_a_provider_that_is_not_there_is_refused():
    import onnxruntime

    if "CUDAExecutionProvider" in onnxruntime.get_available_providers():
        pytest.skip("onnxruntime has its CUDA provider here")
    with pytest.raises(InputError, match=r"detector\.provider: expected one of cpu.*got 'cuda'"):
        OnnxDetector("builtin", provider="cuda")


def test_a_provider_that_gave_way_is_refused(monkeypatch):
    import onnxruntime

    # a provider that onnxruntime lists but cannot load: it falls back to the CPU with a warning
    monkeypatch.setattr(onnxruntime, "get_available_providers", lambda: ["CUDAExecutionProvider"])
    session = onnxruntime.InferenceSession

    def fallen_back(path, options, providers):
        return session(path, options, providers=["CPUExecutionProvider"])

    monkeypatch.setattr(onnxruntime, "InferenceSession", fallen_back)
    with pytest.raises(InputError, match="fell back to CPUExecutionProvider"):
        OnnxDetector("builtin", provider="cuda")
