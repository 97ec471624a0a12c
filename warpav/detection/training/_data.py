"""Labelled images of the town and of recorded traffic for training and evaluating the detector."""

from __future__ import annotations

import functools
import itertools
import logging
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from warpav.core.cache import fingerprint
from warpav.core.errors import InputError
from warpav.core.executor import Executor
from warpav.core.warp_setup import load_warp
from warpav.detection._matching import visible_boxes
from warpav.detection.training import CLASS_NAMES
from warpav.raster.camera import CameraModel, Lens
from warpav.raster.mesh import Mesh
from warpav.rig import MountSurface, RigCamera, mount_surface_from_mesh
from warpav.scene import LEVELS, Level, Scene, TownSource, ego_vehicle
from warpav.scene.traffic.files import recordings_in
from warpav.scene.traffic.moments import moment_of, moments_of, search_and_test
from warpav.scene.traffic.traffic_scene import TrafficSource


@dataclass(frozen=True)
class Subset:
    # A level of the town; ``reconstructed``: scenes of the level easy that are recorded by cameras and made of their
    # images again; recordings that ship with warpav, those of the search or those of the test; or paths of others
    made_of: Level | Literal["reconstructed", "search recordings", "test recordings"] | tuple[Path, ...]
    first_seed: int  # seeds count up from here; those below a million belong to experiments
    scene_count: int  # number of scenes
    views_per_scene: dict[int, int]  # images per scene, by their side [px]

    @property
    def seeds(self) -> range:
        return range(self.first_seed, self.first_seed + self.scene_count)

    def sources(self) -> list[TownSource | TrafficSource]:
        """What the scenes are built of; those that are reconstructed, before that."""
        if self.made_of == "reconstructed":
            return [TownSource(seed) for seed in self.seeds]
        if self.made_of in LEVELS:
            return [TownSource(seed, self.made_of) for seed in self.seeds]
        search, test = search_and_test(None, None)
        shipped = test if self.made_of == "test recordings" else search
        files = recordings_in(self.made_of) if isinstance(self.made_of, tuple) else shipped
        moments = moments_of(files, ego_vehicle().bounds_m())
        return [TrafficSource(moment_of(moments, seed), seed) for seed in self.seeds]


_TRAIN_VIEWS, _TEST_VIEWS = {256: 10, 384: 4, 640: 3, 1280: 1}, {256: 10, 384: 4, 640: 3, 1280: 2}
TRAIN_SUBSETS = {
    "train_easy": Subset("easy", 1_000_000, 700, _TRAIN_VIEWS),
    "train_urban": Subset("urban", 1_100_000, 500, _TRAIN_VIEWS),
    "train_dense": Subset("dense", 1_200_000, 800, _TRAIN_VIEWS),
    "train_motorway": Subset("motorway", 1_300_000, 400, _TRAIN_VIEWS),
    "train_recorded": Subset("search recordings", 1_400_000, 1_600, _TRAIN_VIEWS),
}
"""Scenes of the training, by the name of their folder; none is a scene of a test."""


def own_subset(recordings: Sequence[Path]) -> Subset:
    """Scenes of recordings of the user's own, for the training."""
    return Subset(tuple(recordings), 1_600_000, 600, _TRAIN_VIEWS)


TEST_SUBSETS = {
    "test_easy": Subset("easy", 3_000_000, 60, _TEST_VIEWS),
    "test_dense": Subset("dense", 3_200_000, 60, _TEST_VIEWS),
    "test_motorway": Subset("motorway", 3_300_000, 40, _TEST_VIEWS),
    "test_recorded": Subset("test recordings", 3_400_000, 60, _TEST_VIEWS),
    "test_reconstructed": Subset("reconstructed", 3_500_000, 16, {256: 30, 384: 12, 640: 8, 1280: 4}),
}
"""Scenes that evaluate, likewise."""

_CLASS_OF_CATEGORY = {
    **dict.fromkeys(("hatchback", "saloon", "estate", "suv"), "car"),
    **{name: name for name in CLASS_NAMES},
}

