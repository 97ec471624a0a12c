"""Whether a rig is all right: every requirement and design rule with its margin, on one page."""

from __future__ import annotations

import io
import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from warpav.core.errors import InputError
from warpav.core.files import check_parent
from warpav.core.warp_setup import checked_device
from warpav.optimisation import DetectionRange
from warpav.raster.mesh import Mesh
from warpav.rig import OFF_SKIN_M, Rig, off_skin_m
from warpav.runs._evaluate import limits_for
from warpav.runs._rig_source import check_rig_source, find_rig
from warpav.runs._scene_set import first_scene
from warpav.runs.config import Config
from warpav.runs.report._statements import RULES
from warpav.runs.report.report import write_check
from warpav.scene import road_user_of
from warpav.sight import (
    Body,
    Checks,
    RequirementResult,
    RuleCheck,
    Rules,
    SectorCounts,
    check_requirements,
    level_ground,
    read_checks,
    read_requirements,
    sight,
)
from warpav.view import Canvas, checked_figure, drawing_of, figure_bytes

_LIGHT_M = np.array([[x, y, 5.0] for x in (15.0, 20.0, 30.0, 40.0, 60.0) for y in (-3.5, 0.0, 3.5)])
"""Traffic lights: how far in front of the body, to the left, and how high [m]."""

_NEAR_EDGES_M = (3.0, 5.0, 7.5, 10.0, 15.0, 20.0)
"""Bands around the vehicle in which redundancy and the loss of a camera count [m]."""

_TOLERANCE_DEG = 1.0
"""By how much all cameras are pitched to see which rules then break [deg]."""


class Item(NamedTuple):
    """One thing that is checked; without a limit it is only shown."""

    about: str
    asked: str
    found: str
    margin: str
    is_kept: bool | None
    is_hard: bool


def check_rig_page(source: str, config: Config, *, requirements: str, out: Path) -> tuple[Path, list[Item]]:
    """Write a page that says whether a rig keeps requirements and design rules; its file and what was checked."""
    check_parent(checked_figure(out, (".html",)), "out")
    wanted, checks = read_requirements(requirements), read_checks(requirements)
    check_rig_source(source)
    ego, device = first_scene(config).ego, checked_device(config.device)
    rig = find_rig(source, config, ego)
    met = check_requirements(rig, ego, wanted, supersampling=config.camera.supersampling, device=device)
    limits = limits_for(source, config)
    items = [
        *_required(met),
        _on_body(rig, ego, max(OFF_SKIN_M, 2.0 * config.rig.height_offset_m)),
        *rule_items(rig, ego, limits, device, wanted=config.rules.limits),
        *_seen(rig, ego, checks, device),
    ]
    items += [*_far(rig, ego, checks, device), _tolerated(rig, ego, limits, checks, device)]
    figures = {
        kind: io.BytesIO(figure_bytes(drawing_of(rig, Canvas(off_screen=True), kind=kind, ego=ego), ".png"))
        for kind in ("ground", "near_field", "redundancy", "plan")
        if kind in ("ground", "near_field") or any(camera.model.beams is None for camera in rig.cameras)
    }
    return write_check(source, items, figures, out), items


def _required(met: RequirementResult) -> Iterator[Item]:
    for each in met.outcomes:
        asked, kind = each.requirement.share, each.requirement.test_object.kind
        gap = "" if each.gap is None or each.is_met else f"; largest gap {each.gap.area_m2:.2f} m², {each.gap.sector}"
        margin = "" if asked is None else f"{100.0 * (each.share - asked):+.1f} points"
        yield Item(
            f"Requirement {each.requirement.name} ({kind})",
            "" if asked is None else f"at least {100.0 * asked:g}% of the points",
            f"{100.0 * each.share:.1f}%{gap}",
            margin,
            None if asked is None else each.is_met,
            each.requirement.is_hard,
        )


def _on_body(rig: Rig, ego: Mesh, most_m: float) -> Item:
    """The camera that is deepest in the body or, where none is in it, farthest off the skin."""
    off_m = off_skin_m(rig, ego)
    spare_m = np.where(off_m < 0.0, off_m, most_m - off_m)
    k = int(spare_m.argmin())
    found = f"{abs(off_m[k]):.2f} m {'inside' if off_m[k] < 0.0 else 'off'} ({rig.cameras[k].name})"
    asked = f"at most {most_m:g} m off the skin, none inside"
    return Item("Cameras on the body", asked, found, f"{spare_m[k]:+.2f} m", bool(spare_m[k] >= 0.0), True)


