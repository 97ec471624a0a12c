"""Train the built-in detector: images, training, ONNX file; can be interrupted and resumed at any time."""

from __future__ import annotations

import copy
import logging
import math
import time
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from pickle import UnpicklingError

import numpy as np
import torch
from torch import Tensor, nn

from warpav.core.errors import InputError
from warpav.detection.training import CLASS_NAMES, TrainingOptions
from warpav.detection.training._data import TRAIN_SUBSETS, LabelledImages, load_images, own_subset, write_images
from warpav.detection.training._loss import MIN_SIDE_PX, TargetBoxes, augment, detection_loss
from warpav.detection.training._network import TownNetwork, export_network

# An image is drawn the more often, the more of these kinds it shows; they are rarer than cars.
_RARE_NAMES = ("motorcycle", "pedestrian", "cyclist")
# Images are varied at full strength up to this share of the training, then less and less, down to that strength.
_FULL_VARIETY_UNTIL, _LAST_VARIETY = 0.5, 0.25
# Relative frequency of batches by image side [px].
_SIZE_PROBABILITY = {256: 0.4, 384: 0.2, 640: 0.25, 1280: 0.15}

_LEARNING_RATE = 2e-3
_LAST_LEARNING_RATE_FRACTION = 0.01
_WEIGHT_DECAY = 0.02
_WARM_UP_STEPS = 500
_AVERAGE_DECAY = 0.9995
_GRADIENT_NORM_MAX = 10.0
_LOG_STEPS = 500
_CHECKPOINT_S = 120.0

_logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class DeviceData:
    """Images of one size on the training device."""

    images_rgb: Tensor
    truth: TargetBoxes
    frequency: Tensor  # how often each image is drawn, relative to one without kinds that are rare

    @classmethod
    def load(cls, labelled: Iterable[LabelledImages], device: torch.device) -> DeviceData:
        """Copy images of one size to the device, block by block; objects of less than `MIN_SIDE_PX` are ignored."""
        labelled = list(labelled)
        count = sum(len(each.images_rgb) for each in labelled)
        images_rgb = torch.empty((count, *labelled[0].images_rgb.shape[1:]), dtype=torch.uint8, device=device)
        first = 0
        for each in labelled:
            for start in range(0, len(each.images_rgb), 1024):
                block = torch.from_numpy(np.array(each.images_rgb[start : start + 1024]))
                images_rgb[first : first + len(block)] = block.to(device)
                first += len(block)
        box_px = np.concatenate([each.labels.box_px for each in labelled])
        class_index = np.concatenate([each.labels.class_index for each in labelled])
        ignored = np.concatenate([each.labels.ignored for each in labelled])
        side_px = (box_px[..., 2:] - box_px[..., :2]).min(axis=-1)
        ignored |= side_px < MIN_SIDE_PX
        rare = [(~ignored & (class_index == CLASS_NAMES.index(name))).any(axis=1) for name in _RARE_NAMES]
        return cls(
            images_rgb,
            TargetBoxes(
                torch.from_numpy(box_px).to(device),
                torch.from_numpy(class_index.astype(np.int64)).to(device),
                torch.from_numpy(ignored).to(device),
            ),
            torch.from_numpy(1.0 + np.sum(rare, axis=0, dtype=np.float32)).to(device),
        )

    def batch(self, index: Tensor) -> tuple[Tensor, TargetBoxes]:
        truth = self.truth
        return self.images_rgb[index], TargetBoxes(truth.box_px[index], truth.class_index[index], truth.ignored[index])


