"""Training of the built-in detector; needs PyTorch (extra ``train``)."""

from dataclasses import dataclass
from pathlib import Path

CLASS_NAMES = ("car", "van", "lorry", "bus", "motorcycle", "pedestrian", "cyclist")
"""Labels of the shipped detector, in the order of its output."""


@dataclass(frozen=True)
class TrainingOptions:
    """How the detector is trained."""

    device: str = "cpu"  # of PyTorch
    processes: int = 2  # that render
    steps: int = 13_632  # length of the schedule
    batch_size: int = 192  # images of 256 px a step; of larger ones as many as have the same number of pixels
    seed: int = 0  # of the weights and of the batches
    recordings: tuple[Path, ...] = ()  # recorded traffic of one's own, besides what ships with warpav
