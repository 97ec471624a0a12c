"""A rig under inspection: scenes to show, iterations to go through, cameras to move, and what follows from it.

Nothing here draws; `warpav.view._inspector` does.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from functools import cached_property, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from warpav.optimisation import min_camera_distance_m
from warpav.rig import Rig, RigCamera, write_rig
from warpav.scene import DeviceScene
from warpav.sight import HEIGHTS_M, PATCH_M, Ground

if TYPE_CHECKING:
    from warpav.optimisation import Constraints, FurtherCameras, RigObservation, RigObserver
    from warpav.raster.mesh import Mesh
    from warpav.rig import Module, MountSurface
    from warpav.scene import Scene
    from warpav.sight import Coverage, RequirementResult
    from warpav.view._layers import Steepest

NEAR_M = 20.0
"""Ground of which the lines say how much several cameras see is this near to the vehicle's centre [m]."""

_KEPT_SCENES = 4
"""Scenes that are held in memory; others are built again when they are shown."""


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
        device: str = "cpu",
    ) -> None:
        """Begin with the last frame and the first scene."""
        if not frames or scene_count < 1:
            raise ValueError(f"expected at least one rig and one scene, got {len(frames)} and {scene_count}")
        if descents and len(descents) != len(frames):
            raise ValueError(f"expected a descent for each of {len(frames)} rigs, got {len(descents)}")
        self.frames = list(frames)
        self._descents = list(descents) or [None] * len(frames)
        self._further, self._modules, self._check = further, tuple(modules), check
        self.frame = len(self.frames) - 1
        self.rig = self.frames[-1]
        self.scene_index, self.scene_count = 0, scene_count
        self._constraints, self._height_offset_m = constraints, height_offset_m
        self._observer_of, self._device = observer_of, device
        self._last_coverage: dict[tuple[float, ...], tuple[tuple[RigCamera, ...], Coverage]] = {}
        kept = lru_cache(_KEPT_SCENES)
        self._scene_of = kept(scene_of)
        self._packed_of = kept(lambda index: DeviceScene.pack(self._scene_of(index), device=device))
        self._ground_of = kept(lambda index: Ground.around(self._packed_of(index)))

    @property
    def known(self) -> set[str]:
        """What there is to show or do beyond what every rig has."""
        found = {
            "descent": any(each is not None for each in self._descents),
            "further": self._further is not None,
            "modules": bool(self._modules),
            "requirements": self._check is not None,
        }
        return {name for name, is_there in found.items() if is_there}

    @property
    def scene(self) -> Scene:
        """The scene that is shown."""
        return self._scene_of(self.scene_index)

    @property
    def packed(self) -> DeviceScene:
        """The same on the device."""
        return self._packed_of(self.scene_index)

    def go_to(self, frame: int) -> None:
        """Show the rig of a frame; moves of cameras are forgotten."""
        if not 0 <= frame < len(self.frames):
            raise IndexError(f"frame must be from 0 to {len(self.frames) - 1}, got {frame}")
        self.frame = frame
        self._set(self.frames[frame])

    def show_scene(self, index: int) -> None:
        """Show another scene; numbers beyond the last begin again with the first."""
        self.scene_index = index % self.scene_count
        self._forget()

    def move(self, camera: int, position_m: np.ndarray) -> RigCamera:
        """Move a camera to the position on the mount surface nearest to another one, and return it as it is then.

        A camera that stood on the surface keeps its height above it. Other cameras stay, so two may come too close:
        see `violation_m`.
        """
        surface = self._constraints.surface
        old = self.rig.cameras[camera]
        wanted_m = np.array([*np.asarray(position_m, np.float64), old.position_m[2]])[:3]
        at_m = self._constraints.project(surface.place_of(wanted_m)[0][None])[0]
        old_place_m, was_above_m = surface.place_of(old.position_m)
        stood_there = bool(self._constraints.contains(old_place_m[None])[0])
        above_m = float(was_above_m) if stood_there else self._height_offset_m
        if surface.zones:
            above_m = float(np.clip(above_m, *surface.zones[int(surface.zone_at(at_m))].rise_m))
        height_m = float(surface.height_at_m(at_m[None])[0]) + above_m
        [pane] = surface.panes_at(at_m[None])
        return self._change(camera, position_m=surface.point_m(at_m, height_m), behind_glass=pane)

    def turn(self, camera: int, yaw_rad: float) -> RigCamera:
        """Turn a camera about the vertical, to a yaw left positive [rad], and return it as it is then."""
        return self._change(camera, yaw_rad=math.remainder(yaw_rad, 2.0 * math.pi))

    def change_module(self, camera: int) -> RigCamera:
        """Put the next module in a camera's place, after the last the first, and return it as it is then.

        Position, angles and near plane stay those of the camera. Where there are no modules, nothing changes.
        """
        old, names = self.rig.cameras[camera], [module.name for module in self._modules]
        if not names:
            return old
        module = self._modules[(names.index(old.module) + 1) % len(names) if old.module in names else 0]
        model = dataclasses.replace(module.camera_model(), near_m=old.model.near_m)
        return self._change(camera, model=model, module=module.name)

    @cached_property
    def requirements(self) -> RequirementResult | None:
        """What the rig meets of the requirements on its vehicle; None where there are none."""
        return None if self._check is None else self._check(self.rig, self.scene.ego)

    @property
    def descent(self) -> Steepest | None:
        """Direction of steepest descent at the frame; None if it is unknown, or once a camera was moved or turned."""
        return self._descents[self.frame] if self.rig is self.frames[self.frame] else None

    @property
    def further(self) -> FurtherCameras | None:
        """What further cameras would add; None at other frames than the last, or once a camera was moved or turned."""
        return self._further if self.rig is self.frames[-1] else None

    @property
    def surface(self) -> MountSurface:
        """What the cameras stand on."""
        return self._constraints.surface

    @cached_property
    def coverage(self) -> Coverage:
        """Which cameras see whom where in the scene; only cameras that changed since the last time are asked again."""
        return self._coverage_of(HEIGHTS_M)

    @cached_property
    def ground_coverage(self) -> Coverage:
        """The same of patches of the ground itself."""
        return self._coverage_of((PATCH_M,))

    def _coverage_of(self, heights_m: tuple[float, ...]) -> Coverage:
        ground, cameras = self._ground_of(self.scene_index), self.rig.cameras
        before, coverage = self._last_coverage.get(heights_m, (None, None))
        if before is None or coverage is None or coverage.ground is not ground:
            coverage = ground.coverage(cameras, heights_m=heights_m)
        else:
            for index, (old, new) in enumerate(zip(before, cameras, strict=True)):
                if new is not old:
                    coverage = coverage.with_camera(index, new)
        self._last_coverage[heights_m] = cameras, coverage
        return coverage

    @cached_property
    def observation(self) -> RigObservation:
        """What the detector makes of the scene."""
        return self._observer_of(self.rig).observe(self.packed)

    @property
    def violation_m(self) -> float:
        """By how much the rig breaks the constraints [m]."""
        return self._constraints.violation_m(self.rig)

    @property
    def lines(self) -> list[str]:
        """What there is to know at once, without asking the detector."""
        shares, areas = self.coverage.covered_share, self.coverage.blind_area_m2
        seen = (
            f"{height_m:g} m tall: seen on {share:.1%} of the ground, blind {area_m2:.0f} m²"
            for height_m, share, area_m2 in zip(self.coverage.heights_m, shares, areas, strict=True)
        )
        distance_m = min_camera_distance_m(np.array([camera.position_m for camera in self.rig.cameras]))
        apart = [f"closest pair of cameras {distance_m:.2f} m"] if math.isfinite(distance_m) else []
        breach = [f"constraints broken by {self.violation_m:.2f} m"] if self.violation_m else []
        return [f"scene {self.scene.name}, {len(self.scene.vehicles)} vehicles", *seen, *apart, *breach]

    def save(self, path: Path | str) -> Path:
        """Write the rig as it is now."""
        write_rig(self.rig, path)
        return Path(path)

    def _change(self, camera: int, **changes: object) -> RigCamera:
        cameras = list(self.rig.cameras)
        cameras[camera] = dataclasses.replace(cameras[camera], **changes)  # pyright: ignore[reportArgumentType]
        Rig([cameras[camera]])  # checked; the others were before
        self._set(Rig(tuple(cameras)))
        return self.rig.cameras[camera]

    def _set(self, rig: Rig) -> None:
        self.rig = rig
        self._forget()

    def _forget(self) -> None:
        for name in ("coverage", "ground_coverage", "observation", "requirements"):
            self.__dict__.pop(name, None)
