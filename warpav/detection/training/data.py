"""Pictures of town scenes with their boxes: what the detector is trained, watched and judged on.

python -m warpav.detection.training.data --seeds 1000000..1001000 --out FOLDER [--device cuda:0] [--processes 8]
"""

from __future__ import annotations

import argparse
import functools
import logging
import math
import multiprocessing
import time
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from warpav.detection.ground_truth import visible_boxes
from warpav.detection.training import CLASS_NAMES
from warpav.geometry.mount_surface import MountSurface, mount_surface_from_mesh
from warpav.rig.camera import CameraModel
from warpav.rig.rig import RigCamera
from warpav.scene.scene import Scene

# Seeds below a million belong to experiments.
TRAINING_SEED, VALIDATION_SEED, TEST_SEED = 1_000_000, 2_000_000, 3_000_000

# Pictures of every scene, by their side [px].
VIEWS_PER_SCENE = {256: 10, 384: 4, 640: 2}

CLASS_OF_CATEGORY = {
    "hatchback": "car",
    "saloon": "car",
    "estate": "car",
    "suv": "car",
    "van": "van",
    "lorry": "lorry",
    "bus": "bus",
}

_OBJECT_MAX = 24
_MIN_AREA_PX = 16

_logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Labels:
    """The objects of a set of images, padded to one count.

    Attributes:
        box_px: Ground-truth box ``x0, y0, x1, y1`` [px], float32, shape [image, object, 4].
        class_index: Index into `CLASS_NAMES`, -1 where padded, int8, shape [image, object].
        too_small: Objects that show less than the least area of a ground-truth box, bool, shape [image, object].
        visible_fraction: Share of the object's area in the image that nothing hides, in 0..1, float32, shape
            [image, object].
        distance_m: From the camera to the middle of the object [m], float32, shape [image, object].
    """

    box_px: np.ndarray
    class_index: np.ndarray
    too_small: np.ndarray
    visible_fraction: np.ndarray
    distance_m: np.ndarray

    @classmethod
    def empty(cls, image_count: int) -> Labels:
        """Room for the objects of so many images."""
        shape = (image_count, _OBJECT_MAX)
        return cls(
            np.zeros((*shape, 4), np.float32),
            np.full(shape, -1, np.int8),
            np.zeros(shape, bool),
            np.zeros(shape, np.float32),
            np.zeros(shape, np.float32),
        )


@dataclass(frozen=True)
class Pictures:
    """Images of one size and their objects.

    Attributes:
        images_rgb: uint8, shape [image, row, column, 3]; lies on the disk until it is read.
        labels: Their objects.
    """

    images_rgb: np.ndarray
    labels: Labels

    def first(self, count: int | None) -> Pictures:
        """The first so many images; None means all."""
        labels = Labels(*(getattr(self.labels, field.name)[:count] for field in fields(Labels)))
        return Pictures(self.images_rgb[:count], labels)


def sample_cameras(
    rng: np.random.Generator, surface: MountSurface, ego_bounds_m: np.ndarray, *, side_px: int, count: int
) -> list[RigCamera]:
    """Random cameras on and around the ego vehicle.

    Three of four stand 5 to 50 cm above roof or bonnet, the others around the body, 2 to 30 cm off it, 0.3 to 2 m high.
    They look anywhere around, pitched and rolled by some degrees, half of them with the thesis's 90 degrees.

    Args:
        rng: Random numbers.
        surface: The ego vehicle's mount surface.
        ego_bounds_m: Least and greatest corner of the ego vehicle [m], shape [2, 3].
        side_px: Width and height of the images [px].
        count: Number of cameras.

    Returns:
        The cameras, in the ego frame.
    """
    cameras = []
    low_xy_m, high_xy_m = surface.bounds_m
    for number in range(count):
        if rng.random() < 0.75:
            xy_m = rng.uniform(low_xy_m, high_xy_m)
            z_m = float(surface.height_at_m(xy_m[None])[0]) + rng.uniform(0.05, 0.5)
        else:
            xy_m = rng.uniform(*ego_bounds_m[:, :2])
            axis, end = rng.integers(2, size=2)
            xy_m[axis] = ego_bounds_m[end, axis] + (2 * end - 1) * rng.uniform(0.02, 0.3)
            z_m = rng.uniform(0.3, 2.0)
        fov_deg = 90.0 if rng.random() < 0.5 else rng.uniform(60.0, 110.0)
        cameras.append(
            RigCamera(
                name=f"camera_{number}",
                position_m=np.array([*xy_m, z_m]),
                yaw_rad=rng.uniform(-math.pi, math.pi),
                pitch_rad=math.radians(float(np.clip(rng.normal(2.0, 6.0), -15.0, 25.0))),
                roll_rad=math.radians(float(np.clip(rng.normal(0.0, 2.0), -6.0, 6.0))),
                model=CameraModel(width_px=side_px, height_px=side_px, fov_rad=math.radians(fov_deg)),
            )
        )
    return cameras


