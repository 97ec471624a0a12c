"""How what single cameras detect changes as they move: one render in each scene, one backward pass for all of them.

A camera's probability to detect an object depends on the camera's pose alone, so the Jacobian of all probabilities is
what a tape gives for one rig, pair by pair. On a GPU the launches of every scene are recorded and replayed, several
scenes beside each other: a rig of a few cameras does not fill it.
"""

from __future__ import annotations

import gc
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from weakref import WeakKeyDictionary, ref

import numpy as np
import warp as wp

from warpav.detection import LidarProbability, WholeObjects, away_from, line_of_sight, whole_solid_angle
from warpav.optimisation._mount import MOUNT_POSE_SIZE, CameraMount, PlacedViews
from warpav.optimisation.losses._scene_on_tape import CameraProbability
from warpav.raster.areas import MEASURE_COUNT, Measures, WindowMeasures
from warpav.raster.buffers import Content, lens_of
from warpav.raster.camera import CameraModel
from warpav.raster.chunks import Recording, ViewsAtOnce, beside_each_other, equal_chunks
from warpav.raster.pane import Pane
from warpav.raster.renderer import Renderer
from warpav.scene import DeviceScene, UprightBoxes
from warpav_kernels import raster as kernels

_MEASURED = ("value", "jac_translation", "jac_rotation", "jac_log_focal")
_VECTORS = ("jac_translation", "jac_rotation")


class CameraJacobians:
    """Probabilities of single cameras and their Jacobians, as `SingleCameras.with_jacobian` gives them."""

    def __init__(
        self,
        mount: CameraMount,
        camera: CameraModel,
        probability: CameraProbability,
        renderers_for: Callable[[int], Sequence[Renderer]],
        most_views: int,
        pane: Pane | None = None,
    ) -> None:
        self.mount, self.camera, self.probability = mount, camera, probability
        self._renderers_for, self._at_once, self._pane = renderers_for, ViewsAtOnce(most_views), pane
        self._views: dict[int, _Views] = {}

    def of(self, mount_pose: np.ndarray, scenes: Sequence[DeviceScene]) -> tuple[np.ndarray, np.ndarray]:
        pose = np.ascontiguousarray(mount_pose, np.float32).reshape(-1, MOUNT_POSE_SIZE)
        peopled = [scene for scene in scenes if scene.vehicle_count > 0]
        if not peopled or not len(pose):
            count = sum(scene.vehicle_count for scene in peopled)
            return np.zeros((len(pose), count)), np.zeros((len(pose), count, MOUNT_POSE_SIZE))
        return self._at_once.run(lambda most: self._of(pose, peopled, most), release=self._views.clear)

    def _of(self, pose: np.ndarray, peopled: Sequence[DeviceScene], most: int) -> tuple[np.ndarray, np.ndarray]:
        """`of`, at most so many cameras at once, in scenes none of which is empty."""
        slope = placing_slope(self.mount, pose)
        chunks = equal_chunks(len(pose), most)
        views = self._views_of(len(chunks[0]))
        parts, position_m, turn = [], [], []
        for chunk in chunks:
            filled = chunk[np.minimum(np.arange(views.count), len(chunk) - 1)]
            parts.append(views.shown(pose[filled], peopled).first(len(chunk)))
            position_m.append(views.placed.position_ego_m.numpy()[: len(chunk)].copy())
            turn.append(views.placed.camera_from_ego.numpy()[: len(chunk)].copy())
        if not wp.get_device(self.mount.device).is_cuda:
            views.renderers = ()  # who keeps renderers may let go of them
        # the last chunk is filled up with copies
        shown = _Shown.joined(parts, axis=0).first(len(pose))
        poses = np.concatenate(position_m)[: len(pose)], np.concatenate(turn)[: len(pose)]
        return self._differentiated(shown, *poses, slope)

    def _views_of(self, count: int) -> _Views:
        """Views of at least so many cameras; a GPU keeps all, for what it has recorded, a CPU the last."""
        is_cuda = wp.get_device(self.mount.device).is_cuda
        count = 1 << (count - 1).bit_length() if is_cuda else count  # recording takes longer than views too many
        known = self._views.get(count)
        if known is None:
            if not is_cuda:
                self._views.clear()
            known = self._views[count] = _Views(self.mount, self._renderers_for(count), self._pane)
        elif not is_cuda:
            known.renderers = self._renderers_for(count)
        return known

    def _differentiated(
        self, shown: _Shown, position_ego_m: np.ndarray, camera_from_ego: np.ndarray, slope: _PlacingSlope
    ) -> tuple[np.ndarray, np.ndarray]:
        """Probabilities and Jacobian of what cameras at some places [camera, 3], turned so, are shown."""
        device = self.mount.device
        whole_sr, whole_slope = _whole_and_slope(position_ego_m, shown.box, device)
        sight, sight_by_place, sight_by_spin = _sight_and_slope(
            position_ego_m, camera_from_ego, self.camera, shown.box[0], device
        )
        # every probability is a function of its own pair's measures alone, so one backward pass gives all slopes
        values = (shown.measures["value"], shown.in_frame["value"], whole_sr, *sight)
        leaves = [wp.array(each, dtype=float, device=device, requires_grad=True) for each in values]
        with wp.Tape() as tape:
            seen = self.probability.model.of_measures(
                leaves[0],
                leaves[1],
                WholeObjects(leaves[2], leaves[3], leaves[4], wp.array(shown.kind, dtype=int, device=device)),
                wp.array(shown.contrast, dtype=float, device=device),
                width_px=self.camera.width_px,
                height_px=self.camera.height_px,
            )
            found = self.probability.share_of_box(seen) or seen.probability
        tape.backward(grads={found: wp.ones_like(found)})
        by_measure, by_in_frame, by_whole, *by_sight = (_gradient_of(each) for each in leaves)

        def chained(name: str) -> np.ndarray:
            """The slope of the probability to what a Jacobian is taken to, [camera, object, ...]."""
            return np.einsum("vkm,vkm...->vk...", by_measure, shown.measures[name]) + np.einsum(
                "vkm,vkm...->vk...", by_in_frame, shown.in_frame[name]
            )

        by_position = chained("jac_translation") + by_whole[..., None] * whole_slope
        by_position += np.einsum("fvk,fvki->vki", by_sight, sight_by_place)
        by_spin = chained("jac_rotation") + np.einsum("fvk,fvki->vki", by_sight, sight_by_spin)
        jacobian = (
            np.einsum("vki,vij->vkj", by_position, slope.position)
            + np.einsum("vki,vij->vkj", by_spin, slope.rotation)
            + chained("jac_log_focal")[..., None] * slope.log_zoom[:, None]
        )
        return found.numpy().astype(np.float64), jacobian


