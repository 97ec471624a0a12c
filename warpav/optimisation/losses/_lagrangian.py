"""The number that descent lowers and the multipliers' ascent raises: objectives and constraints in one."""

from __future__ import annotations

import warp as wp

from warpav_kernels.placement import lagrangian


def lagrangian_of(
    objective_loss: wp.array,
    constraint_loss: wp.array,
    multiplier: wp.array,
    *,
    weight: wp.array,
    scale: wp.array | None = None,
    repeats: float = 1.0,
    damping: float = 0.0,
) -> wp.array:
    """The Lagrangian, float [1], recorded on the active tape. ``weight`` [objective]; all others [constraint].

    The thesis's constraints have a ``scale`` and count ``repeats`` times; without one they are inequalities.
    """
    total = wp.zeros(1, dtype=float, device=weight.device, requires_grad=True)
    if scale is None:
        wp.launch(
            lagrangian.damped_lagrangian_kernel,
            dim=1,
            inputs=[objective_loss, weight, constraint_loss, multiplier, damping],
            outputs=[total],
            device=weight.device,
        )
        return total
    wp.launch(
        lagrangian.lagrangian_kernel,
        dim=1,
        inputs=[objective_loss, weight, constraint_loss, scale, multiplier, repeats, damping],
        outputs=[total],
        device=weight.device,
    )
    return total
