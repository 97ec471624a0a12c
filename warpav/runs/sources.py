"""What the words of a command or a configuration mean: devices, scenes, rigs, mount surfaces."""

from __future__ import annotations

import contextlib
import dataclasses
import difflib
import importlib.util
import math
import shlex
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import platformdirs

from warpav.core.errors import InputError, OptionError
from warpav.core.fingerprint import digest
from warpav.core.warp_setup import load_warp
from warpav.optimisation.settings import ONE_FIELD_LOSSES
from warpav.raster.camera import CameraModel
from warpav.raster.lens import Lens
from warpav.rig.mount_surface import MountSurface, mount_surface_from_mesh
from warpav.rig.presets import preset_names, preset_rig
from warpav.rig.rig import Rig, read_rig
from warpav.runs.config import Config, placed_config, with_absolute_paths
from warpav.runs.run_folder import RunFolder
from warpav.scene.capture.plan import PlanSettings
from warpav.scene.reconstruction.settings import METHOD_PACKAGES, ReconstructionSettings
from warpav.scene.store import CaptureTask, SceneTask, capture_path, capture_scenes, make_scenes, scene_path

if TYPE_CHECKING:
    from warpav.detection.onnx_detector import OnnxDetector
    from warpav.detection.probability import DetectorUse
    from warpav.optimisation.constraints import Constraints
    from warpav.optimisation.mount import CameraMount, FreeRanges, HeldCameras
    from warpav.raster.mesh import Mesh
    from warpav.scene.scene import Scene

HIGHEST = "highest"
SAME_CAMERA_TOLERANCE = 1e-6  # rig files keep six decimals


def checked_device(device: str) -> str:
    """The name of a Warp device that this machine has.

    Raises:
        InputError: It has none of that name.
    """
    warp = load_warp()
    names = [each.alias for each in warp.get_devices()]
    if device not in names:
        raise OptionError("device", f"expected one of {', '.join(names)}, got {device!r}; warpav doctor lists them")
    return device


def device_name(device: str) -> str:
    """Alias and name of a Warp device, such as ``cuda:0 (NVIDIA H100)``."""
    found = load_warp().get_device(device)
    return f"{found.alias} ({found.name})"


def load_scenes(config: Config, seeds: Sequence[int], *, say: Callable[[str], None] | None = None) -> Iterator[Scene]:
    """The scenes of ``seeds``, one after the other: built, captured and reconstructed, or read.

    Their vehicles are the road users that ``scenes.targets`` names. Scenes that went through images hold people and
    cyclists as part of the environment, so there only vehicles can be targets. With ``scenes.ego`` all are around that
    vehicle, without the road users at whose places it stands.

    Args:
        config: Says which scenes.
        seeds: Their numbers.
        say: Told of road users that were left out.

    Raises:
        InputError: A file is missing or cannot be used.
    """
    ego = own_vehicle(config)
    for scene in _scenes_of(config, seeds):
        around = scene if ego is None else scene.around(ego)
        left_out = len(scene.road_users) - len(around.road_users)
        if left_out and say is not None:
            users = "1 road user" if left_out == 1 else f"{left_out} road users"
            say(f"{scene.name}: {users} left out, where the vehicle of scenes.ego stands")
        yield around.targeting(config.scenes.targets)


def own_vehicle(config: Config) -> Mesh | None:
    """The vehicle of ``scenes.ego`` in the ego frame; None where scenes keep their own.

    Raises:
        InputError: It cannot be read, or not be used as it is.
    """
    from warpav.scene.own_vehicle import examine, read_vehicle

    path = config.scenes.ego
    if path is None:
        return None
    try:
        file = read_vehicle(path)
        found = examine(file, file.usual)
    except InputError as error:
        raise OptionError("scenes.ego", str(error)) from None
    if found.problems:
        raise OptionError(
            "scenes.ego",
            f"{path}: {found.problems[0].text}; warpav vehicle check {shlex.quote(str(path))} says how to mend it",
        )
    return found.mesh


