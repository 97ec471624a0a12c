"""A CARLA server and its client, as small as they can be while a `CarlaSimulator` cannot tell the difference.

Everything is CARLA's own: left-handed axes, degrees, wheels in centimetres, actors that are listed from the next step
on, images that come in another order than they are asked for. Every call to the server is written down and can be made
to fail, before or after it takes effect. What the cameras send is rendered from a toy world of boxes by formulas that
share nothing with warpav.
"""

from __future__ import annotations

import copy
import fnmatch
import functools
import math
import sys
import threading
from dataclasses import dataclass
from types import ModuleType, SimpleNamespace

import numpy as np

from warpav.core.frames import FLU_FROM_RDF, rotation_from_yaw_pitch_roll
from warpav.raster.camera import CameraModel
from warpav.scene import ViewKind
from warpav.scene.capture._capture import CaptureView

GROUND = (1, 77)  # semantic tag and number
VEGETATION_TAG, BUILDING_TAG, CAR_TAG = 9, 3, 14


@dataclass
class Vector3D:
    x: float = 0.0
    y: float = 0.0
    z: float = 0.0


class Location(Vector3D):
    pass


@dataclass
class Rotation:
    pitch: float = 0.0
    yaw: float = 0.0
    roll: float = 0.0


class Transform:
    def __init__(self, location=None, rotation=None):
        self.location, self.rotation = location or Location(), rotation or Rotation()

    def get_matrix(self):
        turn = self.rotation
        (cp, sp), (cy, sy), (cr, sr) = (
            (math.cos(math.radians(angle)), math.sin(math.radians(angle)))
            for angle in (turn.pitch, turn.yaw, turn.roll)
        )
        at = self.location
        return [
            [cp * cy, cy * sp * sr - sy * cr, -cy * sp * cr - sy * sr, at.x],
            [cp * sy, sy * sp * sr + cy * cr, -sy * sp * cr + cy * sr, at.y],
            [sp, -cp * sr, cp * cr, at.z],
            [0.0, 0.0, 0.0, 1.0],
        ]


class BoundingBox:
    def __init__(self, location, extent):
        self.location, self.extent, self.rotation = location, extent, Rotation()


class WeatherParameters:
    def __init__(self, **values):
        self._values = {"sun_altitude_angle": 0.0, "rayleigh_scattering_scale": 0.0331} | values


@dataclass
class WorldSettings:
    synchronous_mode: bool = False
    no_rendering_mode: bool = True
    fixed_delta_seconds: float | None = None
    substepping: bool = True
    max_substep_delta_time: float = 0.02
    max_substeps: int = 8


@dataclass
class VehicleControl:
    throttle: float = 0.0
    steer: float = 0.0
    brake: float = 0.0
    hand_brake: bool = False


MapLayer = type("MapLayer", (), {"Foliage": "foliage"})
CityObjectLabel = type("CityObjectLabel", (), {"Vegetation": "vegetation"})
LightGroup = type("LightGroup", (), {"NONE": "all"})
VehicleLightState = type("VehicleLightState", (), {"NONE": 0})


class ActorAttribute:
    def __init__(self, value, recommended=(), *, modifiable=True):
        self._value, self.recommended_values, self.is_modifiable = value, list(recommended), modifiable

    def as_str(self):
        return self._value

    def as_float(self):
        return float(self._value)

    def as_int(self):
        return int(self._value)


class ActorBlueprint:
    def __init__(self, name, attributes):
        self.id, self._attributes = name, attributes

    def has_attribute(self, name):
        return name in self._attributes

    def get_attribute(self, name):
        return self._attributes[name]

    def set_attribute(self, name, value):
        assert isinstance(value, str), "the client takes strings only"
        assert self._attributes[name].is_modifiable
        self._attributes[name] = ActorAttribute(value, self._attributes[name].recommended_values)


class BlueprintLibrary:
    def __init__(self, blueprints):
        self._blueprints = {blueprint.id: blueprint for blueprint in blueprints}

    def filter(self, pattern):
        return [copy.deepcopy(one) for name, one in self._blueprints.items() if fnmatch.fnmatch(name, pattern)]

    def find(self, name):
        if name not in self._blueprints:
            raise IndexError(f"blueprint '{name}' not found")
        return copy.deepcopy(self._blueprints[name])


