"""What the host sends to the device before a step of an optimisation and fetches after it: each in one piece."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp

from warpav.optimisation.losses.loss import LossSchedule
from warpav.optimisation.mount import MOUNT_POSE_SIZE
from warpav.raster.renderer import Renderer
from warpav_kernels.placement import exchange


@dataclass(frozen=True)
class Fetched:
    """What became of a step.

    Attributes:
        pose_gradient: Of the Lagrangian to the mount poses, float32 [camera, 7].
        multiplier_gradient: Of it to the multipliers, float32 [constraint].
        batch_loss: Every loss on the device, summed over the scenes of the batch, float64 [loss].
        constraint_loss: Every constraint's, float64 [constraint].
        total: The Lagrangian.
        needed_samples: Of each renderer, for `Renderer.grew`.
    """

    pose_gradient: np.ndarray
    multiplier_gradient: np.ndarray
    batch_loss: np.ndarray
    constraint_loss: np.ndarray
    total: float
    needed_samples: tuple[int, ...]


class Exchange:
    """Arrays that recorded launches read and write, always at the same place: slices of one that is sent.

    Attributes:
        pose: Mount poses, float [camera, 7], with a gradient.
        multiplier: Lagrange multipliers, float [constraint], with a gradient.
        panorama_share: See `LossSchedule`, float [1].
        detector_share: Likewise, float [1].
        weight: Of each loss of a scene in the gradient, float [loss].
        weights: The same one by one, float [1] each.
        count: What each loss is a mean over in the batch, float [loss].
        batch_loss: Every loss, summed over the scenes that are done, float64 [loss].
        host_weight: As ``weight``, of the losses that the host computes.
    """

    def __init__(self, camera_count: int, constraint_count: int, loss_count: int, *, device: str) -> None:
        """Zeros."""
        self._device = device
        self._shape = (camera_count, MOUNT_POSE_SIZE)
        # the last is nobody's: Warp cannot slice what is empty from the end of an array
        sizes = [camera_count * MOUNT_POSE_SIZE, constraint_count, 1, 1, loss_count, loss_count, 1]
        ends = np.cumsum([0, *sizes])
        self._sent = wp.zeros(int(ends[-1]), dtype=float, device=device, requires_grad=True)
        parts = [_slice(self._sent, int(a), int(b)) for a, b in itertools.pairwise(ends)]
        self.pose, self.multiplier = parts[0].reshape(self._shape), parts[1]
        self.panorama_share, self.detector_share, self.weight, self.count, _ = parts[2:]
        assert self._sent.grad is not None
        self._gradient = _slice(self._sent.grad, 0, int(ends[2]))
        self.weights = [_slice(self.weight, k, k + 1) for k in range(loss_count)]
        self.host_weight: tuple[float, ...] = ()
        self.batch_loss = wp.zeros(loss_count, dtype=wp.float64, device=device)
        self._mean_loss = wp.zeros(loss_count, dtype=float, device=device)
        self._fetched_count = int(ends[2]) + loss_count + constraint_count + 1
        self._gathered = wp.zeros(self._fetched_count, dtype=wp.float64, device=device)

    def send(
        self,
        mount_pose: np.ndarray,
        multiplier: np.ndarray,
        schedule: LossSchedule,
        *,
        weight: Sequence[float] | np.ndarray,
        count: Sequence[float] | np.ndarray,
        host_weight: Sequence[float] = (),
    ) -> None:
        """Begin a step: one copy to the device, and gradients and sums of 0."""
        if np.shape(mount_pose) != self._shape:
            raise ValueError(f"expected mount poses of shape {self._shape}, got {np.shape(mount_pose)}")
        self.host_weight = tuple(host_weight)
        numbers = [
            np.ravel(mount_pose),
            multiplier,
            [schedule.panorama_share, schedule.detector_share],
            weight,
            np.where(np.asarray(count) > 0, count, 1),
            [0.0],
        ]
        self._sent.assign(np.concatenate([np.asarray(each, np.float32) for each in numbers]))
        self.zero()

    def zero(self) -> None:
        """Gradients and sums of 0."""
        assert self._sent.grad is not None
        self._sent.grad.zero_()
        self.batch_loss.zero_()

    def add_scene(self, loss: wp.array) -> None:
        """Add a scene's losses, float [loss], to those of the scenes before it."""
        wp.launch(
            exchange.add_scene_losses_kernel,
            dim=loss.shape,
            inputs=[loss],
            outputs=[self.batch_loss],
            device=self._device,
            record_tape=False,
        )

    def mean_loss(self) -> wp.array:
        """Every loss of the batch, float [loss]; without a gradient."""
        wp.launch(
            exchange.mean_losses_kernel,
            dim=self._mean_loss.shape,
            inputs=[self.batch_loss, self.count],
            outputs=[self._mean_loss],
            device=self._device,
            record_tape=False,
        )
        return self._mean_loss

    def fetch(self, constraint_loss: wp.array, total: wp.array, renderers: Sequence[Renderer]) -> Fetched:
        """End a step: one copy to the host, the only one that waits for the device."""
        size = self._fetched_count + len(renderers)
        if len(self._gathered) != size:
            self._gathered = wp.zeros(size, dtype=wp.float64, device=self._device)
        for k, renderer in enumerate(renderers):
            wp.launch(
                exchange.gather_needed_samples_kernel,
                dim=1,
                inputs=[renderer.needed_samples, self._fetched_count + k],
                outputs=[self._gathered],
                device=self._device,
                record_tape=False,
            )
        wp.launch(
            exchange.gather_step_kernel,
            dim=self._fetched_count,
            inputs=[self._gradient, self.batch_loss, constraint_loss, total],
            outputs=[self._gathered],
            device=self._device,
            record_tape=False,
        )
        gathered = self._gathered.numpy()
        sizes = [self._shape[0] * self._shape[1], len(self.multiplier), len(self.batch_loss), len(self.multiplier), 1]
        pose, multiplier, batch_loss, constraints, total_loss, needed = np.split(gathered, np.cumsum(sizes))
        return Fetched(
            pose.astype(np.float32).reshape(self._shape),
            multiplier.astype(np.float32),
            batch_loss.copy(),
            constraints.copy(),
            float(total_loss[0]),
            tuple(int(each) for each in needed),
        )


def _slice(array: wp.array, first: int, end: int) -> wp.array:
    """A part of an array, in the same memory, with the same part of its gradient."""
    part = array[first:end]
    assert isinstance(part, wp.array)
    return part
