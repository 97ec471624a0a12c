"""Cameras and the vehicle below them, as the configuration says: camera model, mount surface, constraints."""

from __future__ import annotations

import dataclasses
import difflib
import math
from collections.abc import Callable, Collection, Iterable
from typing import TYPE_CHECKING

import numpy as np

from warpav.core.cache import digest
from warpav.core.errors import InputError, OptionError
from warpav.core.warp_setup import checked_device
from warpav.raster.camera import CameraModel
from warpav.raster.decide import Occlusion
from warpav.raster.lens import Lens
from warpav.rig import (
    NORMALS,
    PLAIN,
    PLAIN_HOUSING,
    Module,
    MountSurface,
    MovedRig,
    Price,
    Rig,
    Role,
    Zone,
    builtin_modules,
    chart_of,
    mount_surface_from_mesh,
    parts_of,
    preset_on_vehicle,
    propose_zones,
    read_modules,
    read_zones,
    skin_distance_m,
    with_middles,
)
from warpav.runs.config import NAMED_STARTS, Config

if TYPE_CHECKING:
    from warpav.optimisation import CameraMount, Constraints, FreeRanges, FrozenCameras, ObjectiveOptions, RigLimits
    from warpav.raster.mesh import Mesh

_FLUSH_NEAR_M = 0.01
"""What is nearer to a camera in a zone is not seen [m]: its own body is nearer than most near planes are."""

_SAME_CAMERA_TOLERANCE = 1e-6  # rig files keep six decimals


def camera_model(config: Config) -> CameraModel:
    """The camera model that all cameras of a run share; flush with a body they see what is a centimetre away."""
    camera = config.camera
    return CameraModel(
        camera.width_px,
        camera.height_px,
        math.radians(camera.fov_deg),
        _near_m(config),
        Lens(camera.lens),
        distortion=camera.distortion,
    )


def _near_m(config: Config) -> float:
    near_m = config.camera.near_m
    is_flush = config.mount.zones is not None or config.rig.modules is not None
    return min(near_m, _FLUSH_NEAR_M) if is_flush else near_m


def has_zones(config: Config) -> bool:
    """Whether cameras stand in zones: those of a file, or for modules those that the body suggests."""
    return config.mount.zones is not None or config.rig.module_counts is not None


def rig_modules(config: Config) -> tuple[Module, ...]:
    """The camera modules that a rig may be made of, in the order of ``rig.modules``; none: equal cameras."""
    if config.rig.module_counts is None:
        return ()
    if config.rig.modules is None:
        camera = camera_model(config)
        return (
            Module(
                name=PLAIN,
                sensor_px=(camera.width_px, camera.height_px),
                fov_rad=camera.fov_rad,
                housing=PLAIN_HOUSING,
                price=Price(0.0),
                source="the section camera",
                lens=camera.lens,
                distortion=camera.distortion,
            ),
        )
    catalogue = builtin_modules() if config.rig.catalogue is None else read_modules(config.rig.catalogue)
    for name in config.rig.modules:
        if name not in catalogue:
            near = difflib.get_close_matches(name, catalogue, 1, 0.5)
            hint = f"did you mean {near[0]}?" if near else "warpav modules list shows the shipped ones"
            raise OptionError("rig.modules", f"expected modules out of {', '.join(catalogue)}, got {name!r}; {hint}")
    found = (catalogue[name] for name in config.rig.modules)
    return tuple(found) if config.keeps_rules else tuple(dataclasses.replace(each, role=Role.ANY) for each in found)


def check_one_unit(modules: Iterable[Module]) -> None:
    """Refuse modules whose prices cannot be added."""
    of_unit = {module.price.unit: module.name for module in modules}
    if len(of_unit) > 1:
        given = " and ".join(f"{unit} ({name})" for unit, name in of_unit.items())
        raise OptionError(
            "rig.modules", f"expected prices of one unit, since they are added, got {given}; change them in a catalogue"
        )