class _Views:
    """So many views that are rendered in one scene after another."""

    def __init__(self, mount: CameraMount, renderers: Sequence[Renderer], pane: Pane | None) -> None:
        self._mount, self._pane = mount, pane
        self.renderers = renderers
        self.count = renderers[0].view_count  # how many
        self._pose = wp.zeros((self.count, MOUNT_POSE_SIZE), dtype=float, device=mount.device)
        self.placed = PlacedViews.zeros(self._pose, 1)  # their poses, always in the same arrays
        self._recorded: WeakKeyDictionary[DeviceScene, _Recorded] = WeakKeyDictionary()
        self._rooms: WeakKeyDictionary[DeviceScene, _Room] = WeakKeyDictionary()
        self._streams = [wp.Stream(each.device) for each in renderers if each.device.is_cuda]

    def shown(self, pose: np.ndarray, scenes: Sequence[DeviceScene]) -> _Shown:
        """What cameras [camera, 7] are shown in some scenes, none of them empty."""
        self._pose.assign(pose)
        self._mount.place(self._pose, 1, into=self.placed)
        if self.renderers[0].device.is_cuda:
            return self._replayed(scenes)

        def drawn(scene: DeviceScene, renderer: Renderer) -> _Shown:
            room = self._rooms.get(scene) or self._rooms.setdefault(scene, _Room(renderer, scene))
            _draw(renderer, scene, room, self.placed, self._pane)
            return room.shown()

        return _Shown.joined(beside_each_other(drawn, scenes, self.renderers), axis=1)

    def _replayed(self, scenes: Sequence[DeviceScene]) -> _Shown:
        """The same from recorded launches; the streams, each with a renderer of its own, share the scenes."""
        todo = list(scenes)
        while todo:
            for number, scene in enumerate(todo):
                if scene not in self._recorded:
                    self._recorded[scene] = self._recording(scene, number % len(self._streams))
                taken = self._recorded[scene]
                with wp.ScopedStream(self._streams[taken.stream]):
                    taken.draw()
            for stream in self._streams:
                wp.wait_stream(stream)
            # recorded launches cannot make room for more samples than there were before
            grown = [renderer.grew() for renderer in self.renderers]
            todo = [scene for scene in todo if grown[self._recorded[scene].stream]]
        return _Shown.joined([self._recorded[scene].room.shown() for scene in scenes], axis=1)

    def _recording(self, scene: DeviceScene, stream: int) -> _Recorded:
        """`_draw` of a scene; it holds the scene weakly, so that what is recorded goes with it, and these views not."""
        renderer, weak, placed, pane = self.renderers[stream], ref(scene), self.placed, self._pane
        room = _Room(renderer, scene)

        def draw() -> None:
            held = weak()
            assert held is not None
            _draw(renderer, held, room, placed, pane)

        return _Recorded(room, stream, Recording(draw, renderer))