class ActorList(list):
    def filter(self, pattern):
        return ActorList(actor for actor in self if fnmatch.fnmatch(actor.type_id, pattern))


def rpc(method):
    """A call that goes to the server."""

    @functools.wraps(method)
    def called(self, *arguments, **named):
        return self._server.call(f"{type(self).__name__}.{method.__name__}", lambda: method(self, *arguments, **named))

    return called


def gets(name, attribute):
    """A call of this name that returns a copy of something of the server's."""
    return rpc(name_it(lambda self: copy.deepcopy(getattr(self._server, attribute)), name))


def sets(name, attribute, where="_server"):
    """A call of this name that sets something of the server's, or of the actor's."""

    def method(self, value):
        setattr(self._server if where == "_server" else self, attribute, copy.deepcopy(value))

    return rpc(name_it(method, name))


def name_it(method, name):
    method.__name__ = name
    return method


class Actor:
    def __init__(self, server, number, blueprint, transform):
        self._server, self.id, self.type_id = server, number, blueprint.id
        self.attributes = {name: one.as_str() for name, one in blueprint._attributes.items()}
        self._at, self._seen = transform, Transform()

    def get_transform(self):
        return copy.deepcopy(self._seen)  # of the last step, and nothing before the first


SHAPE = {  # half sizes, middle, wheels (x, +-y), their radius [m]
    "vehicle.lincoln.mkz_2020": ((2.45, 1.05, 0.74), (0.05, 0.0, 0.75), (-1.35, 1.5, 0.8), 0.35),
    "vehicle.audi.tt": ((2.1, 0.98, 0.69), (0.0, 0.0, 0.7), (-1.2, 1.25, 0.75), 0.34),
    "vehicle.carlamotors.truck": ((4.0, 1.3, 1.7), (0.2, 0.0, 1.75), (-2.0, 2.4, 1.0), 0.5),
    "vehicle.ford.van": ((2.9, 1.1, 1.3), (0.0, 0.0, 1.3), (-1.7, 1.8, 0.85), 0.36),
    "vehicle.vespa.two": ((0.9, 0.0, 0.6), (0.0, 0.0, 0.6), (-0.6, 0.6, 0.0), 0.25),
}


class Vehicle(Actor):
    def __init__(self, server, number, blueprint, transform):
        super().__init__(server, number, blueprint, transform)
        half, middle, self._wheels, self._radius = SHAPE[self.type_id]
        self.bounding_box = BoundingBox(Location(*middle), Vector3D(*half))
        self._physics, self._braked, self._speed, self._lamps = True, False, 0.0, "brake lights"

    @rpc
    def apply_control(self, control):
        self._braked = control.hand_brake

    set_light_state = sets("set_light_state", "_lamps", "actor")
    set_simulate_physics = sets("set_simulate_physics", "_physics", "actor")

    @rpc
    def get_physics_control(self):
        rear, front, side = self._wheels
        matrix = np.array(self._at.get_matrix())
        wheels = []
        for x, y in ((front, -side), (front, side), (rear, -side), (rear, side)):
            place = 100.0 * (matrix @ [x, y, self._radius, 1.0])[:3] * (1.0 if self._physics else 0.0)
            wheels.append(SimpleNamespace(position=Vector3D(*place), radius=100.0 * self._radius))
        return SimpleNamespace(wheels=self._server.wheels_of(wheels))

    def get_velocity(self):
        return Vector3D(0.0, 0.0, -self._speed)

    def _step(self):
        if not self._physics:
            return
        at = self._at.location
        gap = at.z - self._server.height(at.x)
        self._speed = 2.0 if gap > 0.0 else 0.0
        at.z -= min(0.15, gap)
        if gap <= 0.15:
            self._at.rotation = self._server.rotation_on_ground(self._at.rotation.yaw)
        if not self._braked:
            at.x, self._speed = at.x + 0.4, 8.0


