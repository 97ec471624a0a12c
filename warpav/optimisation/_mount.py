"""Cameras on the mount surface: from the numbers that are optimised to the poses of all views."""

from __future__ import annotations

import copy
import dataclasses
import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import warp as wp

from warpav.core.errors import InputError
from warpav.core.frames import rotation_from_yaw_pitch_roll
from warpav.raster.buffers import lens_of
from warpav.raster.camera import CameraModel, rotational_additions
from warpav.raster.pane import Pane
from warpav.rig import PLAIN, PLAIN_HOUSING, Housing, MountSurface, Rig, RigCamera, Role, Zone
from warpav_kernels.placement import mount_pose as kernels

X_M, Y_M, YAW_RAD = int(kernels.X_M), int(kernels.Y_M), int(kernels.YAW_RAD)
PITCH_RAD, ROLL_RAD = int(kernels.PITCH_RAD), int(kernels.ROLL_RAD)
HEIGHT_DELTA_M, LOG_ZOOM = int(kernels.HEIGHT_DELTA_M), int(kernels.LOG_ZOOM)
MOUNT_POSE_SIZE = int(kernels.MOUNT_POSE_SIZE)

MIRROR = np.ones(MOUNT_POSE_SIZE, np.float32)
"""What a mount pose is multiplied by to be that of the mirror image, on the mirrored mount."""
MIRROR[[YAW_RAD, ROLL_RAD]] = -1.0

_ROUNDING = 1e-9
_FROZEN_OFF_M = 1e-3  # rig files keep micrometres, mount poses single precision


@dataclass(frozen=True)
class PlacedViews:
    """Poses of all views of a rig: view = camera * rotation_count + rotational addition."""

    mount_pose: wp.array  # x, y [m], yaw, pitch, roll [rad], height delta [m], log zoom of every camera
    position_ego_m: wp.array  # centre of every view [m], vec3 [view]
    camera_from_ego: wp.array  # rotation from ego to camera axes of every view, mat33 [view]
    log_zoom: wp.array  # logarithm of every view's focal length over that of the mount's camera, float [view]

    @classmethod
    def zeros(cls, mount_pose: wp.array, rotation_count: int) -> PlacedViews:
        """Arrays with gradients for the views of cameras at ``mount_pose``, not placed yet."""
        view_count, device = mount_pose.shape[0] * rotation_count, mount_pose.device
        return cls(
            mount_pose,
            wp.zeros(view_count, dtype=wp.vec3, device=device, requires_grad=True),
            wp.zeros(view_count, dtype=wp.mat33, device=device, requires_grad=True),
            wp.zeros(view_count, dtype=float, device=device, requires_grad=True),
        )

    def zero_grad(self) -> None:
        """Gradients of 0, but for that of the mount poses."""
        for array in (self.position_ego_m, self.camera_from_ego, self.log_zoom):
            assert array.grad is not None
            array.grad.zero_()


@dataclass(frozen=True)
class FreeRanges:
    """What may differ from camera to camera besides x, y and yaw, and how far: low and high; None: it stays fixed."""

    pitch_rad: tuple[float, float] | None = None  # pitch, nose-down positive [rad]
    height_m: tuple[float, float] | None = None  # height of the camera's centre above the mount surface [m]
    fov_rad: tuple[float, float] | None = None  # horizontal field of view [rad]; a zoom of the lens gives it

    def __post_init__(self) -> None:
        for name, pair in vars(self).items():
            if pair is not None and not -math.inf < pair[0] < pair[1] < math.inf:
                raise ValueError(f"{name} must be a range, the lower end first, got {pair}")


@dataclass(frozen=True, eq=False)
class FrozenCameras:
    """Cameras of a rig that stay as they are, wherever they stand."""

    camera: tuple[RigCamera, ...]  # every camera of the rig in its order; those that may move give their names alone
    is_frozen: np.ndarray  # which of them stay, bool [camera]
    mount_pose: np.ndarray  # their mount poses, float32 [camera, 7]; those of the others mean nothing

    @property
    def position_m(self) -> np.ndarray:
        """Centres of those that stay [m], float64 [frozen, 3]."""
        return np.array([self.camera[k].position_m for k in np.flatnonzero(self.is_frozen)], np.float64).reshape(-1, 3)


