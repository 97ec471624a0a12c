"""The optimiser's step."""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.kernel(enable_backward=False)
def adamw_step_kernel(
    # in
    gradient: wp.array[float],
    step_size: wp.array[float],
    weight_decay: float,
    beta1: float,
    beta2: float,
    epsilon: float,
    step_number: int,
    # out
    first_moment: wp.array[float],
    second_moment: wp.array[float],
    value: wp.array[float],
):
    """One step of AdamW: Adam with bias correction, weight decay decoupled from the gradient.

    A negative step size ascends; weight decay always pulls to 0. A number of step size 0 stays as it is.
    Source: Loshchilov and Hutter, Decoupled Weight Decay Regularization, 2019, algorithm 2.

    Launch: ``dim=number of values``; one thread per value; ``step_number`` counts from 1. Not taped.
    Writes: every element of ``first_moment``, ``second_moment`` and ``value``, in place.
    """
    i = wp.tid()
    rate = step_size[i]
    if rate == 0.0:
        return
    g = gradient[i]
    m = beta1 * first_moment[i] + (1.0 - beta1) * g
    v = beta2 * second_moment[i] + (1.0 - beta2) * g * g
    first_moment[i] = m
    second_moment[i] = v
    m_hat = m / (1.0 - wp.pow(beta1, float(step_number)))
    v_hat = v / (1.0 - wp.pow(beta2, float(step_number)))
    decayed = value[i] * (1.0 - wp.abs(rate) * weight_decay)
    value[i] = decayed - rate * m_hat / (wp.sqrt(v_hat) + epsilon)
