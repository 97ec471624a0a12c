"""A scene from a moment of a recording: the recorded road users around the ego vehicle, on a road made of the lanes.

Positions, headings, velocities and sizes are recorded; bodies, paint, houses and furniture are drawn by seed, from the
makers of the embedded town. The ground is level. The ego vehicle stands where the recorded one did, centre on centre.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from warpav.core.cache import fingerprint
from warpav.raster.mesh import Mesh, merge
from warpav.scene._scene import Scene, Vehicle, yaw_rotation
from warpav.scene.town._houses import KERB_HEIGHT_M, MIRRORS_M, SceneryBuilder
from warpav.scene.town._levels import FLEET_CODE
from warpav.scene.town._street_life import upright_box
from warpav.scene.town._streets import FRAMES_WITHIN_M
from warpav.scene.town._surface_builder import StreetGround
from warpav.scene.town._town import drawn_sky, ego_vehicle
from warpav.scene.town._town_layout import Footprint
from warpav.scene.traffic._road import Body, Road, Roadside, pavement_width_m, road_of, subdivided
from warpav.scene.traffic._road_users import body_mesh, drawn_kind
from warpav.scene.traffic.files import content_digest, read_recording
from warpav.scene.traffic.moments import OVERLAP_MAX_M, REACH_M, Moment
from warpav.scene.traffic.recording import Lanelet, RecordedState, Recording, without_overlaps

if TYPE_CHECKING:
    from warpav.scene._fleet import Fleet

_ROOM_M = 0.45  # of road around whoever stands on it outside the lanes, and free of houses around who walks
_LANE_STEP_M = 2.0
_SHADOW_LAYERS = 16  # shadows that lie over each other get heights of their own
_STREAM = 0x7AF1D
_FLEET_KEY = 0x7AF  # as no level of the town has
_RIDDEN = ("cyclist", "motorcycle")
_ON_FOOT = ("pedestrian", *_RIDDEN)


@dataclass(frozen=True)
class TrafficSource:
    """What a scene from recorded traffic is made of."""

    moment: Moment  # where and when
    seed: int  # draws what was not recorded
    fleet: Fleet | None = None  # vehicles of other makers, in the places of some of the town's; None: none

    def scene(self, ego: Mesh | None = None) -> Scene:
        return self.scene_and_left_out(ego)[0]

    def scene_and_left_out(self, ego: Mesh | None = None) -> tuple[Scene, int]:
        """The scene, and how many road users were left out because the ego vehicle stands in their places."""
        return traffic_scene(read_recording(self.moment.file), self.moment, self.seed, ego=ego, fleet=self.fleet)

    @property
    def fingerprint(self) -> str:
        """Hash of all that the scene depends on besides the ego vehicle."""
        content = content_digest(self.moment.file)
        made_of = (content, self.moment.step, self.moment.ego_id, self.seed)
        if self.fleet is None:
            return fingerprint(*made_of, code=(__name__,))
        return fingerprint(*made_of, self.fleet.share, self.fleet.content, code=(__name__, *FLEET_CODE))


def traffic_scene(
    recording: Recording, moment: Moment, seed: int, *, ego: Mesh | None = None, fleet: Fleet | None = None
) -> tuple[Scene, int]:
    """The scene of a moment, in the ego frame, and how many road users are left out."""
    if seed < 0:
        raise ValueError(f"seed must be 0 or more, got {seed}")
    states, overlapping = without_overlaps(recording.states_at(moment.step), OVERLAP_MAX_M)
    own = next((state for state in states if state.user.user_id == moment.ego_id), None)
    if own is None:
        raise ValueError(f"no road user {moment.ego_id!r} at step {moment.step}")
    rng = np.random.default_rng([_STREAM, seed])
    ego = ego_vehicle() if ego is None else ego
    low_m, high_m = ego.bounds_m().astype(np.float64)
    frame = _EgoFrame(own, 0.5 * (low_m + high_m)[:2])
    recorded = []
    for state in states:
        if state is own or np.linalg.norm(state.centre_m - own.centre_m) > REACH_M:
            continue
        size = state.user.size_m
        kind = drawn_kind(state.user.category, size, rng)
        x, y = frame.point_in_ego(state.centre_m).tolist()
        footprint = Footprint(x, y, frame.yaw_in_ego(state.yaw_rad), size[0], size[1])
        recorded.append(Body(kind, body_mesh(kind, size, rng), footprint, state.velocity_m_s))
    (x, y), (length, width) = frame.centre_ego_m.tolist(), (high_m - low_m)[:2].tolist()
    ego_place = Footprint(x, y, 0.0, length, width)

    road = _road(recording, recorded, ego_place, frame, pavement_width_m(rng))
    builder = SceneryBuilder(rng, StreetGround(), detailed_within_m=FRAMES_WITHIN_M)
    roadside = Roadside(road, [ego_place, *(each.footprint for each in recorded)], rng)
    ground = road.ground(builder, rng)
    road.add_markings(builder)
    roadside.build(builder)
    bodies = [*recorded, *roadside.parked]
    exchange = None if fleet is None else fleet.exchange(_FLEET_KEY, seed)
    users = []
    for number, body in enumerate(bodies, start=1):
        place, mesh = body.footprint, body.mesh
        if exchange is not None:
            size_m = np.array([place.length_m, place.width_m, float(mesh.vertex_m[:, 2].max())])
            mesh = exchange(number, body.kind, mesh, size_m)
        foot_m = np.append(place.centre_m, road.height_m(place.centre_m))
        mesh = mesh.transformed(yaw_rotation(place.yaw_rad), foot_m)
        box = upright_box(mesh, place.yaw_rad)
        velocity = frame.direction_in_ego(body.velocity_m_s - own.velocity_m_s)
        users.append(Vehicle(number, body.kind, mesh, box, velocity))
    _add_shadow(builder, road, ego_place, "ego", 0)
    for number, body in enumerate(bodies, start=1):
        _add_shadow(builder, road, body.footprint, body.kind, number)
    environment = merge([ground, builder.finish(), *roadside.furniture])
    name = f"traffic_{seed:04d}"
    source = f"{recording.recording_id} step {moment.step} ego {moment.ego_id} seed {seed}"
    if overlapping:
        source += f"; left out for overlaps: {', '.join(state.user.user_id for state in overlapping)}"
    if recording.account:
        source += f"; {recording.account}"
    scene = Scene(name, environment, ego, tuple(users), drawn_sky(rng), source)
    around = scene.targeting(("vehicle",)).around(ego)
    return around, len(users) - len(around.road_users)


class _EgoFrame:
    """How the recording's frame becomes the ego frame: the centre of one vehicle's box is that of the other's."""

    def __init__(self, own: RecordedState, centre_ego_m: np.ndarray) -> None:
        c, s = math.cos(own.yaw_rad), math.sin(own.yaw_rad)
        self._ego_from_recording = np.array([[c, s], [-s, c]])
        self._own = own
        self.centre_ego_m = centre_ego_m

    def point_in_ego(self, point_m: np.ndarray) -> np.ndarray:
        return (point_m - self._own.centre_m) @ self._ego_from_recording.T + self.centre_ego_m

    def direction_in_ego(self, direction: np.ndarray) -> np.ndarray:
        return self._ego_from_recording @ direction

    def yaw_in_ego(self, yaw_rad: float) -> float:
        """A heading in the ego frame, -pi to pi."""
        turned_rad = yaw_rad - self._own.yaw_rad
        return math.atan2(math.sin(turned_rad), math.cos(turned_rad))


