"""What all cameras of a rig see of a scene, on one sheet, with their angles and what the own body covers."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from warpav.detection.images import render
from warpav.scene.device_scene import DeviceScene
from warpav.sight.around import body_shares
from warpav.view.figures.style import WIDTH_INCH, caption, empty_panel, figure_style, new_figure
from warpav.view.palette import INK_RGB, camera_rgb, hex_colour

if TYPE_CHECKING:
    from warpav.rig.rig import Rig, RigCamera
    from warpav.scene.scene import Scene


def contact_figure(rig: Rig, scene: Scene, *, heading: str | None = None, supersampling: int = 2) -> Any:  # noqa: ANN401
    """The images of all cameras, from the left to the right of the vehicle and then behind it, in equal widths.

    Below each stand its yaw, pitch and horizontal field of view [degrees], its size [px] and the share of its pixels
    that show the own vehicle, which is rendered alone for that.
    """
    images = render(rig, scene, supersampling=supersampling)
    share = body_shares(rig, DeviceScene.pack(scene))
    order = sorted(range(len(rig.cameras)), key=lambda k: _turn_from_left_rad(rig.cameras[k]))
    columns = min(3, len(order)) if len(order) != 4 else 2
    rows = -(-len(order) // columns)
    with figure_style():
        width_inch = WIDTH_INCH / columns
        shape = [rig.cameras[k].model.height_px / rig.cameras[k].model.width_px for k in order]
        row_inch = [0.94 * width_inch * max(shape[k : k + columns]) + 0.8 for k in range(0, len(order), columns)]
        figure = new_figure(WIDTH_INCH, sum(row_inch) + 0.6)
        axes = figure.subplots(rows, columns, squeeze=False, height_ratios=row_inch)
        for axis in axes.flat[len(order) :]:
            axis.set_axis_off()
        for axis, index in zip(axes.flat, order, strict=False):
            camera = rig.cameras[index]
            axis.imshow(images[camera.name].rgb, interpolation="antialiased")
            axis.set_anchor("N")
            empty_panel(axis)
            axis.spines[:].set(color=hex_colour(camera_rgb(index)), linewidth=2.0)
            axis.set_title(camera.name, fontsize=10, color=hex_colour(camera_rgb(index)))
            model, degrees = camera.model, (camera.yaw_rad, camera.pitch_rad, camera.model.fov_rad)
            yaw_deg, pitch_deg, fov_deg = (math.degrees(each) for each in degrees)
            yaw_deg = math.remainder(yaw_deg, 360.0)
            axis.set_xlabel(
                f"yaw {yaw_deg + 0.0:.0f}°, pitch {pitch_deg + 0.0:.0f}°, fov {fov_deg:.0f}°\n"
                f"{model.width_px} x {model.height_px} px, own body {100.0 * share[camera.name]:.1f} % of the image",
                fontsize=8,
                color=hex_colour(INK_RGB),
            )
        caption(figure, f"Scene {scene.name}. Yaw: 0 ahead, positive to the left. Pitch: positive nose down.")
        if heading:
            figure.suptitle(heading, x=0.01, ha="left", fontweight="bold")
        return figure


def _turn_from_left_rad(camera: RigCamera) -> float:
    """How far to the right of the left rear a camera looks [rad], so that a row goes from left to right."""
    forward = camera.ego_from_camera[:2, 2]
    return (0.75 * math.pi - math.atan2(forward[1], forward[0])) % (2.0 * math.pi)
