"""The number that descent lowers and the multipliers' ascent raises: objectives and constraints in one."""

from __future__ import annotations

from collections.abc import Sequence

import warp as wp

from warpav_kernels.placement import lagrangian


class Lagrangian:
    """Weights of the objectives and of the constraints, on the device."""

    def __init__(
        self,
        weights: Sequence[float],
        constraint_count: int,
        *,
        damping: float = 0.0,
        are_inequalities: bool = False,
        scale: float | None = None,
        repeats: int | None = None,
        device: str = "cpu",
    ) -> None:
        self._weight = wp.array(list(weights), dtype=float, device=device)
        scale = max(weights, default=0.0) if scale is None else scale
        self._constraint_scale = wp.array([scale] * constraint_count, dtype=float, device=device)
        self._repeats = float(sum(weight > 0.0 for weight in weights) if repeats is None else repeats)
        self._damping = damping
        self._are_inequalities = are_inequalities

    def on_tape(self, objective_loss: wp.array, constraint_loss: wp.array, multiplier: wp.array) -> wp.array:
        """The Lagrangian, recorded on the active tape. Returns float [1]. ``objective_loss`` float [objective].

        ``constraint_loss`` float [constraint]; ``multiplier`` float [constraint].
        """
        device = objective_loss.device
        total = wp.zeros(1, dtype=float, device=device, requires_grad=True)
        if self._are_inequalities:
            wp.launch(
                lagrangian.damped_lagrangian_kernel,
                dim=1,
                inputs=[objective_loss, self._weight, constraint_loss, multiplier, self._damping],
                outputs=[total],
                device=device,
            )
            return total
        wp.launch(
            lagrangian.lagrangian_kernel,
            dim=1,
            inputs=[
                objective_loss,
                self._weight,
                constraint_loss,
                self._constraint_scale,
                multiplier,
                self._repeats,
                self._damping,
            ],
            outputs=[total],
            device=device,
        )
        return total