def _road(
    recording: Recording, recorded: Sequence[Body], place: Footprint, frame: _EgoFrame, pavement_m: float
) -> Road:
    lanelets = []
    for lanelet in recording.lanelets:
        left, right = (frame.point_in_ego(subdivided(line, _LANE_STEP_M)) for line in (lanelet.left_m, lanelet.right_m))
        if min(np.abs(line).max(axis=1).min() for line in (left, right)) <= REACH_M:
            lanelets.append(Lanelet(left, right, lanelet.kinds))
    heavy = [place, *(body.footprint for body in recorded if body.kind not in _ON_FOOT)]
    light = [body.footprint for body in recorded if body.kind in _RIDDEN]  # people on foot step over kerbs
    driven, walked = [], []
    for user, line in recording.tracks:
        way = frame.point_in_ego(line)
        if (np.abs(way).min(axis=0) <= REACH_M).all():
            ways = driven if user.category in ("car", "truck", "bus") else walked
            ways.append((way[(np.abs(way) <= REACH_M).all(axis=1)], user.size_m[1] + 2.0 * _ROOM_M))
    return road_of(
        lanelets,
        [_grown(each, _ROOM_M).corners_m() for each in heavy],
        [_grown(each, _ROOM_M).corners_m() for each in light],
        [way for way in driven if len(way[0]) > 1],
        [way for way in walked if len(way[0]) > 1],
        pavement_m,
    )


def _grown(footprint: Footprint, room_m: float) -> Footprint:
    return replace(footprint, length_m=footprint.length_m + 2.0 * room_m, width_m=footprint.width_m + 2.0 * room_m)


def _add_shadow(builder: SceneryBuilder, road: Road, place: Footprint, kind: str, number: int) -> None:
    distance = float(road.distance_m(place.centre_m))
    layer = number % _SHADOW_LAYERS
    if kind in _ON_FOOT:
        if distance < road.pavement_m:  # beyond there may be grass
            builder.add_shadow(place, layer, distance / road.pavement_m if distance > 0.0 else -1.0)
        return
    height = KERB_HEIGHT_M if distance > 0.0 else 0.0
    builder.add_shadow(place, layer, mirrors_m=MIRRORS_M if kind == "ego" else 0.0, height_m=height)
