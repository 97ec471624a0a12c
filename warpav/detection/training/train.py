"""Train the shipped detector; can stop and go on.

    python -m warpav.detection.training.train --data FOLDER --checkpoint FILE.pt --device cuda --minutes 17

The schedule counts steps: either as many as given, or as many as fit into the minutes at the speed of the first ones.
Run the same command again to go on from the checkpoint.
"""

from __future__ import annotations

import argparse
import copy
import logging
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from warpav.detection.training.augmentation import MIN_SIDE_PX, augment
from warpav.detection.training.data import Pictures, load_pictures
from warpav.detection.training.loss import Truth, detection_loss
from warpav.detection.training.network import TownNetwork

# How often a batch is drawn from the pictures of each side [px].
SIZE_PROBABILITY = {256: 0.55, 384: 0.25, 640: 0.2}

_LEARNING_RATE = 2e-3
_LAST_LEARNING_RATE_FRACTION = 0.01
_WEIGHT_DECAY = 0.02
_WARM_UP_STEPS = 500
_AVERAGE_DECAY = 0.9995
_GRADIENT_NORM_MAX = 10.0
# The speed is measured over these steps, after as many to warm up.
_SPEED_STEPS = 100
_LOG_STEPS = 500
_CHECKPOINT_S = 120.0

_logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class DeviceData:
    """Pictures of one size on the device that trains."""

    images_rgb: Tensor
    truth: Truth

    @classmethod
    def load(cls, pictures: Pictures, device: torch.device) -> DeviceData:
        """Copy pictures to the device, block by block; objects of less than `MIN_SIDE_PX` are ignored."""
        labels = pictures.labels
        images_rgb = torch.empty(pictures.images_rgb.shape, dtype=torch.uint8, device=device)
        for start in range(0, len(images_rgb), 1024):
            block = np.array(pictures.images_rgb[start : start + 1024])
            images_rgb[start : start + 1024] = torch.from_numpy(block).to(device)
        side_px = (labels.box_px[..., 2:] - labels.box_px[..., :2]).min(axis=-1)
        return cls(
            images_rgb,
            Truth(
                torch.from_numpy(labels.box_px).to(device),
                torch.from_numpy(labels.class_index.astype(np.int64)).to(device),
                torch.from_numpy(labels.too_small | (side_px < MIN_SIDE_PX)).to(device),
            ),
        )

    def batch(self, index: Tensor) -> tuple[Tensor, Truth]:
        """The images and objects of these indices."""
        truth = self.truth
        return self.images_rgb[index], Truth(truth.box_px[index], truth.class_index[index], truth.ignored[index])