def camera_models(config: Config) -> tuple[CameraModel, ...]:
    """The models of all cameras that a rig may have: those of its modules, or the one that its cameras share."""
    models = [(module.beams, module.camera_model()) for module in rig_modules(config)]
    near_m = _near_m(config)
    found = (model if beams else dataclasses.replace(model, near_m=near_m) for beams, model in models)
    return tuple(found) or (camera_model(config),)


def preset_for(name: str, config: Config, ego: Mesh) -> MovedRig:
    """A preset on a vehicle, its images in their own proportions, as ``baselines.preset_images`` says."""
    moved = preset_on_vehicle(name, ego)
    cameras = [dataclasses.replace(each, model=_network_model(each.model, config)) for each in moved.rig.cameras]
    return dataclasses.replace(moved, rig=Rig(cameras))


def _network_model(model: CameraModel, config: Config) -> CameraModel:
    """A camera with the image that a network gets of it; one flush with a body sees what is a centimetre away."""
    model = dataclasses.replace(model, near_m=min(config.camera.near_m, _FLUSH_NEAR_M))
    known = camera_models(config)
    match config.baselines.preset_images:
        case "sensor":
            return model
        case "same_width":
            width_px = max(each.width_px for each in known)
            return model.with_pixels(width_px**2 * model.height_px / model.width_px)
    pixels = [each.width_px * each.height_px for each in known]
    return model.with_pixels(sum(pixels) / len(pixels))


def rig_limits(config: Config, surface: MountSurface) -> RigLimits | None:
    """How many cameras of which module a rig may have; None where all cameras are equal."""
    if config.rig.module_counts is None:
        return None
    from warpav.optimisation import RigLimits

    if config.rig.max_cost is not None:
        check_one_unit(rig_modules(config))
    pairs = surface.pairs or (False,) * len(surface.modules)
    return RigLimits.of(
        config.rig.module_counts,
        count=config.rig.camera_range,
        price={module.name: module.price.value for module in rig_modules(config)},
        cost_max=config.rig.max_cost,
        kinds=[(name, 1 + is_pair) for name, is_pair in zip(surface.modules, pairs, strict=True)],
    )


def free_ranges(config: Config) -> FreeRanges:
    """What may differ from camera to camera besides x, y and yaw."""
    from warpav.optimisation import FreeRanges

    free = config.rig.free
    angles = (
        None if pair is None else (math.radians(pair[0]), math.radians(pair[1]))
        for pair in (free.pitch_deg, free.fov_deg)
    )
    pitch_rad, fov_rad = angles
    return FreeRanges(pitch_rad=pitch_rad, height_m=free.height_m, fov_rad=fov_rad)


def mount_surface(config: Config, ego: Mesh) -> MountSurface:
    """Where cameras may stand on the ego vehicle: in the zones of ``mount.zones``, or on roof and bonnet."""
    paths = [path for path in (config.mount.zones, config.rig.catalogue) if path is not None and path.is_file()]
    files = [(str(path), path.stat().st_mtime_ns) for path in paths]
    settings = config.mount.model_dump_json(), config.rig.model_dump_json(exclude={"symmetric"})
    body = (ego.vertex_m.tobytes(), ego.triangle.tobytes(), ego.vertex_rgb.tobytes())
    made_of = digest(*body, config.rig.is_symmetric, *files, *settings)
    if made_of not in _SURFACES:
        surface = _zones_chart(config, ego) if has_zones(config) else roof_surface(config, ego)
        if config.mount.zones is None and config.rig.modules is None:
            surface = _without_glass(surface, ego)
        for old in list(_SURFACES)[:-1]:
            del _SURFACES[old]
        _SURFACES[made_of] = surface
    return _SURFACES[made_of]


_SURFACES: dict[str, MountSurface] = {}
"""The last two, by what they follow from: a run looks for mistakes in it before it makes scenes, and takes it then."""


_LEAST_PANE_M2, _PANE_DEPTH_M = 0.1, 0.1
"""Less of a pane is its curved edge, and what is farther from its plane is another part of the body."""


