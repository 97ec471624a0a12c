"""The traffic of a run: its scenes, read or made, on the device, and the vehicle that carries the cameras."""

from __future__ import annotations

import dataclasses
import importlib.util
import math
import shlex
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from warpav.core.cache import digest, user_cache_folder
from warpav.core.errors import ArgumentError, InputError, OptionError
from warpav.core.progress import NullProgress, Progress
from warpav.core.warp_setup import checked_device, compiling
from warpav.optimisation import RuleSettings
from warpav.raster.camera import CameraModel
from warpav.raster.mesh import Mesh
from warpav.rig import read_zones
from warpav.runs._mounts import camera_mount, has_zones, mount_surface, rig_modules
from warpav.runs.config import Config, RigConfig, RunConfig
from warpav.scene import (
    METHOD_PACKAGES,
    ROAD_USERS,
    BuiltSource,
    CaptureTask,
    DeviceScene,
    Level,
    PlanSettings,
    ReconstructionSettings,
    Scene,
    SceneRecipe,
    SceneTask,
    StoredScene,
    TownSource,
    capture_path,
    capture_scenes,
    ego_vehicle,
    file_of,
    level_of,
    level_of_seed,
    level_scene,
    make_scenes,
    parts_of,
    recordings_of,
    scene_path,
    scenes_of,
    sources_of,
    stored_scenes,
)
from warpav.scene.traffic.files import content_digest
from warpav.scene.traffic.moments import moment_of, search_and_test, traffic_of
from warpav.scene.traffic.traffic_scene import TrafficSource

if TYPE_CHECKING:
    from warpav.optimisation import CameraMount
    from warpav.scene import Fleet

_VEHICLE_RGB = (150, 152, 156)
"""Colour of a vehicle that comes without one."""

_RARE_KERNELS = ("experiments", "thesis", "reconstruction", "raster._b", "raster._ray", "raster._tra", "raster.cal")
"""Kernels that few runs launch, by the beginning of their names: compiled when they are needed."""

_EGO_TOLERANCE_M = 0.2
"""Ego vehicles that were reconstructed from images of different scenes differ by less."""


@dataclass(frozen=True, eq=False)
class SceneSet:
    """Scenes on the device, and the vehicle that carries the cameras."""

    train: list[DeviceScene]  # training scenes; with ``scenes.mirror`` their mirror images after them
    validation: list[DeviceScene]  # scenes on which the rigs of a run are compared; maybe none
    test: list[DeviceScene]  # test scenes; none where a caller brings its own
    mount: CameraMount  # where the cameras may stand, and their model
    ego: Mesh  # the vehicle that carries them
    shown: Scene  # the first test scene, else the first of training, for figures
    _areas: dict[tuple[int, int], np.ndarray] = field(default_factory=dict, repr=False)

    @property
    def scenes(self) -> list[DeviceScene]:
        return [*self.train, *self.validation, *self.test]

    def check_vehicle(self, scene: Scene) -> None:
        """Make sure that a scene is around the same ego vehicle."""
        if not _is_same_size(scene.ego.bounds_m(), self.ego.bounds_m()):
            raise InputError(f"{scene.name}: ego: expected the vehicle of the placement, got another")

    def with_cameras(self, config: Config) -> SceneSet:
        """The same scenes with other cameras, on another mount surface; nothing is loaded."""
        return replace(self, mount=camera_mount(config, self.ego), _areas={})

    def areas(self, scenes: Sequence[DeviceScene], rotation_count: int) -> list[np.ndarray]:
        """What `areas_of` gives for some of `scenes`; rendered when first asked for."""
        new = [scene for scene in scenes if (id(scene), rotation_count) not in self._areas]
        if new:
            found = self.areas_of(new, rotation_count)
            self._areas.update({(id(scene), rotation_count): area for scene, area in zip(new, found, strict=True)})
        return [self._areas[id(scene), rotation_count] for scene in scenes]

    def areas_of(self, scenes: Sequence[DeviceScene], rotation_count: int) -> list[np.ndarray]:
        """Area of every vehicle alone in directions all round [px^2], seen from the middle of the ego vehicle.

        Shapes: returns [vehicle, rotation].
        """
        from warpav.thesis import areas_around

        return areas_around(
            [scene.raster for scene in scenes],
            np.arange(rotation_count) * (2.0 * math.pi / rotation_count),
            np.append(self.ego.bounds_m()[:, :2].mean(axis=0), 0.0),
            CameraModel() if self.mount.is_mixed else self.mount.camera,
            device=self.mount.device,
        )


