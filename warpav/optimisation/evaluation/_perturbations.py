"""What perturbations cost a rig in expected misses: a lost camera, errors of mounting, dirt before a lens, loads.

Cameras err independently, so a rig misses object o with the probability m_o, the product over its cameras of 1 - p_io.
Whatever befalls a rig changes rows of its matrix of probabilities; `_perturb` is the cost of that. Each camera is
rendered by itself, as a pool is, and only where it is changed: a lost one is a row of zeros; one that is off stands
elsewhere, inwards up to the skin of the body; dirt is an opaque sheet before the lens; under a load it is the world
that moves in the ego frame.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from operator import attrgetter
from typing import Any, Literal, get_args

import numpy as np

from warpav.core.errors import ArgumentError, InputError
from warpav.core.frames import rotation_from_yaw_pitch_roll
from warpav.core.progress import NullProgress, Progress
from warpav.core.table import Table
from warpav.detection import expected_miss_rate, expected_miss_slope, shares_of
from warpav.optimisation._mount_errors import COLUMNS, MountErrors, outside_skin
from warpav.optimisation._single_cameras import SingleCameras
from warpav.raster.camera import CameraModel
from warpav.raster.decide import Occlusion
from warpav.raster.mesh import Mesh, merge
from warpav.rig import RigCamera
from warpav.scene import Box, DeviceScene, Scene, Vehicle


def _perturb(
    probability: np.ndarray, changed: Mapping[int, np.ndarray] | None = None, share: np.ndarray | None = None
) -> float:
    """Expected misses per 100 objects of a rig of which some cameras detect otherwise.

    Args:
        probability: Of each camera for each object, 0..1, float [camera, object].
        changed: New rows by the number of their camera; 0: lost.
        share: Of each object in the mean, see `shares_of`; None: all count the same.
    """
    rows = probability
    if changed:
        rows = np.array(probability)
        for camera, row in changed.items():
            rows[camera] = row
    return 100.0 * expected_miss_rate(rows, share)


def _detected(cameras: SingleCameras, pose: np.ndarray, side: np.ndarray, scene: DeviceScene) -> np.ndarray:
    """What each camera of rigs detects, on its own side, float [..., camera, object]; ``pose`` [..., camera, 7]."""
    found = np.zeros((*pose.shape[:-1], cameras.column_count(scene)))
    for number, of_side in enumerate(cameras.sides):
        own = np.flatnonzero(side == number)
        seen = of_side.detection_probability(pose[..., own, :].reshape(-1, pose.shape[-1]), scene)
        found[..., own, :] = seen.reshape(*pose.shape[:-2], len(own), found.shape[-1])
    return found


@dataclass(frozen=True, eq=False)
class PosedRig:
    """A rig whose cameras are rendered one by one."""

    names: Sequence[str]  # of its cameras
    mount_pose: np.ndarray  # float [camera, 7]
    cameras: SingleCameras
    weight: np.ndarray | None = None  # of the objects or their columns, scene by scene


# ---------------------------------------------------------------------------------------------------- lost cameras


@dataclass(frozen=True)
class _CameraOutage:
    camera: str
    expected_misses_per_100: float
    difference_per_100: float
    weighted_expected_misses_per_100: float | None = None
    weighted_difference_per_100: float | None = None


@dataclass(frozen=True)
class CameraOutages:
    """A rig without each of its cameras in turn."""

    expected_misses_per_100: float
    weighted_expected_misses_per_100: float | None = None
    cameras: tuple[_CameraOutage, ...] = ()

    def __post_init__(self) -> None:
        weighted = [self.weighted_expected_misses_per_100]
        for each in self.cameras:
            weighted += [each.weighted_expected_misses_per_100, each.weighted_difference_per_100]
        if not self.cameras or len({number is None for number in weighted}) > 1:
            raise ValueError("weighted numbers must be there for all cameras or for none")

    @classmethod
    def of(
        cls,
        camera: Sequence[str],
        detection_probability: np.ndarray,
        weight: np.ndarray | None = None,
        alike: np.ndarray | None = None,
    ) -> CameraOutages | None:
        """From what each camera detects.

        Args:
            detection_probability: Of each camera for each object or column of it, 0..1, float [camera, object].
            weight: Of these.
            alike: Weights by which all objects count the same; None: 1.
        """
        if detection_probability.shape[1] == 0:
            return None
        share = None if weight is None or not weight.any() else shares_of(weight)
        lost: list[dict[int, Any]] = [{}, *({k: 0.0} for k in range(len(camera)))]
        plain, *without = (_perturb(detection_probability, each, shares_of(alike)) for each in lost)
        if share is None:
            outages = (_CameraOutage(name, rate, rate - plain) for name, rate in zip(camera, without, strict=True))
            return cls(plain, None, tuple(outages))
        weighted, *weighted_without = (_perturb(detection_probability, each, share) for each in lost)
        numbers = zip(camera, without, weighted_without, strict=True)
        outages = (
            _CameraOutage(name, rate, rate - plain, by_weight, by_weight - weighted)
            for name, rate, by_weight in numbers
        )
        return cls(plain, weighted, tuple(outages))

    @property
    def worst(self) -> _CameraOutage:
        """The outage with most expected misses, by their weights where these are set; of equal ones the first."""
        is_weighted = self.weighted_expected_misses_per_100 is not None
        name = "weighted_expected_misses_per_100" if is_weighted else "expected_misses_per_100"
        return max(self.cameras, key=attrgetter(name))

    def table(self, name: str) -> Table:
        """What a rig of this name is expected to miss, whole and without each camera."""
        names = ["expected_misses_per_100", "difference_per_100"]
        columns = ["expected misses per 100", "difference"]
        if self.weighted_expected_misses_per_100 is not None:
            names += [f"weighted_{name}" for name in names]
            columns += [f"weighted {column}" for column in columns]
        whole = ("no camera", *("" if "difference" in name else f"{getattr(self, name):.1f}" for name in names))
        rows = [
            (
                each.camera + (" (worst)" if each.camera == self.worst.camera else ""),
                *(f"{getattr(each, name):{'+' if 'difference' in name else ''}z.1f}" for name in names),
            )
            for each in self.cameras
        ]
        return Table((f"{name} without", *columns), (whole, *rows))

    def to_json(self) -> dict[str, Any]:
        """As ``evaluation.json`` has it; without weights their numbers are left out."""
        cameras = [asdict(each) for each in self.cameras]
        found = {**asdict(self), "cameras": cameras, "worst": self.worst.camera}
        for each in (found, *cameras):
            for name in [name for name, value in each.items() if value is None]:
                del each[name]
        return found


# -------------------------------------------------------------------------------------------------- errors of mounting


@dataclass(frozen=True)
class MountEffect:
    """One camera that is off in one degree of freedom.

    Attributes:
        per_unit: Derivative of the expected misses per 100 objects at the rig [1/m, 1/rad].
    """

    camera: str
    degree: str
    per_unit: float
    below: float
    above: float

    @property
    def worst(self) -> float:
        return max(self.below, self.above)

    def to_json(self) -> dict[str, Any]:
        return {**asdict(self), "worst": self.worst}


@dataclass(frozen=True, eq=False)
class MountTolerance:
    """What errors of mounting cost a rig in expected misses per 100 objects, weighted where objects have weights."""

    position_m: float
    angle_rad: float
    nominal: float
    samples: np.ndarray
    effects: tuple[MountEffect, ...]
    scenes: int

    @property
    def worst(self) -> MountEffect:
        """The camera and degree of freedom that cost most; of equal ones the first."""
        return max(self.effects, key=lambda effect: effect.worst)

    def table(self) -> Table:
        """What each camera costs by degree of freedom: text when printed, HTML in a notebook."""
        cameras = dict.fromkeys(effect.camera for effect in self.effects)
        found = {(effect.camera, effect.degree): f"{effect.worst:+z.2f}" for effect in self.effects}
        limits = f"+-{100.0 * self.position_m:g} cm, +-{np.degrees(self.angle_rad):g} deg"
        high = np.quantile(self.samples, 0.95)
        return Table(
            ("misses per 100, change", *COLUMNS),
            tuple((name, *(found[name, degree] for degree in COLUMNS)) for name in cameras),
            f"Worst change with one camera off by {limits} in one direction. The rig is expected to miss "
            f"{self.nominal:.2f} of 100; with all cameras off by chance {self.samples.mean():.2f}, "
            f"in 95 % of {len(self.samples)} draws at most {high:.2f}.",
        )

    def to_json(self) -> dict[str, Any]:
        return {
            "position_m": self.position_m,
            "angle_rad": self.angle_rad,
            "expected_misses_per_100": self.nominal,
            "draws": {
                "count": len(self.samples),
                "expected_misses_per_100": float(self.samples.mean()),
                "quantile_95": float(np.quantile(self.samples, 0.95)),
            },
            "effects": [effect.to_json() for effect in self.effects],
            "worst": {"camera": self.worst.camera, "degree": self.worst.degree, "change_per_100": self.worst.worst},
            "scenes": self.scenes,
        }

    @classmethod
    def of(
        cls,
        rig: PosedRig,
        scenes: Sequence[DeviceScene],
        errors: MountErrors,
        *,
        sample_count: int,
        seed: int,
        progress: Progress | None = None,
    ) -> MountTolerance:
        """Render a rig's cameras with errors of mounting; inwards they end at the surface that the cameras stand on."""
        cameras, given = rig.cameras, {**vars(errors), "sample_count": sample_count}
        for name, value in given.items():
            if not value > 0.0:
                raise ArgumentError(name, f"expected a positive number, got {value!r}")
        if not any(scene.vehicle_count for scene in scenes):
            raise ArgumentError("scenes", "expected at least one object, got none")
        pose, side = cameras.apart(np.asarray(rig.mount_pose, np.float64))
        count, columns = len(pose), list(COLUMNS.values())
        tolerance = errors.tolerance
        rng = np.random.default_rng(seed)
        drawn = np.tile(pose, (sample_count, 1, 1))
        drawn[..., columns] += tolerance * rng.uniform(-1.0, 1.0, (sample_count, count, len(columns)))
        alone = np.tile(pose, (2, len(columns), 1, 1))  # [below or above, degree, camera, 7]
        for k, column in enumerate(columns):
            alone[0, k, :, column] -= tolerance[k]
            alone[1, k, :, column] += tolerance[k]
        every = np.concatenate([pose[None], alone.reshape(-1, count, pose.shape[1]), drawn])
        every = outside_skin(every, pose, cameras.mount)
        progress = progress or NullProgress()
        steps = progress.steps("mount errors", scenes, count=len(scenes))
        found = np.concatenate([_detected(cameras, every, side, scene) for scene in steps], axis=-1)
        share = shares_of(rig.weight)
        plain, single, together = found[0], found[1 : 1 + 2 * len(columns)], found[1 + 2 * len(columns) :]
        nominal = _perturb(plain, share=share)
        single = single.reshape(2, len(columns), count, -1)
        slope = _slopes(cameras, pose.astype(np.float32), side, scenes, share)
        effects = []
        for c, name in enumerate(rig.names):
            for k, degree in enumerate(COLUMNS):
                below, above = (_perturb(plain, {c: ends[k, c]}, share) - nominal for ends in single)
                effects.append(MountEffect(name, degree, float(slope[c, columns[k]]), below, above))
        samples = np.array([_perturb(each, share=share) for each in together])
        return cls(errors.position_m, errors.angle_rad, nominal, samples, tuple(effects), len(scenes))


