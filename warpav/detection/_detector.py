"""What a detector is: a thing that turns images into boxes with a confidence and a label."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol, cast, runtime_checkable

import numpy as np

from warpav.scene import ROAD_USERS

__all__ = ["ROAD_USERS", "Detections", "Detector", "TensorDetector"]


@dataclass(frozen=True)
class Detections:
    """What a detector found in one image, most confident first.

    Attributes:
        box_px: Boxes ``x0, y0, x1, y1`` in pixels of the image, inside it, float32, shape [detection, 4].
        confidence: Confidence in 0..1, float32, shape [detection].
        class_index: Index into `names`, int32, shape [detection].
        names: Every label that the detector can give.
        road_user_index: Index into `ROAD_USERS`, int32, shape [detection]; all vehicles when left out.
    """

    box_px: np.ndarray
    confidence: np.ndarray
    class_index: np.ndarray
    names: tuple[str, ...]
    road_user_index: np.ndarray = cast("np.ndarray", None)  # noqa: RUF009 (a constant)

    def __post_init__(self) -> None:
        if cast("np.ndarray | None", self.road_user_index) is None:
            object.__setattr__(self, "road_user_index", np.zeros(len(self.confidence), np.int32))

    def __len__(self) -> int:
        return len(self.confidence)

    @property
    def label(self) -> tuple[str, ...]:
        return tuple(self.names[index] for index in self.class_index)

    def only(self, chosen: np.ndarray | slice) -> Detections:
        """Some of them; ``chosen`` bool [detection], or a slice."""
        box_px, confidence, class_index = self.box_px[chosen], self.confidence[chosen], self.class_index[chosen]
        return Detections(box_px, confidence, class_index, self.names, self.road_user_index[chosen])

    @classmethod
    def none(cls, names: tuple[str, ...] = ()) -> Detections:
        return cls(np.zeros((0, 4), np.float32), np.zeros(0, np.float32), np.zeros(0, np.int32), names)


class Detector(Protocol):
    """Finds road users in images."""

    @property
    def names(self) -> tuple[str, ...]: ...

    def detect(self, images_rgb: np.ndarray | Sequence[np.ndarray]) -> list[Detections]:
        """What is in images of one size, uint8 [image, row, column, 3]; one `Detections` for each, in order."""
        ...


@runtime_checkable
class TensorDetector(Detector, Protocol):
    """A detector that can also read its network's input where it lies, without a copy through the host."""

    def takes_tensor(self, height_px: int, width_px: int) -> bool:
        """Whether images of this size go into the network as they are."""
        ...

    def detect_tensor(self, network_input: Any) -> list[Detections]:  # noqa: ANN401 (a DLPack capsule has no type)
        """The same for anything with the DLPack protocol: RGB in 0..1, float32 [image, 3, row, column]; not kept."""
        ...