_OBJECT_MAX = 40
_MIN_AREA_PX = 16
_FISHEYE_SHARE = 0.125
# Reconstructed people extend this far beyond their boxes, and start this high above their feet [m].
_PERSON_MARGIN_M, _PERSON_FOOT_M = 0.15, 0.08

_logger = logging.getLogger(__name__)


_LABEL = np.dtype(
    [
        ("box_px", np.float32, 4),  # ground-truth box ``x0, y0, x1, y1`` [px]
        ("class_index", np.int8),  # index into `CLASS_NAMES`, -1 where padded
        # To be neither found nor left alone: it shows less than the least area of a ground-truth box, or is a person
        # whom a reconstruction made unrecognisable
        ("ignored", np.bool_),
        ("visible_fraction", np.float32),  # unoccluded share of its area in the image, in 0..1
        ("distance_m", np.float32),  # from the camera to its middle [m]
    ]
)


def empty_labels(image_count: int) -> np.recarray:
    """Room for the objects of so many images, records [image, object]."""
    labels = np.zeros((image_count, _OBJECT_MAX), _LABEL).view(np.recarray)
    labels.class_index = -1
    return labels


@dataclass(frozen=True)
class LabelledImages:
    """Images of one size and their objects."""

    images_rgb: np.ndarray  # uint8, shape [image, row, column, 3]; lies on the disk until it is read
    labels: np.recarray  # their objects, see `empty_labels`

    def first(self, count: int | None) -> LabelledImages:
        """The first so many images; None means all."""
        return LabelledImages(self.images_rgb[:count], self.labels[:count])


def sample_cameras(
    rng: np.random.Generator, surface: MountSurface, ego_bounds_m: np.ndarray, *, side_px: int, count: int
) -> list[RigCamera]:
    """Random cameras on and around the ego vehicle.

    Three of five stand 5 to 50 cm above roof or bonnet, one of four beside the body, the others up to 3 m high. One of
    eight is a fisheye of 130 to 190 degrees, half of the others have the thesis's 90 degrees, the rest 25 to 120.
    """
    cameras = []
    low_xy_m, high_xy_m = surface.bounds_m
    for number in range(count):
        place = rng.random()
        if 0.6 <= place < 0.85:
            xy_m = rng.uniform(*ego_bounds_m[:, :2])
            axis, end = rng.integers(2, size=2)
            xy_m[axis] = ego_bounds_m[end, axis] + (2 * end - 1) * rng.uniform(0.02, 0.3)
            z_m = rng.uniform(0.3, 2.0)
        else:
            xy_m = rng.uniform(low_xy_m, high_xy_m)
            height_m = float(surface.height_at_m(xy_m[None])[0])
            z_m = height_m + rng.uniform(0.05, 0.5) if place < 0.6 else rng.uniform(height_m + 0.05, 3.0)
        lens = Lens.FISHEYE if rng.random() < _FISHEYE_SHARE else Lens.PINHOLE
        if lens is Lens.FISHEYE:
            fov_deg = rng.uniform(130.0, 190.0)
        else:
            fov_deg = 90.0 if rng.random() < 0.5 else rng.uniform(25.0, 120.0)
        cameras.append(
            RigCamera(
                name=f"camera_{number}",
                position_m=np.array([*xy_m, z_m]),
                yaw_rad=rng.uniform(-math.pi, math.pi),
                pitch_rad=math.radians(float(np.clip(rng.normal(2.0, 6.0), -15.0, 25.0))),
                roll_rad=math.radians(float(np.clip(rng.normal(0.0, 2.0), -6.0, 6.0))),
                model=CameraModel(width_px=side_px, height_px=side_px, fov_rad=math.radians(fov_deg), lens=lens),
            )
        )
    return cameras


