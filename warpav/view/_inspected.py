"""A rig under inspection: scenes to show, iterations to go through, and what follows from each edit of the rig.

Nothing here draws; `warpav.view._inspector` does, and `warpav.view._editing` edits.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from warpav.detection import render_images
from warpav.rig import Rig, first_hit, ray_caster
from warpav.scene import EGO, DeviceScene
from warpav.sight import HEIGHTS_M, PATCH_M, Ground
from warpav.view._editing import EditedRig

if TYPE_CHECKING:
    from warpav.optimisation import Constraints, FurtherCameras, RigObservation, RigObserver
    from warpav.raster.camera import CameraModel
    from warpav.raster.mesh import Mesh
    from warpav.rig import Module, MountSurface, RigCamera
    from warpav.scene import Scene
    from warpav.sight import Coverage, RequirementResult
    from warpav.view._editing import Finding
    from warpav.view._layers import Steepest

NEAR_M = 20.0
"""Ground of which the lines say how much several cameras see is this near to the vehicle's centre [m]."""

_KEPT_SCENES = 4
"""Scenes that are held in memory; others are built again when they are shown."""

_THUMBNAIL_PX = 160
"""Width of the small images of all cameras."""


class InspectedRig:
    """A rig that is shown and changed."""

    def __init__(
        self,
        frames: Sequence[Rig],
        scene_of: Callable[[int], Scene],
        scene_count: int,
        *,
        constraints: Constraints,
        height_offset_m: float,
        observer_of: Callable[[Rig], RigObserver],
        descents: Sequence[Steepest | None] = (),
        further: FurtherCameras | None = None,
        modules: Sequence[Module] = (),
        check: Callable[[Rig, Mesh], RequirementResult] | None = None,
        judge: Callable[[Rig], Sequence[Finding]] | None = None,
        device: str = "cpu",
    ) -> None:
        if not frames or scene_count < 1:
            raise ValueError(f"expected at least one rig and one scene, got {len(frames)} and {scene_count}")
        if descents and len(descents) != len(frames):
            raise ValueError(f"expected a descent for each of {len(frames)} rigs, got {len(descents)}")
        self.frames = list(frames)
        self._descents = list(descents) or [None] * len(frames)
        self._further, self._is_checked = further, check is not None
        self.frame = len(self.frames) - 1
        where = {"constraints": constraints, "height_offset_m": height_offset_m}
        self.edits = EditedRig(self.frames[-1], modules=modules, judge=judge, **where)
        self.scene_index, self.scene_count = 0, scene_count
        self._constraints, self._device = constraints, device
        self._last_coverage: dict[tuple[float, ...], tuple[tuple[RigCamera, ...], Coverage]] = {}
        kept = lru_cache(_KEPT_SCENES)
        self.scene_of = kept(scene_of)
        self._packed_of = kept(lambda index: DeviceScene.pack(self.scene_of(index), device=device))
        self._ground_of = kept(lambda index: Ground.around(self._packed_of(index)))
        self._caster_of = kept(lambda index: ray_caster(self.scene_of(index).ego))
        self._observation_of = kept(lambda rig, index: observer_of(rig).observe(self._packed_of(index)))
        self._requirements_of = kept(lambda rig, index: None if check is None else check(rig, self.scene_of(index).ego))
        self._last_images: dict[RigCamera, tuple[int, bytes, float]] = {}

    @property
    def known(self) -> set[str]:
        """What there is to show or do beyond what every rig has."""
        found = {
            "descent": any(each is not None for each in self._descents),
            "further": self._further is not None,
            "modules": bool(self.edits.modules),
            "requirements": self._is_checked,
        }
        return {name for name, is_there in found.items() if is_there}

    @property
    def scene(self) -> Scene:
        """The scene that is shown."""
        return self.scene_of(self.scene_index)

    @property
    def packed(self) -> DeviceScene:
        """The same on the device."""
        return self._packed_of(self.scene_index)

    @property
    def rig(self) -> Rig:
        """The rig as it is now."""
        return self.edits.rig

    def go_to(self, frame: int) -> None:
        """Show the rig of a frame, as a step that can be undone."""
        if not 0 <= frame < len(self.frames):
            raise IndexError(f"frame must be from 0 to {len(self.frames) - 1}, got {frame}")
        self.frame = frame
        self.edits.replace(self.frames[frame])

    def show_scene(self, index: int) -> None:
        """Show another scene; numbers beyond the last begin again with the first."""
        self.scene_index = index % self.scene_count

    def skin_at(self, ray: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        """Where a ray, origin and direction [2, 3], meets the vehicle first, and the normal there; None: nowhere."""
        return first_hit(self._caster_of(self.scene_index), self.scene.ego, ray)

    @property
    def requirements(self) -> RequirementResult | None:
        """What the rig meets of the requirements on its vehicle; None where there are none."""
        return self._requirements_of(self.rig, self.scene_index)

    @property
    def descent(self) -> Steepest | None:
        """Direction of steepest descent at the frame; None if it is unknown, or once a camera was moved or turned."""
        return next((d for d, rig in zip(self._descents, self.frames, strict=True) if rig is self.rig), None)

    @property
    def further(self) -> FurtherCameras | None:
        """What further cameras would add; None at other frames than the last, or once a camera was moved or turned."""
        return self._further if self.rig is self.frames[-1] else None

    @property
    def surface(self) -> MountSurface:
        """What the cameras stand on."""
        return self._constraints.surface

    @property
    def coverage(self) -> Coverage:
        """Which cameras see whom where in the scene; only cameras that changed since the last time are asked again."""
        return self._coverage_of(HEIGHTS_M)

    @property
    def ground_coverage(self) -> Coverage:
        """The same of patches of the ground itself."""
        return self._coverage_of((PATCH_M,))

    def _coverage_of(self, heights_m: tuple[float, ...]) -> Coverage:
        ground, cameras = self._ground_of(self.scene_index), self.rig.cameras
        before, coverage = self._last_coverage.get(heights_m, ((), None))
        if coverage is None or coverage.ground is not ground or len(before) != len(cameras):
            coverage = ground.coverage(cameras, heights_m=heights_m)
        else:
            for index, (old, new) in enumerate(zip(before, cameras, strict=True)):
                if new is not old:
                    coverage = coverage.with_camera(index, new)
        self._last_coverage[heights_m] = cameras, coverage
        return coverage

    @property
    def observation(self) -> RigObservation:
        """What the detector makes of the scene."""
        return self._observation_of(self.rig, self.scene_index)

    @property
    def images(self) -> list[tuple[bytes, float]]:
        """What each camera sees, small, as JPEG, and the share of it that is the own body.

        Only cameras that changed since the last time are drawn again.
        """
        import cv2

        cameras, scene = self.rig.cameras, self.scene_index
        known = {camera: self._last_images[camera] for camera in cameras if camera in self._last_images}
        new = [camera for camera in cameras if camera not in known or known[camera][0] != scene]
        small = [dataclasses.replace(camera, model=_small(camera.model)) for camera in new]
        for camera, image in zip(new, render_images(self.packed, small, device=self._device), strict=True):
            jpeg = cv2.imencode(".jpg", np.ascontiguousarray(image.rgb[:, :, ::-1]))[1].tobytes()
            known[camera] = scene, jpeg, float((image.object_index == EGO).mean())
        self._last_images = known
        return [known[camera][1:] for camera in cameras]

    @property
    def lines(self) -> list[str]:
        """What there is to know at once, without asking the detector."""
        shares, areas = self.coverage.covered_share, self.coverage.blind_area_m2
        seen = (
            f"{height_m:g} m tall: seen on {share:.1%} of the ground, blind {area_m2:.0f} m²"
            for height_m, share, area_m2 in zip(self.coverage.heights_m, shares, areas, strict=True)
        )
        return [f"scene {self.scene.name}, {len(self.scene.vehicles)} vehicles", *seen]


def _small(model: CameraModel) -> CameraModel:
    return model.resized(_THUMBNAIL_PX, max(8, round(_THUMBNAIL_PX * model.height_px / model.width_px)))