def rule_items(rig: Rig, ego: Mesh, limits: Rules, device: str, *, wanted: Rules | None = None) -> Iterator[Item]:
    """The design rules, each with its worst camera; ``wanted``: the limits that a run was asked to keep."""
    for each in RuleCheck(rig, ego, limits, device=device).margins:
        factor, unit = (100.0, "%") if each.unit.startswith("of the") else (1.0, " m" if each.unit == "m" else "°")
        is_least = each.rule in ("horizon", "crossing")
        found = "nowhere" if each.value is None else f"{factor * each.value:.3g}{unit}"
        cameras = f" ({', '.join(each.cameras)})" if each.cameras and each.value else ""
        asked, margin = "", ""
        if each.limit is not None:
            asked = f"at {'least' if is_least else 'most'} {factor * each.limit:.3g}{unit}"
        if each.rule == "azimuth_gap" and wanted is not None and wanted.azimuth_gap_rad != limits.azimuth_gap_rad:
            asked += f", as the run kept ({math.degrees(wanted.azimuth_gap_rad or 0.0):.3g}° wanted)"
        if each.limit is not None and each.value is not None:
            slack = (each.value - each.limit) * (1.0 if is_least else -1.0)
            margin = f"{factor * slack + 0.0:+.3g}{unit}"
        yield Item(
            _heading(each.rule), asked, found + cameras, margin, None if each.limit is None else each.is_kept, True
        )


def _heading(rule: str) -> str:
    name = RULES[rule][0]
    return name[0].upper() + name[1:]


def _judged(
    about: str, found: str, value: float, limit: float | None, unit: str, *, is_hard: bool, is_least: bool = True
) -> Item:
    """What has a limit of a number; None: it is shown alone."""
    if limit is None:
        return Item(about, "", found, "", None, is_hard)
    slack = (value - limit) * (1.0 if is_least else -1.0)
    factor = 100.0 if unit == "%" else 1.0
    asked = f"at {'least' if is_least else 'most'} {factor * limit:.0f}{unit}"
    return Item(about, asked, found, f"{factor * slack:+.0f}{unit}", slack >= 0.0, is_hard)


def _tolerated(rig: Rig, ego: Mesh, limits: Rules, checks: Checks, device: str) -> Item:
    """The rules that all cameras pitched up or down would break besides."""

    def broken(pitch_deg: float) -> set[str]:
        cameras = [replace(each, pitch_rad=each.pitch_rad + math.radians(pitch_deg)) for each in rig.cameras]
        margins = RuleCheck(Rig(cameras), ego, limits, device=device).margins
        return {each.rule for each in margins if not each.is_kept}

    further = (broken(_TOLERANCE_DEG) | broken(-_TOLERANCE_DEG)) - broken(0.0)
    text = "; ".join(_heading(each) for each in RULES if each in further) or "no further rule breaks"
    about, is_hard = f"Tolerance: all cameras pitched by ±{_TOLERANCE_DEG:g}°", "tolerance" in checks.hard
    if not checks.tolerance:
        return Item(about, "", text, "", None, is_hard)
    return Item(about, "no further rule breaks", text, f"{-len(further)} rules", not further, is_hard)


def _seen(rig: Rig, ego: Mesh, checks: Checks, device: str) -> Iterator[Item]:
    front_m = float(np.asarray(ego.bounds_m())[1, 0])
    light_m = _LIGHT_M + np.array([front_m, Body.of(ego).centre_m[1], 0.0])
    share = float(sight(rig, light_m, level_ground(ego, device=device)).seen.any(axis=0).mean())
    about, found = "Traffic lights 5 m high, 15 to 60 m ahead", f"{100.0 * share:.0f}% in an image"
    yield _judged(about, found, share, checks.traffic_lights, "%", is_hard="traffic_lights" in checks.hard)
    counts = SectorCounts.of(rig, ego, edges_m=_NEAR_EDGES_M, device=device)
    twice = float((counts.count >= 2)[counts.count >= 0].mean())
    about, found = f"Redundancy: cars by two cameras, up to {counts.edges_m[-1]:g} m", f"{100.0 * twice:.0f}% of cells"
    yield _judged(about, found, twice, checks.redundancy, "%", is_hard="redundancy" in checks.hard)
    k = counts.costliest
    lost, whole = counts.blind_share(counts.without(k)), counts.blind_share(counts.count)
    about = f"Loss of one camera, at worst {counts.camera[k]}"
    found, is_hard = f"{100.0 * lost:.0f}% of the area blind, not {100.0 * whole:.0f}%", "camera_loss" in checks.hard
    yield _judged(about, found, lost, checks.camera_loss, "%", is_hard=is_hard, is_least=False)


def _far(rig: Rig, ego: Mesh, checks: Checks, device: str) -> Iterator[Item]:
    cameras, is_hard = [each for each in rig.cameras if each.model.beams is None], "far_m" in checks.hard
    try:
        if not cameras:
            raise InputError("the rig has LiDARs alone")
        found = DetectionRange.of(Rig(cameras), ego, azimuth_count=8, device=device)
    except InputError as error:
        yield Item("Far field", "" if checks.far_m is None else "a limit", f"not known: {error}", "", None, is_hard)
        return
    limit_m = {str(kind): each for kind, each in (checks.far_m or {}).items()}
    range_m = np.minimum(found.range_m(0.9), found.limit_m())[:, 0]
    for category, ahead_m in zip(found.categories, range_m, strict=True):
        about, limit = f"Far field: {category} found with probability 0.9", limit_m.get(road_user_of(category))
        yield _judged(about, f"{ahead_m:.0f} m ahead", ahead_m, limit, " m", is_hard=is_hard)