class CameraMount:
    """A mount surface on the device, and the cameras that stand above it.

    A camera is seven numbers, its mount pose: x, y [m], on a surface of zones the place in their chart; yaw, pitch,
    roll [rad]; its height delta, by how much it stands higher above the surface than configured [m]; its log zoom, the
    logarithm of its focal length over the configured one.
    """

    def __init__(
        self,
        surface: MountSurface,
        *,
        camera: CameraModel | Sequence[CameraModel],
        height_offset_m: float,
        device: str = "cpu",
        free: FreeRanges | None = None,
        housings: Sequence[Housing] = (),
        roles: Sequence[Role] = (),
    ) -> None:
        """Mount for cameras of one model, or of the models of several modules."""
        self.surface = surface
        self.cameras = (camera,) if isinstance(camera, CameraModel) else tuple(camera)
        self.housings = tuple(housings) or (PLAIN_HOUSING,) * len(self.cameras)
        self.roles = tuple(roles) or (Role.ANY,) * len(self.cameras)
        self.height_offset_m = height_offset_m
        self.device = device
        self.free = free = free or FreeRanges()
        self.frozen: FrozenCameras | None = None
        self._narrowest_rad = free.fov_rad[0] if free.fov_rad else min(each.fov_rad for each in self.cameras)
        self.rotation_count, self.rotation_step_rad = rotational_additions(self._narrowest_rad)
        of_zone = surface.module_of_zone if surface.modules else np.zeros(max(len(surface.zones), 1), int)
        zones = zip(surface.zones or (None,), of_zone, strict=True)
        ends = [self._ends(number, zone, self.cameras[module]) for number, (zone, module) in enumerate(zones)]
        self._zone_low, self._zone_high = (np.stack(each) for each in zip(*ends, strict=True))
        self._height_m = wp.array(surface.height_m, dtype=float, device=device)
        self._zone_of_cell = wp.array(surface.zone_of_cell, dtype=wp.int32, device=device)
        self._plane_m = wp.array(surface.plane_m, dtype=wp.vec3, device=device)
        self._axes = wp.array(surface.axes, dtype=wp.mat33, device=device)

    @property
    def camera(self) -> CameraModel:
        """The model of all cameras at log zoom 0; of a mount of several modules the first one's."""
        return self.cameras[0]

    @property
    def is_mixed(self) -> bool:
        """Whether it carries modules, each with a camera model of its own."""
        return bool(self.surface.modules)

    def module_of(self, mount_pose: np.ndarray) -> np.ndarray:
        """Which of `cameras` the cameras at ``mount_pose`` [camera, 7] are by their zones, int [camera]."""
        return self.surface.module_at(mount_pose[:, [X_M, Y_M]])

    def panes_of(self, mount_pose: np.ndarray) -> list[Pane | None]:
        """What of the body the cameras at ``mount_pose`` [camera, 7] look through; None for those outside of it."""
        return self.surface.panes_at(mount_pose[:, [X_M, Y_M]])

    @property
    def sees_apart(self) -> bool:
        """Whether cameras differ in image or look through the body, so that one render cannot show what all see."""
        return self.is_mixed or any(pane is not None for pane in self.surface.panes)

    @property
    def is_symmetric(self) -> bool:
        """Whether its rigs are symmetric: cameras beside the middle stand for themselves and their mirror images."""
        return bool(self.surface.pairs)

    def is_pair(self, mount_pose: np.ndarray) -> np.ndarray:
        """Which of the cameras at ``mount_pose`` [camera, 7] stand for two, bool [camera]."""
        pairs = self.surface.pairs
        return np.array(pairs)[self.module_of(mount_pose)] if pairs else np.zeros(len(mount_pose), bool)

    @cached_property
    def mirrored(self) -> CameraMount:
        """The mount on the other side: there the mirror images of pairs stand, at `MIRROR` times their poses."""
        mount, surface, across = copy.copy(self), self.surface, np.array([1.0, -1.0, 1.0])
        if surface.panes:
            mirrored = tuple(pane and pane.mirrored() for pane in surface.panes)
            mount.surface = dataclasses.replace(surface, panes=mirrored)
        mount._plane_m = wp.array(surface.plane_m * across, dtype=wp.vec3, device=self.device)
        mount._axes = wp.array(surface.axes * across, dtype=wp.mat33, device=self.device)
        return mount

    @property
    def low(self) -> np.ndarray:
        """The least mount pose of any zone, float32 [7]; infinite where a number has no ends of its own."""
        return self._zone_low.min(axis=0)

    @property
    def high(self) -> np.ndarray:
        """The greatest mount pose of any zone, float32 [7]; infinite where a number has no ends of its own."""
        return self._zone_high.max(axis=0)

    def ends_of(self, place_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Least and greatest mount pose in the zones at places [camera, 2] of the chart, float32 [camera, 7]."""
        zone = self.surface.zone_at(place_m)
        return self._zone_low[zone], self._zone_high[zone]

    def _ends(self, number: int, zone: Zone | None, camera: CameraModel) -> tuple[np.ndarray, np.ndarray]:
        """Least and greatest mount pose of a camera in a zone, float32 [7]."""
        low, high = (np.full(MOUNT_POSE_SIZE, end, np.float32) for end in (-np.inf, np.inf))
        free = self.free
        ranges: dict[int, tuple[float, float]] = {}
        if free.pitch_rad is not None:
            ranges[PITCH_RAD] = free.pitch_rad
        if free.height_m is not None:
            ranges[HEIGHT_DELTA_M] = (free.height_m[0] - self.height_offset_m, free.height_m[1] - self.height_offset_m)
        if free.fov_rad is not None:
            ranges[LOG_ZOOM] = (camera.log_zoom_to(free.fov_rad[1]), camera.log_zoom_to(free.fov_rad[0]))
        if any(least > _ROUNDING or greatest < -_ROUNDING for least, greatest in ranges.values()):
            raise ValueError(f"the free ranges must hold what is configured, got {free}")
        if zone is not None:
            low_m, high_m = zone.rise_m
            ranges[HEIGHT_DELTA_M] = (low_m - self.height_offset_m, high_m - self.height_offset_m)
            # what a zone does not say is fixed there, as others may leave it free
            ranges[ROLL_RAD] = zone.roll_rad or (0.0, 0.0)
            if zone.yaw_range_rad is not None:
                ranges[YAW_RAD] = zone.yaw_range_rad
            if zone.pitch_rad or free.pitch_rad is None:
                ranges[PITCH_RAD] = zone.pitch_rad or (0.0, 0.0)
            if zone.is_centred:
                # y = 0 of the ego frame along the axis of the chart that runs across the vehicle
                across = int(np.abs(zone.axes[:2, 1]).argmax())
                middle_m = -float(self.surface.plane_m[number, 1] / zone.axes[across, 1])
                ranges[(X_M, Y_M)[across]] = middle_m, middle_m
        if camera.beams is not None and camera.beams.is_all_round:  # it stands level, and its yaw says nothing
            ranges[YAW_RAD] = ranges[PITCH_RAD] = ranges[ROLL_RAD] = (0.0, 0.0)
        for column, (least, greatest) in ranges.items():
            # rounded inwards, so that single precision is within as well
            low[column], high[column] = least, greatest
            if least == greatest:
                continue
            if float(low[column]) < least:
                low[column] = np.nextafter(low[column], np.float32(np.inf))
            if float(high[column]) > greatest:
                high[column] = np.nextafter(high[column], np.float32(-np.inf))
        return low, high

    @property
    def is_free(self) -> np.ndarray:
        """Which numbers of a mount pose have a free range, bool [7]; x, y and yaw are always free, and not counted."""
        is_free = np.asarray(np.any(np.isfinite(self._zone_low) & (self._zone_high > self._zone_low), axis=0), bool)
        is_free[YAW_RAD] = False
        return is_free

    def freezing(self, rig: Rig, names: Collection[str]) -> CameraMount:
        """The same mount for rigs of which some cameras stay as they are in ``rig``; they may stand anywhere."""
        is_frozen = np.array([camera.name in names for camera in rig.cameras])
        if is_frozen.sum() != len(set(names)) or is_frozen.all():
            raise ValueError(f"names must be some of the rig's cameras and not all, got {sorted(names)}")
        frozen = [camera for camera in rig.cameras if camera.name in names]
        for camera in frozen:
            if not self.is_mixed and not camera.model.fits_beside(self.camera):
                raise ValueError(
                    f"camera {camera.name!r} must differ from the mount's in zoom alone, got {camera.model}"
                )
        mount_pose = self.mount_pose_of_rig(rig)
        place_m, panes = self.position_m(mount_pose), self.panes_of(mount_pose)
        for k in np.flatnonzero(is_frozen):
            camera, pane = rig.cameras[k], panes[k]
            if math.dist(camera.position_m, place_m[k]) > _FROZEN_OFF_M:
                raise InputError(
                    f"camera {camera.name!r}: expected one above a zone of mount.zones, as it is to stay, got one at "
                    f"{', '.join(f'{each:g}' for each in camera.position_m)} m; let a zone reach there"
                )
            if camera.behind_glass != pane:
                there, given = (each.name if each else "none" for each in (pane, camera.behind_glass))
                raise InputError(
                    f"camera {camera.name!r}: behind_glass: expected that of its place in mount.zones, {there}, as it "
                    f"is to stay, got {given}{' with another outline' if there == given else ''}"
                )
        mount = copy.copy(self)
        mount.frozen = FrozenCameras(rig.cameras, is_frozen, mount_pose)
        narrowest_rad = min(self._narrowest_rad, *(camera.model.fov_rad for camera in frozen))
        mount.rotation_count, mount.rotation_step_rad = rotational_additions(narrowest_rad)
        return mount

    @property
    def of_single_cameras(self) -> CameraMount:
        """The same mount for cameras none of which is frozen, however many."""
        mount = copy.copy(self)
        mount.frozen = None
        return mount

    @property
    def has_one_field(self) -> bool:
        """Whether all cameras have one field of view: none is free, and none that stays has another."""
        zooms = () if self.frozen is None else self.frozen.mount_pose[self.frozen.is_frozen, LOG_ZOOM]
        return self.free.fov_rad is None and not np.any(zooms)

    def within(self, mount_pose: np.ndarray) -> np.ndarray:
        """The nearest mount poses [camera, 7] within the free ranges, of the same type; what is frozen is as it is."""
        pose = self.clipped(mount_pose)
        if self.frozen is not None:
            pose[self.frozen.is_frozen] = self.frozen.mount_pose[self.frozen.is_frozen]
        return pose

    def off_the_skin(self, mount_pose: np.ndarray) -> np.ndarray:
        """Mount poses [camera, 7] as far off the skin as zones allow, of the same type; without zones as they are."""
        pose = np.array(mount_pose)
        if self.surface.zones:
            pose[:, HEIGHT_DELTA_M] = self.ends_of(pose[:, [X_M, Y_M]])[1][:, HEIGHT_DELTA_M]
        return pose

    def clipped(self, mount_pose: np.ndarray) -> np.ndarray:
        """The nearest mount poses [camera, 7] within the ranges of the zones that they are in, of the same type."""
        pose = np.array(mount_pose)
        low, high = self.ends_of(pose[:, [X_M, Y_M]])
        # a yaw may be a whole turn beside its range
        ends = np.isfinite(low[:, YAW_RAD])
        middle_rad = 0.5 * (low[ends, YAW_RAD] + high[ends, YAW_RAD])
        away_rad = np.remainder(pose[ends, YAW_RAD] - middle_rad + np.pi, 2.0 * np.pi) - np.pi
        pose[ends, YAW_RAD] = middle_rad + away_rad
        return np.clip(pose, low, high).astype(mount_pose.dtype)

    def has_model(self, model: CameraModel) -> bool:
        """Whether a camera of this model can be one of the mount's."""
        if model in self.cameras or (self.free.fov_rad is not None and model.is_zoom_of(self.camera)):
            return True
        frozen = self.frozen
        return frozen is not None and any(frozen.camera[k].model == model for k in np.flatnonzero(frozen.is_frozen))

    def place(
        self, mount_pose: wp.array, rotation_count: int | None = None, *, into: PlacedViews | None = None
    ) -> PlacedViews:
        """Poses of all views; recorded on the active tape, gradients flow to ``mount_pose``."""
        camera_count = mount_pose.shape[0]
        rotation_count = self.rotation_count if rotation_count is None else rotation_count
        views = PlacedViews.zeros(mount_pose, rotation_count) if into is None else into
        views.zero_grad()
        wp.launch(
            kernels.place_on_surface_kernel,
            dim=camera_count,
            inputs=[
                mount_pose,
                self._height_m,
                wp.vec2(*self.surface.origin_m),
                self.surface.cell_m,
                self._zone_of_cell,
                self._plane_m,
                self._axes,
                self.height_offset_m,
                rotation_count,
                self.rotation_step_rad,
            ],
            outputs=[views.position_ego_m, views.camera_from_ego, views.log_zoom],
            device=self.device,
        )
        return views

    def windows(self, views: PlacedViews, *, requires_grad: bool = True) -> wp.array:
        """The field of view of each camera as a window of each view of its panorama, for `Frame.window_area`, vec4.

        Recorded on the active tape; gradients flow to the views' rotations and zooms.
        """
        view_count, camera_count = len(views.position_ego_m), views.mount_pose.shape[0]
        window_rad = wp.zeros(view_count, dtype=wp.vec4, device=self.device, requires_grad=requires_grad)
        wp.launch(
            kernels.place_windows_kernel,
            dim=camera_count,
            inputs=[
                views.camera_from_ego,
                views.log_zoom,
                view_count // camera_count,
                lens_of(self.camera),
                wp.vec2(*self.camera.half_field),
            ],
            outputs=[window_rad],
            device=self.device,
        )
        return window_rad

    def position_m(self, mount_pose: np.ndarray) -> np.ndarray:
        """Centres of cameras at ``mount_pose`` [camera, 7] in the ego frame [m], float64 [camera, 3]."""
        place = mount_pose[:, [X_M, Y_M]]
        height_m = self.surface.height_at_m(place) + self.height_offset_m + mount_pose[:, HEIGHT_DELTA_M]
        return self.surface.point_m(place, height_m).astype(np.float64)

    def rig(self, mount_pose: np.ndarray) -> Rig:
        """The rig whose cameras stand at ``mount_pose`` [camera, 7], named by where they look (`named_by_direction`).

        Where some are frozen, all have the names of the rig that these are of, and these are the same to the last bit.
        """
        frozen = self.frozen
        position_m = self.position_m(mount_pose)
        module = self.module_of(mount_pose)
        modules = self.surface.modules
        panes = self.panes_of(mount_pose)
        cameras: list[RigCamera] = []
        for i, (pose, is_pair) in enumerate(zip(mount_pose, self.is_pair(mount_pose), strict=True)):
            if frozen is not None and frozen.is_frozen[i]:
                cameras.append(frozen.camera[i])
                continue
            camera = RigCamera(
                name="camera" if frozen is None else frozen.camera[i].name,
                position_m=position_m[i],
                yaw_rad=float(pose[YAW_RAD]),
                pitch_rad=float(pose[PITCH_RAD]),
                roll_rad=float(pose[ROLL_RAD]),
                model=self.cameras[module[i]].zoomed(float(pose[LOG_ZOOM])),
                module=modules[module[i]] if modules and modules[module[i]] != PLAIN else None,
                behind_glass=panes[i],
                housing=self.housings[module[i]],
            )
            cameras += [camera, mirror_image(camera)] if is_pair else [camera]
        return Rig(named_by_direction(cameras) if frozen is None else cameras)

    def rows_of_cameras(self, mount_pose: np.ndarray) -> np.ndarray:
        """The row of ``mount_pose`` [row, 7] that each camera of its `rig` comes from, int [camera]."""
        return np.repeat(np.arange(len(mount_pose)), 1 + self.is_pair(mount_pose))

    def mount_pose_of_rig(self, rig: Rig, *, as_configured: bool = False) -> np.ndarray:
        """The mount poses of a rig's cameras wherever they stand, float32 [camera, 7]; the inverse of `rig`.

        Cameras of another model give the zoom at which the mount's has their focal length; modules must be its own.
        """
        rows = []
        carriers = self.surface.carriers_of(rig.cameras)
        for k, camera in enumerate(rig.cameras):
            module = self._module_of_camera(camera)
            may_be = None if carriers is None else carriers[k]
            if self.is_symmetric:
                is_centred = abs(camera.position_m[1]) <= _FROZEN_OFF_M
                may_be = may_be & (np.array(self.surface.pairs) != is_centred)
                self._check_mirrored(rig, camera)
                if not is_centred and camera.position_m[1] < 0.0:
                    continue  # the mirror image of another one
            (x_m, y_m), rise_m = self.surface.place_of(camera.position_m, may_be)
            height_delta_m = float(rise_m) - self.height_offset_m
            log_zoom = camera.model.log_zoom_over(self.cameras[module])
            rows.append([x_m, y_m, camera.yaw_rad, camera.pitch_rad, camera.roll_rad, height_delta_m, log_zoom])
        pose = np.array(rows, np.float32)
        if as_configured:
            pose[:, [n for n in (HEIGHT_DELTA_M, LOG_ZOOM) if not self.is_free[n]]] = 0.0
        return pose

    def _check_mirrored(self, rig: Rig, camera: RigCamera) -> None:
        """Make sure that a camera of a rig has its mirror image there, to a millimetre and a milliradian."""
        wanted = mirror_image(camera)
        for other in rig.cameras:
            turn = wanted.ego_from_camera[:3, :3].T @ other.ego_from_camera[:3, :3]
            is_near = math.dist(wanted.position_m, other.position_m) <= _FROZEN_OFF_M
            if is_near and np.abs(turn - np.eye(3)).max() <= _FROZEN_OFF_M and other.model == camera.model:
                return
        raise InputError(
            f"camera {camera.name!r}: expected its mirror image at {np.round(wanted.position_m, 3).tolist()} m, as "
            "rig.symmetric asks for, got none; set rig.symmetric=false"
        )

    def _module_of_camera(self, camera: RigCamera) -> int:
        """Which of the mount's modules a camera of a rig is, by name, or else by its model; 0 without modules."""
        modules = self.surface.modules
        if not modules:
            return 0
        if camera.module in modules:
            return modules.index(camera.module)  # of kinds of one module all have one model
        near_m = self.camera.near_m
        if camera.module is None and (model := dataclasses.replace(camera.model, near_m=near_m)) in self.cameras:
            return self.cameras.index(model)
        raise InputError(
            f"camera {camera.name!r}: module: expected one of {', '.join(modules)}, got "
            f"{camera.module or f'a camera of {camera.model.width_px} x {camera.model.height_px} px without one'}"
        )


def mirror_image(camera: RigCamera) -> RigCamera:
    """The camera on the other side of the vehicle."""
    position_m = camera.position_m * [1.0, -1.0, 1.0]
    pane = camera.behind_glass and camera.behind_glass.mirrored()
    return dataclasses.replace(
        camera, position_m=position_m, yaw_rad=-camera.yaw_rad, roll_rad=-camera.roll_rad, behind_glass=pane
    )


_SECTORS = ("front", "front_left", "left", "rear_left", "rear", "rear_right", "right", "front_right")


def named_by_direction(cameras: Sequence[RigCamera]) -> list[RigCamera]:
    """Cameras named by the eighth of a turn in which they look: ``front_left``, ``rear``; LiDARs so: ``lidar_left``.

    Several of one eighth have their field of view behind it where that tells them apart, ``front_30``, else a number
    from the foremost on, ``left_1``.
    """
    sector = [_SECTORS[round(camera.yaw_rad / (math.pi / 4.0)) % 8] for camera in cameras]
    for k, beams in enumerate(camera.model.beams for camera in cameras):
        if beams is not None:
            sector[k] = beams.kind if beams.is_all_round else f"{beams.kind}_{sector[k]}"
    field_deg = [round(math.degrees(camera.model.fov_rad)) for camera in cameras]
    names = []
    for k, name in enumerate(sector):
        there = [j for j, other in enumerate(sector) if other == name]
        fields = [field_deg[j] for j in there]
        if len(there) > 1 and len(set(fields)) == len(fields):
            name = f"{name}_{field_deg[k]}"  # noqa: PLW2901
        elif len(there) > 1:
            there.sort(key=lambda j: -cameras[j].position_m[0])
            name = f"{name}_{1 + there.index(k)}"  # noqa: PLW2901
        names.append(name)
    return [dataclasses.replace(camera, name=name) for camera, name in zip(cameras, names, strict=True)]


def views_of_rig(
    rig: Rig, *, rotation_count: int, rotation_step_rad: float, device: str = "cpu", mount: CameraMount | None = None
) -> PlacedViews:
    """Poses of all views of a rig that stands anywhere; nothing is taped."""
    position, rotation = [], []
    for camera in rig.cameras:
        transform = camera.ego_from_camera
        for a in range(rotation_count):
            turn = rotation_from_yaw_pitch_roll(a * rotation_step_rad, 0.0, 0.0)
            position.append(transform[:3, 3])
            rotation.append((turn @ transform[:3, :3]).T)
    if mount is not None:
        pose = mount.mount_pose_of_rig(rig)
    else:
        flat = [[*c.position_m[:2], c.yaw_rad, c.pitch_rad, c.roll_rad, 0.0, 0.0] for c in rig.cameras]
        pose = np.array(flat, np.float32)
    return PlacedViews(
        wp.array(pose, dtype=float, device=device),
        wp.array(np.array(position, np.float32), dtype=wp.vec3, device=device),
        wp.array(np.array(rotation, np.float32), dtype=wp.mat33, device=device),
        wp.array(np.repeat(pose[:, LOG_ZOOM], rotation_count), dtype=float, device=device),
    )