def own_vehicle_digest(config: Config) -> str | None:
    """Hash of the file that ``scenes.ego`` names, so that what was made with another one is made again; None for none.

    Raises:
        InputError: It cannot be read.
    """
    path = config.scenes.ego
    if path is None:
        return None
    try:
        return digest(path.expanduser().read_bytes())
    except OSError as error:
        raise OptionError("scenes.ego", f"expected a readable mesh file, got {str(path)!r}: {error.strerror}") from None


def _scenes_of(config: Config, seeds: Sequence[int]) -> Iterator[Scene]:
    from warpav.scene.cache import town_scenes
    from warpav.scene.glb import read_scene

    if config.scenes.source == "town":
        yield from town_scenes(seeds)
        return
    if config.scenes.source == "captured":
        yield from map(read_scene, _captured(config, seeds))
        return
    assert config.scenes.folder is not None
    files = [scene_path(config.scenes.folder, seed) for seed in seeds]
    missing = [file for file in files if not file.is_file()]
    if missing:
        raise OptionError(
            "scenes.folder",
            f"expected {missing[0].name} in {str(config.scenes.folder)!r}, got no such file "
            f"({len(missing)} of {len(files)} missing); change scenes.train_seeds and scenes.test_seeds",
        )
    yield from map(read_scene, files)


def _captured(config: Config, seeds: Sequence[int]) -> Iterator[Path]:
    """Files of scenes that went through images; those that are not there yet are made."""
    folder = config.scenes.folder or Path(platformdirs.user_cache_dir("warpav", appauthor=False)) / "captured"
    plan, meshes = plan_settings(config), reconstruction_settings(config)
    for seed in seeds:
        captured = CaptureTask(seed, capture_path(folder / "captures", seed), plan)
        scene = SceneTask(seed, scene_path(folder, seed), captured.folder, meshes)
        for outcome in (*capture_scenes([captured]), *make_scenes([scene])):
            if outcome.error is not None:
                raise InputError(outcome.error)
        yield scene.file


def plan_settings(config: Config) -> PlanSettings:
    """What is recorded of a situation."""
    capture = config.capture
    return PlanSettings(
        vehicle_count=capture.vehicles,
        radius_m=capture.radius_m,
        width_px=capture.width_px,
        height_px=capture.height_px,
        scene_heights_m=capture.scene_heights_m,
        rotation_count=capture.rotations,
        ego_side_count=capture.ego_sides,
    )


def reconstruction_settings(config: Config) -> ReconstructionSettings:
    """How a capture becomes a scene.

    Raises:
        InputError: The surface method is not installed.
    """
    how = config.reconstruction
    missing = [name for name in METHOD_PACKAGES.get(how.method, ()) if importlib.util.find_spec(name) is None]
    if missing:
        raise OptionError(
            "reconstruction.method",
            f"expected an installed surface method, got {how.method!r} without the package {' and '.join(missing)}; "
            "install as https://github.com/nv-tlabs/NKSR says, or use poisson",
        )
    standard = ReconstructionSettings()
    vehicle = {"point_count": how.vehicle_points, "cell_m": how.vehicle_cell_m, "reach_m": 2.0 * how.vehicle_cell_m}
    return ReconstructionSettings(
        cloud=dataclasses.replace(
            standard.cloud, far_depth_m=how.far_depth_m, radius_m=how.radius_m, max_height_m=how.max_height_m
        ),
        method=how.method,
        vehicle=dataclasses.replace(standard.vehicle, **vehicle, triangle_count=how.vehicle_triangles),
        ego=dataclasses.replace(standard.ego, **vehicle),
        environment=dataclasses.replace(
            standard.environment,
            point_count=how.environment_points,
            cell_m=how.environment_cell_m,
            reach_m=2.5 * how.environment_cell_m,
            triangle_count=how.environment_triangles,
        ),
    )