def render_scene(
    scene: Scene,
    surface: MountSurface,
    seed: int,
    *,
    views_per_scene: dict[int, int],
    ignored_ids: Sequence[int] = (),
    thread_count: int | None = None,
    device: str = "cpu",
) -> dict[int, LabelledImages]:
    """Images of one scene by random cameras, by their side [px]."""
    from warpav.detection._images import render_images
    from warpav.scene import DeviceScene

    rng = np.random.default_rng([seed, 1])
    scene = replace(scene, vehicles=scene.vehicles + scene.others, others=())
    packed = DeviceScene.pack(scene, device=device)
    center_m = np.array([vehicle.box.center_m for vehicle in scene.vehicles]).reshape(-1, 3)
    label = np.array([CLASS_NAMES.index(_CLASS_OF_CATEGORY[vehicle.category]) for vehicle in scene.vehicles], np.int8)
    is_ignored = np.isin([vehicle.instance_id for vehicle in scene.vehicles], ignored_ids)
    labelled = {}
    for side_px, count in views_per_scene.items():
        cameras = sample_cameras(rng, surface, scene.ego.bounds_m(), side_px=side_px, count=count)
        supersampling = int(rng.integers(1, 3))
        rendered = render_images(packed, cameras, supersampling=supersampling, thread_count=thread_count, device=device)
        labels = empty_labels(count)
        for image, (camera, render) in enumerate(zip(cameras, rendered, strict=True)):
            box_px = visible_boxes(render.object_index, len(scene.vehicles), min_area_px=1)
            large_box_px = visible_boxes(render.object_index, len(scene.vehicles), min_area_px=_MIN_AREA_PX)
            seen = np.nonzero(~np.isnan(box_px[:, 0]))[0]
            # Should more be seen than there is room for, the smallest are left out.
            seen = seen[np.argsort(-render.visible_area_px[seen], kind="stable")][:_OBJECT_MAX]
            room = slice(len(seen))
            labels.box_px[image, room] = box_px[seen]
            labels.class_index[image, room] = label[seen]
            labels.ignored[image, room] = np.isnan(large_box_px[seen, 0]) | is_ignored[seen]
            amodal_area_px = np.maximum(render.amodal_area_px[seen], 1e-6)
            labels.visible_fraction[image, room] = np.clip(render.visible_area_px[seen] / amodal_area_px, 0.0, 1.0)
            labels.distance_m[image, room] = np.linalg.norm(center_m[seen] - camera.position_m, axis=1)
        labelled[side_px] = LabelledImages(np.stack([render.rgb for render in rendered]), labels)
    return labelled


def reconstructed_scene(seed: int) -> Scene:
    """A town scene that was recorded by cameras and made of their images again.

    People end up in its environment; here they are cut out of it by the boxes in which they stood.
    """
    from warpav.scene import PlanSettings, ReconstructionSettings, TownSimulator, reconstruct, record, town_scene

    with TownSimulator() as simulator:
        capture = record(simulator, seed, PlanSettings())
    scene = reconstruct(capture, ReconstructionSettings(thread_count=1))
    environment, others = scene.environment, []
    for person in town_scene(seed).others:
        middle_m = environment.vertex_m[environment.triangle].mean(axis=1)
        above = middle_m[:, 2] > person.box.center_m[2] - 0.5 * person.box.size_m[2] + _PERSON_FOOT_M
        inside = above & person.box.contains(middle_m, margin_m=_PERSON_MARGIN_M)
        if inside.any():
            others.append(replace(person, mesh=_part(environment, inside)))
            environment = _part(environment, ~inside)
    return replace(scene, environment=environment, others=tuple(others))


def _part(mesh: Mesh, chosen: np.ndarray) -> Mesh:
    """Some triangles of a mesh, bool [triangle], with the vertices that they use."""
    used, triangle = np.unique(mesh.triangle[chosen], return_inverse=True)
    return Mesh(mesh.vertex_m[used], triangle.reshape(-1, 3).astype(np.int32), mesh.vertex_rgb[used])