def render_scene(scene: Scene, surface: MountSurface, seed: int, *, device: str = "cpu") -> dict[int, Pictures]:
    """Pictures of one scene by random cameras, by the side of the image [px].

    Args:
        scene: The scene.
        surface: Where cameras may stand on its ego vehicle.
        seed: Of the cameras, and of whether a picture has one or four samples a pixel.
        device: Warp device.

    Returns:
        Pictures for every size of `VIEWS_PER_SCENE`.
    """
    from warpav.render.device_scene import DeviceScene
    from warpav.render.images import render_images

    rng = np.random.default_rng([seed, 1])
    packed = DeviceScene.pack(scene, device=device)
    center_m = np.array([vehicle.box.center_m for vehicle in scene.vehicles]).reshape(-1, 3)
    label = np.array([CLASS_NAMES.index(CLASS_OF_CATEGORY[vehicle.category]) for vehicle in scene.vehicles], np.int8)
    pictures = {}
    for side_px, count in VIEWS_PER_SCENE.items():
        cameras = sample_cameras(rng, surface, scene.ego.bounds_m(), side_px=side_px, count=count)
        rendered = render_images(packed, cameras, supersampling=int(rng.integers(1, 3)), device=device)
        labels = Labels.empty(count)
        for image, (camera, picture) in enumerate(zip(cameras, rendered, strict=True)):
            box_px = visible_boxes(picture.object_index, len(scene.vehicles), min_area_px=1)
            large_box_px = visible_boxes(picture.object_index, len(scene.vehicles), min_area_px=_MIN_AREA_PX)
            seen = np.nonzero(~np.isnan(box_px[:, 0]))[0]
            # Should more be seen than there is room for, the smallest are left out.
            seen = seen[np.argsort(-picture.visible_area_px[seen], kind="stable")][:_OBJECT_MAX]
            room = slice(len(seen))
            labels.box_px[image, room] = box_px[seen]
            labels.class_index[image, room] = label[seen]
            labels.too_small[image, room] = np.isnan(large_box_px[seen, 0])
            amodal_area_px = np.maximum(picture.amodal_area_px[seen], 1e-6)
            labels.visible_fraction[image, room] = np.clip(picture.visible_area_px[seen] / amodal_area_px, 0.0, 1.0)
            labels.distance_m[image, room] = np.linalg.norm(center_m[seen] - camera.position_m, axis=1)
        pictures[side_px] = Pictures(np.stack([picture.rgb for picture in rendered]), labels)
    return pictures


def load_pictures(folder: Path) -> dict[int, Pictures]:
    """What `main` wrote, by the side of the image [px]; the images stay on the disk until they are read."""
    pictures = {}
    for side_px in VIEWS_PER_SCENE:
        with np.load(folder / f"labels_{side_px}.npz") as arrays:
            labels = Labels(**{field.name: arrays[field.name] for field in fields(Labels)})
        images_rgb = np.load(folder / f"images_{side_px}.npy", mmap_mode="r")
        # Where time ran out, the end of the file is empty.
        pictures[side_px] = Pictures(images_rgb[: len(labels.class_index)], labels)
    return pictures


