"""Taped: one number from the losses, their scales and the Lagrange multipliers."""

import warp as wp


@wp.kernel
def lagrangian_kernel(
    # in
    objective_loss: wp.array[float],
    objective_scale: wp.array[float],
    constraint_loss: wp.array[float],
    constraint_scale: wp.array[float],
    multiplier: wp.array[float],
    constraint_repeats: float,
    damping: float,
    # out
    total: wp.array[float],
):
    """Sum of the scaled objectives and the multiplied constraints.

    Every objective of Eq. 1 brings all constraints with it, so the constraints count ``constraint_repeats`` times: the
    number of objectives as printed, or once. ``damping`` adds half its value times the squared scaled constraint (0 in
    the thesis).

    Equation: 1 (as printed)

    Launch: ``dim=1``.
    Writes: ``total[0]`` once.
    """
    whole = float(0.0)
    for j in range(objective_loss.shape[0]):
        whole += objective_scale[j] * objective_loss[j]
    for i in range(constraint_loss.shape[0]):
        violation = constraint_scale[i] * constraint_loss[i]
        whole += constraint_repeats * (multiplier[i] * violation + 0.5 * damping * violation * violation)
    total[0] = whole