def _without_glass(surface: MountSurface, ego: Mesh) -> MountSurface:
    """Roof and bonnet without windscreen and rear window, and the pillars beside them, where these are as flat."""
    point_m, inside, left_out = surface.point_m(surface.place_m, surface.height_m), surface.inside, []
    for pane in parts_of(ego).panes:
        own_m = point_m @ pane.axes.T
        corner_m = np.asarray(pane.outline_m)
        is_near = np.abs(own_m[..., 2] - (corner_m @ pane.axes[2]).mean()) < _PANE_DEPTH_M
        if np.count_nonzero(surface.inside & is_near & pane.holds(own_m)) * surface.cell_m**2 > _LEAST_PANE_M2:
            along = corner_m[:, 0].min() <= point_m[..., 0], point_m[..., 0] <= corner_m[:, 0].max()
            inside = inside & ~(is_near & along[0] & along[1])
            left_out.append(pane.name.replace("_", " "))
    if not left_out or not inside.any():
        return surface
    note = f"glass is left out, though flat enough to carry cameras: {', '.join(left_out)}"
    return dataclasses.replace(surface, is_mountable=inside, notes=(*surface.notes, note))


_ACROSS = np.array([1.0, -1.0, 1.0])
_MIRRORED_M, _SAME_PLACE_M = 0.02, 0.05
"""How far the skin of a symmetric vehicle is from its mirror image, and places of zones from those of others [m]."""


def made_symmetric(config: Config, ego: Mesh, start: Rig | None = None) -> Config:
    """A configuration whose ``rig.symmetric: auto`` means true if all is symmetric, else as it is."""
    if not config.may_be_symmetric:
        return config
    wanted = config.model_copy(update={"rig": config.rig.mirrored()})
    from scipy.spatial import KDTree

    try:
        free = mount_surface(config, ego) if config.mount.zones is not None else None
        mount = camera_mount(wanted, ego)
        constraints_of(wanted, mount.surface)
        if start is not None:
            mount.mount_pose_of_rig(start)
    except InputError:
        return config
    if free is not None:
        there_m, wanted_m = (
            each.point_m(each.place_m[each.inside], each.height_at_m(each.place_m[each.inside]))
            for each in (free, mount.surface)
        )
        if not (KDTree(there_m).query(wanted_m * _ACROSS)[0] <= _SAME_PLACE_M).all():
            return config
    return wanted


def _check_mirrored(surface: MountSurface, ego: Mesh) -> None:
    """See that the skin on the right is the mirror image of that on the left, where cameras may stand."""
    place_m = surface.place_m[surface.inside][::20]
    point_m, normal = surface.point_m(place_m, surface.height_at_m(place_m)), surface.axes[surface.zone_at(place_m), 2]
    off_m = float(np.quantile(skin_distance_m(ego, point_m * _ACROSS, normal * _ACROSS), 0.95))
    if off_m > _MIRRORED_M:
        raise OptionError(
            "rig.symmetric",
            f"expected a vehicle that is its own mirror image, got a skin that is {off_m:.2f} m off on the right; set "
            "rig.symmetric=false, or move the mesh so that y = 0 is its middle",
        )