def scene_part(config: Config) -> Config:
    """The configuration with nothing but what `load_scene_set` looks at; the scenes of equal parts are the same."""
    return Config(
        run=RunConfig(batch_size=1),
        device=config.device,
        scenes=config.scenes,
        capture=config.capture,
        reconstruction=config.reconstruction,
        rig=RigConfig(
            height_offset_m=config.rig.height_offset_m,
            free=config.rig.free,
            modules=config.rig.modules,
            catalogue=config.rig.catalogue,
            cameras=config.rig.cameras,
            symmetric=config.rig.is_symmetric,
            min_spacing_m=config.rig.min_spacing_m if config.rig.is_symmetric else RigConfig().min_spacing_m,
        ),
        camera=config.camera,
        mount=config.mount,
        rules=RuleSettings(enforced=config.keeps_rules),
    )


def same_scenes(one: Config, other: Config) -> bool:
    """Whether two configurations have the same scenes on the same device; cameras and mount surface may differ."""
    parts = [(each.device, each.scenes, each.capture, each.reconstruction) for each in (one, other)]
    return parts[0] == parts[1]


def load_scene_set(config: Config, progress: Progress) -> SceneSet:
    """Open or make the scenes of a configuration, and find where cameras may stand."""
    config = scene_part(config)
    device = checked_device(config.device)
    train, validation, test = _seeds(config)
    recipes = _recipes(config, progress)
    scenes: list[StoredScene] = []
    with compiling(device, but=_RARE_KERNELS):
        made = stored_scenes(recipes, device=device)
        for scene in progress.steps("scenes", made, count=len(recipes)):
            _check_same_vehicle(scene.name, scene.ego_bounds_m, (scenes or [scene])[0].ego_bounds_m)
            if scene.left_out and not recipes[len(scenes)].is_mirrored:
                progress.say(_left_out_text(scene.name, scene.left_out))
            scenes.append(scene)
    _check_targets(config.scenes.targets, scenes, progress)
    first, shown = (load_scenes(config, seeds[:1]) for seeds in (train, test or train))
    ego = next(first).ego
    until = np.cumsum([len(train), len(validation), len(test)])
    return SceneSet(
        [*scenes[: until[0]], *scenes[until[2] :]],
        list(scenes[until[0] : until[1]]),
        list(scenes[until[1] : until[2]]),
        camera_mount(config, ego, say=progress.say),
        ego,
        next(shown),
    )


def prepare_scenes(config: Config, progress: Progress) -> None:
    """Make the scenes of a configuration that nobody made before, so that several processes may open them at once."""
    recipes = _recipes(scene_part(config), progress)
    for _ in progress.steps("scenes", stored_scenes(recipes), count=len(recipes)):
        pass


def _seeds(config: Config) -> tuple[tuple[int, ...], tuple[int, ...], tuple[int, ...]]:
    return config.scenes.train_seeds, config.scenes.validation_seeds or (), config.scenes.test_seeds


def _recipes(config: Config, progress: Progress) -> list[SceneRecipe]:
    """Of the scenes of training, validation and test, and then of the mirror images of the first."""
    train, validation, test = _seeds(config)
    recipes = scene_recipes(config, (*train, *validation, *test), progress)
    if config.scenes.mirror:
        recipes += [replace(recipe, is_mirrored=True) for recipe in recipes[: len(train)]]
    return recipes