def _slopes(
    cameras: SingleCameras,
    mount_pose: np.ndarray,
    side: np.ndarray,
    scenes: Sequence[DeviceScene],
    share: np.ndarray | None,
) -> np.ndarray:
    """Derivatives of the expected misses per 100 to every number of every camera of a side, float64 [camera, 7]."""
    objects = sum(map(cameras.column_count, scenes))
    probability, jacobian = np.zeros((len(side), objects)), np.zeros((len(side), objects, mount_pose.shape[1]))
    for number, of_side in enumerate(cameras.sides):
        own = np.flatnonzero(side == number)
        probability[own], jacobian[own] = of_side.with_jacobian(mount_pose[own], scenes)
    return 100.0 * expected_miss_slope(probability, jacobian, share)


# ---------------------------------------------------------------------------------------------------------------- dirt


SoilShape = Literal["disc", "rows", "columns"]

_DIRT_RGB = (88, 78, 66)
_DIRT_STEPS = 64
_BEYOND_NEAR = 1.05  # of the distance from which on a camera sees
_PITCH_LIMIT_DEG = 30.0


@dataclass(frozen=True)
class SoiledPart:
    """A part of an image in which nothing can be seen.

    Attributes:
        shape: A disc; or a band of rows (from the left edge to the right) or of columns (from the upper edge to the
            lower).
    """

    shape: SoilShape = "disc"
    place: tuple[float, float] = (0.5, 0.5)
    share: float = 0.1

    def __post_init__(self) -> None:
        if self.shape not in get_args(SoilShape):
            raise ArgumentError("shape", f"expected one of {', '.join(get_args(SoilShape))}, got {self.shape!r}")
        if len(self.place) != 2 or not all(0.0 <= value <= 1.0 for value in self.place):
            raise ArgumentError("place", f"expected two shares of the image from 0 to 1, got {self.place!r}")
        if not 0.0 < self.share <= 1.0:
            raise ArgumentError("share", f"expected a share of the image's area in (0, 1], got {self.share!r}")

    def covers(self, place_px: np.ndarray, model: CameraModel) -> np.ndarray:
        """Whether places of an image, column and row [px], [..., 2], lie in the part; bool [...]."""
        size_px = np.array([model.width_px, model.height_px], np.float64)
        offset_px = np.asarray(place_px, np.float64) - self.place * size_px
        if self.shape == "disc":
            return np.hypot(offset_px[..., 0], offset_px[..., 1]) <= self._radius_px(model)
        axis = 1 if self.shape == "rows" else 0
        return np.abs(offset_px[..., axis]) <= 0.5 * self.share * size_px[axis]

    def covered_share(self, model: CameraModel) -> float:
        """Share of an image's pixels of which the middle lies in the part, 0..1."""
        row, column = np.mgrid[: model.height_px, : model.width_px] + 0.5
        return float(self.covers(np.stack([column, row], axis=-1), model).mean())

    def _radius_px(self, model: CameraModel) -> float:
        return math.sqrt(self.share * model.width_px * model.height_px / math.pi)

    def sheet(self, camera: RigCamera) -> Mesh:
        """An opaque sheet in the ego frame that covers the part of an image, just beyond the camera's near distance."""
        model = camera.model
        size_px = np.array([model.width_px, model.height_px], np.float64)
        middle_px = self.place * size_px
        first, second = np.meshgrid(*2 * [np.linspace(0.0, 1.0, _DIRT_STEPS + 1)], indexing="ij")
        if self.shape == "disc":
            radius_px, turn = self._radius_px(model) * first, 2.0 * math.pi * second
            corner_px = middle_px + radius_px[..., None] * np.stack([np.cos(turn), np.sin(turn)], axis=-1)
        else:
            axis = 1 if self.shape == "rows" else 0
            along = middle_px[axis] + (first - 0.5) * self.share * size_px[axis]
            across = second * size_px[1 - axis]
            corner_px = np.stack([across, along] if axis == 1 else [along, across], axis=-1)
        ray = model.rays(np.clip(corner_px, 0.0, size_px)).reshape(-1, 3)
        index = np.arange((_DIRT_STEPS + 1) ** 2).reshape(_DIRT_STEPS + 1, -1)
        corners = [index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]]
        a, b, c, d = (each.ravel() for each in corners)
        triangle = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
        point_camera_m = _BEYOND_NEAR * model.near_m * ray
        edge_m = np.diff(point_camera_m[triangle], axis=1)
        area = np.linalg.norm(np.cross(edge_m[:, 0], edge_m[:, 1]), axis=1)
        triangle = triangle[np.isfinite(area) & (area > 0.0)]  # beyond a fisheye's circle nothing is seen
        if not len(triangle):
            raise InputError(f"soiled part: camera {camera.name!r} sees nothing at place {self.place}")
        used, numbered = np.unique(triangle, return_inverse=True)
        transform = camera.ego_from_camera
        point_m = point_camera_m[used] @ transform[:3, :3].T + transform[:3, 3]
        return Mesh.create(point_m, numbered.reshape(-1, 3), _DIRT_RGB)