def _zones_chart(config: Config, ego: Mesh) -> MountSurface:
    path = config.mount.zones
    if path is not None:
        zones = read_zones(path)
    elif config.rig.modules is not None:
        zones = propose_zones(ego)
    else:
        height_m = config.rig.free.height_m or (config.rig.height_offset_m, config.rig.height_offset_m)
        top = Zone("top", NORMALS["up"], stand_off_m=height_m)
        ahead = dataclasses.replace(top, name="top_middle", is_centred=True)
        zones = top, ahead, dataclasses.replace(ahead, name="top_middle_rear", yaw_rad=(math.pi, math.pi))
    if config.rig.is_symmetric and not any(zone.is_centred for zone in zones):
        all_round = any(module.beams and module.beams.is_all_round for module in rig_modules(config))
        zones = with_middles(zones, upwards=all_round)
    try:
        surface = chart_of(
            zones,
            ego,
            modules=rig_modules(config),
            pair_spacing_m=config.rig.min_spacing_m if config.rig.is_symmetric else None,
            pitch_rad=free_ranges(config).pitch_rad or (0.0, 0.0),
            cell_m=config.mount.cell_m,
            min_upward_normal=config.mount.min_upward_normal,
            min_zone_normal=config.mount.min_zone_normal,
        )
    except InputError as error:
        raise InputError(str(error) if path is None else f"{path}: {error}") from None
    if config.rig.is_symmetric:
        _check_mirrored(surface, ego)
    return surface


def roof_surface(config: Config, ego: Mesh) -> MountSurface:
    """Roof and bonnet of the ego vehicle."""
    return mount_surface_from_mesh(
        ego,
        cell_m=config.mount.cell_m,
        min_upward_normal=config.mount.min_upward_normal,
        min_zone_normal=config.mount.min_zone_normal,
        smoothing_tolerance_m=config.mount.smoothing_tolerance_m,
    )


def camera_mount(config: Config, ego: Mesh, *, say: Callable[[str], None] | None = None) -> CameraMount:
    """The mount surface of the ego vehicle on the device, with the cameras of the configuration."""
    from warpav.optimisation import CameraMount

    surface = mount_surface(config, ego)
    if say is not None:
        for note in surface.notes:
            say(note)
    if any(surface.panes) and (config.search_kind == "descent" or not config.losses.is_by_single_cameras):
        raise OptionError(
            "mount.zones",
            "expected no zone with behind_glass, as only the search by a pool, with the loss expected_miss_rate alone, "
            "knows such cameras; set optimiser.search=pool, or leave the losses as they are",
        )
    models = dict(zip(config.rig.module_counts or (), camera_models(config), strict=False))
    housings = {module.name: module.housing for module in rig_modules(config)}
    roles = {module.name: module.role for module in rig_modules(config)}
    return CameraMount(
        surface,
        camera=[models[name] for name in surface.modules] if surface.modules else camera_model(config),
        # zones have their own stand-off
        height_offset_m=0.0 if has_zones(config) else config.rig.height_offset_m,
        device=checked_device(config.device),
        free=free_ranges(config),
        housings=[housings[name] for name in surface.modules],
        roles=[roles[name] for name in surface.modules],
    )


def constraints_of(config: Config, surface: MountSurface, frozen: FrozenCameras | None = None) -> Constraints:
    """What the method demands of the places of the cameras."""
    from warpav.optimisation import ZoneAndSpacing

    if config.method == "thesis":
        from warpav.thesis import BoundsAndSpacing

        return BoundsAndSpacing(surface, min_spacing_m=config.rig.min_spacing_m)
    limits = rig_limits(config, surface)
    module = None if limits is None else limits.first_kinds()
    return ZoneAndSpacing(
        surface,
        camera_count=config.rig.cameras if module is None else len(module),
        min_spacing_m=config.rig.min_spacing_m,
        margin_m=config.mount.margin_m,
        frozen=frozen,
        module=module,
    )


def objective_options(config: Config) -> ObjectiveOptions:
    """How scenes are looked at."""
    from warpav.optimisation import ObjectiveOptions

    kinds = {model.beams is None for model in camera_models(config)}
    if config.lidar.fused.is_set and len(kinds) < 2:
        raise OptionError(
            "lidar.fusion",
            f"expected any, as rig.modules has no {'LiDAR' if kinds == {True} else 'camera'}, got "
            f"{config.lidar.fusion}; add one, or set lidar.fusion=any",
        )
    return ObjectiveOptions(
        confidence_min=config.detector.confidence_min,
        iou_min=config.detector.iou_min,
        false_alarms_per_image=config.evaluation.false_alarms_per_image,
        occlusion=Occlusion(config.visibility.occlusion),
        supersampling=config.camera.supersampling,
        multiplier_damping=config.optimiser.damping(are_inequalities=config.method != "thesis"),
        lidar=config.lidar.curve,
        fusion=config.lidar.fused,
        false_alarms=config.losses.false_alarms,
        cameras_have_bodies=config.keeps_rules,
    )


