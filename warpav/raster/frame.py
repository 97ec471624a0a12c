"""One render: what its views see of a scene, and how that changes with them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
import warp as wp

from warpav.core.errors import InputError
from warpav.raster import _images as images
from warpav.raster import areas
from warpav.raster.areas import AREA_COUNT, Areas, Coverage, Measures, WindowMeasures
from warpav.raster.buffers import Buffers, Content, RenderState
from warpav.raster.decide import hide_by_foreground
from warpav.raster.poses import ViewPoses, view_poses
from warpav.raster.scene import Scene
from warpav_kernels import raster as kernels

_OF_MEASURES = (Content.OBJECTS, Content.COVERAGE)  # what a render with all measures holds as well


class Frame:
    """One render of a scene.

    A frame of `warpav.raster.render` owns its buffers: any number of them live at once. One of a `Renderer` reads the
    renderer's buffers, and is stale after its next render: whatever reads them then raises `InputError`.

    **Gradients.** `areas`, `extents`, `weighted_area`, `colours`, `depths` and `silhouettes` take the poses of the
    views, ``camera_from_world`` [view, 4, 4], and ``log_focal`` [view], the logarithms of their focal lengths over the
    cameras'. With poses that require a gradient and inside of ``with wp.Tape() as tape:`` the result is a function of
    them on that tape: its value is the rendered one, plus for areas and extents the first order around the rendered
    poses. Without poses nothing is taped. Nothing else has a gradient: not vertices, not colours, not distortion.

    Attributes:
        scene: What was rendered.
    """

    def __init__(self, buffers: Buffers, state: RenderState) -> None:
        """The render that ``buffers`` hold as ``state``; `Renderer.render` makes frames."""
        self._buffers, self._state = buffers, state
        self.scene: Scene = state.scene

    @property
    def device(self) -> wp.Device:
        """Where it is."""
        return self._buffers.device

    @property
    def view_count(self) -> int:
        """Number of views."""
        return self._buffers.view_count

    @property
    def lens(self) -> wp.array:
        """The lens of every view, of the kernels' `Lens` [view]; `Renderer.set_lenses` writes others there."""
        return self._buffers.lens

    @property
    def width_px(self) -> int:
        """Width of the images."""
        return self._buffers.width_px

    @property
    def height_px(self) -> int:
        """Height of the images."""
        return self._buffers.height_px

    @property
    def supersampling(self) -> int:
        """Samples per pixel along each axis."""
        return self._buffers.supersampling

    def _require(self, *contents: Content) -> None:
        """Check that the buffers still hold this render, and that it holds what is asked for: one of some contents."""
        if self._buffers.state is not self._state:
            raise InputError(
                "frame: expected the last render of its renderer, got a stale one, whose buffers hold a later render; "
                "ask it before its renderer renders again, or use raster.render, whose frames own their buffers"
            )
        held = self._state.content
        held_too = _OF_MEASURES if held is Content.MEASURES else ()
        if held is not Content.ALL and not {held, *held_too}.intersection(contents):
            raise InputError(
                f"frame: expected a render with content {contents[0].value}, got one that holds {held.value} only"
            )

    def _poses(self, camera_from_world: Any, log_focal: wp.array | np.ndarray | None) -> ViewPoses | None:  # noqa: ANN401
        """The poses that were handed over; None: nothing is to be taped."""
        if camera_from_world is None and log_focal is None:
            return None
        if camera_from_world is None:
            poses = ViewPoses(wp.clone(self._buffers.position_world_m), wp.clone(self._buffers.camera_from_world))
        else:
            poses = view_poses(camera_from_world, self.view_count, self.device)
        return poses if log_focal is None else view_poses(poses, self.view_count, self.device, log_focal=log_focal)

    @cached_property
    def _depth_and_id(self) -> tuple[wp.array, wp.array]:
        return self.depths_and_ids()

    @property
    def depth_m(self) -> wp.array:
        """Depth at the sample nearest to every pixel's centre [m], float [view, row, column]; +inf: nothing.

        Along the optical axis for pinhole and Brown-Conrady lenses, distance for the others.
        """
        return self._depth_and_id[0]

    @property
    def object_id(self) -> wp.array:
        """What that sample shows, int32 [view, row, column]: k for object k, -1 for nothing, -2 - j for occluder j."""
        return self._depth_and_id[1]

    @cached_property
    def rgb(self) -> wp.array:
        """Colours 0..1, averaged over every pixel, vec3 [view, row, column]."""
        return self.colours()

    def areas(self, camera_from_world: Any = None, *, log_focal: wp.array | np.ndarray | None = None) -> Areas:  # noqa: ANN401
        """Visible and amodal area of every object in every view [px^2], with Jacobians.

        Args:
            camera_from_world: The poses as variables, see the class; None: no gradient.
            log_focal: The focal lengths as variables, see the class; None: as rendered.

        Raises:
            InputError: The frame is stale or holds no objects, or poses of another shape or device.
        """
        return Areas(self.measure().at(self._poses(camera_from_world, log_focal)))

    def extents(self, camera_from_world: Any = None, *, log_focal: wp.array | np.ndarray | None = None) -> Measures:  # noqa: ANN401
        """How far every object alone reaches in the image: left, right, top, bottom [px], [view, object, 4].

        Left and top are the image's size, right and bottom 0, where it is not in the image. Arguments and errors are
        those of `areas`.
        """
        whole = self.measure()
        parts = {
            name: areas.part_of(getattr(whole, name), slice(AREA_COUNT, None))
            for name in ("value", "jac_translation", "jac_rotation", "jac_log_focal")
        }
        return replace(whole, **parts).at(self._poses(camera_from_world, log_focal))

    def measure(self, box_px: wp.array | None = None, *, into: Measures | None = None) -> Measures:
        """Areas and extents of every object in every view, with Jacobians to the views' poses and focal lengths.

        Args:
            box_px: Box per view and object (left, top, right, bottom [px]) for BOX_AREA, vec4 [view, object]; None:
                no box.
            into: An earlier result to write over; None: fresh arrays, so several scenes can stay on one tape.

        Raises:
            InputError: The frame is stale or holds no objects, or an array of another shape.
        """
        self._require(Content.OBJECTS)
        return areas.measure_all(self._buffers, self.scene, box_px, into)

    def calibration_jacobian(self) -> wp.array:
        """Jacobian of the visible and the amodal area of every object to its view's calibration.

        What a calibration's error does to what is seen; the poses stay. A pass of its own, in which no gradient flows.

        Returns:
            float [view, object, 2, 12]: to fx, fy, cx and cy [px^2/px], then to the lens's coefficients in the order of
            `CameraModel.distortion` [px^2], 0 where it has none.

        Raises:
            InputError: The frame is stale or holds no objects.
        """
        self._require(Content.OBJECTS)
        return areas.measure_calibration(self._buffers, self.scene)

    def coverage(self) -> Coverage:
        """Areas, extents and solid angles of every object in every view, without Jacobians.

        The values are those of `measure` and `window_area`, at a fraction of their time.

        Raises:
            InputError: The frame is stale, or holds images or objects only.
        """
        self._require(Content.COVERAGE)
        return areas.measure_coverage(self._buffers, self.scene)

    def contrast(self, value: wp.array) -> wp.array:
        """Distance of every object's mean colour from that of its surroundings in every view, float [view, object].

        Of what is seen of it and of what else is seen in its extent, enlarged by a quarter and 2 pixels on every side;
        RGB in 0..1; 0 where either is not seen. No gradient.

        Args:
            value: Of this render's `measure` or `coverage`, float [view, object, measure].

        Raises:
            InputError: The frame is stale, or holds images or objects only, or measures of another shape.
        """
        self._require(Content.COVERAGE)
        return areas.measure_contrast(self._buffers, self.scene, value)

    def weighted_area(
        self,
        weight_image: wp.array,
        camera_from_world: Any = None,  # noqa: ANN401
        *,
        log_focal: wp.array | np.ndarray | None = None,
        visible: bool = True,
        into: Measures | None = None,
    ) -> Measures:
        """Area of every object in every view, each pixel weighted, with Jacobians.

        Args:
            weight_image: Weight of every pixel, float [row, column] for all views, [view, row, column], or [view,
                object, row, column]; no gradient flows to it.
            camera_from_world: As for `areas`.
            log_focal: As for `areas`.
            visible: Whether to leave out what other surfaces hide; else each object counts as if it stood alone.
            into: An earlier result to write over; None: fresh arrays.

        Returns:
            Measures with one element on the last axis, in weight x px^2.

        Raises:
            InputError: The frame is stale or does not hold what is asked for, or an array of another shape.
        """
        self._require(Content.MEASURES if visible else Content.OBJECTS)
        result = areas.measure_weighted(
            self._buffers,
            self.scene,
            areas.checked_weight(self._buffers, self.scene, weight_image),
            kind=_kind(visible=visible),
            hiding=self._buffers.hiding,
            into=into,
        )
        return result.at(self._poses(camera_from_world, log_focal))

    def weighted_coverage(self, weight_image: wp.array) -> wp.array:
        """Visible area of every object in every view, each pixel weighted, float [view, object, 1] [weight x px^2].

        The values of `weighted_area`, without Jacobians; weights and errors are its own. Where the nearest surface
        hides, images are enough, and it takes a fraction of the time.
        """
        if not self._state.is_exact:
            return self.weighted_area(weight_image).value
        self._require(Content.IMAGES, Content.COVERAGE)
        weight = areas.checked_weight(self._buffers, self.scene, weight_image)
        return areas.weigh_visible(self._buffers, self.scene, weight)

    def unblocked_area(self, *, into: Measures | None = None) -> Measures:
        """Area of every object alone outside the foreground's silhouette, in every view, with Jacobians.

        The foreground counts as nearest everywhere, and nothing else hides, whatever hides objects in `measure`.

        Args:
            into: An earlier result to write over; None: fresh arrays.

        Returns:
            Measures with one element on the last axis [px^2].

        Raises:
            InputError: The frame is stale, has no objects or images, or a renderer without ``foreground_layer``.
        """
        self._require(Content.MEASURES)
        if not self._buffers.has_foreground:
            raise InputError("unblocked_area needs a renderer that was made with foreground_layer=True")
        hide_by_foreground(self._buffers, self.scene)
        return areas.measure_weighted(
            self._buffers,
            self.scene,
            (self._buffers.ones, 0, 0),
            kind=int(kernels.VISIBLE),
            hiding=self._buffers.foreground_hiding,
            into=into,
        )

    def window_area(
        self,
        window_rad: wp.array | None = None,
        *,
        softness_rad: float = 1.0,
        visible: bool,
        into: WindowMeasures | None = None,
    ) -> WindowMeasures:
        """Solid angle of every object in every view inside a soft window of directions, with Jacobians.

        The window is the field of view of a camera that looks elsewhere from the same place, with logistic edges; e.g.
        four views to the ahead, left, rear and right, summed, are a panorama over which a camera's yaw, pitch and field
        of view move, and what is outside still pulls. With azimuth a and elevation e of a direction from the window's
        centre, half width w, half height h, softness t, and s the logistic function, a direction counts

            s((w + a) / t) s((w - a) / t) s((h + e) / t) s((h - e) / t).

        Args:
            window_rad: Per view in its own axes: azimuth of the window's centre, counted like yaw from the optical axis
                to the left; its elevation, upwards; half width; half height [rad], vec4 [view]. None: all directions,
                so that everything in the image counts.
            softness_rad: t, positive.
            visible: Whether to leave out what other surfaces hide; else each object counts as if it stood alone.
            into: An earlier result to write over; None: fresh arrays.

        Raises:
            InputError: The frame is stale or does not hold what is asked for, there is not one window per view, or
                ``softness_rad`` is not positive.
        """
        self._require(Content.MEASURES if visible else Content.OBJECTS)
        return areas.measure_window(
            self._buffers, self.scene, window_rad, softness_rad=softness_rad, kind=_kind(visible=visible), into=into
        )

    def colours(
        self,
        camera_from_world: Any = None,  # noqa: ANN401
        *,
        log_focal: wp.array | np.ndarray | None = None,
        views: Sequence[int] | None = None,
        into: wp.array | None = None,
    ) -> wp.array:
        """Colour images 0..1 of the chosen views, vec3 [image, row, column].

        The backward pass adds what the static scene's flow through the images makes of the images' gradient: with
        colours I, gradient A and neighbouring samples p and q, ``dL = sum of (I_p - I_q) . (A_p + A_q) / 2 x flow from
        p to q of the nearer surface`` (see `warpav_kernels.raster.image_flow`). It reads this render's buffers, so a
        renderer's frame must not be stale by then.

        Args:
            camera_from_world: The poses at which it was rendered, as variables; None: no gradient.
            log_focal: The focal lengths at which it was rendered, as variables.
            views: The views to show, by number; None: all.
            into: An earlier result to write over; None: a fresh array.

        Raises:
            InputError: The frame is stale or holds no images, ``into`` has another shape, or views that are not there.
        """
        self._require(Content.IMAGES)
        shown = self._buffers.shown_views(views)
        image = images.draw_colours(self._buffers, self.scene, shown, into)
        return self._taped(
            image,
            self._poses(camera_from_world, log_focal),
            lambda gradients: images.flow_of_colours(self._buffers, self.scene, image, shown, gradients),
        )

    def depths_and_ids(self, *, into: tuple[wp.array, wp.array] | None = None) -> tuple[wp.array, wp.array]:
        """What `depth_m` and `object_id` hold, in arrays of its own; no gradient.

        Args:
            into: An earlier result to write over; None: fresh arrays.

        Raises:
            InputError: The frame is stale or holds no images, or ``into`` has another shape.
        """
        self._require(Content.IMAGES)
        return images.draw_depths(self._buffers, self.scene, float("inf"), into)

    def incidence(self) -> wp.array:
        """Cosine between ray and normal of what pixels' middles show, 0..1, float [view, row, column]; 0: nothing.

        Raises:
            InputError: The frame is stale or holds no images.
        """
        self._require(Content.IMAGES)
        return images.draw_incidence(self._buffers, self.scene)

    def depths(
        self,
        camera_from_world: Any = None,  # noqa: ANN401
        *,
        background_m: float,
        log_focal: wp.array | np.ndarray | None = None,
    ) -> wp.array:
        """Depth images [m], float [view, row, column], in which nothing has a depth too.

        Backwards as `colours`; besides, the depths themselves change as the views move: every sample adds its gradient
        times the change of the depth of the point that it sees. The value is the depth at the sample nearest to a
        pixel's centre; the gradient is that of the mean over the pixel, whose expectation is the same and which is
        smoother.

        Args:
            camera_from_world: The poses at which it was rendered, as variables; None: no gradient.
            background_m: Depth where nothing is hit [m], finite, since outlines move against it.
            log_focal: The focal lengths at which it was rendered, as variables.

        Raises:
            InputError: The frame is stale or holds no images, or ``background_m`` is not finite.
        """
        self._require(Content.IMAGES)
        images.require_depth(background_m)
        depth_m, _ = images.draw_depths(self._buffers, self.scene, background_m, None)
        return self._taped(
            depth_m,
            self._poses(camera_from_world, log_focal),
            lambda gradients: images.flow_of_depths(self._buffers, depth_m, background_m, gradients),
        )

    def silhouettes(
        self,
        camera_from_world: Any = None,  # noqa: ANN401
        *,
        log_focal: wp.array | np.ndarray | None = None,
        visible: bool = True,
    ) -> wp.array:
        """Share of every pixel that each object covers, 0..1, float [view, object, row, column].

        Backwards, a gradient to the silhouettes is a weight of every pixel, and the gradient to the views is that of
        the weighted area.

        Args:
            camera_from_world: The poses at which it was rendered, as variables; None: no gradient.
            log_focal: The focal lengths at which it was rendered, as variables.
            visible: Whether to leave out what other surfaces hide; else each object is shown as if it stood alone.

        Raises:
            InputError: The frame is stale or does not hold what is asked for.
        """
        self._require(Content.ALL if visible else Content.OBJECTS)
        kind = _kind(visible=visible)
        silhouette = images.draw_silhouettes(self._buffers, self.scene, kind)
        return self._taped(
            silhouette,
            self._poses(camera_from_world, log_focal),
            lambda gradients: images.flow_of_silhouettes(self._buffers, self.scene, silhouette, kind, gradients),
        )

    def _taped(self, image: wp.array, poses: ViewPoses | None, backward: Callable[[list[wp.array]], None]) -> wp.array:
        """The image, with its backward pass recorded on the active tape."""
        if poses is None:
            return image
        image.requires_grad = True

        def run(gradients: list[wp.array]) -> None:
            self._require(self._state.content)
            backward(gradients)

        images.record(self._buffers, image, poses, run)
        return image

    def visible_masks(self, views: Sequence[int]) -> list[list[tuple[int, int, np.ndarray]]]:
        """Non-occluded silhouettes on the host, cropped: for each view and object (left, top, mask), in samples.

        ``left`` and ``top`` are the crop's first column and row in samples of the image (supersampling per pixel); the
        mask is bool [row, column], cut to the image.
        """
        self._require(Content.ALL)
        return images.visible_masks(self._buffers, self.scene, list(views))


def _kind(*, visible: bool) -> int:
    return int(kernels.VISIBLE if visible else kernels.ALONE)
