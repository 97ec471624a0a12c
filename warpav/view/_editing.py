"""A rig that is edited: cameras put, moved, posed, copied, mirrored, added and removed, and every step undone.

Nothing here draws, and nothing is changed in place: each step gives an `Edit`, a rig with what constraints and rules
say of it, and the history is a row of them.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from warpav.core.errors import InputError
from warpav.optimisation import mirror_image, named_by_direction
from warpav.rig import LEAST_STAND_OFF_M, Rig, RigCamera, write_rig

if TYPE_CHECKING:
    from warpav.optimisation import Constraints
    from warpav.raster.pane import Pane
    from warpav.rig import Module

_NEAR_M = 0.1
"""A place of the skin so near to one that may carry a camera is that one [m]."""

_STANDS_M = 0.5
"""A camera so near to the mount surface stands on it [m]."""

_LEVEL = 0.7
"""Where the part of the skin's normal upwards is greater, a camera that is put there looks away from the middle."""

_ROUND_RAD = math.radians(5.0)
"""To which yaws of cameras that are put are rounded."""

_LEAST_STEP_M = 0.05
"""Between a camera and its copy [m]."""

NUMBERS = ("x_m", "y_m", "z_m", "yaw_deg", "pitch_deg", "roll_deg")
"""What of a camera's pose is typed, in the ego frame [m, deg]."""


class Finding(NamedTuple):
    """What a constraint, a rule or a requirement says of a rig."""

    about: str
    found: str
    asked: str
    is_kept: bool | None  # None: nothing is asked


class RigScore(NamedTuple):
    """What a rig finds in some scenes."""

    expected_per_100: float | None  # road users that it is expected to miss, of 100; None where that is not known
    missed_per_100: float | None  # that the detector misses in all images, at its threshold; None without road users
    objects: int


@dataclass(frozen=True, eq=False)
class Edit:
    """A step: the rig, the camera that it was about, and what is said of the rig."""

    rig: Rig
    camera: int | None
    constraints: Constraints
    judge: Callable[[Rig], Sequence[Finding]] | None

    @cached_property
    def findings(self) -> tuple[Finding, ...]:
        """The worst border and the worst pair by the constraints, then what rules and requirements say."""
        return tuple(self._kept()) + (() if self.judge is None else tuple(self.judge(self.rig)))

    def _kept(self) -> Sequence[Finding]:
        margins = self.constraints.margins(self.rig)
        found = []
        for kind, words in (("border", "Inside of where cameras may stand"), ("spacing", "Closest pair of cameras")):
            of_kind = [each for each in margins if each.kind == kind]
            if of_kind:
                worst = min(of_kind, key=lambda each: each.slack_m)
                value = f"{worst.value_m:.2f} m ({', '.join(worst.cameras)})"
                found.append(Finding(words, value, f"at least {worst.limit_m:.2f} m", worst.is_kept))
        return found


def _other_side(word: re.Match[str]) -> str:
    side = "right" if word[0].lower() == "left" else "left"
    return side.upper() if word[0].isupper() else side.title() if word[0].istitle() else side


