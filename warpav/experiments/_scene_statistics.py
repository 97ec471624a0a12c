"""What is in scenes: road users by kind, by distance and by how much of them can be seen.

Distances are those of the centres of boxes from the middle of the ego vehicle, seen from above. The visible share is
that of the pixels that a road user would have alone, in images all round from `_EYE_HEIGHT_M` above the middle of the
ego vehicle, the shares of nuScenes. It takes any `Scene`: of the town, of files, of recordings.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from warpav.detection import render_images
from warpav.raster.camera import CameraModel
from warpav.rig import RigCamera
from warpav.scene import ROAD_USERS, Scene

_DISTANCE_EDGES_M = (0.0, 10.0, 20.0, 40.0, 80.0, 200.0)
_VISIBLE_EDGES = (0.0, 0.4, 0.6, 0.8, 1.0)  # edges of the shares of nuScenes: to 40 %, to 60 %, to 80 %, to all
_EYE_HEIGHT_M = 1.8
_SIZE_PX = 768
_VIEWS = 4


@dataclass
class _SceneStatistics:
    scene_count: int = 0
    category: list[str] = field(default_factory=list)
    road_user: list[str] = field(default_factory=list)
    distance_m: list[float] = field(default_factory=list)
    visible_share: list[float] = field(default_factory=list)
    speed_m_s: list[float] = field(default_factory=list)

    def by_kind(self) -> dict[str, float]:
        return {kind: self.road_user.count(kind) / self.scene_count for kind in ROAD_USERS}

    def by_category(self) -> dict[str, float]:
        """Road users a scene by category, the most frequent first."""
        return {name: count / self.scene_count for name, count in Counter(sorted(self.category)).most_common()}

    def by_distance(self, kind: str | None = None) -> dict[str, float]:
        """Share of the road users, 0..1, by distance; of all kinds, or of one."""
        chosen = [d for d, each in zip(self.distance_m, self.road_user, strict=True) if kind in (None, each)]
        return _shares(chosen, (*_DISTANCE_EDGES_M, math.inf), "m")

    def by_visible_share(self) -> dict[str, float]:
        """Share of the road users, 0..1, by visible share; those without a pixel count as not visible at all."""
        return _shares(list(np.nan_to_num(self.visible_share)), _VISIBLE_EDGES, "%", 100.0)

    def table(self) -> list[str]:
        total = len(self.category)
        mean = total / max(self.scene_count, 1)

        def line(title: str, values: dict[str, float], form: str) -> str:
            return f"  {title:22}" + "  ".join(f"{name} {value:{form}}" for name, value in values.items())

        known = [speed for speed in self.speed_m_s if not math.isnan(speed)]
        lines = [
            f"{self.scene_count} scenes, {total} road users, {mean:.1f} a scene",
            line("by kind, a scene", self.by_kind(), ".1f"),
            line("by category, a scene", self.by_category(), ".1f"),
            line("by distance", self.by_distance(), ".0%"),
            line("by visible share", self.by_visible_share(), ".0%"),
        ]
        if known:
            low, middle, high = np.quantile(known, [0.05, 0.5, 0.95])
            lines.append(f"  {'relative speed':22}5 % {low:.0f}  median {middle:.0f}  95 % {high:.0f} m/s")
        return lines


def scene_statistics(scenes: Iterable[Scene], *, device: str = "cpu") -> _SceneStatistics:
    """Count the road users of scenes, those that are no targets too."""
    found = _SceneStatistics()
    for scene in scenes:
        whole = scene.targeting(ROAD_USERS)
        centre_m = scene.ego.bounds_m()[:, :2].astype(np.float64).mean(axis=0)
        found.scene_count += 1
        found.visible_share += _visible_shares_of(whole, device=device).tolist()
        for user in whole.vehicles:
            velocity = user.velocity_ego_m_s
            found.category.append(user.category)
            found.road_user.append(user.road_user)
            found.distance_m.append(float(np.hypot(*(user.box.center_m[:2] - centre_m))))
            found.speed_m_s.append(math.nan if velocity is None else float(np.hypot(*velocity)))
    return found


def _visible_shares_of(scene: Scene, *, device: str = "cpu") -> np.ndarray:
    """Visible share of every target of a scene from above the middle of the ego vehicle, float64 [vehicle]."""
    centre_m = scene.ego.bounds_m()[:, :2].astype(np.float64).mean(axis=0)
    model = CameraModel(_SIZE_PX, _SIZE_PX, math.radians(360.0 / _VIEWS))
    cameras = [
        RigCamera(f"view_{k}", np.array([*centre_m, _EYE_HEIGHT_M]), 2.0 * math.pi * k / _VIEWS, 0.0, 0.0, model)
        for k in range(_VIEWS)
    ]
    views = render_images(scene, cameras, device=device)
    visible, alone = (
        np.sum([getattr(view, name) for view in views], axis=0, dtype=np.float64)
        for name in ("visible_area_px", "amodal_area_px")
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(alone > 0.0, np.minimum(visible / alone, 1.0), np.nan)


def _shares(values: Sequence[float], edges: Sequence[float], unit: str, scale: float = 1.0) -> dict[str, float]:
    """Share of the values between each pair of edges, the last edge included."""
    count = np.histogram(values, edges)[0]
    names = [
        f"over {low * scale:g} {unit}" if math.isinf(high) else f"{low * scale:g}-{high * scale:g} {unit}"
        for low, high in pairwise(edges)
    ]
    return dict(zip(names, count / max(len(values), 1), strict=True))
