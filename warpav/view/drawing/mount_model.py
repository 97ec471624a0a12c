"""What a workshop drawing shows of a rig: mounts, datums, and the numbers of every camera."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from warpav.raster.mesh import Mesh
from warpav.scene.glb import GLTF_FROM_EGO, ROOT_NODE, add_node
from warpav.view.drawing.sheet import MARK_MM, Mount, Note, Stroke, angles_deg, ordinate_line_mm, text_width_mm
from warpav.view.frustum import frustum_points
from warpav.view.palette import camera_rgb

if TYPE_CHECKING:
    from warpav.rig.module import Housing, Module
    from warpav.rig.rig import RigCamera
if TYPE_CHECKING:
    from warpav.view.drawing.sheet import Mark, Sheet

FRUSTUM_DEPTH_M = 1.0
"""How far frustums reach [m]."""

_BOX = ((0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1), (2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4),
        (1, 5, 7), (1, 7, 3))  # fmt: skip


def housing_corners_m(camera: RigCamera, housing: Housing) -> np.ndarray:
    """The corners of a camera's housing in the ego frame [m], float64 [8, 3]."""
    signs = np.array(list(itertools.product((-0.5, 0.5), repeat=3)))
    corner_camera_m = signs * np.asarray(housing.size_m) + np.asarray(housing.offset_m)
    transform = camera.ego_from_camera
    return corner_camera_m @ transform[:3, :3].T + transform[:3, 3]


def mount_glb(mounts: Sequence[Mount], ego: Mesh | None, modules: Mapping[str, Module]) -> bytes:
    """A rig as GLB: the node ``vehicle``, and for each camera ``<name>/frustum`` and, of a module, ``<name>/housing``.

    Vertices are in the ego frame [m] below one node that turns it into glTF's axes, as in scene files. Extras of a
    frustum hold the numbers of its camera. The same input gives the same bytes.
    """
    import trimesh

    file = trimesh.Scene(base_frame="world")
    file.metadata = {
        "frame": "ego: ISO 8855, x forward, y left, z up, origin on the ground below the rear axle's centre"
    }
    file.graph.update(frame_from="world", frame_to=ROOT_NODE, matrix=GLTF_FROM_EGO)
    if ego is not None:
        add_node(file, "vehicle", ego, {})
    for index, mount in enumerate(mounts):
        camera, colour = mount.camera, camera_rgb(index)
        yaw_deg, pitch_deg, roll_deg = angles_deg(camera)
        numbers = {
            "position_m": [float(value) for value in camera.position_m],
            "yaw_deg": yaw_deg,
            "pitch_deg": pitch_deg,
            "roll_deg": roll_deg,
        }
        sides = [[0, 2, 1], [0, 3, 2], [0, 4, 3], [0, 1, 4], [1, 2, 3], [1, 3, 4]]
        point_m = frustum_points(camera, depth_m=FRUSTUM_DEPTH_M)
        add_node(file, f"{camera.name}/frustum", Mesh.create(point_m, sides, colour), numbers)
        module = modules.get(camera.module or "")
        if module is not None:
            corner_m = housing_corners_m(camera, module.housing)
            add_node(file, f"{camera.name}/housing", Mesh.create(corner_m, _BOX, colour), {"module": module.name})
    data = file.export(file_type="glb")
    assert isinstance(data, bytes)
    return data


_NUMBER_MM = 2.5
"""Height of the digits."""

_CLEAR_MM = 0.6
"""Between a number and anything else."""

_AWAY_MM = (3.0, 4.0, 5.5, 7.0, 9.0, 11.0)
_TURN_COUNT = 24
_SYMBOL_COST, _LINE_COST, _LEADER_COST, _TURN_COST = 1000.0, 10.0, 20.0, 1.0
_STEP_MM = 0.4


def add_numbers(sheet: Sheet) -> None:
    """Number the marks of a sheet, after everything else in its views is there.

    A number stays off marks, arrows and other numbers, and where it can off lines. It is near its mark, behind the
    arrow rather than beside it. Marks that lie on each other and look the same way share a line of numbers.
    """
    symbol_mm = np.concatenate([_mark_points_mm(mark) for mark in sheet.marks])
    lines = [_points_mm(stroke.point_mm, is_closed=stroke.is_closed) for stroke in sheet.strokes]
    lines += [_points_mm(ordinate_line_mm(ordinate)) for ordinate in sheet.ordinates]
    line_mm = np.concatenate(lines)
    for view in sheet.views:
        for group in _groups([mark for mark in sheet.marks if mark.view is view]):
            text = ", ".join(str(mark.camera + 1) for mark in group)
            size_mm = np.array([text_width_mm(text, _NUMBER_MM, is_bold=True), _NUMBER_MM])
            place_mm = np.mean([mark.place_mm for mark in group], axis=0)
            ahead_mm = np.mean([mark.tip_mm for mark in group], axis=0) - place_mm
            middle_mm = _free_place_mm(place_mm, ahead_mm, size_mm, symbol_mm, line_mm)
            leader_mm = _leader_mm(place_mm, middle_mm, size_mm)
            across_mm, up_mm = middle_mm.tolist()
            camera = group[0].camera
            sheet.notes.append(Note("CAMERAS", (across_mm, up_mm), text, _NUMBER_MM, "middle", camera))
            sheet.strokes.append(Stroke("CAMERAS", leader_mm, camera=camera))
            box_mm = middle_mm + 0.5 * size_mm * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
            symbol_mm = np.concatenate([symbol_mm, _points_mm(box_mm, is_closed=True), _points_mm(leader_mm)])