class EditedRig:
    """A rig and its history; positions in the ego frame [m].

    While something is dragged its steps are ``held``: together they are one step of the history.
    """

    def __init__(
        self,
        rig: Rig,
        *,
        constraints: Constraints,
        height_offset_m: float = 0.0,
        modules: Sequence[Module] = (),
        judge: Callable[[Rig], Sequence[Finding]] | None = None,
    ) -> None:
        """Begin with a rig; ``height_offset_m`` is how far new cameras stand off a mount surface without zones."""
        self.modules = {module.name: module for module in modules}
        self._constraints, self._surface = constraints, constraints.surface
        self._height_offset_m, self._judge = height_offset_m, judge
        self.edit = Edit(rig, None, constraints, judge)  # the last step
        self.past: tuple[Edit, ...] = ()  # the steps before, the last one last
        self.future: tuple[Edit, ...] = ()  # those that were undone, the last one first
        self._is_held = False

    @property
    def rig(self) -> Rig:
        """The rig as it is now."""
        return self.edit.rig

    def undo(self) -> Edit:
        """Go back by a step; at the beginning nothing happens."""
        if self.past:
            *past, edit = self.past
            self.past, self.future, self.edit = tuple(past), (self.edit, *self.future), edit
        self._is_held = False
        return self.edit

    def redo(self) -> Edit:
        """Take the step again that was undone last; nothing happens where there is none."""
        if self.future:
            edit, *future = self.future
            self.past, self.future, self.edit = (*self.past, self.edit), tuple(future), edit
        return self.edit

    def replace(self, rig: Rig, camera: int | None = None, *, held: bool = False) -> Edit:
        """Go on with another rig."""
        if not self._is_held:
            self.past = (*self.past, self.edit)
        self._is_held, self.future, self.edit = held, (), Edit(rig, camera, self._constraints, self._judge)
        return self.edit

    def put(self, point_m: np.ndarray, outward: np.ndarray, *, like: int = 0, module: str | None = None) -> Edit:
        """Add a camera at a point of the skin with its outward normal, both [3], that looks outwards and level.

        Of the module, or with the image and lens of another of its cameras.
        """
        position_m, pane = self._place(np.asarray(point_m, np.float64), np.asarray(outward, np.float64))
        middle_m = np.array([self._surface.over_ground.bounds_m[:, 0].mean(), 0.0])
        away = outward[:2] if outward[2] < _LEVEL else position_m[:2] - middle_m
        made = dataclasses.replace(
            self.rig.cameras[like],
            position_m=position_m,
            yaw_rad=_ROUND_RAD * round(math.atan2(away[1], away[0]) / _ROUND_RAD),
            pitch_rad=0.0,
            roll_rad=0.0,
            behind_glass=pane,
        )
        [named] = named_by_direction([made if module is None else self._of_module(made, module)])
        return self._added(named, named.name)

    def move(self, camera: int, point_m: np.ndarray, outward: np.ndarray | None = None, *, held: bool = False) -> Edit:
        """Move a camera to a point [3], or to a place [2] on a mount surface without zones; other cameras stay.

        A point of the skin comes with its outward normal: on the mount surface the camera keeps its height above it,
        elsewhere it stands just off the skin. Without a normal it goes to the nearest place of the mount surface.
        """
        old = self.rig.cameras[camera]
        wanted_m = np.array([*np.asarray(point_m, np.float64), old.position_m[2]])[:3]
        position_m, pane = self._place(wanted_m, outward, old)
        return self._with(camera, dataclasses.replace(old, position_m=position_m, behind_glass=pane), held=held)

    def pose(self, camera: int, **numbers: float) -> Edit:
        """Set some of `NUMBERS`; what is typed is taken as it is, and constraints say what they think of it."""
        old = self.rig.cameras[camera]
        angles_deg = np.degrees([old.yaw_rad, old.pitch_rad, old.roll_rad])
        known = dict(zip(NUMBERS, [*old.position_m.tolist(), *angles_deg.tolist()], strict=True))
        if strange := numbers.keys() - known.keys():
            raise ValueError(f"expected some of {', '.join(NUMBERS)}, got {', '.join(strange)}")
        *position_m, yaw_deg, pitch_deg, roll_deg = (known | numbers).values()
        angles = {"yaw_rad": yaw_deg, "pitch_rad": pitch_deg, "roll_rad": roll_deg}
        changes: dict[str, Any] = {
            name: math.remainder(math.radians(angle_deg), math.tau) if math.isfinite(angle_deg) else angle_deg
            for name, angle_deg in angles.items()
        }
        moved = dataclasses.replace(old, position_m=np.array(position_m))
        if not np.array_equal(moved.position_m, old.position_m):
            changes |= {"position_m": moved.position_m, "behind_glass": self._pane_at(moved.position_m)}
        return self._with(camera, dataclasses.replace(old, **changes))

    def set_module(self, camera: int, name: str) -> Edit:
        """Put another module in a camera's place; position, angles and near plane stay."""
        return self._with(camera, self._of_module(self.rig.cameras[camera], name))

    def copy(self, camera: int) -> Edit:
        """Add the same camera again, at the nearest free place beside it."""
        old, taken_m = self.rig.cameras[camera], np.array([each.position_m for each in self.rig.cameras])
        spacing_m = max(self._constraints.min_spacing_m, _LEAST_STEP_M)
        angle = np.arange(8) * math.tau / 8
        steps = np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=1)
        for length_m, step in itertools.product(1.01 * spacing_m * np.arange(1, 9), steps):
            wanted_m = old.position_m + length_m * step
            position_m, pane = self._place(wanted_m, None, old) if self._is_on(old.position_m) else (wanted_m, None)
            if np.linalg.norm(taken_m - position_m, axis=1).min() >= spacing_m:
                return self._added(dataclasses.replace(old, position_m=position_m, behind_glass=pane), old.name)
        raise InputError(f"camera {old.name!r}: expected room for a copy beside it, got none; move other cameras away")

    def mirror(self, camera: int) -> Edit:
        """Make the camera's mirror image on the other side, in place of the camera that has its name.

        Names have left and right exchanged.

        Raises:
            InputError: It stands in the middle and looks straight on.
        """
        old = self.rig.cameras[camera]
        image = mirror_image(old)
        if np.abs(image.ego_from_camera - old.ego_from_camera).max() < _LEAST_STEP_M:
            raise InputError(f"camera {old.name!r}: expected one aside of the middle, as it is its own mirror image")
        name = re.sub("left|right", _other_side, old.name, flags=re.IGNORECASE)
        names = [each.name for each in self.rig.cameras]
        if image.behind_glass is not None:
            image = dataclasses.replace(image, behind_glass=self._pane_at(image.position_m) or image.behind_glass)
        if name != old.name and name in names:
            return self._with(names.index(name), dataclasses.replace(image, name=name))
        return self._added(image, name if name != old.name else f"{old.name}_mirrored")

    def remove(self, camera: int) -> Edit:
        """Take a camera away.

        Raises:
            InputError: It is the last.
        """
        if len(self.rig.cameras) == 1:
            raise InputError("rig: expected at least one camera to stay, got the last one to remove")
        return self.replace(Rig(each for k, each in enumerate(self.rig.cameras) if k != camera))

    def foot_m(self, camera: int) -> np.ndarray:
        """Where on the skin a camera stands [m], [3]; itself where it does not stand on the mount surface."""
        position_m = self.rig.cameras[camera].position_m
        if not self._is_on(position_m):
            return position_m
        place_m, _ = self._surface.place_of(position_m)
        return self._surface.point_m(place_m, float(self._surface.height_at_m(place_m[None])[0]))

    def save(self, path: Path | str) -> Path:
        """Write the rig as it is now."""
        write_rig(self.rig, path)
        return Path(path)

    def _with(self, camera: int, new: RigCamera, *, held: bool = False) -> Edit:
        cameras = list(self.rig.cameras)
        cameras[camera] = new
        return self.replace(Rig(cameras), camera, held=held)

    def _added(self, camera: RigCamera, name: str) -> Edit:
        taken = {each.name.casefold() for each in self.rig.cameras}
        stem = re.sub(r"_\d+$", "", name)
        names = itertools.chain([name], (f"{stem}_{number}" for number in itertools.count(2)))
        free = next(each for each in names if each.casefold() not in taken)
        return self.replace(Rig([*self.rig.cameras, dataclasses.replace(camera, name=free)]), len(self.rig.cameras))

    def _of_module(self, camera: RigCamera, name: str) -> RigCamera:
        if name not in self.modules:
            raise InputError(f"module: expected one of {', '.join(self.modules) or 'no module'}, got {name!r}")
        module = self.modules[name]
        model = dataclasses.replace(module.camera_model(), near_m=camera.model.near_m)
        return dataclasses.replace(camera, model=model, module=name, housing=module.housing)

    def _is_on(self, point_m: np.ndarray) -> bool:
        place_m, above_m = self._surface.place_of(self._surface.left_of(point_m))
        return bool(self._constraints.contains(place_m[None])[0]) and abs(float(above_m)) <= _STANDS_M

    def _pane_at(self, point_m: np.ndarray) -> Pane | None:
        place_m, above_m = self._surface.place_of(point_m)
        return self._surface.panes_at(place_m[None])[0] if above_m < 0.0 and self._is_on(point_m) else None

    def _place(
        self, wanted_m: np.ndarray, outward: np.ndarray | None, old: RigCamera | None = None
    ) -> tuple[np.ndarray, Pane | None]:
        surface = self._surface
        at_m = self._constraints.project(surface.place_of(surface.left_of(wanted_m))[0][None])[0]
        foot_m = surface.point_m(at_m, float(surface.height_at_m(at_m[None])[0]))
        if outward is not None and math.dist(foot_m, surface.left_of(wanted_m)) > _NEAR_M:
            return wanted_m + LEAST_STAND_OFF_M * outward, None
        above_m = self._height_offset_m
        if old is not None and self._is_on(old.position_m):
            above_m = float(surface.place_of(surface.left_of(old.position_m))[1])
        if surface.zones:
            above_m = float(np.clip(above_m, *surface.zones[int(surface.zone_at(at_m))].rise_m))
        [pane] = surface.panes_at(at_m[None])
        point_m = surface.point_m(at_m, float(surface.height_at_m(at_m[None])[0]) + above_m)
        if any(surface.pairs) and wanted_m[1] < 0.0:  # what is on the left stands for both sides
            return point_m * [1.0, -1.0, 1.0], pane and pane.mirrored()
        return point_m, pane