def load_scene(source: str, config: Config | None = None) -> Scene:
    """The scene that ``source`` means: a GLB file, or the embedded scene of a seed.

    Args:
        source: What the user wrote.
        config: Its ``scenes.ego`` takes the place of the scene's own vehicle; None: nothing does.

    Raises:
        InputError: It is neither.
    """
    ego = None if config is None else own_vehicle(config)
    scene = _scene_of(source)
    return scene if ego is None else scene.around(ego)


def _scene_of(source: str) -> Scene:
    from warpav.scene.glb import read_scene
    from warpav.scene.town.town import town_scene

    if source.isdecimal() and not Path(source).exists():
        return town_scene(int(source))
    if not Path(source).is_file():
        raise InputError(f"{source}: scene: expected a GLB file or the seed of an embedded scene, got {source!r}")
    return read_scene(source)


def mount_surface(config: Config, ego: Mesh) -> MountSurface:
    """Where cameras may stand on the ego vehicle.

    Raises:
        InputError: Nothing on it faces upwards enough.
    """
    return mount_surface_from_mesh(
        ego,
        cell_m=config.mount.cell_m,
        min_upward_normal=config.mount.min_upward_normal,
        min_zone_normal=config.mount.min_zone_normal,
        smoothing_tolerance_m=config.mount.smoothing_tolerance_m,
    )


def checked_held(config: Config, start: Rig) -> Rig:
    """The rig of ``rig.start`` as a mount can hold the cameras of ``rig.freeze`` of it.

    Raises:
        InputError: The rig has no such camera, or one that cannot be in one rig with those of the configuration.
    """
    shared, known = camera_model(config), [camera.name for camera in start.cameras]
    cameras = []
    for camera in start.cameras:
        model = dataclasses.replace(camera.model, near_m=shared.near_m)
        cameras.append(dataclasses.replace(camera, model=model))
    models = {camera.name: camera.model for camera in cameras}
    for name in config.rig.freeze:
        if name not in known:
            near = difflib.get_close_matches(name, known, 1, 0.5)
            hint = f"; did you mean {near[0]}?" if near else ""
            names = f"{', '.join(known)}, the cameras of {config.rig.start}"
            raise OptionError("rig.freeze", f"expected names out of {names}, got {name!r}{hint}")
        model = models[name]
        if not model.fits_beside(shared):
            raise OptionError(
                "rig.freeze",
                "expected cameras with the image and the lens of the others, but for a pinhole's field of view, got "
                f"{name} with {model.width_px} x {model.height_px} px ({model.lens}"
                f"{', calibrated' if model.focal_px else ''}) beside {shared.width_px} x {shared.height_px} px "
                f"({shared.lens}); {_as_held(model)}",
            )
        alike = [each for each in ONE_FIELD_LOSSES if getattr(config.losses, each)]
        if alike and model.log_zoom_over(shared):
            raise OptionError(
                "rig.freeze",
                f"expected cameras of camera.fov_deg={config.camera.fov_deg:g}, as losses.{alike[0]} takes one field "
                f"of view for all, got {name} with {math.degrees(model.fov_rad):g}",
            )
    return Rig.create(cameras, name=config.rig.start)


def _as_held(model: CameraModel) -> str:
    """How a run's cameras can have the image and the lens of a camera."""
    if model.focal_px is not None:
        return "replace focal_px and centre_px by fov_deg in the rig's file"
    options = f"camera.width_px={model.width_px} camera.height_px={model.height_px}"
    if model.lens is Lens.PINHOLE:
        return f"set {options} camera.lens=pinhole, or write the camera with the smaller image into a rig's file"
    numbers = ",".join(f"{value:g}" for value in model.distortion)
    angle = f" camera.fov_deg={math.degrees(model.fov_rad):g}"
    return f"set {options} camera.lens={model.lens}{angle} camera.distortion=[{numbers}]"


