"""What a step of an optimisation leaves on the device until the host fetches all of it at once. Nothing is taped."""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.kernel(enable_backward=False)
def add_scene_losses_kernel(
    # in
    loss: wp.array[float],
    # out
    batch_loss: wp.array[wp.float64],
):
    """Add a scene's losses to those of the scenes before it, in double precision.

    Launch: ``dim=loss_count``; scene by scene, so that the order of the sum is fixed. Not taped.
    Writes: every element of ``batch_loss``, in place.
    """
    j = wp.tid()
    batch_loss[j] = batch_loss[j] + wp.float64(loss[j])


@wp.kernel(enable_backward=False)
def mean_losses_kernel(
    # in
    batch_loss: wp.array[wp.float64],
    count: wp.array[float],
    # out
    mean_loss: wp.array[float],
):
    """The mean of every loss over what it counts in the batch: its scenes, or their objects.

    Launch: ``dim=loss_count``. Not taped.
    Writes: every element of ``mean_loss`` once.
    """
    j = wp.tid()
    mean_loss[j] = float(wp.float64(1.0) / wp.float64(count[j]) * batch_loss[j])


@wp.kernel(enable_backward=False)
def gather_step_kernel(
    # in
    gradient: wp.array[float],
    batch_loss: wp.array[wp.float64],
    constraint_loss: wp.array[float],
    total: wp.array[float],
    # out
    gathered: wp.array[wp.float64],
):
    """Everything that the host wants to know of a step side by side: gradient, losses, constraints, total.

    Launch: ``dim`` their number. Not taped.
    Writes: as many elements of ``gathered`` once; what follows them is `gather_needed_samples_kernel`'s.
    """
    k = wp.tid()
    losses_at = gradient.shape[0]
    constraints_at = losses_at + batch_loss.shape[0]
    total_at = constraints_at + constraint_loss.shape[0]
    if k < losses_at:
        gathered[k] = wp.float64(gradient[k])
    elif k < constraints_at:
        gathered[k] = batch_loss[k - losses_at]
    elif k < total_at:
        gathered[k] = wp.float64(constraint_loss[k - constraints_at])
    else:
        gathered[k] = wp.float64(total[0])


@wp.kernel(enable_backward=False)
def gather_needed_samples_kernel(
    # in
    needed_samples: wp.array[wp.int64],
    place: int,
    # out
    gathered: wp.array[wp.float64],
):
    """How many samples a renderer needed, beside what the host wants to know of a step.

    Launch: ``dim=1``. Not taped.
    Writes: ``gathered[place]``; numbers of samples are exact in double precision.
    """
    gathered[place] = wp.float64(needed_samples[0])