def soiled_scene(scene: Scene, camera: RigCamera, part: SoiledPart) -> Scene:
    """The scene with dirt before one camera; other cameras may see it where it is."""
    return replace(scene, environment=merge([scene.environment, part.sheet(camera)]))


@dataclass(frozen=True)
class _SoiledCamera:
    camera: str
    covered_share: float
    expected_misses_per_100: float
    difference_per_100: float


@dataclass(frozen=True)
class Soiling:
    """What a soiled camera costs a rig, weighted where objects have weights."""

    part: SoiledPart
    expected_misses_per_100: float
    cameras: tuple[_SoiledCamera, ...]

    @property
    def worst(self) -> _SoiledCamera:
        """The camera whose soiling costs most; of equal ones the first."""
        return max(self.cameras, key=lambda each: each.difference_per_100)

    def to_json(self) -> dict[str, Any]:
        """As the file of ``warpav evaluate --json`` has it."""
        return {**asdict(self), "worst": self.worst.camera}

    def table(self) -> Table:
        """What each soiled camera costs: text when printed, HTML in a notebook."""
        column, row = self.part.place
        return Table(
            ("soiled camera", "covered", "expected misses per 100", "difference"),
            tuple(
                (
                    each.camera,
                    f"{each.covered_share:.0%}",
                    f"{each.expected_misses_per_100:.2f}",
                    f"{each.difference_per_100:+.2f}",
                )
                for each in self.cameras
            ),
            f"Soiled in one camera: a {self._words} around {column:.0%} of the width and {row:.0%} of the height. The "
            f"clean rig is expected to miss {self.expected_misses_per_100:.2f} of 100.",
        )

    @property
    def _words(self) -> str:
        return "disc" if self.part.shape == "disc" else f"band of {self.part.shape}"

    @classmethod
    def of(
        cls, rig: PosedRig, scenes: Sequence[Scene], part: SoiledPart, *, progress: Progress | None = None
    ) -> Soiling:
        """Render a rig's cameras clean and soiled."""
        cameras = rig.cameras
        if cameras.occlusion is not Occlusion.EXACT:
            raise InputError(
                f"visibility.occlusion: expected exact for dirt to hide something, got {cameras.occlusion.value}"
            )
        _check_objects(scenes)
        standing = cameras.mount.rig(np.asarray(rig.mount_pose, np.float32)).cameras
        pose, side = cameras.apart(np.asarray(rig.mount_pose, np.float32))
        share = shares_of(rig.weight)

        def detected(camera: int, scene: Scene) -> np.ndarray:
            single = cameras.sides[side[camera]]
            return single.detection_probability(pose[camera : camera + 1], _packed(scene, cameras))[0]

        clean, soiled = [], []
        for scene in (progress or NullProgress()).steps("soiled cameras", scenes, count=len(scenes)):
            clean.append(_detected(cameras, pose, side, _packed(scene, cameras)))
            soiled.append([detected(k, soiled_scene(scene, each, part)) for k, each in enumerate(standing)])
        plain, dirty = np.concatenate(clean, axis=1), np.concatenate(soiled, axis=1)
        nominal = _perturb(plain, share=share)
        found = []
        for k, (name, each) in enumerate(zip(rig.names, standing, strict=True)):
            missed = _perturb(plain, {k: dirty[k]}, share)
            found.append(_SoiledCamera(name, part.covered_share(each.model), missed, missed - nominal))
        return cls(part, nominal, tuple(found))