def constraints_of(config: Config, surface: MountSurface, held: HeldCameras | None = None) -> Constraints:
    """What the method demands of the places of the cameras.

    Args:
        config: The configuration.
        surface: What they stand on.
        held: Those that stay as they are.

    Raises:
        InputError: No place of the mountable zone is far enough from its border.
    """
    from warpav.optimisation.constraints import BoundsAndSpacing, ZoneAndSpacing

    if config.method == "thesis":
        return BoundsAndSpacing(surface, min_spacing_m=config.rig.min_spacing_m)
    return ZoneAndSpacing(
        surface,
        camera_count=config.rig.cameras,
        min_spacing_m=config.rig.min_spacing_m,
        margin_m=config.mount.margin_m,
        held=held,
    )


def camera_model(config: Config) -> CameraModel:
    """The camera model that all cameras of a run share."""
    camera = config.camera
    return CameraModel(
        camera.width_px,
        camera.height_px,
        math.radians(camera.fov_deg),
        camera.near_m,
        Lens(camera.lens),
        distortion=camera.distortion,
    )


def load_detector(config: Config, *, every_road_user: bool = False) -> OnnxDetector:
    """The detector of the configuration, tried on a grey image of the configured camera.

    Args:
        config: Says which, and whom it is to find.
        every_road_user: Let it find whomever it has labels for, if vehicles are among those to be found.

    Raises:
        InputError: Its file cannot be used, or gives something else than detections.
    """
    from warpav.detection.families import GREY
    from warpav.detection.onnx_detector import OnnxDetector

    detector = OnnxDetector(
        config.detector.model,
        confidence_min=config.detector.confidence_min,
        nms_iou_max=config.detector.nms_iou_max,
        family=config.detector.format,
        labels=config.detector.labels,
        classes=dict(config.detector.classes),
        targets=None if every_road_user and "vehicle" in config.scenes.targets else config.scenes.targets,
        input_px=config.detector.input_px,
        provider=config.detector.provider,
    )
    # what a network cannot do shows at once, not when scenes have been rendered and a run folder lies there
    detector.detect(np.full((1, config.camera.height_px, config.camera.width_px, 3), GREY, np.uint8))
    return detector


def detector_use(config: Config) -> DetectorUse:
    """The detector, and everything in the configuration on which its chances in a view depend."""
    from warpav.detection.onnx_detector import BUILTIN_MODEL_PATH
    from warpav.detection.probability import DetectorUse

    config = with_absolute_paths(config)  # a run folder writes them so, and finds the same fit
    model = BUILTIN_MODEL_PATH if config.detector.model == "builtin" else Path(config.detector.model).expanduser()
    ego = own_vehicle_digest(config)
    free = {name: pair for name, pair in config.rig.free.model_dump(mode="json").items() if pair is not None}
    return DetectorUse(
        model,
        {
            "detector": config.detector.model_dump(mode="json", exclude={"model", "provider"}),
            "camera": config.camera.model_dump(mode="json"),
            "scenes": config.scenes.model_dump(
                mode="json", exclude={"train_seeds", "validation_seeds", "test_seeds", "mirror", "ego"}
            ),
            **({} if ego is None else {"scenes.ego": ego}),
            "rig.height_offset_m": config.rig.height_offset_m,
            "visibility.occlusion": config.visibility.occlusion,
            **({"rig.free": free} if free else {}),
        },
    )


def free_ranges(config: Config) -> FreeRanges:
    """What may differ from camera to camera besides x, y and yaw."""
    from warpav.optimisation.mount import FreeRanges

    free = config.rig.free
    angles = (
        None if pair is None else (math.radians(pair[0]), math.radians(pair[1]))
        for pair in (free.pitch_deg, free.fov_deg)
    )
    pitch_rad, fov_rad = angles
    return FreeRanges(pitch_rad=pitch_rad, height_m=free.height_m, fov_rad=fov_rad)


