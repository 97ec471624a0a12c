"""What an editor of rigs shows beside the rig: rules, a score on some scenes, and searches that begin with the rig.

What these need is imported when they are first asked for, which is after the first picture.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import cache, lru_cache
from typing import TYPE_CHECKING, Any, Literal, TypeVar

import numpy as np

from warpav.core.errors import InputError
from warpav.core.progress import NullProgress
from warpav.core.warp_setup import checked_device
from warpav.detection import expected_miss_rate, shares_of
from warpav.rig import Rig, RigCamera, bodies_of
from warpav.runs._mounts import objective_options, with_shared_model
from warpav.runs._networks import load_detector
from warpav.runs._scene_set import load_scenes
from warpav.scene import DeviceScene, Scene
from warpav.sight import housing_shares
from warpav.view import Finding, RigScore

if TYPE_CHECKING:
    from warpav.optimisation import CameraProbability
    from warpav.raster.camera import CameraModel
    from warpav.raster.mesh import Mesh
    from warpav.runs.config import Config
    from warpav.sight import Rules

_Item = TypeVar("_Item")

_KEPT_SCENES, _KEPT_CAMERAS = 40, 4096
"""Scenes that are held in memory, and cameras of which it is known what they find in a scene."""


_AWAY_M = 0.4
"""How far behind the first camera one more begins [m]."""


def judge_of(source: str, config: Config, ego: Mesh) -> Callable[[Rig], list[Finding]]:
    """What the design rules say of rigs on a vehicle, by the limits for the rig that ``source`` means."""

    @cache
    def limits() -> Rules:
        from warpav.runs._evaluate import limits_for

        return limits_for(source, config)

    def judge(rig: Rig) -> list[Finding]:
        from warpav.runs._check import rule_items

        items = rule_items(rig, ego, limits(), checked_device(config.device))
        return [Finding(each.about, each.found, each.asked, each.is_kept) for each in items]

    return judge


class RigScorer:
    """What rigs find in scenes; of a rig only cameras that are new are rendered and shown to the detector."""

    def __init__(self, config: Config, scene_of: Callable[[int], Scene]) -> None:
        self._config, self._device = config, checked_device(config.device)
        self._packed_of = lru_cache(_KEPT_SCENES)(lambda index: DeviceScene.pack(scene_of(index), device=self._device))
        self._detector = lru_cache(1)(lambda: load_detector(config))
        self._probability_of = lru_cache(_KEPT_SCENES)(self._fitted)
        self._found_by = lru_cache(_KEPT_CAMERAS)(self._seen)

    def _fitted(self, model: CameraModel) -> CameraProbability | None:
        from warpav.optimisation import CameraProbability
        from warpav.runs._detector_fit import ensure_fit

        return CameraProbability.of(self._config.losses, ensure_fit(self._config, camera=model))

    def _seen(
        self, camera: RigCamera, before: tuple[RigCamera, ...], scene: int
    ) -> tuple[np.ndarray, np.ndarray | None]:
        from warpav.optimisation import RigObserver

        options, probability_of = objective_options(self._config), self._probability_of
        packed = self._packed_of(scene)
        if before:
            packed = packed.carrying(bodies_of(Rig(before), packed.raster.foreground_mesh()))
        observer = RigObserver(
            Rig([camera]), self._detector(), options, device=self._device, probability_of=probability_of
        )
        seen = observer.observe(packed)
        probability = seen.detection_probability
        return seen.detected_by_camera[0], None if probability is None else probability[0]

    def __call__(self, rig: Rig, scenes: Sequence[int], breathe: Callable[[], None] = lambda: None) -> RigScore:
        """The score on some scenes; ``breathe`` is called between images, and may raise."""
        from warpav.optimisation import Importance

        found, probability, weight = [], [], []
        importance = Importance.of(self._config.importance)
        cameras, before = rig.cameras, [tuple[RigCamera, ...]()] * len(rig.cameras)
        if objective_options(self._config).cameras_have_bodies:
            pose = np.array([camera.ego_from_camera for camera in cameras])
            share, _ = housing_shares(pose, *zip(*((each.model, each.housing) for each in cameras), strict=True))
            before = [tuple(cameras[k] for k in np.flatnonzero(row)) for row in share]
        for scene in scenes:
            rows = []
            for camera, others in zip(cameras, before, strict=True):
                breathe()
                rows.append(self._found_by(camera, others, scene))
            found.append(np.any([row for row, _ in rows], axis=0))
            known = [row for _, row in rows if row is not None]
            probability.append(np.array(known) if len(known) == len(rows) else None)
            weight.append(None if importance is None else importance.weights(self._packed_of(scene)))
        expected, count = None, sum(map(len, found))
        if count and all(each is not None for each in probability):
            share = shares_of(None if importance is None else np.concatenate(weight))
            expected = 100.0 * expected_miss_rate(np.concatenate(probability, axis=1), share)
        missed = 100.0 * float(1.0 - np.concatenate(found).mean()) if count else None
        return RigScore(expected, missed, count)


class _Told(NullProgress):
    """A progress that tells how far the present stage is."""

    def __init__(self, tell: Callable[[str, float], None]) -> None:
        self._tell = tell

    def stage(self, description: str) -> None:
        self._tell(description, 0.0)

    def steps(self, description: str, items: Iterable[_Item], *, count: int) -> Iterator[_Item]:
        for k, item in enumerate(items):
            self._tell(description, k / max(count, 1))
            yield item


def search_from(
    what: Literal["polish", "one_more"],
    rig: Rig,
    chosen: Sequence[int],
    *,
    tell: Callable[[str, float, Rig | None], None],
    config: Config,
    scenes: Sequence[Scene] | None,
) -> None:
    """Polish a rig, or look for the best place of one more camera; reports every better rig and the progress.

    On the chosen of some scenes, None: of the test scenes of the configuration. A polish keeps mirrored pairs mirrored
    where the rig is symmetric and ``rig.symmetric`` lets it be.

    Raises:
        InputError: The cameras are neither of one model nor all modules, or they cannot be placed.
    """
    from warpav.optimisation import PoolTask, named_by_direction, polish_start
    from warpav.runs._jobs import optimise
    from warpav.runs._placement import Placement

    if scenes is None:
        scenes = list(load_scenes(config, [config.scenes.test_seeds[k] for k in chosen]))
    else:
        scenes = [scenes[k] for k in chosen]
    more = int(what == "one_more")
    names = [camera.name for camera in rig.cameras]
    changes = {
        **_cameras_of(rig, more),
        "optimiser.search": "pool",
        "optimiser.pool_rounds": 0,
        "rig.freeze": [],
        "rig.symmetric": "auto" if config.rig.symmetric and not more else False,  # a new camera is one, not a pair
    }
    config = config.replace(changes)
    rig = with_shared_model(rig, config)
    first = rig.cameras[0]
    added = [replace(first, name="added", position_m=first.position_m - [_AWAY_M, 0.0, 0.0])] * more
    start = Rig([*rig.cameras, *added])
    placement = Placement(scenes, start=start, cameras=len(start.cameras), freeze=names if more else (), config=config)
    progress = _Told(lambda stage, share: tell(stage, share, None))
    placement.prepare(progress)
    if not more:
        pose = placement.mount_pose_of(rig)
        at = np.array([each.ego_from_camera for each in placement.mount.rig(pose).cameras])
        order = [np.abs(at - each.ego_from_camera).sum(axis=(1, 2)).argmin() for each in rig.cameras]
        task = PoolTask.of(placement.objective, placement.train, start=pose, rules=placement.rules)
        for share, pose in polish_start(task):
            found = placement.mount.rig(pose).cameras
            tell("polish", share, Rig(replace(found[k], name=name) for k, name in zip(order, names, strict=True)))
        return
    found = optimise(placement, progress=progress).found
    [new] = named_by_direction([each for each in found.cameras if each.name not in names])
    taken = [name for name in names if name == new.name or name.startswith(f"{new.name}_")]
    name = f"{new.name}_{len(taken) + 1}" if taken else new.name
    tell("polish", 1.0, Rig([*rig.cameras, replace(new, name=name)]))


def _cameras_of(rig: Rig, more: int) -> dict[str, Any]:
    """Options by which the cameras of a configuration are those of a rig, and so many more of the same."""
    modules, models = {each.module for each in rig.cameras}, {each.model for each in rig.cameras}
    if None not in modules:
        counts = Counter(str(each.module) for each in rig.cameras)
        return {"rig.modules": {name: [count, count + more] for name, count in counts.items()}}
    if len(models) > 1:
        sizes = ", ".join(f"{each.size_text} {each.lens_text} of {math.degrees(each.fov_rad):.0f}°" for each in models)
        raise InputError(f"rig: expected cameras of one model, or a module for each, got {sizes}; choose modules")
    [model] = models
    image = {"width_px": model.width_px, "height_px": model.height_px, "lens": str(model.lens)}
    image |= {"fov_deg": math.degrees(model.fov_rad), "distortion": list(model.distortion)}
    return {"rig.modules": None, **{f"camera.{name}": value for name, value in image.items()}}