class Training:
    """A training run: the network, its running average, the optimiser and the schedule."""

    def __init__(self, device: torch.device, *, step_count: int, seed: int = 0) -> None:
        torch.manual_seed(seed)
        self.device = device
        self.network = TownNetwork().to(device)
        self.network.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue] - the stub lacks it
        self.average = copy.deepcopy(self.network).eval().requires_grad_(False)
        average, current = self.average.state_dict(), self.network.state_dict()
        floating = [name for name, value in current.items() if value.is_floating_point()]
        self._averages, self._currents = [average[name] for name in floating], [current[name] for name in floating]
        # weights of convolutions decay, biases and normalisation do not
        weights, others = ([v for v in self.network.parameters() if (v.ndim > 1) == wide] for wide in (True, False))
        groups = [{"params": weights, "weight_decay": _WEIGHT_DECAY}, {"params": others, "weight_decay": 0.0}]
        self.optimiser = torch.optim.AdamW(groups, lr=_LEARNING_RATE, fused=device.type == "cuda")
        self.random = np.random.default_rng(seed)
        self.generator = torch.Generator(device).manual_seed(seed)
        self.step = 0
        self.step_count = step_count

    def load(self, path: Path) -> None:
        hint = "train into another folder, or remove the file"
        try:
            state = torch.load(path, map_location=self.device, weights_only=True)
            step, step_count = int(state["step"]), int(state["step_count"])
            if step_count == self.step_count:
                self.network.load_state_dict(state["network"])
                self.average.load_state_dict(state["average"])
                self.optimiser.load_state_dict(state["optimiser"])
        except (RuntimeError, KeyError, TypeError, ValueError, OSError, EOFError, UnpicklingError) as error:
            raise InputError(f"{path}: expected a checkpoint of this training, got another file; {hint}") from error
        if step_count != self.step_count:
            raise InputError(f"{path}: expected a training of {self.step_count} steps, got one of {step_count}; {hint}")
        self.step = step
        # Random numbers go on in a stream of their own rather than repeat.
        self.random = np.random.default_rng([self.step])
        self.generator.manual_seed(self.step)

    def save(self, path: Path) -> None:
        state = {
            "network": self.network.state_dict(),
            "average": self.average.state_dict(),
            "optimiser": self.optimiser.state_dict(),
            "step": self.step,
            "step_count": self.step_count,
        }
        path.parent.mkdir(parents=True, exist_ok=True)
        partial = path.with_suffix(".partial")
        torch.save(state, partial)
        partial.replace(path)

    def train_step(self, data: DeviceData, batch_size: int) -> Tensor:
        warm_up = min(1.0, (self.step + 1) / min(_WARM_UP_STEPS, max(1, self.step_count // 10)))
        cosine = 0.5 * (1.0 + math.cos(math.pi * min(1.0, self.step / max(1, self.step_count))))
        for group in self.optimiser.param_groups:
            group["lr"] = _LEARNING_RATE * warm_up * max(cosine, _LAST_LEARNING_RATE_FRACTION)
        # drawn on the device, since a copy would wait for all that it has yet to do
        index = torch.multinomial(data.frequency, batch_size, replacement=True, generator=self.generator)
        share = self.step / max(1, self.step_count)
        variety = float(np.interp(share, (_FULL_VARIETY_UNTIL, 1.0), (1.0, _LAST_VARIETY)))
        images, truth = augment(*data.batch(index), self.generator, strength=variety)
        images = images.contiguous(memory_format=torch.channels_last)
        # A CPU gains nothing from half precision.
        with torch.autocast(self.device.type, torch.bfloat16, enabled=self.device.type == "cuda"):
            score_logit, box_px, center_px, _ = self.network(images)
        score_loss, box_loss = detection_loss(score_logit, box_px, center_px, truth)
        self.optimiser.zero_grad(set_to_none=True)
        (score_loss + box_loss).backward()
        nn.utils.clip_grad_norm_(self.network.parameters(), _GRADIENT_NORM_MAX)
        self.optimiser.step()
        self.step += 1
        decay = min(_AVERAGE_DECAY, (1.0 + self.step) / (10.0 + self.step))  # the first steps are forgotten sooner
        with torch.no_grad():  # PyTorch documents the function, but its stub lacks it
            torch._foreach_lerp_(self._averages, self._currents, 1.0 - decay)  # pyright: ignore[reportPrivateImportUsage]
        return torch.stack((score_loss, box_loss)).detach()


def train(training: Training, data: dict[int, DeviceData], batch_size: int, checkpoint: Path) -> None:
    """Train on images by their side [px] until the schedule ends; saved now and then, and when interrupted."""
    saved_s = time.perf_counter()
    sides_px = list(data)
    probability = np.array([_SIZE_PROBABILITY[side_px] for side_px in sides_px])
    losses: list[Tensor] = []
    try:
        while training.step < training.step_count:
            side_px = int(training.random.choice(sides_px, p=probability / probability.sum()))
            batch = max(1, round(batch_size * (256 / side_px) ** 2))
            losses.append(training.train_step(data[side_px], batch))
            if training.step % _LOG_STEPS == 0:
                loss = torch.stack(losses).mean(dim=0).tolist()
                losses.clear()
                _logger.info("step %d of %d: score loss %.3f, box loss %.3f", training.step, training.step_count, *loss)
                if not math.isfinite(sum(loss)):
                    raise RuntimeError(f"the loss is not finite at step {training.step}; the last checkpoint is whole")
            if time.perf_counter() - saved_s > _CHECKPOINT_S:
                training.save(checkpoint)
                saved_s = time.perf_counter()
    except KeyboardInterrupt:
        training.save(checkpoint)
        raise
    training.save(checkpoint)


def train_detector(folder: Path, options: TrainingOptions, *, image_folder: Path) -> Path:
    """Render the images, train, and write the network as ``detector.onnx``; resumes from existing results."""
    torch.backends.cudnn.benchmark = True
    torch.set_float32_matmul_precision("high")
    training = Training(torch.device(options.device), step_count=options.steps, seed=options.seed)
    checkpoint = folder / "checkpoint.pt"
    if checkpoint.exists():
        training.load(checkpoint)
        _logger.info("going on from step %d of %d", training.step, training.step_count)
    subsets = TRAIN_SUBSETS | ({"train_own": own_subset(options.recordings)} if options.recordings else {})
    for name, subset in subsets.items():
        write_images(subset, image_folder / name, processes=options.processes, device=options.device)
    if training.step < training.step_count:
        loaded = [load_images(image_folder / name) for name in subsets]
        data = {
            side_px: DeviceData.load([each[side_px] for each in loaded], training.device)
            for side_px in _SIZE_PROBABILITY
        }
        train(training, data, options.batch_size, checkpoint)
    file = folder / "detector.onnx"
    export_network(training.average, file)
    return file
