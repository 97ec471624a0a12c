"""The detector in the optimisation loop: batched, parallel to the rendering, and cached for unmoved cameras."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any
from weakref import WeakKeyDictionary

from warpav.detection.detector import Detections, Detector
from warpav.detection.observe import detections_in, network_input_of


@dataclass(frozen=True)
class RenderedImage:
    """A rendered image for the detector.

    Attributes:
        scene: The scene; compared by identity.
        camera: Index of the camera.
        pose: Everything else that the content depends on, as bytes; equal bytes mean an equal image.
        image: Colours 0..1, vec3 [1, row, column]; may be overwritten as soon as `DetectorInLoop.ask` returns.
    """

    scene: Hashable
    camera: int
    pose: bytes
    image: Any


class DetectorInLoop:
    """Runs a detector on images in its own thread and caches the last detections of every scene and camera.

    onnxruntime releases the GIL, so the caller can continue rendering. Which images share a batch of the network
    depends only on the calls, not on timing.
    """

    def __init__(self, detector: Detector) -> None:
        """The detector is called from one thread, one call at a time."""
        self._detector = detector
        self._pool = ThreadPoolExecutor(1)
        self._known: WeakKeyDictionary[Any, dict[int, tuple[bytes, Detections]]] = WeakKeyDictionary()

    def ask(self, images: Sequence[RenderedImage]) -> Callable[[], list[Detections]]:
        """Start detecting.

        Args:
            images: All of one size.

        Returns:
            A function that waits for the detections, one per image, in order; it raises the errors of the detector.
        """
        new = [image for image in images if self._answer(image) is None]
        answers = None
        if new:
            network_input = network_input_of([image.image for image in new], self._detector)
            answers = self._pool.submit(detections_in, network_input, self._detector)

        def wait() -> list[Detections]:
            if answers is not None:
                for image, found in zip(new, answers.result(), strict=True):
                    self._known.setdefault(image.scene, {})[image.camera] = (image.pose, found)
            found = [self._answer(image) for image in images]
            assert all(each is not None for each in found)
            return [each for each in found if each is not None]

        return wait

    def _answer(self, image: RenderedImage) -> Detections | None:
        pose, found = self._known.get(image.scene, {}).get(image.camera, (None, None))
        return found if pose == image.pose else None