class Training:
    """A training run: the network, its running average, the optimiser and the schedule.

    Args:
        device: PyTorch device.
        seed: Of the weights and of the batches.
        learning_rate: The largest.
    """

    def __init__(self, device: torch.device, *, seed: int = 0, learning_rate: float = _LEARNING_RATE) -> None:
        torch.manual_seed(seed)
        self.device = device
        self.network = TownNetwork().to(device)
        self.network.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue] - the stub lacks it
        self.average = copy.deepcopy(self.network).eval().requires_grad_(False)
        average, current = self.average.state_dict(), self.network.state_dict()
        floating = [name for name, value in current.items() if value.is_floating_point()]
        self._averages, self._currents = [average[name] for name in floating], [current[name] for name in floating]
        self.learning_rate = learning_rate
        self.optimiser = torch.optim.AdamW(_parameter_groups(self.network), lr=learning_rate)
        self.random = np.random.default_rng(seed)
        self.generator = torch.Generator(device).manual_seed(seed)
        self.step = 0
        self.step_count = 0

    def load(self, path: Path) -> None:
        """Go on from a checkpoint."""
        state = torch.load(path, map_location=self.device, weights_only=True)
        self.network.load_state_dict(state["network"])
        self.average.load_state_dict(state["average"])
        self.optimiser.load_state_dict(state["optimiser"])
        self.step, self.step_count = state["step"], state["step_count"]
        # Random numbers go on in a stream of their own rather than repeat.
        self.random = np.random.default_rng([self.step])
        self.generator.manual_seed(self.step)

    def save(self, path: Path) -> None:
        """Write a checkpoint; an older one stays whole until the new one is."""
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

    def train_step(self, data: DeviceData, batch_size: int) -> tuple[Tensor, Tensor]:
        """One step on a random batch.

        Args:
            data: Pictures to draw from.
            batch_size: Number of images.

        Returns:
            The losses of scores and boxes, without gradient.
        """
        for group in self.optimiser.param_groups:
            group["lr"] = self._learning_rate()
        index = torch.from_numpy(self.random.integers(len(data.images_rgb), size=batch_size)).to(self.device)
        images, truth = augment(*data.batch(index), self.generator)
        images = images.contiguous(memory_format=torch.channels_last)
        # The graph is the same whatever the precision; a CPU gains nothing from half.
        with torch.autocast(self.device.type, torch.bfloat16, enabled=self.device.type == "cuda"):
            score_logit, box_px, center_px, _ = self.network(images)
        score_loss, box_loss = detection_loss(score_logit, box_px, center_px, truth)
        self.optimiser.zero_grad(set_to_none=True)
        (score_loss + box_loss).backward()
        nn.utils.clip_grad_norm_(self.network.parameters(), _GRADIENT_NORM_MAX)
        self.optimiser.step()
        self.step += 1
        self._update_average()
        return score_loss.detach(), box_loss.detach()

    def _learning_rate(self) -> float:
        warm_up = min(1.0, (self.step + 1) / min(_WARM_UP_STEPS, max(1, self.step_count // 10)))
        progress = min(1.0, self.step / max(1, self.step_count))
        cosine = 0.5 * (1.0 + math.cos(math.pi * progress))
        return self.learning_rate * warm_up * max(cosine, _LAST_LEARNING_RATE_FRACTION)

    @torch.no_grad()
    def _update_average(self) -> None:
        # The first steps are forgotten sooner.
        decay = min(_AVERAGE_DECAY, (1.0 + self.step) / (10.0 + self.step))
        # PyTorch documents the function, its stub hides it.
        torch._foreach_lerp_(self._averages, self._currents, 1.0 - decay)  # pyright: ignore[reportPrivateImportUsage]


def _parameter_groups(network: nn.Module) -> list[dict[str, object]]:
    """Weights of convolutions decay, biases and normalisation do not."""
    weights = [value for value in network.parameters() if value.ndim > 1]
    others = [value for value in network.parameters() if value.ndim <= 1]
    return [{"params": weights, "weight_decay": _WEIGHT_DECAY}, {"params": others, "weight_decay": 0.0}]


def train(
    training: Training,
    data: dict[int, DeviceData],
    *,
    checkpoint: Path,
    batch_size: int,
    minutes: float,
    stop_after_minutes: float,
) -> None:
    """Train until the schedule ends or the time is up, and save.

    Args:
        training: The run; its schedule is set from the measured speed if it has none.
        data: Pictures by their side [px].
        checkpoint: Where to save.
        batch_size: Number of images of 256 px a step; of larger images, as many as have the same number of pixels.
        minutes: Length of the whole training, used if there is no schedule yet [min].
        stop_after_minutes: Stop before the schedule's end after so long [min].
    """
    start_s = saved_s = time.perf_counter()
    speed_start_s = start_s
    sides_px = list(data)
    probability = np.array([SIZE_PROBABILITY[side_px] for side_px in sides_px])
    total = torch.zeros(2, device=training.device)
    first_step = training.step
    while not training.step_count or training.step < training.step_count:
        side_px = int(training.random.choice(sides_px, p=probability / probability.sum()))
        losses = training.train_step(data[side_px], max(1, round(batch_size * (256 / side_px) ** 2)))
        total += torch.stack(losses)
        steps_here = training.step - first_step
        if not training.step_count and steps_here in (_SPEED_STEPS, 2 * _SPEED_STEPS):
            total.tolist()  # waits for the device
            if steps_here == _SPEED_STEPS:
                speed_start_s = time.perf_counter()
            else:
                step_s = (time.perf_counter() - speed_start_s) / _SPEED_STEPS
                left_s = max(0.0, 60.0 * minutes - (time.perf_counter() - start_s))
                training.step_count = training.step + int(left_s / step_s)
                _logger.info("%.1f ms a step, %d steps", 1e3 * step_s, training.step_count)
        now_s = time.perf_counter()
        if training.step % _LOG_STEPS == 0:
            score_loss, box_loss = (total / min(_LOG_STEPS, steps_here)).tolist()
            total.zero_()
            _logger.info(
                "step %d of %d: score loss %.3f, box loss %.3f, %.0f s",
                training.step, training.step_count, score_loss, box_loss, now_s - start_s,
            )  # fmt: skip
            if not math.isfinite(score_loss + box_loss):
                raise RuntimeError(f"the loss is not finite at step {training.step}; the last checkpoint is whole")
        if now_s - saved_s > _CHECKPOINT_S:
            training.save(checkpoint)
            saved_s = now_s
        if now_s - start_s > 60.0 * stop_after_minutes:
            break
    training.save(checkpoint)
    _logger.info(
        "stopped at step %d of %d after %.0f s", training.step, training.step_count, time.perf_counter() - start_s
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """The command."""
    parser = argparse.ArgumentParser(description="Train the shipped detector.")
    parser.add_argument("--data", type=Path, required=True, help="folder that training.data wrote")
    parser.add_argument("--checkpoint", type=Path, required=True, help="written, and gone on from where it exists")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--minutes", type=float, default=17.0, help="length of the whole training")
    parser.add_argument(
        "--steps", type=int, default=0, help="number of steps of the whole training, instead of minutes"
    )
    parser.add_argument("--stop-after-minutes", type=float, default=math.inf, help="stop this command earlier")
    parser.add_argument("--batch-size", type=int, default=192, help="images of 256 px a step")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(arguments)
    logging.basicConfig(level=logging.INFO, format="%(message)s")

    device = torch.device(options.device)
    torch.backends.cudnn.benchmark = True
    torch.set_float32_matmul_precision("high")
    training = Training(device, seed=options.seed)
    training.step_count = options.steps
    if options.checkpoint.exists():
        training.load(options.checkpoint)
        _logger.info("going on from step %d of %d", training.step, training.step_count)
    start_s = time.perf_counter()
    data = {side_px: DeviceData.load(each, device) for side_px, each in load_pictures(options.data).items()}
    _logger.info("read the pictures in %.0f s", time.perf_counter() - start_s)
    train(
        training,
        data,
        checkpoint=options.checkpoint,
        batch_size=options.batch_size,
        minutes=options.minutes,
        stop_after_minutes=options.stop_after_minutes,
    )


if __name__ == "__main__":
    main()