def _draw(renderer: Renderer, scene: DeviceScene, room: _Room, placed: PlacedViews, pane: Pane | None) -> None:
    """Render a scene and measure it, nothing taped."""
    raster = scene.raster.through(pane)
    poses = placed.position_ego_m, placed.camera_from_ego
    frame = renderer.render(raster, *poses, log_focal=placed.log_zoom, content=Content.MEASURES)
    measures = frame.measure(into=room.measures)
    frame.window_area(visible=False, into=room.in_frame)
    wp.copy(room.contrast, frame.contrast(measures.value))


class LidarJacobians:
    """The same of LiDARs, whose probabilities follow from the points on each object, and of radars."""

    def __init__(
        self,
        mount: CameraMount,
        probability: LidarProbability,
        renderers_for: Callable[[int], Sequence[Renderer]],
        most_views: int,
        pane: Pane | None = None,
    ) -> None:
        self.mount, self.probability, self._pane = mount, probability, pane
        self._renderers_for, self._at_once = renderers_for, ViewsAtOnce(most_views)

    def of(self, mount_pose: np.ndarray, scenes: Sequence[DeviceScene]) -> tuple[np.ndarray, np.ndarray]:
        pose = np.ascontiguousarray(mount_pose, np.float32).reshape(-1, MOUNT_POSE_SIZE)
        peopled = [scene for scene in scenes if scene.vehicle_count > 0]
        shape = len(pose), sum(scene.vehicle_count for scene in peopled)
        if not all(shape):
            return np.zeros(shape), np.zeros((*shape, MOUNT_POSE_SIZE))
        return self._at_once.run(lambda most: self._of(pose, peopled, most), release=gc.collect)

    def _of(self, pose: np.ndarray, peopled: Sequence[DeviceScene], most: int) -> tuple[np.ndarray, np.ndarray]:
        chunks = equal_chunks(len(pose), most)
        renderers = self._renderers_for(len(chunks[0]))
        for scene in peopled:
            scene.upright_box  # noqa: B018 (found once, before threads ask for it)

        def drawn(scene: DeviceScene, renderer: Renderer) -> list[np.ndarray]:
            parts = [self._drawn(pose[chunk], scene, renderer) for chunk in chunks]
            return [np.concatenate(each)[: len(pose)] for each in zip(*parts, strict=True)]

        found = beside_each_other(drawn, peopled, renderers)
        points, by_view, distance_m, by_place = (np.concatenate(each, axis=1) for each in zip(*found, strict=True))
        greatest = self._greatest(pose, peopled, points, by_view, distance_m, by_place)
        kind = np.concatenate([scene.road_user_index for scene in peopled])
        leaves = [
            wp.array(each, dtype=float, device=self.mount.device, requires_grad=True) for each in (points, distance_m)
        ]
        with wp.Tape() as tape:
            _, value = self.probability.of_points(leaves[0], leaves[1], kind, greatest)
        tape.backward(grads={value: wp.ones_like(value)})
        by_points, by_distance = (_gradient_of(each) for each in leaves)
        by_view = by_points * by_view
        by_view[..., :3] += by_distance[..., None] * by_place
        return value.numpy().astype(np.float64), placing_slope(self.mount, pose).chained(by_view)

    def _greatest(
        self,
        pose: np.ndarray,
        peopled: Sequence[DeviceScene],
        points: np.ndarray,
        by_view: np.ndarray,
        *away: np.ndarray,
    ) -> np.ndarray | None:
        """The greatest probabilities of a radar [camera, object], None of a LiDAR; points become percent of boxes."""
        if self.probability.beams.radar is None:
            return None
        position_m = self.mount.place(wp.array(pose, dtype=float, device=self.mount.device), 1).position_ego_m.numpy()
        parts = []
        for scene in peopled:
            box, count = scene.upright_box, scene.vehicle_count
            boxes = (box.centre_ego_m.numpy()[:count], box.half_size_m.numpy()[:count], box.along.numpy()[:count])
            parts.append(_whole_and_slope(position_m, boxes, self.mount.device))
        whole_sr, slope = (np.concatenate(each, axis=1) for each in zip(*parts, strict=True))
        percent = 100.0 / np.maximum(whole_sr[..., None], 1e-12)
        by_view[..., :3] -= points * percent / 100.0 * slope  # of a quotient
        by_view *= percent
        points *= percent
        ends = np.cumsum([scene.vehicle_count for scene in peopled])[:-1]
        of_scene = zip(*(np.split(each, ends, 1) for each in (points, whole_sr, *away)), strict=True)
        return np.concatenate([self.probability.most(*each) for each in of_scene], axis=1)

    def _drawn(self, pose: np.ndarray, scene: DeviceScene, renderer: Renderer) -> tuple[np.ndarray, ...]:
        """Points on each object [camera, object, 1], their Jacobian [..., 7], distances and their slopes [..., 3]."""
        views = self.mount.place(wp.array(pose, dtype=float, device=self.mount.device), 1)
        frame = renderer.render(
            scene.raster.through(self._pane),
            views.position_ego_m,
            views.camera_from_ego,
            log_focal=views.log_zoom,
            content=self.probability.content,
        )
        points = self.probability.points(frame)
        return points.value.numpy(), points.jacobian.numpy()[:, :, 0], *away_from(scene, views.position_ego_m.numpy())