def _free_place_mm(
    place_mm: np.ndarray, ahead_mm: np.ndarray, size_mm: np.ndarray, symbol_mm: np.ndarray, line_mm: np.ndarray
) -> np.ndarray:
    """Where the middle of a number is best."""
    back_rad = math.atan2(-ahead_mm[1], -ahead_mm[0]) if np.linalg.norm(ahead_mm) > 3.0 else 0.25 * math.pi
    reach_mm = _AWAY_MM[-1] + float(size_mm.max()) + 2.0
    symbol_mm, line_mm = (each[(np.abs(each - place_mm) < reach_mm).all(axis=1)] for each in (symbol_mm, line_mm))
    turns_rad = np.linspace(-math.pi, math.pi, _TURN_COUNT, endpoint=False)
    tried = sorted((away_mm + _TURN_COST * abs(turn), away_mm, turn) for away_mm in _AWAY_MM for turn in turns_rad)
    best_mm, least = place_mm, math.inf
    for distance_cost, away_mm, turn_rad in tried:
        if distance_cost >= least:
            break
        angle_rad = back_rad + turn_rad
        middle_mm = place_mm + (away_mm + 0.5 * size_mm) * (math.cos(angle_rad), math.sin(angle_rad))
        cost = distance_cost + _SYMBOL_COST * _is_on(symbol_mm, middle_mm, size_mm)
        cost += _LINE_COST * _is_on(line_mm, middle_mm, size_mm)
        if cost < least:
            leader_mm = _points_mm(_leader_mm(place_mm, middle_mm, size_mm))
            leader_mm = leader_mm[np.linalg.norm(leader_mm - place_mm, axis=1) > 2.0 * MARK_MM]
            apart_mm = np.linalg.norm(leader_mm[:, None] - symbol_mm, axis=-1)
            cost += _LEADER_COST * bool((apart_mm < 0.5 * _CLEAR_MM).any())
        if cost < least:
            best_mm, least = middle_mm, cost
    return best_mm


def _is_on(point_mm: np.ndarray, middle_mm: np.ndarray, size_mm: np.ndarray) -> bool:
    """Whether a number comes too near to one of some points."""
    return bool((np.abs(point_mm - middle_mm) < 0.5 * size_mm + _CLEAR_MM).all(axis=1).any())


def _leader_mm(place_mm: np.ndarray, middle_mm: np.ndarray, size_mm: np.ndarray) -> np.ndarray:
    """From the circle of a mark to just before its number, [2, 2]."""
    half_mm = 0.5 * size_mm + 0.5 * _CLEAR_MM
    end_mm = np.clip(place_mm, middle_mm - half_mm, middle_mm + half_mm)
    towards = (end_mm - place_mm) / np.linalg.norm(end_mm - place_mm)
    return np.stack([place_mm + MARK_MM * towards, end_mm])


def _mark_points_mm(mark: Mark) -> np.ndarray:
    """Points of a mark and its arrow, near enough to each other that no number fits between them."""
    turn_rad = np.linspace(0.0, 2.0 * math.pi, 16, endpoint=False)
    round_mm = mark.place_mm + 1.6 * MARK_MM * np.stack([np.cos(turn_rad), np.sin(turn_rad)], axis=1)
    return np.concatenate([round_mm, _points_mm(np.stack([mark.place_mm, mark.tip_mm]))])


def _points_mm(line_mm: np.ndarray, *, is_closed: bool = False) -> np.ndarray:
    """Points along a line, `_STEP_MM` apart at most."""
    line_mm = np.vstack([line_mm, line_mm[:1]]) if is_closed else line_mm
    parts = [
        np.linspace(start_mm, end_mm, 2 + int(np.linalg.norm(end_mm - start_mm) / _STEP_MM))
        for start_mm, end_mm in itertools.pairwise(line_mm)
    ]
    return np.concatenate(parts)


def _groups(marks: Sequence[Mark]) -> list[list[Mark]]:
    """Marks that overlap and look the same way share a place for their numbers, others stand alone."""
    groups: list[list[Mark]] = []
    for mark in marks:
        for group in groups:
            first = group[0]
            apart_mm = max(np.linalg.norm(mark.place_mm - first.place_mm), np.linalg.norm(mark.tip_mm - first.tip_mm))
            if apart_mm < 2.0 * MARK_MM:
                group.append(mark)
                break
        else:
            groups.append([mark])
    return groups