def scene_recipes(
    config: Config, seeds: Sequence[int], progress: Progress, *, ego: Mesh | None = None
) -> list[SceneRecipe]:
    """What the scenes of a configuration are made of; those that have to be captured first are captured here."""
    ego, targets = own_vehicle(config) if ego is None else ego, tuple(config.scenes.targets)
    sources: Sequence[BuiltSource | Path]
    if config.scenes.source == "captured":
        sources = list(progress.steps("captured scenes", _captured(config, seeds), count=len(seeds)))
    elif config.scenes.source in ("traffic", "places"):
        sources = _traffic(config, seeds, ego, progress)
    elif config.scenes.source == "town":
        fleet = _traffic_fleet(config)
        of_street = config.scenes.moments_per_street
        sources = [
            TownSource(
                seed, level_of_seed(config.scenes.level, seed), fleet, seed // of_street if of_street > 1 else None
            )
            for seed in seeds
        ]
    else:
        sources = _files_of(config, seeds)
    return [SceneRecipe(source, ego, targets) for source in sources]


def pack_scenes(scenes: Iterable[Scene], counts: tuple[int, int], config: Config, progress: Progress) -> SceneSet:
    """Scenes on the device, and where cameras may stand on the vehicle that they share."""
    device = checked_device(config.device)
    train_count, test_from = counts[0], sum(counts)
    packed: list[DeviceScene] = []
    mirrored: list[DeviceScene] = []
    ego = shown = None
    with compiling(device, but=_RARE_KERNELS):
        for k, scene in enumerate(scenes):
            ego = scene.ego if ego is None else ego
            _check_same_vehicle(scene.name, scene.ego.bounds_m(), ego.bounds_m())
            shown = scene if k in (0, test_from) else shown
            packed.append(DeviceScene.pack(scene, device=device))
            if config.scenes.mirror and k < train_count:
                mirrored.append(DeviceScene.pack(scene.mirrored(), device=device))
    assert ego is not None
    assert shown is not None
    _check_targets(config.scenes.targets, packed, progress)
    return SceneSet(
        packed[:train_count] + mirrored,
        packed[train_count:test_from],
        packed[test_from:],
        camera_mount(config, ego, say=progress.say),
        ego,
        shown,
    )


def load_scenes(
    config: Config, seeds: str | Sequence[int], *, ego: Mesh | None = None, say: Callable[[str], None] | None = None
) -> Iterator[Scene]:
    """The scenes of a configuration, one after the other, in the ego frame [m]: built, recorded, reconstructed or read.

    Their vehicles are the road users that ``scenes.targets`` names. Scenes that went through images hold people and
    cyclists as part of the environment, so there only vehicles can be targets. With ``scenes.ego`` all are around that
    vehicle, without the road users at whose places it stands.

    Args:
        config: Its section ``scenes`` says where they are from; of recorded traffic the test has recordings of its own.
        seeds: Their numbers, or the split whose they are: ``train``, ``validation`` or ``test``.
        ego: The vehicle instead of ``scenes.ego``.
        say: Gets a line about the road users that were left out.

    Raises:
        InputError: Scenes, recordings or the vehicle cannot be used.
    """
    if isinstance(seeds, str):
        if seeds not in (splits := dict(zip(("train", "validation", "test"), _seeds(config), strict=True))):
            raise ArgumentError("seeds", f"expected numbers or one of {', '.join(splits)}, got {seeds!r}")
        seeds = splits[seeds]
    recipes = scene_recipes(config, seeds, NullProgress(), ego=ego)
    for scene, left_out in scenes_of(recipes):
        if left_out and say is not None:
            say(_left_out_text(scene.name, left_out))
        yield scene


def first_scene(config: Config) -> Scene:
    """The first test scene, which figures show."""
    return next(load_scenes(config, config.scenes.test_seeds[:1]))


def load_scene(source: str, config: Config | None = None, *, fleet: Fleet | None = None) -> Scene:
    """The scene that ``source`` means: a GLB file, or the embedded scene of a seed."""
    ego = None if config is None else own_vehicle(config)
    if config is not None and fleet is None:
        fleet = _traffic_fleet(config)
    scene = _scene_of(source, None if config is None else config.scenes.level, fleet)
    return scene if ego is None else scene.around(ego)


