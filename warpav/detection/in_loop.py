"""The detector in the optimisation's loop: only images that matter, many at once, beside the rendering, none twice."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any
from weakref import WeakKeyDictionary

from warpav.detection.detector import Detections, Detector
from warpav.detection.observe import detections_in, network_input_of


@dataclass(frozen=True)
class Picture:
    """An image that a detector is asked about.

    Attributes:
        scene: What is shown; compared by identity.
        camera: Which camera shows it.
        pose: All that its content depends on besides, as bytes; equal bytes mean an equal image.
        image: Colours 0..1, vec3 [1, row, column]; may be written over as soon as `DetectorInLoop.ask` returns.
    """

    scene: Hashable
    camera: int
    pose: bytes
    image: Any


class DetectorInLoop:
    """Runs a detector on pictures in a thread of its own, and remembers what it said last of every scene and camera.

    onnxruntime works without Python's lock, so the caller can go on rendering. Which pictures go into the network
    together depends on the calls alone, not on timing.
    """

    def __init__(self, detector: Detector) -> None:
        """The detector is called from one thread, one call at a time."""
        self._detector = detector
        self._pool = ThreadPoolExecutor(1)
        self._known: WeakKeyDictionary[Any, dict[int, tuple[bytes, Detections]]] = WeakKeyDictionary()

    def ask(self, pictures: Sequence[Picture]) -> Callable[[], list[Detections]]:
        """Begin to detect.

        Args:
            pictures: All of one size.

        Returns:
            A function that waits for the answers, one for every picture, in order; it raises what the detector raises.
        """
        new = [picture for picture in pictures if self._answer(picture) is None]
        answers = None
        if new:
            network_input = network_input_of([picture.image for picture in new], self._detector)
            answers = self._pool.submit(detections_in, network_input, self._detector)

        def wait() -> list[Detections]:
            if answers is not None:
                for picture, found in zip(new, answers.result(), strict=True):
                    self._known.setdefault(picture.scene, {})[picture.camera] = (picture.pose, found)
            found = [self._answer(picture) for picture in pictures]
            assert all(each is not None for each in found)
            return [each for each in found if each is not None]

        return wait

    def _answer(self, picture: Picture) -> Detections | None:
        pose, found = self._known.get(picture.scene, {}).get(picture.camera, (None, None))
        return found if pose == picture.pose else None