# ------------------------------------------------------------------------------------------------------------ loads


@dataclass(frozen=True)
class LoadState:
    """How a load moves the vehicle, with its cameras, against the world."""

    pitch_deg: float = 0.0
    height_m: float = 0.0

    def __post_init__(self) -> None:
        if not abs(self.pitch_deg) <= _PITCH_LIMIT_DEG:
            raise ArgumentError("pitch_deg", f"expected an angle within {_PITCH_LIMIT_DEG:g}, got {self.pitch_deg!r}")
        if not math.isfinite(self.height_m):
            raise ArgumentError("height_m", f"expected a finite number, got {self.height_m!r}")

    @property
    def ground_from_ego(self) -> np.ndarray:
        """From the ego frame under the load to that without one, float64 [4, 4]."""
        transform = np.eye(4)
        transform[:3, :3] = rotation_from_yaw_pitch_roll(0.0, math.radians(self.pitch_deg), 0.0)
        transform[2, 3] = self.height_m
        return transform


def loaded_scene(scene: Scene, state: LoadState) -> Scene:
    """The scene as a vehicle under a load has it in its frame: the vehicle stays, all else moves.

    Boxes stay upright and as large, with their middle and heading moved. So does the sky, whose colours change with
    elevation.
    """
    ground_from_ego = state.ground_from_ego
    rotation, offset_m = ground_from_ego[:3, :3], ground_from_ego[:3, 3]

    def moved(mesh: Mesh) -> Mesh:
        return mesh.transformed(rotation.T, -rotation.T @ offset_m)

    def user(each: Vehicle) -> Vehicle:
        heading = np.array([math.cos(each.box.yaw_rad), math.sin(each.box.yaw_rad), 0.0]) @ rotation
        centre_m = (np.asarray(each.box.center_m) - offset_m) @ rotation
        box = Box(centre_m, each.box.size_m, math.atan2(heading[1], heading[0]))
        return replace(each, mesh=moved(each.mesh), box=box)

    return replace(
        scene,
        environment=moved(scene.environment),
        vehicles=tuple(user(each) for each in scene.vehicles),
        others=tuple(user(each) for each in scene.others),
    )