def own_vehicle(config: Config) -> Mesh | None:
    """The vehicle of ``scenes.ego`` in the ego frame; None where scenes keep their own."""
    from warpav.scene import examine, read_vehicle_file, shaded

    path = config.scenes.ego
    if path is None:
        return None
    try:
        file = read_vehicle_file(file_of(path))
        found = examine(file, file.usual)
    except InputError as error:
        raise OptionError("scenes.ego", str(error)) from None
    if found.problems:
        raise OptionError(
            "scenes.ego",
            f"{path}: {found.problems[0].text}; warpav vehicle check {shlex.quote(str(path))} says how to fix it",
        )
    return shaded(found.mesh)


def known_vehicle(config: Config) -> Mesh | None:
    """The vehicle that carries the cameras, where it is known before scenes are made."""
    ego = own_vehicle(config)
    if ego is None and config.scenes.source in ("town", "traffic", "places"):
        return ego_vehicle()
    return next(load_scenes(config, config.scenes.train_seeds[:1])).ego if config.scenes.source == "folder" else ego


def check_zones(config: Config) -> None:
    """See that modules and zones can be used, before scenes are made; on the vehicle where that is known before."""
    rig_modules(config)
    if not has_zones(config):
        return
    ego = known_vehicle(config)
    if ego is not None:
        mount_surface(config, ego)
    elif config.mount.zones is not None:
        read_zones(config.mount.zones)


def checked_vehicle(ego: object) -> Mesh:
    """A vehicle that is given as an object, in the ego frame; ``ego`` [vertex, 3]."""
    from warpav.scene import Reading, VehicleFile, examine, shaded

    mesh = ego if isinstance(ego, Mesh) else _mesh_of(ego)
    file = VehicleFile(Path("ego"), mesh.vertex_m, mesh.triangle, mesh.vertex_rgb, Reading("z", "x"), False, "a mesh")
    problems = examine(file, file.usual).problems
    if problems:
        raise ArgumentError("ego", f"{problems[0].text}; move the mesh into the ego frame")
    return mesh if isinstance(ego, Mesh) else shaded(mesh)