@functools.cache
def _town_surface() -> MountSurface:
    from warpav.scene.town import ego_vehicle

    return mount_surface_from_mesh(ego_vehicle())


def _write_scene(seed: int, *, index: int, folder: Path, device: str) -> dict[int, Labels]:
    """Render one town scene into its place in the folder's files and return its labels."""
    from warpav.scene.town import town_scene

    pictures = render_scene(town_scene(seed), _town_surface(), seed, device=device)
    for side_px, count in VIEWS_PER_SCENE.items():
        images_rgb = np.load(folder / f"images_{side_px}.npy", mmap_mode="r+")
        images_rgb[index * count : (index + 1) * count] = pictures[side_px].images_rgb
    return {side_px: each.labels for side_px, each in pictures.items()}


def _write_job(job: tuple[int, int, Path, str]) -> dict[int, Labels]:
    index, seed, folder, device = job
    return _write_scene(seed, index=index, folder=folder, device=device)


def write_pictures(
    seeds: Sequence[int], folder: Path, *, device: str, processes: int, minutes: float = math.inf
) -> None:
    """Render town scenes and save their pictures: ``images_<side>.npy`` and ``labels_<side>.npz``.

    Args:
        seeds: Of the scenes.
        folder: Where to; made if it does not exist.
        device: Warp device.
        processes: That share the scenes.
        minutes: Leave the other scenes out after so long [min].
    """
    folder.mkdir(parents=True, exist_ok=True)
    for side_px, count in VIEWS_PER_SCENE.items():
        shape = (len(seeds) * count, side_px, side_px, 3)
        np.lib.format.open_memmap(folder / f"images_{side_px}.npy", mode="w+", dtype=np.uint8, shape=shape).flush()

    jobs = [(index, seed, folder, device) for index, seed in enumerate(seeds)]
    start_s = time.perf_counter()
    # The first scene fills the kernel cache, which processes would otherwise all compile at once.
    labels = [_write_job(jobs[0])]
    with multiprocessing.get_context("spawn").Pool(processes) as pool:
        for done in pool.imap(_write_job, jobs[1:], chunksize=4):
            labels.append(done)
            passed_s = time.perf_counter() - start_s
            if len(labels) % 100 == 0:
                _logger.info("%d of %d scenes, %.0f s", len(labels), len(jobs), passed_s)
            if passed_s > 60.0 * minutes:
                _logger.info("the time is up after %d of %d scenes", len(labels), len(jobs))
                break
    for side_px in VIEWS_PER_SCENE:
        arrays: dict[str, Any] = {
            field.name: np.concatenate([getattr(each[side_px], field.name) for each in labels])
            for field in fields(Labels)
        }
        np.savez(str(folder / f"labels_{side_px}.npz"), **arrays)
        _logger.info(
            "%d images of %d px, %d objects", len(arrays["box_px"]), side_px, (arrays["class_index"] >= 0).sum()
        )


def _seed_range(text: str) -> range:
    first, _, last = text.partition("..")
    return range(int(first), int(last) + 1)


def main(arguments: Sequence[str] | None = None) -> None:
    """The command."""
    parser = argparse.ArgumentParser(description="Render pictures of town scenes for the detector.")
    parser.add_argument("--seeds", type=_seed_range, required=True, help="first..last, both included")
    parser.add_argument("--out", type=Path, required=True, help="folder to write to")
    parser.add_argument("--device", default="cpu", help="Warp device: cpu or cuda:0")
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--minutes", type=float, default=math.inf, help="leave the other scenes out after so long")
    options = parser.parse_args(arguments)
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    write_pictures(
        options.seeds, options.out, device=options.device, processes=options.processes, minutes=options.minutes
    )


if __name__ == "__main__":
    main()