def camera_mount(config: Config, ego: Mesh) -> CameraMount:
    """The mount surface of the ego vehicle on the device, with the cameras of the configuration."""
    from warpav.optimisation.mount import CameraMount

    return CameraMount(
        mount_surface(config, ego),
        camera=camera_model(config),
        height_offset_m=config.rig.height_offset_m,
        device=checked_device(config.device),
        free=free_ranges(config),
    )


def is_run_folder(source: str) -> bool:
    """Whether the source of a rig means a folder; one with a preset's name counts only if it holds a run."""
    folder = Path(source)
    return folder.is_dir() and (source not in preset_names() or (folder / "config.yaml").is_file())


def check_rig_source(source: str) -> None:
    """Refuse early what :func:`find_rig` would refuse after the scenes have been built.

    Raises:
        InputError: ``source`` means no rig.
    """
    if source != HIGHEST:
        find_file_rig(source)


def find_rig(source: str, config: Config, ego: Mesh) -> Rig:
    """The rig that ``source`` means: a rig YAML, a preset, a run folder, or ``highest``.

    Args:
        source: What the user wrote.
        config: Gives the near plane of all cameras, and everything about the cameras of ``highest``.
        ego: The vehicle on whose highest point ``highest`` stands.

    Raises:
        InputError: It means none, or the file cannot be used.
    """
    if source == HIGHEST:
        from warpav.optimisation.baselines import highest_mount_pose

        mount = camera_mount(config, ego)
        return mount.rig(highest_mount_pose(constraints_of(config, mount.surface), config.rig.cameras))
    shared = camera_model(config)
    return Rig.create(
        [
            dataclasses.replace(camera, model=_completed(camera.model, shared))
            for camera in find_file_rig(source).cameras
        ],
        name=source,
    )


def config_for(
    source: str, config: str | None, overrides: Sequence[str], *, default: str
) -> contextlib.AbstractContextManager[Config]:
    """The configuration with which to look at a rig: the given one, else that of the run folder, else ``default``.

    Returns:
        What :func:`warpav.runs.config.placed_config` returns.
    """
    if config is None and is_run_folder(source):
        config = str(RunFolder.open(source).path / "config.yaml")
    return placed_config(config or default, overrides)


def arm_name(source: str) -> str:
    """What the rig of ``source`` is called in results."""
    return "optimised" if is_run_folder(source) else Path(source).stem


def rig_to_export(source: str) -> Rig:
    """The rig that ``source`` means; ``highest`` stands on the embedded vehicle, with the cameras of ``quick``.

    Raises:
        InputError: It means none, or the file cannot be used.
    """
    if source != HIGHEST:
        return find_file_rig(source)
    from warpav.scene.town.town import town_scene

    with placed_config("quick", ()) as config:
        return find_rig(source, config, town_scene(0).ego)


def find_file_rig(source: str) -> Rig:
    """The rig of a rig YAML, a preset or a run folder, as it stands there.

    Raises:
        InputError: It means none, or the file cannot be used.
    """
    names = preset_names()
    if is_run_folder(source):
        return RunFolder.open(source).rig()
    if Path(source).is_file():
        return read_rig(source)
    if source in names:
        return preset_rig(source)
    near = difflib.get_close_matches(source, [*names, HIGHEST], 1, 0.6)
    hint = f"; did you mean {near[0]}?" if near else ""
    raise InputError(
        f"{source}: rig: expected a rig YAML, a run folder, a preset ({', '.join(names)}) or {HIGHEST}, "
        f"got no file of that name{hint}"
    )


def _completed(model: CameraModel, shared: CameraModel) -> CameraModel:
    """A model from a file with what files do not hold: the near plane, and the decimals that were rounded off."""
    model = dataclasses.replace(model, near_m=shared.near_m)
    same_fov = np.isclose(model.fov_rad, shared.fov_rad, rtol=0.0, atol=SAME_CAMERA_TOLERANCE)
    is_shared = same_fov and model.focal_px is None and dataclasses.replace(model, fov_rad=shared.fov_rad) == shared
    return shared if is_shared else model