@dataclass(frozen=True, eq=False)
class _Recorded:
    """A scene's recorded launches: where they leave what they find, and the number of their stream and renderer."""

    room: _Room
    stream: int
    draw: Recording


class _Room:
    """Where a render's measures of a scene stand: arrays on the device that share one piece of memory."""

    def __init__(self, renderer: Renderer, scene: DeviceScene) -> None:
        pairs = (renderer.view_count, scene.vehicle_count)
        self._shapes: dict[str, tuple[int, ...]] = {}
        for kind, count in (("measures", MEASURE_COUNT), ("in_frame", 1)):
            for name in _MEASURED:
                self._shapes[f"{kind} {name}"] = (*pairs, count, *((3,) if name in _VECTORS else ()))
        self._shapes["contrast"] = pairs
        ends = np.cumsum([math.prod(shape) for shape in self._shapes.values()])
        self._firsts = dict(zip(self._shapes, [0, *ends[:-1]], strict=True))
        device = renderer.device
        self._memory = wp.zeros(int(ends[-1]), dtype=float, device=device)
        assert self._memory.ptr is not None
        self._pointer = self._memory.ptr
        poses = {
            "position_world_m": wp.zeros(pairs[0], dtype=wp.vec3, device=device),
            "camera_from_world": wp.zeros(pairs[0], dtype=wp.mat33, device=device),
            "log_focal": wp.zeros(pairs[0], dtype=float, device=device),
        }
        self.measures = Measures(**{name: self._array(f"measures {name}") for name in _MEASURED}, **poses)
        self.in_frame = WindowMeasures(
            **{name: self._array(f"in_frame {name}") for name in _MEASURED},
            **poses,
            jac_window=wp.zeros(pairs, dtype=wp.vec4, device=device),
            window_rad=wp.zeros(pairs[0], dtype=wp.vec4, device=device),
        )
        self.contrast = self._array("contrast")
        box = scene.upright_box
        count = pairs[1]
        self._box = (box.centre_ego_m.numpy()[:count], box.half_size_m.numpy()[:count], box.along.numpy()[:count])
        self._kind = scene.road_user_index

    def _array(self, name: str) -> wp.array:
        """A part of the memory by its name, of vectors where the last axis is one."""
        shape = self._shapes[name]
        return wp.array(
            ptr=self._pointer + 4 * int(self._firsts[name]),
            dtype=wp.vec3 if len(shape) == 4 else float,
            shape=shape[:3],
            device=self._memory.device,
        )

    def shown(self) -> _Shown:
        """What stands there, copied to the host."""
        memory = self._memory.numpy()
        found = {
            name: memory[first : first + math.prod(self._shapes[name])].reshape(self._shapes[name])
            for name, first in self._firsts.items()
        }
        return _Shown(
            {name: found[f"measures {name}"] for name in _MEASURED},
            {name: found[f"in_frame {name}"] for name in _MEASURED},
            found["contrast"],
            self._box,
            self._kind,
        )