def load_images(folder: Path) -> dict[int, LabelledImages]:
    """What `write_images` wrote, by the side of the image [px]; images stay on the disk until they are read."""
    labelled = {}
    for file in sorted(folder.glob("labels_*.npy")):
        side_text = file.stem.removeprefix("labels_")
        try:
            labels = np.load(file)
            images_rgb = np.load(folder / f"images_{side_text}.npy", mmap_mode="r")
            if labels.dtype != _LABEL or images_rgb.shape != (len(labels), int(side_text), int(side_text), 3):
                raise ValueError(f"images of shape {images_rgb.shape} for {len(labels)} labels")
        except (OSError, ValueError, EOFError) as error:
            raise InputError(
                f"{file}: expected labels and images that warpav wrote, got others ({' '.join(str(error).split())}); "
                "remove the folder, and they are made again"
            ) from error
        labelled[int(side_text)] = LabelledImages(images_rgb, labels.view(np.recarray))
    return dict(sorted(labelled.items()))


_town_surface = functools.cache(lambda: mount_surface_from_mesh(ego_vehicle()))


def _write_scene(
    numbered: tuple[int, TownSource | TrafficSource],
    *,
    subset: Subset,
    folder: Path,
    thread_count: int | None,
    device: str,
) -> dict[int, np.recarray]:
    """Render one scene, with its index in the files of its subset, into these files, and return its labels."""
    load_warp()  # without its start-up messages, in every process
    index, source = numbered
    is_reconstructed = subset.made_of == "reconstructed"
    scene = reconstructed_scene(source.seed) if is_reconstructed else source.scene()
    labelled = render_scene(
        scene,
        _town_surface(),
        source.seed,
        views_per_scene=subset.views_per_scene,
        ignored_ids=[other.instance_id for other in scene.others] if is_reconstructed else (),
        thread_count=thread_count,
        device=device,
    )
    for side_px, count in subset.views_per_scene.items():
        images_rgb = np.load(folder / f"images_{side_px}.npy", mmap_mode="r+")
        images_rgb[index * count : (index + 1) * count] = labelled[side_px].images_rgb
    return {side_px: each.labels for side_px, each in labelled.items()}


def write_images(subset: Subset, folder: Path, *, processes: int, device: str = "cpu") -> None:
    """Render scenes into ``images_<side>.npy`` and ``labels_<side>.npy``, unless the same are there already."""
    made_with = fingerprint(subset, CLASS_NAMES, code=(__name__,))
    note = folder / "made_with.txt"
    if note.is_file():
        if note.read_text() != made_with:
            raise InputError(
                f"{folder}: expected images of {subset.scene_count} scenes from seed {subset.first_seed} on, made by "
                "this version, got others; remove the folder to make them again"
            )
        return
    folder.mkdir(parents=True, exist_ok=True)
    labels: dict[int, list[np.recarray]] = {}
    for side_px, count in subset.views_per_scene.items():
        shape = (subset.scene_count * count, side_px, side_px, 3)
        np.lib.format.open_memmap(folder / f"images_{side_px}.npy", mode="w+", dtype=np.uint8, shape=shape).flush()
        labels[side_px] = [empty_labels(count)] * subset.scene_count

    threads = None if processes == 1 else 1
    write = functools.partial(_write_scene, subset=subset, folder=folder, thread_count=threads, device=device)
    jobs = list(enumerate(subset.sources()))
    start_s = time.perf_counter()
    # The first scene fills the kernel cache, which processes would otherwise all compile at once.
    first = Executor().map(write, jobs[:1])
    rest = Executor("serial" if processes == 1 else "process", processes).map(write, jobs[1:])
    for done, outcome in enumerate(itertools.chain(first, rest), start=1):
        if outcome.result is None:
            raise RuntimeError(f"seed {outcome.task[1].seed}: {outcome.error}")
        for side_px, each in outcome.result.items():
            labels[side_px][outcome.task[0]] = each
        if done % 100 == 0:
            _logger.info("%d of %d scenes, %.0f s", done, len(jobs), time.perf_counter() - start_s)
    for side_px, each in labels.items():
        joined = np.concatenate(each)
        np.save(folder / f"labels_{side_px}.npy", joined)
        count = int((joined["class_index"] >= 0).sum())
        _logger.info("%s: %d images of %d px, %d objects", folder.name, len(joined), side_px, count)
    note.write_text(made_with)
