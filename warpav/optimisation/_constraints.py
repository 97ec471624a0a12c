"""Where cameras may stand: on the mount surface, and apart from each other."""

from __future__ import annotations

import copy
import itertools
import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp
from scipy import sparse

from warpav.core.errors import OptionError
from warpav.optimisation._mount import HEIGHT_DELTA_M, X_M, Y_M, FrozenCameras, PlacedViews
from warpav.rig import MountSurface, Rig, RigCamera
from warpav_kernels.placement import constraint_losses

if TYPE_CHECKING:
    from scipy.spatial import KDTree

_PROJECTION_ROUNDS = 200
_SHAKE_EVERY = 20  # rounds
_RANDOM_TRIES = 1000

# a rig file keeps micrometres; what is smaller is rounding, not a violation
_ROUNDING_M = 1e-6
_SLOPE_STEP_M = 1e-6


@dataclass(frozen=True)
class Margin:
    kind: str  # ``border``, the distance of a camera to the border of where it may stand, negative outside
    cameras: tuple[str, ...]  # names of the cameras
    value_m: float  # the distance [m]
    limit_m: float  # what it has to be at least [m]
    slack_m: float  # by how much it is more [m]; negative where the constraint is broken
    is_kept: bool  # whether it holds, but for the rounding of rig files

    @classmethod
    def of(cls, kind: str, cameras: Sequence[RigCamera], value_m: float, limit_m: float) -> Margin:
        slack_m = float(value_m) - limit_m
        names = tuple(camera.name for camera in cameras)
        return cls(kind, names, float(value_m), limit_m, slack_m, slack_m >= -_ROUNDING_M)


