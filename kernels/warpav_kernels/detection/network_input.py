"""Rendered images as a detection network takes them."""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.kernel(enable_backward=False)
def write_network_input_kernel(
    # in
    image: wp.array3d[wp.vec3],
    # out
    network_input: wp.array4d[float],
):
    """Colours 0..1 in planes, rounded to 256 levels as in a stored image.

    Launch: ``dim=(image_count, height_px)``; one thread per row. Not taped.
    Writes: every element of ``network_input`` [image, channel, row, column] once.
    """
    i, row = wp.tid()
    for column in range(image.shape[2]):
        rgb = image[i, row, column]
        for channel in range(3):
            network_input[i, channel, row, column] = wp.floor(rgb[channel] * 255.0 + 0.5) * (1.0 / 255.0)