@dataclass(frozen=True, eq=False)
class _PlacingSlope:
    """How the views of cameras move with their mount poses, float64."""

    position: np.ndarray  # of the centres [m], [camera, 3, 7]
    rotation: np.ndarray  # of the small rotation about the camera's axes [rad], [camera, 3, 7]
    log_zoom: np.ndarray  # of the log zoom, [camera, 7]

    def chained(self, by_view: np.ndarray) -> np.ndarray:
        """Derivatives to the mount poses of what has such to views, both float64 [camera, object, 7]."""
        by_pose = np.einsum("cov,cvk->cok", by_view[..., :3], self.position)
        by_pose += np.einsum("cov,cvk->cok", by_view[..., 3:6], self.rotation)
        return by_pose + by_view[..., 6:] * self.log_zoom[:, None]


def placing_slope(mount: CameraMount, mount_pose: np.ndarray) -> _PlacingSlope:
    """The Jacobian of `CameraMount.place`, by one backward pass through a copy for each number of a view."""
    count, numbers = len(mount_pose), 3 + 9 + 1
    pose = wp.array(np.tile(mount_pose, (numbers, 1)), dtype=float, device=mount.device, requires_grad=True)
    with wp.Tape() as tape:
        views = mount.place(pose, 1)
    parts = np.split(np.repeat(np.eye(numbers, dtype=np.float32), count, axis=0), [3, 12], axis=1)
    arrays = views.position_ego_m, views.camera_from_ego, views.log_zoom
    shaped = [part.reshape(array.numpy().shape) for array, part in zip(arrays, parts, strict=True)]
    seeds = [wp.array(each, dtype=to.dtype, device=mount.device) for to, each in zip(arrays, shaped, strict=True)]
    tape.backward(grads=dict(zip(arrays, seeds, strict=True)))
    slope = _gradient_of(pose).reshape(numbers, count, MOUNT_POSE_SIZE).swapaxes(0, 1)
    # with the vector s the rotation R becomes R + [s]x R
    turned = slope[:, 3:12].reshape(-1, 3, 3, MOUNT_POSE_SIZE)
    skew = np.einsum("vijn,vkj->vikn", turned, views.camera_from_ego.numpy()[:count].astype(np.float64))
    spin = 0.5 * np.stack(
        [skew[:, 2, 1] - skew[:, 1, 2], skew[:, 0, 2] - skew[:, 2, 0], skew[:, 1, 0] - skew[:, 0, 1]], axis=1
    )
    return _PlacingSlope(slope[:, :3], spin, slope[:, 12])