class Constraints(ABC):
    """What a rig must satisfy. A kind of constraints says which places are allowed, and what a violation costs."""

    are_inequalities: bool  # whether the losses are inequalities g <= 0 [m], negative where there is room to spare

    def __init__(
        self,
        surface: MountSurface,
        *,
        min_spacing_m: float,
        frozen: FrozenCameras | None = None,
        module: np.ndarray | None = None,
    ) -> None:
        """Constraints on a surface. ``module`` int [camera]."""
        self.surface = surface  # what the cameras stand on
        self.min_spacing_m = min_spacing_m  # least distance between two camera centres [m]
        self.margin_m = 0.0  # least distance of a camera's centre to the border of where it may stand [m]
        self.frozen = frozen
        self.module = module

    @property
    def of_single_cameras(self) -> Constraints:
        """The same for cameras none of which is frozen; projections and slacks alone, which take any number of them."""
        constraints = self.of_any_modules
        constraints.frozen = None
        return constraints

    @property
    def of_any_modules(self) -> Constraints:
        """The same for rigs whose cameras are of whatever modules: each stays the one that it is."""
        constraints = copy.copy(self)
        constraints.module = None
        return constraints

    @property
    @abstractmethod
    def names(self) -> tuple[str, ...]:
        """Names of the losses in their order; every one has a multiplier of its own."""

    @abstractmethod
    def losses_of(self, views: PlacedViews, rotation_count: int) -> wp.array:
        """The losses in the order of `names`, float [constraint], on the active tape, from the mount pose."""

    @abstractmethod
    def contains(self, place_m: np.ndarray) -> np.ndarray:
        """Which places [..., 2] [m] may hold a camera that is alone; bool [...]."""

    @abstractmethod
    def do_not_fit(self, camera_count: int) -> OptionError:
        """The error for more cameras than there is room for."""

    def violation_m(self, rig: Rig) -> float:
        """All excess over the borders plus all missing spacing [m]; frozen cameras break none by themselves."""
        violation = sum(max(-each.slack_m, 0.0) for each in self.margins(rig))
        return violation if violation > _ROUNDING_M else 0.0

    def slack_m(self, place_m: np.ndarray, height_delta_m: np.ndarray) -> np.ndarray:
        """By how much cameras keep more than they must [m]: borders, then pairs, without those of frozen ones alone."""
        place, height_delta = np.array(place_m, np.float64), np.array(height_delta_m, np.float64)
        is_frozen = self._put_frozen(place, height_delta)
        point_m = self._point_m(place, height_delta)
        one, other = np.triu_indices(len(place), 1)
        counts = ~(is_frozen[one] & is_frozen[other])
        apart_m = np.linalg.norm(point_m[one[counts]] - point_m[other[counts]], axis=-1)
        border_m = self._border_distance_m(place[~is_frozen])
        return np.concatenate([border_m - self.margin_m, apart_m - self.min_spacing_m])

    def slack_slope(self, place_m: np.ndarray, height_delta_m: np.ndarray) -> np.ndarray:
        """The slope of `slack_m` to x, y and height, float64 [constraint, camera, 3]; of rasters by differences."""
        place, height_delta = np.array(place_m, np.float64), np.array(height_delta_m, np.float64)
        is_frozen = self._put_frozen(place, height_delta)
        count = len(place)
        step_m = _SLOPE_STEP_M * np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
        around = (place[:, None] + step_m).reshape(-1, 2)

        def differences(value: np.ndarray) -> np.ndarray:
            """Slopes to x and y from values around every place, [place, 2]."""
            value = value.reshape(count, 2, 2)
            return (value[..., 0] - value[..., 1]) / (2.0 * _SLOPE_STEP_M)

        free = np.flatnonzero(~is_frozen)
        borders = np.zeros((len(free), count, 3))
        borders[np.arange(len(free)), free, :2] = differences(self._border_distance_m(around))[free]
        rise = differences(self.surface.height_at_m(around))
        point_m = self._point_m(place, height_delta)
        axes = self.surface.axes[self.surface.zone_at(place)]
        one, other = np.triu_indices(count, 1)
        counts = ~(is_frozen[one] & is_frozen[other])
        one, other = one[counts], other[counts]
        apart = point_m[one] - point_m[other]
        apart /= np.maximum(np.linalg.norm(apart, axis=-1, keepdims=True), 1e-9)
        pairs = np.zeros((len(one), count, 3))
        for camera, sign in ((one, 1.0), (other, -1.0)):
            # along the axes of the zone that the camera is in
            along = np.einsum("pij,pj->pi", axes[camera], apart)
            pairs[np.arange(len(one)), camera, :2] = sign * (along[:, :2] + along[:, 2:] * rise[camera])
            pairs[np.arange(len(one)), camera, 2] = sign * along[:, 2]
        slope = np.concatenate([borders, pairs])
        slope[:, is_frozen] = 0.0
        return slope

    def margins(self, rig: Rig) -> list[Margin]:
        """How far a rig is from breaking each constraint: borders, then pairs, without those of frozen ones alone."""
        position_m = np.array([camera.position_m for camera in rig.cameras])
        is_frozen = self._stands_frozen(position_m)
        place_m, _ = self.surface.place_of(self.surface.left_of(position_m), self.surface.carriers_of(rig.cameras))
        border_m = self._border_distance_m(place_m)
        free = [
            Margin.of("border", [camera], border_m[k], self.margin_m)
            for k, camera in enumerate(rig.cameras)
            if not is_frozen[k]
        ]
        pairs = [
            Margin.of("spacing", [one, other], math.dist(one.position_m, other.position_m), self.min_spacing_m)
            for (i, one), (j, other) in itertools.combinations(enumerate(rig.cameras), 2)
            if not (is_frozen[i] and is_frozen[j])
        ]
        return free + pairs

    def project(self, place_m: np.ndarray, height_delta_m: np.ndarray | None = None) -> np.ndarray:
        """Near places that satisfy the constraints, float64 [camera, 2]: into the borders and apart, in turns.

        Places that satisfy them are returned as they are; frozen cameras stand where they are frozen.
        """
        place = np.array(place_m, np.float64)
        height_delta = np.zeros(len(place)) if height_delta_m is None else np.array(height_delta_m, np.float64)
        is_frozen = self._put_frozen(place, height_delta)
        module = self.module if self.module is not None and len(self.module) == len(place) else None
        wanted_m = self.min_spacing_m + 1e-5  # the numbers that follow are rounded to float32
        rng = np.random.default_rng(0)
        for projection_round in range(1, _PROJECTION_ROUNDS + 1):
            if projection_round % _SHAKE_EVERY == 0:
                # cameras on one line, such as an edge of the surface, would push each other along it for ever
                shaken = rng.uniform(-0.5, 0.5, place.shape) * self.min_spacing_m
                place[~is_frozen] += shaken[~is_frozen]
            place[~is_frozen] = self._brought_in(place[~is_frozen], None if module is None else module[~is_frozen])
            moved = False
            for i, j in itertools.combinations(range(len(place)), 2):
                if is_frozen[i] and is_frozen[j]:
                    continue
                points = self._point_m(place[[i, j]], height_delta[[i, j]])
                if math.dist(points[0], points[1]) >= self.min_spacing_m + 1e-6:
                    continue
                if len(set(self.surface.zone_at(place[[i, j]]).tolist())) > 1:
                    self._part_zones(place, i, j, points, is_frozen)
                    moved = True
                    continue
                distance, direction = _length_and_direction(place[j] - place[i])
                push = (wanted_m - distance) * direction
                # a frozen one stays, and the other one goes the whole way
                place[i] -= (0.0 if is_frozen[i] else 1.0 if is_frozen[j] else 0.5) * push
                place[j] += (0.0 if is_frozen[j] else 1.0 if is_frozen[i] else 0.5) * push
                moved = True
            if not moved:
                return place
        raise self.do_not_fit(len(place))

    def _point_m(self, place: np.ndarray, height_delta: np.ndarray) -> np.ndarray:
        """Points of the ego frame [camera, 3] [m] of cameras that stand so far above the surface."""
        return self.surface.point_m(place, self.surface.height_at_m(place) + height_delta)

    def _part_zones(self, place: np.ndarray, i: int, j: int, point_m: np.ndarray, is_frozen: np.ndarray) -> None:
        """Push two cameras of different zones apart, each along its own plane."""
        between = point_m[1] - point_m[0]
        missing_m = self.min_spacing_m + 1e-5 - float(np.linalg.norm(between))
        for k, sign in ((i, -1.0), (j, 1.0)):
            if not is_frozen[k]:
                along = (self.surface.axes[self.surface.zone_at(place[k])] @ between)[:2]
                place[k] += sign * missing_m * _length_and_direction(along)[1]

    def nearest_place(self, place_m: np.ndarray) -> np.ndarray:
        """The nearest places [camera, 2] [m] where cameras that are alone may stand, float64."""
        return self._brought_in(np.array(place_m, np.float64))

    def random_place(self, camera_count: int, rng: np.random.Generator) -> np.ndarray:
        """Places that satisfy the constraints, uniform among all that do. Returns x and y [m], float64 [camera, 2]."""
        for _ in range(_RANDOM_TRIES):
            place = self._drawn(camera_count, rng)
            self._put_frozen(place, np.zeros(camera_count))
            if (self.slack_m(place, np.zeros(camera_count)) >= 0.0).all():
                return place
        raise self.do_not_fit(camera_count)

    def _put_frozen(self, place: np.ndarray, height_delta: np.ndarray) -> np.ndarray:
        """Put frozen cameras into positions [camera, 2] and height deltas [camera]; returns which these are."""
        frozen = self.frozen
        if frozen is None:
            return np.zeros(len(place), bool)
        place[frozen.is_frozen] = frozen.mount_pose[frozen.is_frozen][:, [X_M, Y_M]]
        height_delta[frozen.is_frozen] = frozen.mount_pose[frozen.is_frozen, HEIGHT_DELTA_M]
        return frozen.is_frozen

    def _stands_frozen(self, position_m: np.ndarray) -> np.ndarray:
        """Which cameras stand exactly where some are frozen, bool [camera]; position_m [camera, 3]."""
        if self.frozen is None:
            return np.zeros(len(position_m), bool)
        offset_m = position_m[:, None] - self.frozen.position_m
        return (np.linalg.norm(offset_m, axis=-1) <= _ROUNDING_M).any(axis=1)

    @abstractmethod
    def _border_distance_m(self, place: np.ndarray) -> np.ndarray:
        """Distance of places [camera, 2] to the border of where a camera may stand [m], [camera]; negative outside."""

    @abstractmethod
    def _brought_in(self, place: np.ndarray, module: np.ndarray | None = None) -> np.ndarray:
        """The nearest places within the borders, float64 [camera, 2], with room for the rounding to float32."""

    @abstractmethod
    def _drawn(self, camera_count: int, rng: np.random.Generator) -> np.ndarray:
        """Places within the borders, uniform and independent, float64 [camera, 2]."""


