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
        """The Lagrangian of some objectives and constraints.

        Args:
            weights: Of the objectives that are on the device.
            constraint_count: Number of constraints.
            damping: Of the multipliers, at least 0; 0 as in the thesis.
            are_inequalities: False: constraints are losses and count as in the thesis's Eq. 1. True: they are
                inequalities g <= 0, and each adds ``m c + d/2 c^2`` once and unscaled, with ``c = max(g, -m/d)``, its
                multiplier m and the damping d.
            scale: Of every loss among the constraints; None: the largest of the weights, as in the thesis.
            repeats: How often each loss among the constraints counts; None: once for every weight above 0, as printed.
            device: Warp device.
        """
        self._weight = wp.array(list(weights), dtype=float, device=device)
        scale = max(weights, default=0.0) if scale is None else scale
        self._constraint_scale = wp.array([scale] * constraint_count, dtype=float, device=device)
        self._repeats = float(sum(weight > 0.0 for weight in weights) if repeats is None else repeats)
        self._damping = damping
        self._are_inequalities = are_inequalities

    def on_tape(self, objective_loss: wp.array, constraint_loss: wp.array, multiplier: wp.array) -> wp.array:
        """The Lagrangian, recorded on the active tape.

        Args:
            objective_loss: Objectives, unscaled, float [objective].
            constraint_loss: As `Constraints.losses_of` gives them, float [constraint].
            multiplier: Of every constraint, float [constraint]; of inequalities at least 0.

        Returns:
            float [1].
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