@dataclass(frozen=True, eq=False)
class _Shown:
    """What cameras are shown of the objects of one or more scenes, on the host."""

    measures: dict[str, np.ndarray]  # measures and their Jacobians by name, float32 [camera, object, measure, ...]
    in_frame: dict[str, np.ndarray]  # likewise of the solid angle in the image [sr]
    contrast: np.ndarray  # of colours, float32 [camera, object]
    box: tuple[np.ndarray, np.ndarray, np.ndarray]  # centre, half size [m] and direction of every object's upright box
    kind: np.ndarray  # of every object, index into `ROAD_USERS`, int32 [object]

    @classmethod
    def joined(cls, shown: Sequence[_Shown], *, axis: int) -> _Shown:
        """What chunks of cameras are shown in the same scenes (axis 0), or the same cameras in several scenes (1)."""
        boxes = zip(*(each.box for each in shown), strict=True)
        return cls(
            {name: np.concatenate([each.measures[name] for each in shown], axis) for name in _MEASURED},
            {name: np.concatenate([each.in_frame[name] for each in shown], axis) for name in _MEASURED},
            np.concatenate([each.contrast for each in shown], axis),
            shown[0].box if axis == 0 else tuple(map(np.concatenate, boxes)),  # pyright: ignore[reportArgumentType]
            shown[0].kind if axis == 0 else np.concatenate([each.kind for each in shown]),
        )

    def first(self, count: int) -> _Shown:
        """What the first so many cameras are shown."""
        return _Shown(
            {name: value[:count] for name, value in self.measures.items()},
            {name: value[:count] for name, value in self.in_frame.items()},
            self.contrast[:count],
            self.box,
            self.kind,
        )


def _whole_and_slope(
    position_ego_m: np.ndarray, box: tuple[np.ndarray, np.ndarray, np.ndarray], device: str
) -> tuple[np.ndarray, np.ndarray]:
    """Solid angle of every object's box [sr], [camera, object], and its slope to a camera's centre [sr/m], [..., 3].

    It depends on centre less place alone, so its gradient to the centre is that to the place with the other sign; and a
    centre has a gradient of its own for every object.
    """
    count = len(box[0])
    centre = wp.array(box[0], dtype=wp.vec3, device=device, requires_grad=True)
    boxes = UprightBoxes(
        centre, wp.array(box[1], dtype=wp.vec3, device=device), wp.array(box[2], dtype=wp.vec2, device=device)
    )
    whole_sr, slope = [], []
    for place_m in position_ego_m:
        place = wp.array(place_m[None], dtype=wp.vec3, device=device)
        with wp.Tape() as tape:
            found = whole_solid_angle(place, boxes, vehicle_count=count)
        tape.backward(grads={found: wp.ones_like(found)})
        whole_sr.append(found.numpy()[0])
        slope.append(-_gradient_of(centre))
        tape.zero()
    return np.array(whole_sr), np.array(slope)


def _sight_and_slope(
    position_ego_m: np.ndarray, camera_from_ego: np.ndarray, camera: CameraModel, centre_ego_m: np.ndarray, device: str
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What `line_of_sight` gives, [2, camera, object], with its slopes to a camera's centre and its spin, [..., 3].

    Every pair is a view of its own, of an object in the origin.
    """
    pairs = len(position_ego_m), len(centre_ego_m)
    place = wp.array(
        (position_ego_m[:, None] - centre_ego_m).reshape(-1, 3), dtype=wp.vec3, device=device, requires_grad=True
    )
    turn_of_pair = np.repeat(camera_from_ego, pairs[1], axis=0)
    turn = wp.array(turn_of_pair, dtype=wp.mat33, device=device, requires_grad=True)
    lens = wp.array([lens_of(camera)], dtype=kernels.Lens, device=device)
    with wp.Tape() as tape:
        found = line_of_sight(place, turn, lens, wp.zeros(1, dtype=wp.vec3, device=device), vehicle_count=1)
    by_place, by_spin = [], []
    for each in found:
        tape.backward(grads={each: wp.ones_like(each)})
        by_place.append(_gradient_of(place).reshape(*pairs, 3))
        # with the vector s the rotation R becomes R + [s]x R
        spin = np.cross(turn_of_pair.swapaxes(1, 2), _gradient_of(turn).swapaxes(1, 2)).sum(axis=1)
        by_spin.append(spin.reshape(*pairs, 3))
        tape.zero()
    return np.array([each.numpy().reshape(pairs) for each in found]), np.array(by_place), np.array(by_spin)


def _gradient_of(array: wp.array) -> np.ndarray:
    assert array.grad is not None
    return array.grad.numpy().astype(np.float64)