class Sensor(Actor):
    def __init__(self, server, number, blueprint, transform):
        super().__init__(server, number, blueprint, transform)
        self._callback = None

    @rpc
    def listen(self, callback):
        self._callback = callback

    @rpc
    def stop(self):
        self._callback = None

    def is_listening(self):
        return self._callback is not None


class TrafficLight(Actor):
    def is_frozen(self):
        return self._server.frozen


class Walker(Actor):
    pass


class Waypoint:
    def __init__(self, transform, *, is_junction=False, lane_type="Driving"):
        self.transform, self.is_junction, self.lane_type = transform, is_junction, SimpleNamespace(name=lane_type)


class Map:
    """A straight street: one lane each way, a junction in the middle, and the map's own points above the lanes."""

    def __init__(self, server):
        self._server, self.name = server, server.map_name

    def get_spawn_points(self):
        points = [self._lane(x, 1.0, above=0.6) for x in (-40.0, -15.0, 15.0, 40.0)]
        bay = self._lane(31.0, 3.5)  # beside the street, heading off to the right
        bay.rotation = self._server.rotation_on_ground(self._server.turn + 50.0)
        return [*points, self._lane(-14.0, 1.0, above=0.6), self._lane(20.0, -1.0, above=0.3), bay]

    def generate_waypoints(self, distance):
        steps = np.arange(-60.0, 60.1, distance)
        points = [Waypoint(self._lane(x, side), is_junction=abs(x) < 6.0) for side in (1.0, -1.0) for x in steps]
        points.append(Waypoint(Transform(Location(0.0, 9.0)), lane_type="Sidewalk"))
        self._server.shuffle.shuffle(points)
        return points

    def get_waypoint(self, location):
        turn = math.radians(self._server.turn)
        along = location.x * math.cos(turn) + location.y * math.sin(turn)
        aside = location.y * math.cos(turn) - location.x * math.sin(turn)
        return Waypoint(self._lane(along, math.copysign(1.0, aside))) if abs(aside) < 4.0 else None

    def _lane(self, along, side, above=0.0):
        turn = math.radians(self._server.turn)
        x = along * math.cos(turn) - 1.75 * side * math.sin(turn)
        y = along * math.sin(turn) + 1.75 * side * math.cos(turn)
        heading = self._server.turn + (0.0 if side > 0.0 else 180.0)
        return Transform(Location(x, y, self._server.height(x) + above), self._server.rotation_on_ground(heading))


class LightManager:
    def __init__(self, server):
        self._server = server

    @rpc
    def get_turned_on_lights(self, _group):
        return sorted(self._server.lights_on)

    @rpc
    def turn_off(self, lights):
        self._server.lights_on -= set(lights)

    @rpc
    def turn_on(self, lights):
        self._server.lights_on |= set(lights)


class World:
    def __init__(self, server):
        self._server = server

    get_settings = gets("get_settings", "settings")
    apply_settings = sets("apply_settings", "settings")
    get_weather = gets("get_weather", "weather")
    set_weather = sets("set_weather", "weather")
    freeze_all_traffic_lights = sets("freeze_all_traffic_lights", "frozen")
    set_annotations_traverse_translucency = sets("set_annotations_traverse_translucency", "sees_through_glass")

    @rpc
    def get_actors(self):
        listed = set() if self._server.was_synchronous else self._server.listed
        return ActorList(self._server.actors[number] for number in sorted(listed))

    @rpc
    def get_blueprint_library(self):
        return self._server.library()

    @rpc
    def get_map(self):
        return Map(self._server)

    @rpc
    def load_map_layer(self, layer):
        self._server.layers.add(layer)

    @rpc
    def unload_map_layer(self, layer):
        assert self._server.map_name.endswith("_Opt"), "this map has no layers"
        self._server.layers.discard(layer)

    @rpc
    def get_environment_objects(self, label):
        return [SimpleNamespace(id=one) for one in self._server.plants if label == CityObjectLabel.Vegetation]

    @rpc
    def enable_environment_objects(self, ids, enable):
        for one in ids:
            self._server.plants[one] = enable

    @rpc
    def try_spawn_actor(self, blueprint, transform):
        return self._server.spawn(blueprint, transform)

    @rpc
    def tick(self, _seconds):
        return self._server.step()

    def get_lightmanager(self):
        return LightManager(self._server)