def checked_frozen(config: Config, start: Rig, freeze: Collection[str]) -> Rig:
    """The rig that a run starts from, as a mount can hold some of its cameras."""
    named = "the start rig" if config.rig.start in NAMED_STARTS else config.rig.start
    shared, known = camera_model(config), [camera.name for camera in start.cameras]
    cameras = []
    for camera in start.cameras:
        model = dataclasses.replace(camera.model, near_m=shared.near_m)
        cameras.append(dataclasses.replace(camera, model=model))
    models = {camera.name: camera.model for camera in cameras}
    for name in freeze:
        if name not in known:
            near = difflib.get_close_matches(name, known, 1, 0.5)
            hint = f"; did you mean {near[0]}?" if near else ""
            names = f"{', '.join(known)}, the cameras of {named}"
            raise OptionError("rig.freeze", f"expected names out of {names}, got {name!r}{hint}")
        model = models[name]
        if config.rig.modules is not None:
            continue  # the mount says whether it is one of its modules
        if not model.fits_beside(shared):
            raise OptionError(
                "rig.freeze",
                "expected cameras with the image and the lens of the others, but for the field of view, got "
                f"{name} with {model.width_px} x {model.height_px} px ({model.lens}"
                f"{', calibrated' if model.focal_px else ''}) beside {shared.width_px} x {shared.height_px} px "
                f"({shared.lens}); {_as_frozen(model)}",
            )
        alike = config.losses.one_field
        if alike and model.log_zoom_over(shared):
            raise OptionError(
                "rig.freeze",
                f"expected cameras of camera.fov_deg={config.camera.fov_deg:g}, as losses.{alike[0]} takes one field "
                f"of view for all, got {name} with {math.degrees(model.fov_rad):g}",
            )
    return Rig(cameras)


def _as_frozen(model: CameraModel) -> str:
    """How a run's cameras can have the image and the lens of a camera."""
    if model.focal_px is not None:
        return "replace focal_px and centre_px by fov_deg in the rig's file"
    options = f"camera.width_px={model.width_px} camera.height_px={model.height_px}"
    if model.lens is Lens.PINHOLE:
        return f"set {options} camera.lens=pinhole, or write the camera with the smaller image into a rig's file"
    numbers = ",".join(f"{value:g}" for value in model.distortion)
    angle = f" camera.fov_deg={math.degrees(model.fov_rad):g}"
    return f"set {options} camera.lens={model.lens}{angle} camera.distortion=[{numbers}]"


def with_shared_model(rig: Rig, config: Config) -> Rig:
    """A rig from a file, its cameras completed by the camera model of a configuration."""
    known = camera_models(config)
    housings = {module.name: module.housing for module in rig_modules(config)}
    cameras = []
    for camera in rig.cameras:
        completed = [_completed(camera.model, shared) for shared in known]
        model = next((model for model in completed if model in known), completed[0])
        housing = housings.get(camera.module or PLAIN, camera.housing)
        cameras.append(dataclasses.replace(camera, model=model, housing=housing))
    return Rig(cameras)


def _completed(model: CameraModel, shared: CameraModel) -> CameraModel:
    """A model from a file with what files do not hold: the near plane, and the decimals that were rounded off."""
    if model.beams is not None:
        return model
    model = dataclasses.replace(model, near_m=shared.near_m)
    same_fov = np.isclose(model.fov_rad, shared.fov_rad, rtol=0.0, atol=_SAME_CAMERA_TOLERANCE)
    is_shared = same_fov and model.focal_px is None and dataclasses.replace(model, fov_rad=shared.fov_rad) == shared
    return shared if is_shared else model