class ZoneAndSpacing(Constraints):
    """The default method's: inside the mountable zone, and apart; one inequality for every camera and every pair."""

    are_inequalities = True

    def __init__(
        self,
        surface: MountSurface,
        *,
        camera_count: int,
        min_spacing_m: float = 0.2,
        margin_m: float = 0.0,
        frozen: FrozenCameras | None = None,
        module: np.ndarray | None = None,
    ) -> None:
        """Constraints for rigs of ``camera_count`` cameras."""
        super().__init__(surface, min_spacing_m=min_spacing_m, frozen=frozen, module=module)
        self.camera_count = camera_count
        self.margin_m = margin_m
        widest_m = float(surface.border_distance_m.max())
        if widest_m < self._kept_m:
            raise OptionError(
                "mount.margin_m",
                f"expected less than {widest_m:.3g} m, the largest distance to the border of the mountable zone, "
                f"got {margin_m:g}",
            )
        self._arrays: dict[str, tuple[wp.array, wp.array]] = {}
        self._borders: dict[int, tuple[np.ndarray, KDTree]] = {}

    @property
    def names(self) -> tuple[str, ...]:
        """``zone_<camera>``, then ``spacing_<camera>_<camera>``, as in `Constraints`; none of frozen cameras alone."""
        cameras, is_frozen = range(self.camera_count), self._is_held
        zone = (f"zone_{camera}" for camera in cameras if not is_frozen[camera])
        pairs = itertools.combinations(cameras, 2)
        return (*zone, *(f"spacing_{i}_{j}" for i, j in pairs if not (is_frozen[i] and is_frozen[j])))

    @property
    def _is_held(self) -> np.ndarray:
        return np.zeros(self.camera_count, bool) if self.frozen is None else self.frozen.is_frozen

    def _on_device(self, device: Any) -> tuple[wp.array, wp.array]:  # noqa: ANN401 (Warp's)
        """The distances to the border, and the losses that count; copied to a device once."""
        if (key := str(device)) not in self._arrays:
            is_frozen = self._is_held
            pairs = np.array(list(itertools.combinations(range(self.camera_count), 2)), int).reshape(-1, 2)
            kept = np.flatnonzero(~np.concatenate([is_frozen, is_frozen[pairs].all(axis=1)]))
            self._arrays[key] = (
                wp.array(self.surface.border_distance_m, dtype=float, device=device),
                wp.array(kept, dtype=wp.int32, device=device),
            )
        return self._arrays[key]

    def losses_of(self, views: PlacedViews, rotation_count: int) -> wp.array:
        """Inequalities g <= 0 [m], as in `Constraints`: how far outside the zone, how much too close."""
        device = views.mount_pose.device
        border_distance_m, kept = self._on_device(device)
        count = self.camera_count * (self.camera_count + 1) // 2
        excess_m = wp.zeros(count, dtype=float, device=device, requires_grad=True)
        wp.launch(
            constraint_losses.zone_excess_kernel,
            dim=self.camera_count,
            inputs=[
                views.mount_pose,
                border_distance_m,
                wp.vec2(*self.surface.origin_m),
                self.surface.cell_m,
                self.margin_m,
            ],
            outputs=[excess_m],
            device=device,
        )
        wp.launch(
            constraint_losses.spacing_excess_kernel,
            dim=1,
            inputs=[views.position_ego_m, rotation_count, self.min_spacing_m],
            outputs=[excess_m],
            device=device,
        )
        if self.frozen is None:
            return excess_m
        kept_m = wp.zeros(len(self.names), dtype=float, device=device, requires_grad=True)
        wp.launch(
            constraint_losses.keep_excess_kernel,
            dim=len(kept_m),
            inputs=[excess_m, kept],
            outputs=[kept_m],
            device=device,
        )
        return kept_m

    def contains(self, place_m: np.ndarray) -> np.ndarray:
        return self.surface.zone_distance_m(place_m) >= self.margin_m

    def do_not_fit(self, camera_count: int) -> OptionError:
        area_m2 = np.count_nonzero(self.surface.border_distance_m >= self.margin_m) * self.surface.cell_m**2
        return do_not_fit(f"the mountable zone of {area_m2:.2f} m²", self.min_spacing_m, camera_count)

    @property
    def _kept_m(self) -> float:
        """The distance to the border that projected places keep [m], with room for the rounding to float32."""
        return self.margin_m + 1e-6

    def _border_distance_m(self, place: np.ndarray) -> np.ndarray:
        return self.surface.zone_distance_m(place)

    def _brought_in(self, place: np.ndarray, module: np.ndarray | None = None) -> np.ndarray:
        place = place.copy()
        of_module = np.full(len(place), -1) if module is None else module
        is_elsewhere = (of_module >= 0) & (self.surface.module_at(place) != of_module)
        is_outside = (self.surface.zone_distance_m(place) < self._kept_m) | is_elsewhere
        for number in np.unique(of_module[is_outside]):
            which = is_outside & (of_module == number)
            outside = place[which]
            # the nearest place of a fine grid is near the nearest of all; uphill lies the nearest of all, as a rule
            border_places, tree = self._border(int(number))
            _, nearest = tree.query(outside)
            inside = np.stack([border_places[nearest], self._uphill(outside)])
            found = self._first_inside(outside, inside)
            if number >= 0:
                found[0] = border_places[nearest]  # the way there may lead through zones of other modules
                found[1, self.surface.module_at(np.nan_to_num(found[1], posinf=0.0)) != number] = np.inf
            is_uphill_nearer = np.less(*np.linalg.norm(found - outside, axis=-1)[::-1])
            place[which] = np.where(is_uphill_nearer[:, None], found[1], found[0])
        return place

    def _uphill(self, place: np.ndarray) -> np.ndarray:
        """Places reached by going up the distance to the border; most of them are inside."""
        step_m = 0.25 * self.surface.cell_m
        reached = place.copy()
        look = step_m * np.array([[0.0, 0.0], [1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
        for _ in range(8):
            here, *around = self.surface.zone_distance_m(reached + look[:, None])
            if (here >= self._kept_m).all():
                break
            along = np.stack([around[0] - around[1], around[2] - around[3]], axis=-1)
            along /= np.maximum(np.linalg.norm(along, axis=-1, keepdims=True), 1e-12)
            reached += 1.001 * np.maximum(self._kept_m - here, 0.0)[:, None] * along
        return reached

    def _first_inside(self, outside: np.ndarray, inside: np.ndarray) -> np.ndarray:
        """The first place inside on the way from outside to inside, shape [..., 2]; inf where that is not inside."""
        is_inside = self.surface.zone_distance_m(inside) >= self._kept_m
        low, high = np.zeros(is_inside.shape), np.ones(is_inside.shape)
        for _ in range(24):  # to less than a micrometre
            share = 0.5 * (low + high)
            is_far = self.surface.zone_distance_m(outside + share[..., None] * (inside - outside)) >= self._kept_m
            low, high = np.where(is_far, low, share), np.where(is_far, share, high)
        # at the whole way rounding must not lead past the end
        met = np.where((high < 1.0)[..., None], outside + high[..., None] * (inside - outside), inside)
        return np.where(is_inside[..., None], met, np.inf)

    def _border(self, module: int) -> tuple[np.ndarray, KDTree]:
        """Places all along the border of a module's zones (-1: of all), just inside [m], [place, 2]; and their tree."""
        from scipy.spatial import KDTree

        if module not in self._borders:
            place = self._border_places() if module < 0 else self._border(-1)[0]
            place = place if module < 0 else place[self.surface.module_at(place) == module]
            self._borders[module] = place, KDTree(place)
        return self._borders[module]

    def _border_places(self) -> np.ndarray:
        """Places of a fine grid all along the border, in squares between cells that it can lead through, [place, 2]."""
        surface = self.surface
        corners = np.lib.stride_tricks.sliding_window_view(surface.border_distance_m, (2, 2))
        low_m, high_m = corners.min(axis=(2, 3)), corners.max(axis=(2, 3))
        square = np.argwhere((high_m >= self._kept_m) & (low_m <= self._kept_m + surface.cell_m))
        fine = (4 * square[:, None] + np.indices((5, 5)).reshape(2, -1).T).reshape(-1, 2)
        place = surface.origin_m + np.unique(fine, axis=0) * (0.25 * surface.cell_m)
        distance_m = surface.zone_distance_m(place)
        return place[(distance_m >= self._kept_m) & (distance_m <= self._kept_m + surface.cell_m)]

    def _drawn(self, camera_count: int, rng: np.random.Generator) -> np.ndarray:
        if self.module is not None and len(self.module) == camera_count:
            return np.concatenate([self._drawn_within(1, rng, int(module)) for module in self.module])
        return self._drawn_within(camera_count, rng, -1)

    def _drawn_within(self, camera_count: int, rng: np.random.Generator, module: int) -> np.ndarray:
        """Places in the zones of a module, -1: in all, float64 [camera, 2]."""
        place = np.zeros((0, 2))
        bounds_m = self.surface.bounds_m if module < 0 else self.surface.bounds_of(module)
        while len(place) < camera_count:
            drawn = rng.uniform(*bounds_m, size=(4 * camera_count, 2))
            inside = self.contains(drawn)
            if module >= 0:
                inside &= self.surface.module_at(drawn) == module
            place = np.concatenate([place, drawn[inside]])
        return place[:camera_count]


def min_camera_distance_m(position_m: np.ndarray) -> float:
    """Smallest distance between two of the points [camera, 3] [m]; inf for a single camera."""
    return min((math.dist(a, b) for a, b in itertools.combinations(position_m, 2)), default=math.inf)


def _length_and_direction(along_m: np.ndarray) -> tuple[float, np.ndarray]:
    """Of a vector; what stands at one point parts along x."""
    length_m = float(np.linalg.norm(along_m))
    return length_m, along_m / length_m if length_m > 1e-9 else np.array([1.0, 0.0])


def do_not_fit(where: str, min_spacing_m: float, camera_count: int) -> OptionError:
    return OptionError(
        "rig.cameras",
        f"expected a number that fits on {where} at rig.min_spacing_m={min_spacing_m:g}, got {camera_count}; "
        "lower one of the two",
    )


def too_near(mount_pose: np.ndarray, constraints: Constraints, *, absent: int = 0) -> sparse.csr_array:
    """Which cameras stand too near to each other to be in one rig, bool [camera, camera]; frozen pairs may."""
    from scipy.spatial import KDTree

    place = mount_pose[:, [X_M, Y_M]].astype(np.float64)
    surface = constraints.surface
    point_m = surface.point_m(place, surface.height_at_m(place) + mount_pose[:, HEIGHT_DELTA_M])
    pair = KDTree(point_m).query_pairs(constraints.min_spacing_m, output_type="ndarray")
    held = 0 if constraints.frozen is None else int(constraints.frozen.is_frozen.sum())
    pair = pair[pair.max(axis=1, initial=-1) >= held]
    count = len(mount_pose) + absent
    return sparse.csr_array((np.ones(len(pair), bool), (pair[:, 0], pair[:, 1])), shape=(count, count))
