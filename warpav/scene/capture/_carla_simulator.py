"""CARLA as a simulator: a running server, synchronous and paused during recording.

Needs the extra ``carla`` (client 0.9.16) and a CARLA 0.9.16 server. Inside this module all poses are right-handed:
``world`` is CARLA's map frame with y turned around by `warpav.core.frames`, so that every product of poses is one
of rotations; only what is handed to the client, and what comes from it, is left-handed.
"""

from __future__ import annotations

import contextlib
import math
import queue
import re
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, Self

import numpy as np

from warpav.core.errors import InputError
from warpav.core.frames import FLU_FROM_RDF, rotation_from_yaw_pitch_roll
from warpav.raster.camera import CameraModel
from warpav.scene._scene import Box
from warpav.scene.capture._capture import (
    EGO_INSTANCE,
    CapturedImage,
    CapturedVehicle,
    CaptureView,
    Simulator,
    SpawnPoint,
    rigid_pose,
)
from warpav.scene.capture._carla_client import (
    Remote,
    boxes_overlap,
    category_of,
    check_pinhole,
    code_from_bgra,
    colours_of,
    depth_from_bgra,
    ego_pose_of_wheels,
    import_carla,
    inverse_pose,
    lane_places,
    meets_box,
    point_of,
    pose_of,
    release_of,
    set_attributes,
    transform_of,
    unreachable,
)

_WAYPOINT_SPACING_M = 10.0
_ANSWER_S = 2.0  # with `REACH_S` below the 5 s within which a missing server is reported
_STEP_S = 0.05
_EGO_BLUEPRINTS = ("vehicle.lincoln.mkz_2020", "vehicle.lincoln.mkz_2017", "vehicle.tesla.model3")
_ROLE, _EGO_ROLE = "warpav", "hero"  # large maps stream their tiles around the actor whose role is "hero"
_DROP_M = 0.4  # vehicles are spawned that far above the road: touching it counts as a collision
_MIN_REST_TICKS, _MAX_REST_TICKS, _REST_SPEED_MPS = 5, 80, 0.05
_MAX_DRIFT_M, _MIN_UPRIGHT = 1.5, math.cos(math.radians(20.0))
_MAX_EGO_PLACES = 20
_LOOK_FROM = ((0.0, 90.0), (0.0, 40.0), (90.0, 40.0), (180.0, 40.0), (270.0, 40.0))  # yaw and nose-down pitch [deg]
_IDENTIFY_SIDE_PX, _MIN_INSIDE_PX = 128, 20
_INSTANCE_MARGIN_M = 0.5  # CARLA's boxes come from collision shapes: mirrors and aerials may exceed them
_CAMERAS = {"rgb": "sensor.camera.rgb", "depth": "sensor.camera.depth", "code": "sensor.camera.instance_segmentation"}
_CALM = ("cloudiness", "precipitation", "precipitation_deposits", "wind_intensity", "fog_density", "wetness")
_PLAIN_IMAGE = {
    "exposure_mode": "histogram",
    **dict.fromkeys(("lens_flare_intensity", "bloom_intensity", "chromatic_aberration_intensity"), "0.0"),
    **dict.fromkeys(("motion_blur_intensity", "motion_blur_max_distortion"), "0.0"),
}
"""What is switched off in colour images. The ``lens_*`` distortion stays at its defaults: they are a pinhole's, and
zeros spoil depth images."""


@dataclass(eq=False)
class _Standing:
    """A vehicle of ours: its actor, its box in the ego frame, and its colours in instance images."""

    actor: Remote
    box: Box
    codes: frozenset[int]


@dataclass(eq=False)
class _Situation:
    """What one call of `begin` has set up."""

    seed: int
    random: np.random.Generator
    world_from_ego: np.ndarray
    standing: dict[int, _Standing] = field(default_factory=dict)
    next_id: int = 1