@dataclass(frozen=True)
class _LoadedRig:
    name: str
    state: LoadState
    expected_misses_per_100: float
    difference_per_100: float


@dataclass(frozen=True)
class LoadStates:
    """What loads cost a rig, weighted where objects have weights; the weights are those without a load."""

    expected_misses_per_100: float
    states: tuple[_LoadedRig, ...]

    @property
    def worst(self) -> _LoadedRig:
        """The load that costs most; of equal ones the first."""
        return max(self.states, key=lambda each: each.difference_per_100)

    def to_json(self) -> dict[str, Any]:
        return {**asdict(self), "worst": self.worst.name}

    def table(self) -> Table:
        """What each load costs: text when printed, HTML in a notebook."""
        return Table(
            ("load", "pitch [deg]", "height [m]", "expected misses per 100", "difference"),
            tuple(
                (
                    each.name,
                    f"{each.state.pitch_deg:+.1f}",
                    f"{each.state.height_m:+.3f}",
                    f"{each.expected_misses_per_100:.2f}",
                    f"{each.difference_per_100:+.2f}",
                )
                for each in self.states
            ),
            "Pitch is positive nose down. Without a load the rig is expected to miss "
            f"{self.expected_misses_per_100:.2f} of 100.",
        )

    @classmethod
    def of(
        cls,
        rig: PosedRig,
        scenes: Sequence[Scene],
        states: Mapping[str, LoadState],
        *,
        progress: Progress | None = None,
    ) -> LoadStates:
        """Render a rig's cameras without a load and under each."""
        if not states:
            raise ArgumentError("states", "expected at least one load, got none")
        _check_objects(scenes)
        cameras, share = rig.cameras, shares_of(rig.weight)
        pose = np.asarray(rig.mount_pose, np.float32)
        found: list[list[np.ndarray]] = [[] for _ in range(1 + len(states))]
        for scene in (progress or NullProgress()).steps("loads", scenes, count=len(scenes)):
            for rows, changed in zip(
                found, [scene, *(loaded_scene(scene, state) for state in states.values())], strict=True
            ):
                rows.append(cameras.detection_probability(pose, _packed(changed, cameras)))
        nominal, *loaded = (_perturb(np.concatenate(rows, axis=1), share=share) for rows in found)
        return cls(
            nominal,
            tuple(
                _LoadedRig(name, state, missed, missed - nominal)
                for (name, state), missed in zip(states.items(), loaded, strict=True)
            ),
        )


def _packed(scene: Scene, cameras: SingleCameras) -> DeviceScene:
    return DeviceScene.pack(scene, device=cameras.mount.device)


def _check_objects(scenes: Sequence[Scene]) -> None:
    if not any(scene.vehicles for scene in scenes):
        raise ArgumentError("scenes", "expected at least one object, got none")
