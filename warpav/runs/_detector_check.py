"""``warpav detector check``: how an ONNX detector is read, what it finds and how fast, found out by running it."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from warpav.core.bounded_files import PNG_SIGNATURE, is_whole_png
from warpav.core.errors import ArgumentError
from warpav.core.files import check_parent, writing
from warpav.core.records import unread_text
from warpav.detection import ROAD_USERS, Detections, OnnxDetector
from warpav.runs._networks import load_detector
from warpav.runs.config import Config
from warpav.view import CAMERA_RGB, PAPER_RGB, checked_figure

_SMALL_PX = 256
_OWN_SIZE_PX = 640
BATCH = 16
_REPEAT = 3
_REPEAT_WITHIN_S = 1.0


def check_detector(
    model: str, config: Config | None = None, *, image_file: Path | None = None, out: Path | None = None
) -> Iterator[str]:
    """Describe in lines how an ONNX detector is read (sizes [px], labels), time it, and try it on an image.

    Args:
        model: Path of the file, or ``builtin``.
        config: Options of the section ``detector``; None: the shipped configuration ``quick``.
        image_file: An image to find road users in; None: none.
        out: PNG to draw them into; None: ``<image>_boxes.png``.

    Raises:
        InputError: The file, an option or the image cannot be used.
    """
    config = Config() if config is None else config
    if out is not None and image_file is None:
        raise ArgumentError("out", "expected `image` beside it, as boxes are drawn on an image")
    image_rgb = None if image_file is None else _read_image(image_file)
    target = None if image_file is None else checked_figure(out or Path(f"{image_file.stem}_boxes.png"), (".png",))
    check_parent(target, "out")
    config = config.model_copy(update={"detector": config.detector.model_copy(update={"model": model})})
    detector = load_detector(config, every_road_user=True)
    if not set(config.scenes.targets) <= set(detector.road_users):
        load_detector(config)  # says which target has no label
    yield from _description(detector)
    yield from _timings(detector)
    if image_rgb is not None and target is not None:
        (found,) = detector.detect(image_rgb[None])
        yield from _list(found, config.detector.confidence_min)
        _draw(image_rgb, found, target)
        yield f"wrote {target}"


def _description(detector: OnnxDetector) -> Iterator[str]:
    family, file = detector.family, detector.file
    yield str(file.path)
    yield _row("format", f"{family.name}: {detector.reason}")
    size = "any size" if file.size_px is None else f"{file.size_px[1]} x {file.size_px[0]} px"
    if file.size_px is None:
        size += (
            f" in steps of {family.step_px} px" if family.square_px is None else f", {family.square_px} px by default"
        )
    colours = f"{'BGR' if family.is_bgr else 'RGB'} 0..{family.white:.0f}"
    batch = "any batch" if family.batch is None else f"{family.batch} at a time"
    yield _row("images", f"{colours}, {family.placement.value}, {size}, {batch}")
    for name, tensors in (("input", file.inputs), ("output", file.outputs)):
        for tensor in tensors:
            yield _row(name, str(tensor))
    labels = ", ".join(detector.names[:12]) + (", ..." if len(detector.names) > 12 else "")
    yield _row("labels", f"{len(detector.names)} from {file.labels_origin}: {labels}")
    if text := unread_text(file.unread_metadata):
        yield _row("metadata", text)
    for user in ROAD_USERS:
        counted = detector.road_users.get(user)
        yield _row(user, ", ".join(counted) if counted else f"no label; detector.classes.{user} can name some")
    import onnxruntime

    available = ", ".join(onnxruntime.get_available_providers())
    yield _row("runs on", f"{detector.providers_used[0]} (onnxruntime offers {available})")


def _timings(detector: OnnxDetector) -> Iterator[str]:
    rng = np.random.default_rng(0)
    own_px = detector.file.size_px or (_OWN_SIZE_PX, _OWN_SIZE_PX)
    for height_px, width_px in dict.fromkeys(((_SMALL_PX, _SMALL_PX), own_px)):
        parts = []
        for batch in (1, BATCH) if detector.family.batch is None else (detector.family.batch,):
            images_rgb = rng.integers(0, 256, (batch, height_px, width_px, 3), np.uint8)
            detector.detect(images_rgb)  # the first run of a size prepares those that follow
            seconds = []
            while len(seconds) < _REPEAT and sum(seconds) < _REPEAT_WITHIN_S:
                start = time.perf_counter()
                detector.detect(images_rgb)
                seconds.append(time.perf_counter() - start)
            parts.append(f"{1000.0 * min(seconds) / batch:.1f} ms in batches of {batch}")
        yield _row("time", f"an image of {width_px} x {height_px} px: {', '.join(parts)}")


def _row(name: str, text: str) -> str:
    return f"  {name:<10}  {text}"


def _list(found: Detections, confidence_min: float) -> Iterator[str]:
    yield f"{len(found)} detections of confidence {confidence_min:g} and more (x0, y0, x1, y1 in pixels)"
    for box_px, confidence, label, user in zip(
        found.box_px, found.confidence, found.label, found.road_user_index, strict=True
    ):
        edges = " ".join(f"{edge:7.1f}" for edge in box_px)
        yield f"  {confidence:.2f}  {edges}  {label} ({ROAD_USERS[user]})"


def _read_image(file: Path) -> np.ndarray:
    import cv2

    try:
        data = file.read_bytes()
    except OSError as error:
        raise ArgumentError("image", f"expected an image, got none: {error.strerror}", place=file) from error
    is_decoded = len(data) > 0 and (is_whole_png(data) or not data.startswith(PNG_SIGNATURE))
    image_bgr = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR) if is_decoded else None
    if image_bgr is None:
        raise ArgumentError(
            "image", f"expected an image such as PNG or JPEG, got a file of {len(data)} bytes that is none", place=file
        )
    return np.ascontiguousarray(image_bgr[..., ::-1])


def _draw(image_rgb: np.ndarray, found: Detections, target: Path) -> None:
    import cv2

    drawn = image_rgb.copy()
    scale = max(0.4, min(drawn.shape[:2]) / 1400.0)
    width_px = max(1, round(2.0 * scale))
    for k in reversed(range(len(found))):  # the most confident lie on top
        x0, y0, x1, y1 = (round(float(edge)) for edge in found.box_px[k])
        colour = CAMERA_RGB[int(found.road_user_index[k])]
        cv2.rectangle(drawn, (x0, y0), (x1, y1), colour, width_px)
        text = f"{found.label[k]} {found.confidence[k]:.2f}"
        (text_px, height_px), below_px = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, scale, width_px)
        left = min(max(x0, 0), max(0, drawn.shape[1] - text_px))
        foot = max(y0 - below_px, height_px)
        cv2.rectangle(drawn, (left, foot - height_px), (left + text_px, foot + below_px), colour, cv2.FILLED)
        cv2.putText(drawn, text, (left, foot), cv2.FONT_HERSHEY_SIMPLEX, scale, PAPER_RGB, width_px, cv2.LINE_AA)
    encoded = cv2.imencode(".png", np.ascontiguousarray(drawn[..., ::-1]))[1]  # imwrite crashes at paths not in UTF-8
    with writing(target):
        target.write_bytes(encoded.tobytes())