class DestroyActor:
    def __init__(self, actor):
        assert isinstance(actor, int)
        self.actor_id = actor


class Client:
    _server: Server

    def __init__(self, host, port):
        assert isinstance(host, str)
        assert isinstance(port, int)

    def set_timeout(self, seconds):
        assert seconds > 0.0

    @rpc
    def get_server_version(self):
        if self._server.is_mute:
            raise RuntimeError("time-out of 2500ms while waiting for the simulator,\nmake sure it is ready")
        return self._server.version

    def get_client_version(self):
        return "0.9.16"

    @rpc
    def get_world(self):
        return World(self._server)

    @rpc
    def apply_batch_sync(self, commands, do_tick):
        assert not do_tick
        return [self._server.destroy(command.actor_id) for command in commands]


class Server:
    """What runs behind the client: the ground climbs by a slope along CARLA's x, the street turns towards its y [deg].

    ``calls`` are the names of all calls so far, ``failures`` map the number of a call to the error that it raises, and
    to whether that is before it takes effect; ``seed`` orders the waypoints.
    """

    def __init__(self, *, map_name="Carla/Maps/Town10HD_Opt", slope=0.0, turn=0.0, seed=0):
        self.version, self.is_mute = "0.9.16", False
        self.map_name, self.slope, self.turn = map_name, slope, turn
        self.shuffle = np.random.default_rng(seed)
        self.calls, self.failures, self.faults = [], {}, []
        self.settings, self.weather = WorldSettings(), WeatherParameters(sun_altitude_angle=-20.0, wind_intensity=40.0)
        self.frozen, self.layers, self.plants = False, {MapLayer.Foliage}, {501: True, 502: True}
        self.lights_on, self.sees_through_glass = {1, 2, 5}, True
        self.actors, self.listed, self.next_actor, self.frame = {}, set(), 100, 1000
        self.was_synchronous = False  # nothing is listed before the first step that this client asks for
        self.frozen_collide, self.is_late, self.wheels_of = False, False, lambda wheels: wheels
        self.solids = [
            # a tree over the lane, a house, a car that belongs to the map
            (Transform(Location(-15.0, 1.75, 4.0)), (2.0, 2.0, 0.5), (VEGETATION_TAG, 900), (20, 120, 20), 501),
            (Transform(Location(0.0, 14.0, 4.0)), (30.0, 2.0, 4.0), (BUILDING_TAG, 901), (150, 120, 90), None),
        ]
        if turn:  # the street leads through them
            self.solids.clear()
        self._put(ActorBlueprint("traffic.traffic_light", {}), Transform(), TrafficLight)
        self.listed = set(self.actors)

    def module(self):
        """The package, as it is imported."""
        package = ModuleType("carla")
        client = type("Client", (Client,), {"_server": self})
        names = (Location, Rotation, Transform, Vector3D, BoundingBox, WeatherParameters, WorldSettings, VehicleControl)
        for one in (*names, MapLayer, CityObjectLabel, LightGroup, VehicleLightState):
            setattr(package, one.__name__, one)
        package.Client = client
        package.command = SimpleNamespace(DestroyActor=DestroyActor)
        return package

    def state(self):
        """All that somebody could find changed afterwards."""
        state = {"settings": vars(self.settings), "weather": self.weather._values, "traffic lights": self.frozen}
        state |= {"layers": self.layers, "plants": self.plants, "lights": self.lights_on, "actors": sorted(self.actors)}
        return copy.deepcopy(state)

    def made(self, kind):
        return [actor for actor in self.actors.values() if fnmatch.fnmatch(actor.type_id, kind)]

    def code(self, actor):
        """Tag and number in instance images: not the actor's id."""
        return CAR_TAG, (actor.id * 7919 + 1234) % 65536

    def call(self, name, effect):
        index = len(self.calls)
        self.calls.append(name)
        error, is_before = self.failures.get(index, (None, False))
        if error is not None and is_before:
            raise error
        result = effect()
        if error is not None:
            raise error
        return result

    def library(self):
        def vehicle(name, base_type, wheels, colours):
            attributes = {
                "role_name": ActorAttribute("autopilot"),
                "base_type": ActorAttribute(base_type, modifiable=False),
                "number_of_wheels": ActorAttribute(str(wheels), modifiable=False),
            }
            if colours:
                attributes["color"] = ActorAttribute(colours[0], colours)
            return ActorBlueprint(name, attributes)

        def camera(name):
            values = {"image_size_x": "800", "image_size_y": "600", "fov": "90.0", "sensor_tick": "0.0"}
            values |= {"role_name": "front", "lens_k": "-1.0", "lens_x_size": "0.08"}
            if name == "rgb":
                values |= {"lens_flare_intensity": "0.1", "bloom_intensity": "0.675", "motion_blur_intensity": "0.45"}
                values |= {"exposure_mode": "histogram", "exposure_min_bright": "10.0", "exposure_max_bright": "12.0"}
            return ActorBlueprint(f"sensor.camera.{name}", {key: ActorAttribute(one) for key, one in values.items()})

        return BlueprintLibrary(
            [
                vehicle("vehicle.vespa.two", "motorcycle", 2, ["1,2,3"]),
                vehicle("vehicle.lincoln.mkz_2020", "car", 4, ["10,20,30", "40,50,60"]),
                vehicle("vehicle.audi.tt", "car", 4, ["200,10,10", "10,200,10", "10,10,200"]),
                vehicle("vehicle.ford.van", "van", 4, []),
                vehicle("vehicle.carlamotors.truck", "truck", 6, ["90,90,90"]),
                *(camera(name) for name in ("rgb", "depth", "instance_segmentation")),
            ]
        )

    def spawn(self, blueprint, transform):
        kind = Vehicle if blueprint.id.startswith("vehicle.") else Sensor
        if kind is Vehicle:
            for other in self.made("vehicle.*"):
                apart = math.dist(
                    (transform.location.x, transform.location.y), (other._at.location.x, other._at.location.y)
                )
                if apart < 4.5 and (other._physics or self.frozen_collide):
                    return None
            if transform.location.z - self.height(transform.location.x) < 0.1:
                return None  # it would touch the road
        return self._put(blueprint, transform, kind)

    def _put(self, blueprint, transform, kind):
        self.next_actor += 1
        actor = kind(self, self.next_actor, blueprint, copy.deepcopy(transform))
        self.actors[actor.id] = actor
        return actor

    def destroy(self, number):
        actor = self.actors.pop(number, None)
        if actor is None:
            return SimpleNamespace(error="unable to destroy actor: not found")
        if isinstance(actor, Sensor) and actor.is_listening():
            self.faults.append(f"{actor.type_id} was destroyed while it was listening")
        return SimpleNamespace(error="")

    def step(self):
        assert self.settings.synchronous_mode, "tick in asynchronous mode"
        self.frame, self.was_synchronous = self.frame + 1, False
        for actor in self.actors.values():
            if isinstance(actor, Vehicle):
                actor._step()
        for actor in self.actors.values():
            actor._seen = copy.deepcopy(actor._at)
        self.listed = set(self.actors)
        if not self.settings.no_rendering_mode:
            for sensor in reversed(self.made("sensor.*")):
                if sensor._callback is not None:
                    image = self.picture(sensor)
                    if self.is_late:
                        threading.Timer(0.02, sensor._callback, [image]).start()
                    else:
                        sensor._callback(image)
        return self.frame

    def height(self, x):
        return 3.0 + self.slope * x

    def rotation_on_ground(self, yaw):
        forward = np.array([math.cos(math.radians(yaw)), math.sin(math.radians(yaw)), 0.0])
        forward[2] = self.slope * forward[0]
        forward /= np.linalg.norm(forward)
        up = np.array([-self.slope, 0.0, 1.0]) / math.hypot(self.slope, 1.0)
        right = np.cross(up, forward)
        return Rotation(math.degrees(math.asin(forward[2])), yaw, math.degrees(math.atan2(-right[2], up[2])))

    def picture(self, sensor):
        """What a camera sends: a planar depth, or the colours of what is nearest, per pixel."""
        width, height = int(sensor.attributes["image_size_x"]), int(sensor.attributes["image_size_y"])
        focal = 0.5 * width / math.tan(0.5 * math.radians(float(sensor.attributes["fov"])))
        column, row = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
        ray = np.stack([np.ones_like(row), (column - 0.5 * width) / focal, -(row - 0.5 * height) / focal], -1)
        matrix = np.array(sensor._at.get_matrix())
        ray, eye = ray @ matrix[:3, :3].T, matrix[:3, 3]
        depth = np.full(row.shape, 5000.0)
        rgb, code = np.full((*row.shape, 3), (120, 170, 230), np.uint8), np.zeros((*row.shape, 2), np.int64)

        def paint(distance, hits, colour, label):
            nearer = hits & (distance > 1e-6) & (distance < depth)
            depth[nearer], rgb[nearer], code[nearer] = distance[nearer], colour, label

        slant = ray[..., 2] - self.slope * ray[..., 0]
        with np.errstate(divide="ignore", invalid="ignore"):
            ground = -(eye[2] - 3.0 - self.slope * eye[0]) / slant
        paint(ground, np.isfinite(ground), (80, 80, 80), GROUND)
        solids = [
            (place, half, label, colour)
            for place, half, label, colour, plant in self.solids
            if plant is None or (self.plants[plant] and MapLayer.Foliage in self.layers)
        ]
        for vehicle in self.made("vehicle.*"):
            half, middle, *_ = SHAPE[vehicle.type_id]
            local = Transform(Location(*middle))
            paint_rgb = [int(one) for one in vehicle.attributes.get("color", "250,250,250").split(",")]
            pose = np.array(vehicle._at.get_matrix()) @ np.array(local.get_matrix())
            solids.append((pose, half, self.code(vehicle), paint_rgb))
        for place, half, label, colour in solids:
            pose = np.array(place.get_matrix()) if isinstance(place, Transform) else place
            start, along = (eye - pose[:3, 3]) @ pose[:3, :3], ray @ pose[:3, :3]
            along = np.where(np.abs(along) < 1e-12, 1e-12, along)
            first, last = (-np.array(half) - start) / along, (np.array(half) - start) / along
            enter, leave = np.minimum(first, last).max(-1), np.maximum(first, last).min(-1)
            paint(enter, enter < leave, colour, label)
        bgra = np.full((height, width, 4), 255, np.uint8)
        if sensor.type_id.endswith("rgb"):
            bgra[..., :3] = rgb[..., ::-1]
        elif sensor.type_id.endswith("depth"):
            bits = np.minimum(np.round(depth / 1000.0 * (2**24 - 1)), 2**24 - 1).astype(np.int64)
            bgra[..., 2], bgra[..., 1], bgra[..., 0] = bits & 255, bits >> 8 & 255, bits >> 16
        else:
            bgra[..., 2], bgra[..., 1], bgra[..., 0] = code[..., 0], code[..., 1] & 255, code[..., 1] >> 8
        return SimpleNamespace(frame=self.frame, width=width, height=height, raw_data=bgra.tobytes())


def install(monkeypatch, one):
    """Put a server where the package would be; no socket leads to it."""
    monkeypatch.setitem(sys.modules, "carla", one.module())
    monkeypatch.setattr("warpav.scene.capture._carla_simulator.unreachable", lambda _host, _port: None)


MODEL = CameraModel(96, 64, math.radians(80.0))


def view_from(position_m, *, yaw_rad=0.0, pitch_rad=0.0, model=MODEL):
    pose = np.eye(4)
    pose[:3, :3] = rotation_from_yaw_pitch_roll(yaw_rad, pitch_rad, 0.0) @ FLU_FROM_RDF
    pose[:3, 3] = position_m
    return CaptureView("view", ViewKind.OTHER, pose, model)


def view_above(box, height_m=9.0, model=MODEL):
    """Straight down, from above a box's middle."""
    return view_from(np.add(box.center_m, [0.0, 0.0, height_m]), pitch_rad=math.pi / 2, model=model)


def first_vehicle(simulator, radius_m=40.0):
    for point in simulator.spawn_points(radius_m):
        vehicle = simulator.spawn(point)
        if vehicle is not None:
            return vehicle
    raise AssertionError("no place takes a vehicle")
