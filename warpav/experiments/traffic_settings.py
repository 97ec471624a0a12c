"""The rivals on hard and on real traffic: settings that are composed of a source of traffic, a mount and cameras.

A setting is ``TRAFFIC_CAMERAS_MOUNT``, with ``_bus`` for a bus that carries the cameras and ``_all`` for all road
users: ``sind_4_rack``, ``dense_6_body_bus_all``. On a rack all cameras are 25 cm above roof and bonnet; roof and body
are zones of the vehicle in which cameras are flush, so that what is compared costs the same. Zones of the two vehicles
ship with warpav, as they belong to what is compared.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from warpav.core.errors import ArgumentError, OptionError
from warpav.experiments.arms import AS_BUILT, common_arms
from warpav.experiments.experiment import Experiment
from warpav.runs.config import Config

TRAFFIC = {
    "dense": ("scenes.level=dense",),
    "sind": ("scenes.source=traffic",),
    "ngsim": ("scenes.source=traffic",),
}
"""Options by source of the traffic; NGSIM is recorded traffic that the user brings (``scenes.recordings``)."""

MOUNTS = {
    "rack": "25 cm above roof and bonnet",
    "roof": "flush on the roof",
    "body": "flush anywhere on the body, but on glass, lamps, plates and wheels",
}
"""Where the cameras may stand."""
CAMERAS = (2, 4, 6)
EGOS = ("car", "bus")
TARGETS = {"vehicles": ("vehicle",), "all": ("vehicle", "pedestrian", "cyclist")}
"""Road users that count, by the word for them."""

ARMS = ("default", "pool_only", "descent_only", "highest", "roof_edge", "random_selected", "cma")
"""Names of the arms of every setting."""
RAISED = "highest_raised"
"""The arm that stands on a rack where all others are flush: it costs more, and shows what a rack would see."""
PRESETS = {6: "nuscenes"}
"""Known rigs with as many cameras, which stand on a car as they are built."""

RUNS = 10
"""Run seeds of an arm."""
FOV_DEG = {2: 90, 4: 90, 6: 60}
"""Horizontal field of view by number of cameras: of six about that of nuScenes's."""
WIDTH_PX = 640
"""Width and height of all images."""
CAMERA_RENDERS = {2: 30_000, 4: 45_000, 6: 50_000}
"""Of every search on a roof, by number of cameras."""
BODY_FACTOR = 2
"""How many times as many renders, and cameras in the first pool, a search on the whole body has: it is larger."""
ROOF_POOL = 128
"""Cameras of the first pool of the default method on a roof."""

_COMMON = (
    f"camera.width_px={WIDTH_PX}",
    f"camera.height_px={WIDTH_PX}",
    "rig.free.pitch_deg=[-10, 30]",
    "scenes.train_seeds=0..149",
    "scenes.validation_seeds=null",
    "scenes.test_seeds=1000..1099",
)
QUICK_SCENES = 16
"""Scenes of the small version's searches: too few for a fit of their own, which the whole version would find again."""
_QUICK = (
    f"scenes.train_seeds=0..{QUICK_SCENES - 1}",
    f"scenes.test_seeds=1000..{1000 + QUICK_SCENES - 1}",
    "optimiser.pool_cameras=48",
    "camera.width_px=256",
    "camera.height_px=256",
)
_ZONES = Path(__file__).parent / "zones"
_TEXT = "TRAFFIC_CAMERAS_MOUNT such as sind_4_rack or dense_6_body_bus_all"


@dataclass(frozen=True)
class TrafficSetting:
    """A setting."""

    traffic: str
    cameras: int
    mount: str
    ego: str = "car"
    targets: str = "vehicles"

    @property
    def name(self) -> str:
        """How it is asked for."""
        ego = "" if self.ego == "car" else f"_{self.ego}"
        return f"{self.traffic}_{self.cameras}_{self.mount}{ego}{'_all' if self.targets == 'all' else ''}"

    @property
    def zones(self) -> Path | None:
        """The zones in which its cameras are flush; None on a rack."""
        return None if self.mount == "rack" else _ZONES / f"{self.ego}_{self.mount}.yaml"

    @property
    def options(self) -> tuple[str, ...]:
        """Overrides of the configuration ``default``."""
        return (
            *TRAFFIC[self.traffic],
            *_COMMON,
            f"rig.cameras={self.cameras}",
            f"camera.fov_deg={FOV_DEG[self.cameras]}",
            *(() if self.zones is None else (f"mount.zones={self.zones}",)),
            f"scenes.targets=[{', '.join(TARGETS[self.targets])}]",
            f"optimiser.pool_cameras={ROOF_POOL * self._factor}",
            *(("scenes.ego=bus",) if self.ego == "bus" else ()),
        )

    @property
    def experiment(self) -> Experiment:
        """Its experiment, whose rigs the detector judges, by what can be found from the mount as well."""
        others = [] if self.mount == "rack" else [RAISED]
        if self.ego == "car" and self.cameras in PRESETS:
            others.append(PRESETS[self.cameras] + AS_BUILT)
        common, renders = common_arms(), CAMERA_RENDERS[self.cameras] * self._factor
        return Experiment(
            f"rivals_{self.name}",
            "default",
            tuple(common[name] for name in (*ARMS, *others)),
            RUNS,
            options=self.options,
            quick=_QUICK,
            reference="default",
            objectives={"configured": ()},
            camera_renders_max=renders,
            quick_camera_renders_max=renders * QUICK_SCENES // 150,
            knows_attainable=True,
        )

    @property
    def _factor(self) -> int:
        return BODY_FACTOR if self.mount == "body" else 1

    def check(self, config: Config) -> None:
        """See that the configuration has what only the user can bring."""
        if self.traffic == "ngsim" and config.scenes.recordings is None:
            raise OptionError(
                "scenes.recordings",
                f"expected the folder of recordings of NGSIM for the setting {self.name}, which do not ship with "
                "warpav, got none; give it as scenes.recordings=FOLDER, or take a setting of sind",
            )


def traffic_settings() -> Mapping[str, TrafficSetting]:
    """All of them, by name."""
    every = (TrafficSetting(*each) for each in itertools.product(TRAFFIC, CAMERAS, MOUNTS, EGOS, TARGETS))
    return {setting.name: setting for setting in every}


def is_traffic_setting(name: str | None) -> bool:
    """Whether a name means one of these settings, and be it a wrong one."""
    return name is not None and re.match(rf"({'|'.join(TRAFFIC)})(_|$)", name) is not None


def find_traffic_setting(name: str) -> TrafficSetting:
    """The setting of this name."""
    every = traffic_settings()
    if name not in every:
        parts = "; ".join(
            f"{part} {', '.join(map(str, values))}"
            for part, values in (("traffic", TRAFFIC), ("cameras", CAMERAS), ("mount", MOUNTS))
        )
        raise ArgumentError(
            "setting", f"expected {_TEXT} ({parts}; _bus and _all are optional, in this order), got {name}"
        )
    return every[name]
