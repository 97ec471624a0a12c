"""Taped: one number from the losses, their scales and the Lagrange multipliers, the thesis's way and damped."""

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


@wp.func
def _damped_violation(excess: float, multiplier: float, damping: float) -> float:
    """What an inequality counts: all of an excess, and as much of the room to spare as its multiplier has to lose."""
    if damping > 0.0:
        return wp.max(excess, -multiplier / damping)
    return excess


@wp.kernel
def damped_lagrangian_kernel(
    # in
    objective_loss: wp.array[float],
    objective_scale: wp.array[float],
    excess: wp.array[float],
    multiplier: wp.array[float],
    damping: float,
    # out
    total: wp.array[float],
):
    """Sum of the scaled objectives, and the augmented Lagrangian of the inequalities ``excess <= 0``.

    Its derivative to a multiplier is the damped violation, which ascent adds; with multipliers of at least 0 descent
    and ascent then meet where the constraints hold and only the active ones pull.
    Source: Rockafellar, The multiplier method of Hestenes and Powell applied to convex programming, 1973.

    Launch: ``dim=1``.
    Writes: ``total[0]`` once.
    """
    whole = float(0.0)
    for j in range(objective_loss.shape[0]):
        whole += objective_scale[j] * objective_loss[j]
    for i in range(excess.shape[0]):
        violation = _damped_violation(excess[i], multiplier[i], damping)
        whole += multiplier[i] * violation + 0.5 * damping * violation * violation
    total[0] = whole