class CarlaSimulator(Simulator):
    """A CARLA server.

    Use it in a ``with`` statement: entering connects, makes the server synchronous and prepares the world; leaving, for
    whatever reason, destroys every actor that was made and restores weather, vegetation, lights and settings.

    A vehicle settles under physics and is then frozen. Its instance colours are those that fill its 3D box in images
    taken right after spawning.
    """

    def __init__(
        self, *, host: str = "127.0.0.1", port: int = 2000, warm_up_ticks: int = 4, timeout_s: float = 60.0
    ) -> None:
        """Nothing is connected yet; ``warm_up_ticks`` steps pass before an image."""
        if not 0 < port < 65535:
            raise ValueError(f"port must lie between 1 and 65534, got {port}")
        if not 0.0 < timeout_s < math.inf:
            raise ValueError(f"timeout_s must be positive, got {timeout_s}")
        if warm_up_ticks < 0:
            raise ValueError(f"warm_up_ticks must not be negative, got {warm_up_ticks}")
        self.name, self.source = "", ""
        # as captures that are there already were made with: map, vehicle, axle and exposure are the server's
        self.world = f"carla None None None {_WAYPOINT_SPACING_M} {warm_up_ticks} None"
        self._host, self._port = host, port
        self._warm_up_ticks, self._timeout_s = warm_up_ticks, timeout_s
        self._carla: Remote = None
        self._client: Remote = None
        self._world: Remote = None
        self._blueprints: Remote = None
        self._map_title = ""
        self._place_m, self._place_yaw_rad = np.zeros((0, 3)), np.zeros(0)
        self._undo: list[tuple[str, Callable[[], object]]] = []
        self._found: frozenset[int] = frozenset()
        self._made: dict[int, Remote] = {}
        self._situation: _Situation | None = None

    def __enter__(self) -> Self:
        """Connect, take hold of the server, and prepare the world."""
        if self._undo:
            raise RuntimeError("this simulator has been entered already")
        try:
            self._connect()
            self._prepare()
        except BaseException as error:
            self._leave(error)
            raise
        return self

    def __exit__(self, *failure: Any) -> None:  # noqa: ANN401
        self._leave(failure[1])

    def _connect(self) -> None:
        self._carla = import_carla()
        place = f"{self._host}:{self._port}"
        hint = (
            f"start it with ./CarlaUE4.sh -RenderOffScreen -carla-rpc-port={self._port} (CarlaUE4.exe on Windows), or "
            "name another host and port"
        )
        fault = unreachable(self._host, self._port)
        if fault is not None:
            raise InputError(f"CARLA: expected a server at {place}, got: {fault}; {hint}")
        try:
            client = self._carla.Client(self._host, self._port)
            client.set_timeout(_ANSWER_S)
            versions = client.get_client_version(), client.get_server_version()
        except RuntimeError as error:
            text = " ".join(str(error).split())
            raise InputError(f"CARLA: expected a CARLA server at {place}, got no answer ({text}); {hint}") from None
        if release_of(versions[0]) != release_of(versions[1]):
            raise InputError(
                f"CARLA: expected the server at {place} to be of the client's version {versions[0]}, got "
                f"{versions[1]}; start that version's server, or run: pip install carla=={release_of(versions[1])}"
            )
        client.set_timeout(self._timeout_s)
        self._client = client

    def _prepare(self) -> None:
        """Make the server synchronous and the world clear; each change has its undoing noted before it is made."""
        self._world = self._client.get_world()
        carla, world = self._carla, self._world
        lights = world.get_lightmanager().get_turned_on_lights(carla.LightGroup.NONE)
        settings, synchronous = world.get_settings(), world.get_settings()
        synchronous.synchronous_mode, synchronous.no_rendering_mode = True, False
        synchronous.fixed_delta_seconds = _STEP_S
        synchronous.substepping, synchronous.max_substep_delta_time, synchronous.max_substeps = True, 0.01, 10
        self._change("settings", lambda: world.apply_settings(settings), lambda: world.apply_settings(synchronous))
        self._tick()  # actors are listed as of the last step, and a server left synchronous has had none for us
        actors = world.get_actors()
        self._found = frozenset(actor.id for actor in actors)
        strangers = [*actors.filter("vehicle.*"), *actors.filter("walker.*")]
        if strangers:
            raise InputError(
                f"CARLA: expected a world without vehicles and walkers at {self._host}:{self._port}, got "
                f"{len(strangers)} of them; end the programs that spawned them, or start the server again"
            )
        self._blueprints = world.get_blueprint_library()
        carla_map = world.get_map()
        self._map_title = re.sub(r"[^A-Za-z0-9_-]", "_", carla_map.name.rsplit("/", 1)[-1])
        self._place_m, self._place_yaw_rad = lane_places(carla_map, spacing_m=_WAYPOINT_SPACING_M)

        if lights:  # those of the map: CARLA does not list lamps of vehicles here
            manager = world.get_lightmanager()
            self._change("lights", lambda: (manager.turn_on(lights), self._tick()), lambda: manager.turn_off(lights))
        weather = world.get_weather()
        # clear and windless, the sun overhead; shadows lie below what casts them
        noon = carla.WeatherParameters(**dict.fromkeys(_CALM, 0.0), sun_altitude_angle=90.0)
        self._change("weather", lambda: world.set_weather(weather), lambda: world.set_weather(noon))
        signals = list(actors.filter("traffic.traffic_light*"))
        if signals and not signals[0].is_frozen():
            self._change(
                "traffic lights",
                lambda: world.freeze_all_traffic_lights(False),
                lambda: world.freeze_all_traffic_lights(True),
            )
        if self._map_title.endswith("_Opt"):  # only these maps have layers
            leaves = carla.MapLayer.Foliage
            self._change("foliage", lambda: world.load_map_layer(leaves), lambda: world.unload_map_layer(leaves))
            self._tick()
        plants = {plant.id for plant in world.get_environment_objects(carla.CityObjectLabel.Vegetation)}
        if plants:
            self._change(
                "vegetation",
                lambda: world.enable_environment_objects(plants, True),
                lambda: world.enable_environment_objects(plants, False),
            )
        world.set_annotations_traverse_translucency(False)  # the server's default: glass is a surface
        self._undo.append(("actors that an interruption hid", self._sweep))
        self._undo.append(("actors", lambda: self._destroy(list(self._made))))
        self._tick()

    def _change(self, what: str, undo: Callable[[], object], change: Callable[[], object]) -> None:
        self._undo.append((what, undo))  # first: a change that times out may have happened all the same
        change()

    def _leave(self, error: BaseException | None) -> None:
        """Undo everything, newest first; an interruption or a failing step keeps none of the others from it."""
        failures: list[str] = []
        interruption: BaseException | None = None
        is_alive = True
        while self._undo:
            what, undo = self._undo.pop()
            if not is_alive:
                failures.append(what)
                continue
            for is_last in (False, True):
                try:
                    undo()
                except Exception as failure:
                    is_alive = self._answers()
                    if is_last or not is_alive:
                        failures.append(f"{what} ({' '.join(str(failure).split())})")
                        break
                except BaseException as failure:  # Ctrl-C: finish first
                    interruption = failure
                    if is_last:
                        failures.append(what)
                else:
                    break
        self._made.clear()
        self._situation = None
        self._client = self._world = self._blueprints = None
        passed_on = error or interruption
        if failures:
            text = f"CARLA at {self._host}:{self._port} was left changed: {'; '.join(failures)}; restart the server"
            if passed_on is None:
                raise RuntimeError(text)
            passed_on.add_note(text)
        if error is None and interruption is not None:
            raise interruption

    def _answers(self) -> bool:
        """Whether the server still answers; a dead one must not be waited for at every step."""
        try:
            self._client.set_timeout(_ANSWER_S)
            self._client.get_server_version()
            self._client.set_timeout(self._timeout_s)
        except Exception:
            return False
        except BaseException:  # Ctrl-C is no sign of a server error
            return True
        return True

    def begin(self, seed: int) -> Box:
        """As in `Simulator`; the seed chooses the ego vehicle's spawn point."""
        if seed < 0:
            raise ValueError(f"seed must not be negative, got {seed}")
        if self._world is None:
            raise RuntimeError("a CarlaSimulator is used inside a with statement")
        self._situation = None
        self._destroy(list(self._made))
        self._tick()
        known = sorted(blueprint.id for blueprint in self._blueprints.filter("vehicle.*"))
        cars = [name for name in known if category_of(self._blueprints.find(name)) == "car"]
        name = next((name for name in (*_EGO_BLUEPRINTS, *cars) if name in known), None)
        if name is None:
            raise InputError(f"CARLA: expected cars in the server at {self._host}:{self._port}, got none")
        blueprint = self._blueprints.find(name)
        set_attributes(blueprint, {"role_name": _EGO_ROLE, "color": next(iter(colours_of(blueprint)), None)})
        order = np.random.default_rng([seed, 0]).permutation(len(self._place_m))
        for place in order[:_MAX_EGO_PLACES]:
            actor = self._put(blueprint, self._place_m[place], float(self._place_yaw_rad[place]))
            if actor is None:
                continue
            world_from_ego = self._ego_frame(actor)
            self._situation = _Situation(seed, np.random.default_rng([seed, 1]), world_from_ego)
            box = self._box(actor)
            codes = self._identify(box)
            if codes:
                self._situation.standing[EGO_INSTANCE] = _Standing(actor, box, frozenset(codes))
                self.name = f"carla_{self._map_title}_{seed:04d}"
                self.source = f"CARLA {self._map_title} seed {seed}"
                return box
            self._situation = None
            self._take(actor)
        raise InputError(
            f"CARLA: expected a free spawn point for {blueprint.id} on the map {self._map_title}, got {len(order)} "
            f"of which the first {min(len(order), _MAX_EGO_PLACES)} are blocked; choose another seed"
        )

    def spawn_points(self, radius_m: float) -> Sequence[SpawnPoint]:
        """As in `Simulator`; without the ego vehicle's own position."""
        situation = self._begun()
        ego_from_world = inverse_pose(situation.world_from_ego)
        position_m = self._place_m @ ego_from_world[:3, :3].T + ego_from_world[:3, 3]
        heading = np.stack([np.cos(self._place_yaw_rad), np.sin(self._place_yaw_rad), 0.0 * self._place_yaw_rad], -1)
        heading = heading @ ego_from_world[:3, :3].T
        ego = situation.standing[EGO_INSTANCE].box
        away_m = np.hypot(*(position_m[:, :2] - ego.center_m[:2]).T)
        free = (np.hypot(*position_m[:, :2].T) <= radius_m) & (away_m > 0.5 * ego.size_m[0])
        order = np.random.default_rng([situation.seed, 2]).permutation(np.flatnonzero(free))
        return [SpawnPoint(position_m[k], math.atan2(heading[k, 1], heading[k, 0])) for k in order]

    def spawn(self, point: SpawnPoint) -> CapturedVehicle | None:
        """As in `Simulator`: a random car, van, lorry or bus of a random colour, lamps off, frozen."""
        situation = self._begun()
        blueprints = sorted(self._blueprints.filter("vehicle.*"), key=lambda blueprint: blueprint.id)
        blueprints = [blueprint for blueprint in blueprints if category_of(blueprint) is not None]
        if not blueprints:
            raise InputError(f"CARLA: expected vehicles in the server at {self._host}:{self._port}, got none")
        blueprint = blueprints[int(situation.random.integers(len(blueprints)))]
        colours = colours_of(blueprint)
        colour = colours[int(situation.random.integers(len(colours)))] if colours else None
        set_attributes(blueprint, {"role_name": _ROLE, "color": colour})
        world_from_ego = situation.world_from_ego
        heading = world_from_ego[:3, :3] @ [math.cos(point.yaw_rad), math.sin(point.yaw_rad), 0.0]
        position_m = world_from_ego[:3, :3] @ point.position_m + world_from_ego[:3, 3]
        actor = self._put(blueprint, position_m, math.atan2(heading[1], heading[0]))
        if actor is None:
            return None
        self._freeze(actor)
        box = self._box(actor)
        codes: list[int] = []
        if min(box.size_m) > 0.1 and not any(boxes_overlap(box, other.box) for other in situation.standing.values()):
            codes = self._identify(box)
        if not codes or situation.next_id >= EGO_INSTANCE:
            self._take(actor)
            return None
        instance_id = situation.next_id
        situation.next_id += 1
        situation.standing[instance_id] = _Standing(actor, box, frozenset(codes))
        colour_rgb = np.array([codes[0] & 255, codes[0] >> 8 & 255, codes[0] >> 16 & 255], np.uint8)
        return CapturedVehicle(
            instance_id, category_of(blueprint) or "car", box, np.array(point.position_m), point.yaw_rad, colour_rgb
        )

    def remove(self, vehicle: CapturedVehicle) -> None:
        standing = self._begun().standing.get(vehicle.instance_id)
        if standing is None or vehicle.instance_id == EGO_INSTANCE:
            raise ValueError(f"there is no vehicle with instance id {vehicle.instance_id}")
        self._take(standing.actor)
        del self._begun().standing[vehicle.instance_id]

    def capture(self, view: CaptureView) -> CapturedImage:
        situation = self._begun()
        image = self._shoot(view.ego_from_camera, view.model, tuple(_CAMERAS), self._warm_up_ticks)
        code = code_from_bgra(image["code"])
        instance = np.zeros(code.shape, np.uint16)
        for instance_id, standing in situation.standing.items():
            row, column = np.nonzero(np.isin(code, list(standing.codes)))
            ray = view.model.rays(np.stack([column + 0.5, row + 0.5], -1)) @ view.ego_from_camera[:3, :3].T
            meets = meets_box(standing.box, view.ego_from_camera[:3, 3], ray, margin_m=_INSTANCE_MARGIN_M)
            instance[row[meets], column[meets]] = instance_id
        return CapturedImage(
            view=view,
            rgb=np.ascontiguousarray(image["rgb"][..., 2::-1]),
            depth_m=depth_from_bgra(image["depth"]),
            instance=instance,
        )

    def _begun(self) -> _Situation:
        if self._situation is None:
            raise RuntimeError("a CarlaSimulator is used inside a with statement, and begin(seed) comes first")
        return self._situation

    def _put(self, blueprint: Remote, position_m: np.ndarray, yaw_rad: float) -> Remote | None:
        """A vehicle at rest, lamps and physics off; None if it does not come to rest."""
        above_m = position_m + np.array([0.0, 0.0, _DROP_M])
        actor = self._spawn(blueprint, rigid_pose(rotation_from_yaw_pitch_roll(yaw_rad, 0.0, 0.0), above_m))
        if actor is None:
            return None
        carla = self._carla
        actor.apply_control(carla.VehicleControl(hand_brake=True, brake=1.0))
        slow = 0
        for tick in range(_MAX_REST_TICKS):
            self._tick()
            velocity = actor.get_velocity()
            slow = slow + 1 if math.hypot(velocity.x, velocity.y, velocity.z) < _REST_SPEED_MPS else 0
            if slow >= 3 and tick >= _MIN_REST_TICKS:
                break
        actor.set_light_state(carla.VehicleLightState.NONE)  # after the brakes, which light some
        world_from_actor = pose_of(actor.get_transform())
        drift_m = math.hypot(*(world_from_actor[:2, 3] - above_m[:2]))
        if drift_m > _MAX_DRIFT_M or world_from_actor[2, 2] < _MIN_UPRIGHT:
            self._take(actor)
            return None
        return actor

    def _ego_frame(self, actor: Remote) -> np.ndarray:
        """World_from_ego of a vehicle that has come to rest; freezes it."""
        before = pose_of(actor.get_transform())
        wheels = actor.get_physics_control().wheels  # before physics are off: then wheels are no more
        wheel_m = np.array([point_of(wheel.position) for wheel in wheels]).reshape(-1, 3) / 100.0
        radius_m = np.array([wheel.radius for wheel in wheels]) / 100.0
        actor_from_ego = ego_pose_of_wheels((wheel_m - before[:3, 3]) @ before[:3, :3], radius_m)
        if actor_from_ego is None:
            raise InputError(
                f"CARLA: ego vehicle {actor.type_id}: expected the positions of its wheels, got none that are "
                "plausible; use a server with the vehicles that come with CARLA"
            )
        self._freeze(actor)
        return pose_of(actor.get_transform()) @ actor_from_ego

    def _freeze(self, actor: Remote) -> None:
        actor.set_simulate_physics(False)
        self._tick()

    def _box(self, actor: Remote) -> Box:
        """The upright box in the ego frame, along the actor's heading, around the actor's own box."""
        ego_from_actor = inverse_pose(self._begun().world_from_ego) @ pose_of(actor.get_transform())
        bounding = actor.bounding_box
        extent_m = np.abs(point_of(bounding.extent))
        corner_m = np.stack(np.meshgrid(*([-1.0, 1.0],) * 3, indexing="ij"), -1).reshape(-1, 3) * extent_m
        for pose in (pose_of(bounding), ego_from_actor):
            corner_m = corner_m @ pose[:3, :3].T + pose[:3, 3]
        yaw_rad = math.atan2(ego_from_actor[1, 0], ego_from_actor[0, 0])
        ego_from_box = rotation_from_yaw_pitch_roll(yaw_rad, 0.0, 0.0)
        along_m = corner_m @ ego_from_box
        low_m, high_m = along_m.min(axis=0), along_m.max(axis=0)
        return Box(ego_from_box @ (0.5 * (low_m + high_m)), high_m - low_m, yaw_rad)

    def _identify(self, box: Box) -> list[int]:
        """The colours of what fills a box in instance images, the most frequent first; none where it is not seen.

        The box is viewed from above and, if occluded, from its sides. A colour is the vehicle's
        where most of its pixels lie inside the box, the road's surface left out. One that another vehicle has already
        makes both unknowable.
        """
        taken = {code for standing in self._begun().standing.values() for code in standing.codes}
        model = CameraModel(_IDENTIFY_SIDE_PX, _IDENTIFY_SIDE_PX)
        away_m = 0.75 * math.hypot(*box.size_m) + 0.5  # the sphere around the box fills 90 degrees
        for yaw_deg, pitch_deg in _LOOK_FROM:
            link = rotation_from_yaw_pitch_roll(box.yaw_rad + math.radians(yaw_deg), math.radians(pitch_deg), 0.0)
            view = rigid_pose(link @ FLU_FROM_RDF, box.center_m - away_m * link[:, 0])
            image = self._shoot(view, model, ("depth", "code"), 0)
            depth_m, code = depth_from_bgra(image["depth"]), code_from_bgra(image["code"])
            row, column = np.nonzero(np.isfinite(depth_m) & (code != 0))
            ray = model.rays(np.stack([column + 0.5, row + 0.5], -1)) @ view[:3, :3].T
            point_m = view[:3, 3] + depth_m[row, column, None] * ray
            # but for its lowest part, where the road is as near as the vehicle
            is_high = box.local_m(point_m)[:, 2] > -0.3 * box.size_m[2]
            inside = is_high & box.contains(point_m, margin_m=0.1)
            found, where, total = np.unique(code[row, column], return_inverse=True, return_counts=True)
            count = np.bincount(where, weights=inside, minlength=len(found))
            mine = (count >= _MIN_INSIDE_PX) & (count > 0.5 * total)
            codes = [int(code) for code in found[mine][np.argsort(-count[mine], kind="stable")]]
            if codes:
                return [] if taken & set(codes) else codes
        return []

    def _tick(self) -> int:
        return self._world.tick(self._timeout_s)

    def _spawn(self, blueprint: Remote, world_from_actor: np.ndarray) -> Remote | None:
        """Spawn an actor, the only function that does; None if CARLA rejects it."""
        actor = self._world.try_spawn_actor(blueprint, transform_of(self._carla, world_from_actor))
        if actor is not None:
            self._made[actor.id] = actor
        return actor

    def _take(self, actor: Remote) -> None:
        """Destroy a vehicle and let it vanish."""
        self._destroy([actor.id])
        self._tick()

    def _destroy(self, actor_ids: Iterable[int]) -> None:
        """Destroy actors in one call; those that are gone already are forgotten."""
        actor_ids = list(actor_ids)
        if not actor_ids:
            return
        for actor_id in actor_ids:
            actor = self._made.get(actor_id)
            if actor is not None and actor.type_id.startswith("sensor.") and actor.is_listening():
                with contextlib.suppress(RuntimeError):  # destroying it ends its images too
                    actor.stop()
        commands = [self._carla.command.DestroyActor(actor_id) for actor_id in actor_ids]
        for actor_id, response in zip(actor_ids, self._client.apply_batch_sync(commands, False), strict=True):
            if response.error and "not found" not in response.error:
                raise RuntimeError(f"CARLA does not destroy actor {actor_id}: {response.error}")
            self._made.pop(actor_id, None)

    def _sweep(self) -> None:
        """Destroy actors of ours whose making was interrupted before their ids were noted."""
        self._tick()  # actors are listed from the step after their making on
        roles = {_ROLE, _EGO_ROLE}
        self._destroy(
            actor.id
            for actor in self._world.get_actors()
            if actor.id not in self._found
            and actor.type_id.startswith(("vehicle.", "sensor.camera."))
            and actor.attributes.get("role_name") in roles
        )

    def _shoot(
        self, ego_from_camera: np.ndarray, model: CameraModel, kinds: Sequence[str], warm_up_ticks: int
    ) -> dict[str, np.ndarray]:
        """Images of one simulation step from cameras that exist only for it: BGRA, uint8 [row, column, 4] by kind."""
        check_pinhole(model)
        world_from_link = self._begun().world_from_ego @ ego_from_camera @ rigid_pose(FLU_FROM_RDF.T, np.zeros(3))
        size = {"image_size_x": str(model.width_px), "image_size_y": str(model.height_px)}
        size |= {"fov": repr(math.degrees(model.fov_rad)), "sensor_tick": "0.0", "role_name": _ROLE}
        sensor_ids: list[int] = []
        inbox: dict[str, queue.SimpleQueue[Remote]] = {}
        try:
            for kind in kinds:
                blueprint = self._blueprints.find(_CAMERAS[kind])
                set_attributes(blueprint, size)
                if kind == "rgb":  # consistent between views: no lens effects, fixed exposure
                    ends = [blueprint.get_attribute(f"exposure_{end}_bright") for end in ("min", "max")]
                    exposure = repr(0.5 * sum(end.as_float() for end in ends))
                    held = {"exposure_min_bright": exposure, "exposure_max_bright": exposure}
                    set_attributes(blueprint, _PLAIN_IMAGE | held)
                sensor = self._spawn(blueprint, world_from_link)
                if sensor is None:
                    raise RuntimeError(f"CARLA does not spawn {_CAMERAS[kind]}")
                sensor_ids.append(sensor.id)
                inbox[kind] = queue.SimpleQueue()
                sensor.listen(inbox[kind].put)
            for _ in range(warm_up_ticks):
                self._tick()
            frame = self._tick()
            return {kind: self._receive(kind, inbox[kind], frame, model) for kind in kinds}
        finally:
            self._destroy(sensor_ids)

    def _receive(self, kind: str, inbox: queue.SimpleQueue[Remote], frame: int, model: CameraModel) -> np.ndarray:
        """The image of exactly that frame; older ones are passed over."""
        deadline_s = time.monotonic() + self._timeout_s
        while True:
            try:
                image = inbox.get(timeout=max(deadline_s - time.monotonic(), 0.0))
            except queue.Empty:
                raise RuntimeError(
                    f"CARLA's {_CAMERAS[kind]} sent no image of frame {frame} within {self._timeout_s:g} s"
                ) from None
            if image.frame > frame:
                raise RuntimeError(
                    f"CARLA went on to frame {image.frame} while frame {frame} was waited for; another program ticks it"
                )
            if image.frame == frame:
                break
        if (image.width, image.height) != (model.width_px, model.height_px):
            raise RuntimeError(
                f"CARLA's {_CAMERAS[kind]} sent {image.width} x {image.height} pixels where {model.width_px} x "
                f"{model.height_px} were asked for"
            )
        return np.frombuffer(bytes(image.raw_data), np.uint8).reshape(image.height, image.width, 4)
