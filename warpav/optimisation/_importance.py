"""What matters: weights of road users by what they are and where they are.

A road user's weight is the product of four factors: that of its category or kind, that of its distance from the ego
vehicle's origin, that of its azimuth there, and that of its time to collision. Whatever is not set is 1. Means over
objects become weighted means, so only ratios of weights count. The objective and the metrics take the same weights.
"""

from __future__ import annotations

import difflib
from collections.abc import Collection, Iterable, Sequence
from weakref import WeakKeyDictionary

import numpy as np

from warpav.core.errors import OptionError
from warpav.optimisation._settings import ImportanceSettings
from warpav.scene import ROAD_USERS, DeviceScene

_CATEGORIES = ("hatchback", "saloon", "estate", "suv", "car", "van", "lorry", "bus")
"""Categories of vehicles in embedded and captured scenes; files may have others."""


class Importance:
    """Weights of road users, found once for each scene."""

    def __init__(self, settings: ImportanceSettings) -> None:
        self.settings = settings  # what they follow
        self._of_scene: WeakKeyDictionary[DeviceScene, np.ndarray] = WeakKeyDictionary()

    @classmethod
    def of(cls, settings: ImportanceSettings) -> Importance | None:
        """With the settings of a configuration; None where nothing is set, so that all weights are 1."""
        return cls(settings) if settings.is_set else None

    def weights(self, scene: DeviceScene) -> np.ndarray:
        """Weight of every object of a scene, at least 0, float64 [object]."""
        if scene not in self._of_scene:
            kind = [ROAD_USERS[k] for k in scene.road_user_index]
            place_m, time_s = scene.place_ego_m, scene.time_to_collision_s
            self._of_scene[scene] = self.weights_at(scene.category, kind, place_m, time_s)
        return self._of_scene[scene]

    def weights_of(self, scenes: Iterable[DeviceScene]) -> np.ndarray:
        """The same of several scenes, one after the other, float64 [object]."""
        return np.concatenate([np.zeros(0), *map(self.weights, scenes)])

    def weights_at(
        self,
        category: Sequence[str],
        kind: Sequence[str],
        centre_ego_m: np.ndarray,
        time_to_collision_s: np.ndarray | None = None,
    ) -> np.ndarray:
        """Weight of road users whose boxes are at ``centre_ego_m`` [object, 2], at least 0, float64 [object]."""
        place_m = np.asarray(centre_ego_m, np.float64).reshape(-1, 2)
        settings, of_category = self.settings, self.settings.category
        weight = np.array([of_category.get(name.lower(), of_category.get(of_kind, 1.0))
                           for name, of_kind in zip(category, kind, strict=True)], np.float64)  # fmt: skip
        if settings.distance_m:
            first_m, factor = np.array(list(settings.distance_m.items())).T
            weight *= factor[np.searchsorted(first_m, np.hypot(*place_m.T), side="right") - 1]
        if settings.time_to_collision_s and time_to_collision_s is not None:
            first_s, factor = np.array(list(settings.time_to_collision_s.items())).T
            meets = np.isfinite(time_to_collision_s)
            weight[meets] *= factor[np.searchsorted(first_s, time_to_collision_s[meets], side="right") - 1]
        azimuth_deg = np.degrees(np.arctan2(place_m[:, 1], place_m[:, 0]))
        for sector in settings.sector_deg:
            weight[sector.contains(azimuth_deg)] *= sector.weight
        return weight

    def check(self, scenes: Iterable[DeviceScene]) -> None:
        """Make sure that the weights say something of some scenes."""
        scenes = list(scenes)
        check_categories(self.settings, {name.lower() for scene in scenes for name in scene.category})
        weight = self.weights_of(scenes)
        if len(weight) and not weight.any():
            raise OptionError(
                "importance", f"expected a weight above 0 for some road user, got 0 for all {len(weight)} of the scenes"
            )


def check_categories(settings: ImportanceSettings, others: Collection[str] = ()) -> None:
    """Make sure that there are the categories that have weights."""
    known = list(dict.fromkeys([*ROAD_USERS, *_CATEGORIES, *sorted(others)]))
    for name in settings.category:
        if name not in known:
            near = difflib.get_close_matches(name, known, 1, 0.6)
            hint = f"; did you mean {near[0]}?" if near else ""
            raise OptionError("importance.category", f"expected some of {', '.join(known)}, got {name!r}{hint}")