def _mesh_of(ego: Any) -> Mesh:  # noqa: ANN401 (checked here)
    pair: tuple[Any, Any] | None = None
    if not isinstance(ego, tuple) and hasattr(ego, "vertices") and hasattr(ego, "faces"):
        pair = ego.vertices, ego.faces
    elif isinstance(ego, tuple) and len(ego) == 2:
        pair = ego
    if pair is None:
        raise TypeError(
            f"ego: expected the path of a mesh file, a Mesh, a trimesh or (vertices, faces), got {type(ego).__name__}"
        )
    try:
        return Mesh.create(*pair, _VEHICLE_RGB, name="ego")
    except (TypeError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise ArgumentError("ego", f"expected numbers of shape [vertex, 3] and [face, 3], got: {error}") from None


def _traffic_fleet(config: Config) -> Fleet | None:
    scenes = config.scenes
    if scenes.vehicles is None:
        return None
    from warpav.scene import USUAL_SHARE, fleet_of

    try:
        return fleet_of(scenes.vehicles, scenes.vehicles_share or USUAL_SHARE)
    except InputError as error:
        raise OptionError("scenes.vehicles", str(error)) from None


def traffic_fleet_digest(config: Config) -> str | None:
    """Hash of the meshes of ``scenes.vehicles``; None where there are none."""
    fleet = _traffic_fleet(config)
    return None if fleet is None else fleet.content


_OF_SEVERAL_FILES = (".urdf", ".usd", ".usda", ".usdc")


def own_vehicle_digest(config: Config) -> str | None:
    """Hash of the file that ``scenes.ego`` names, by which what was made with another is made again; None for none.

    Of a robot or a stage, which other files make up, it is that of their triangles.
    """
    path = config.scenes.ego
    if path is None:
        return None
    try:
        if file_of(path).suffix.lower() in _OF_SEVERAL_FILES:
            from warpav.scene import read_vehicle_file

            file = read_vehicle_file(path, vertices_max=None)
            return digest(file.vertex.tobytes(), file.triangle.tobytes(), file.vertex_rgb.tobytes(), file.usual)
        return digest(file_of(path).read_bytes())
    except OSError as error:
        raise OptionError("scenes.ego", f"expected a readable mesh file, got {str(path)!r}: {error.strerror}") from None


def recordings_digest(config: Config) -> str | None:
    """Hash of the recorded traffic, those for the search and those for the test; None where there is none."""
    scenes = config.scenes
    if scenes.source == "places":
        named = [[(place, recordings_of(place)) for place in part] for part in places_of(config)]
        return digest(*(tuple(tuple(map(content_digest, files)) or place for place, files in part) for part in named))
    if scenes.source != "traffic":
        return None
    parts = search_and_test(scenes.recordings, scenes.test_recordings)
    return digest(*(tuple(content_digest(path) for path in part) for part in parts))


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
    """How a capture becomes a scene."""
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


def _traffic(config: Config, seeds: Sequence[int], ego: Mesh | None, progress: Progress) -> list[BuiltSource]:
    """Moments of recordings, and towns among places: seeds of the test take others than those of the search."""
    scenes, fleet = config.scenes, _traffic_fleet(config)
    bounds_m = (ego_vehicle() if ego is None else ego).bounds_m()
    tested, chosen = set(scenes.test_seeds), set(scenes.validation_seeds or ()) - set(scenes.train_seeds)
    lines: list[str] = []
    found: list[BuiltSource]
    if scenes.source == "places":
        parts = places_of(config)
        part_of = [parts[2 if seed in tested else 1 if seed in chosen else 0] for seed in seeds]
        of_part = {
            part: dict(zip(seeds, sources_of(part, seeds, bounds_m, fleet, say=lines.append), strict=True))
            for part in set(part_of)
        }
        found = [of_part[part][seed] for part, seed in zip(part_of, seeds, strict=True)]
    else:
        search, test = traffic_of(scenes.recordings, scenes.test_recordings, bounds_m, say=lines.append)
        moments = [moment_of(test if seed in tested else search, seed) for seed in seeds]
        found = [TrafficSource(moment, seed, fleet) for moment, seed in zip(moments, seeds, strict=True)]
    if lines and (scenes.recordings or scenes.places):
        more = f", and {len(lines) - 1} recordings more; warpav scenes traffic names them" * (len(lines) > 1)
        progress.say(f"{lines[0]}{more}")
    return found


def places_of(config: Config) -> tuple[tuple[str, ...], tuple[str, ...], tuple[str, ...]]:
    """Places of search, selection and test, where scenes come from places."""
    scenes = config.scenes
    assert scenes.places is not None
    try:
        return parts_of(scenes.places, scenes.selection_places, scenes.test_places)
    except InputError as error:
        raise OptionError("scenes.places", str(error)) from None


def _files_of(config: Config, seeds: Sequence[int]) -> list[Path]:
    assert config.scenes.folder is not None
    files = [scene_path(config.scenes.folder, seed) for seed in seeds]
    missing = [file for file in files if not file.is_file()]
    if missing:
        raise OptionError(
            "scenes.folder",
            f"expected {missing[0].name} in {str(config.scenes.folder)!r}, got no such file "
            f"({len(missing)} of {len(files)} missing); change scenes.train_seeds and scenes.test_seeds",
        )
    return files


def _captured(config: Config, seeds: Sequence[int]) -> Iterator[Path]:
    """Files of scenes that went through images; those that are not there yet are made."""
    folder = config.scenes.folder or user_cache_folder("captured")
    plan, meshes = plan_settings(config), reconstruction_settings(config)
    for seed in seeds:
        captured = CaptureTask(seed, capture_path(folder / "captures", seed), plan)
        scene = SceneTask(seed, scene_path(folder, seed), capture=captured.folder, settings=meshes)
        for outcome in (*capture_scenes([captured]), *make_scenes([scene])):
            if outcome.error is not None:
                raise InputError(outcome.error)
        yield scene.file


def _scene_of(source: str, levels: Sequence[Level] | None, fleet: Fleet | None) -> Scene:
    from warpav.scene import read_scene

    if source.isdecimal() and not Path(source).exists():
        return level_scene(int(source), level_of_seed(levels, int(source)), fleet)
    if not Path(source).is_file():
        raise InputError(f"{source}: scene: expected a GLB file or the seed of an embedded scene, got {source!r}")
    return read_scene(source)


def _left_out_text(name: str, count: int) -> str:
    users = "1 road user" if count == 1 else f"{count} road users"
    return f"{name}: {users} left out, where the ego vehicle stands"


def _check_targets(targets: Sequence[str], scenes: Sequence[DeviceScene], progress: Progress) -> None:
    there = {ROAD_USERS[kind] for scene in scenes for kind in scene.road_user_index}
    absent = [target for target in targets if target not in there]
    if not absent:
        return
    text = f"no {' and no '.join(absent)} in any of the {len(scenes)} scenes"
    hint = "" if "vehicle" in absent else "; scenes made from images hold people as parts of the environment"
    if not there:
        raise OptionError("scenes.targets", f"expected road users that the scenes hold, got {text}{hint}")
    progress.say(f"scenes.targets: {text}, so nothing is optimised or evaluated for them{hint}")


def _is_same_size(one_bounds_m: np.ndarray, other_bounds_m: np.ndarray) -> bool:
    """Whether bounds may be those of one vehicle; how low images show its sides differs by half a metre and more."""
    difference_m = np.abs(one_bounds_m - other_bounds_m)
    difference_m[0, 2] = 0.0
    return bool(difference_m.max() <= _EGO_TOLERANCE_M)


def _check_same_vehicle(name: str, bounds_m: np.ndarray, first_bounds_m: np.ndarray) -> None:
    if not _is_same_size(bounds_m, first_bounds_m):
        raise InputError(f"{name}: ego: expected the same vehicle as in the first scene, got another")


def checked_scenes(name: str, scenes: Sequence[Scene], *, least: int = 1) -> list[Scene]:
    """Scenes of an argument, as a list."""
    if isinstance(scenes, Scene):
        raise TypeError(f"{name}: expected a list of scenes, got one Scene; write [scene]")
    found = list(scenes)
    for scene in found:
        if not isinstance(scene, Scene):
            raise TypeError(f"{name}: expected scenes, such as town([0, 1]) gives, got {type(scene).__name__}")
    if len(found) < least:
        raise ArgumentError(name, "expected at least one scene, got none")
    return found


def are_town(scenes: Sequence[Scene]) -> bool:
    """Whether these are embedded scenes of one level as they are made."""
    found = [level_of(scene.source) for scene in scenes]
    return None not in found and len({one[0] for one in found if one is not None}) <= 1


def scene_options(train: Sequence[Scene], validation: Sequence[Scene], base: Config) -> dict[str, object]:
    """What a configuration can say of scenes: the seeds of embedded ones, and no batch larger than they are many."""
    options: dict[str, object] = {"run.batch_size": min(base.run.batch_size, len(train))}
    if not are_town([*train, *validation]):
        return options
    known = [[one for scene in each if (one := level_of(scene.source)) is not None] for each in (train, validation)]
    seeds = [[seed for _, seed in each] for each in known]
    level = known[0][0][0]
    used = {*seeds[0], *seeds[1]}
    test = [seed for seed in base.scenes.test_seeds if seed not in used] or [max(used) + 1]
    return {
        **options,
        "scenes.source": "town",
        "scenes.level": None if level == "easy" else level,
        "scenes.recordings": None,
        "scenes.test_recordings": None,
        "scenes.train_seeds": list(dict.fromkeys(seeds[0])),
        "scenes.validation_seeds": list(dict.fromkeys(seeds[1])) or None,
        "scenes.test_seeds": test,
    }
