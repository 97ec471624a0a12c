"""AlpaSim's cameras: ``extra_cameras`` of a configuration, which replace cameras of a scene that is rendered neurally.

What AlpaSim calls ``rig_to_camera`` is the camera's pose in the vehicle: it maps camera coordinates to the vehicle's.
Lenses are NCore's models. Principal points count from the image's corner, as warpav's do; those of ``ftheta`` alone
count from the centre of the first pixel.

f-theta, a polynomial of the angle from the optical axis, is read as a fisheye: exactly where it has odd powers alone,
else by a fit, which is off by less than `READ_PX`. eucm and double_sphere are written as a fisheye that is off by less
than `WRITE_PX`; f-theta, which has even powers but ends at the fifth, would be 10 to 1000 times farther off.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from warpav.core.frames import quaternion_from_rotation
from warpav.core.yaml_file import yaml_lines, yaml_number, yaml_row
from warpav.raster.camera import CameraModel
from warpav.raster.lens import Lens, LensShape
from warpav.rig.formats._format import (
    Found,
    FoundCamera,
    Losses,
    Optics,
    PlacedCamera,
    Record,
    RigFormat,
    optics_of,
    read_yaml_record,
    rigid_transform,
    unread_note,
)

WRITE_PX = 0.01
"""How far a lens that is written by a fit may be off anywhere in the image [px]."""

_SHUTTERS = (
    "GLOBAL",
    "ROLLING_TOP_TO_BOTTOM",
    "ROLLING_BOTTOM_TO_TOP",
    "ROLLING_LEFT_TO_RIGHT",
    "ROLLING_RIGHT_TO_LEFT",
)
_CAMERAS = (
    "camera_front_wide_120fov",
    "camera_front_tele_30fov",
    "camera_cross_left_120fov",
    "camera_cross_right_120fov",
)
_RADIAL_FACTOR = (0.8, 1.2)  # NCore's pinhole has no image where the distortion moves a point farther
_SAMPLES = 4001
_SAME_ANGLE_RAD = 1e-4
_POWERS = np.array([1, 3, 5, 7, 9])


def _read(path: Path) -> Found:
    record = read_yaml_record(path)
    record.mapping("AlpaSim's configuration with extra_cameras")
    nested = record.at("runtime").at("extra_cameras")
    entries = nested if nested.value is not None else record.at("extra_cameras")
    rows = entries.items("AlpaSim's list of cameras")
    if not rows:
        raise entries.error("at least one camera", "an empty list")
    notes: list[str] = []
    cameras, unread = [], []
    for row in rows:
        row.mapping("a camera with logical_id, rig_to_camera, intrinsics and resolution_hw")
        name = row.at("logical_id").text()
        shutter = row.at("shutter_type")
        if shutter.value is not None and shutter.one_of(_SHUTTERS) != "GLOBAL":
            notes.append(f"camera {name!r}: shutter {shutter.value} is not read, warpav's images are of one moment")
        cameras.append(FoundCamera(name, _rig_from_camera(row.at("rig_to_camera")), _optics(row, name, notes)))
        # which of the two polynomials counts is stated
        unread += row.unread("pixeldist_to_angle", "angle_to_pixeldist")
    return Found(tuple(cameras), (*notes, *unread_note(path, unread)))


def _rig_from_camera(record: Record) -> np.ndarray:
    if record.value is None:
        raise record.error(
            "translation_m and rotation_xyzw; without them the pose is that of a scene, not of this file"
        )
    turn = record.at("rotation_xyzw")
    x, y, z, w = turn.numbers(4)
    return rigid_transform(turn.unit_quaternion((w, x, y, z)), record.at("translation_m").numbers(3), turn)


def _optics(row: Record, name: str, notes: list[str]) -> Optics | None:
    intrinsics, size = row.at("intrinsics"), row.at("resolution_hw")
    height_px, width_px = (None, None)
    if size.value is not None:
        size.numbers(2)
        height_px, width_px = (each.whole() for each in size.items())
    if intrinsics.value is None:
        return None
    readers = {"opencv_pinhole": _pinhole, "opencv_fisheye": _fisheye, "ftheta": _ftheta}
    model = intrinsics.at("model").one_of(readers)
    values = intrinsics.at(model)
    values.mapping(f"the parameters of {model}")
    return readers[model](values, (width_px, height_px), name, notes)


_Size = tuple[int | None, int | None]


def _pinhole(values: Record, size: _Size, name: str, notes: list[str]) -> Optics:
    del name, notes
    k1, k2, k3, k4, k5, k6 = values.at("radial").numbers(6)
    p1, p2 = values.at("tangential").numbers(2)
    if any(values.at("thin_prism").numbers(4)):
        raise values.at("thin_prism").error("four zeros; warpav has no thin prism")
    distortion = (k1, k2, p1, p2, k3, k4, k5, k6)
    count = 8 if any(distortion[5:]) else 5 if k3 else 4
    return Optics(*size, *_focal_and_centre(values), lens=Lens.BROWN_CONRADY, distortion=distortion[:count])


def _fisheye(values: Record, size: _Size, name: str, notes: list[str]) -> Optics:
    distortion = tuple(values.at("radial").numbers(4))
    optics = Optics(*size, *_focal_and_centre(values), lens=Lens.FISHEYE, distortion=distortion)
    _check_max_angle(values, optics, name, notes)
    return optics


def _focal_and_centre(values: Record) -> tuple[None, tuple[float, float], tuple[float, float]]:
    """No field of view, focal lengths and principal point."""
    (fx, fy), (cx, cy) = values.at("focal_length").numbers(2), values.at("principal_point").numbers(2)
    if min(fx, fy) <= 0.0:
        raise values.at("focal_length").error("two positive focal lengths")
    return None, (fx, fy), (cx, cy)


def _ftheta(values: Record, size: _Size, name: str, notes: list[str]) -> Optics:
    if None in size:
        raise values.error("resolution_hw beside intrinsics, because f-theta is fitted over the image", "none")
    linear = values.at("linear_cde")
    cde = (1.0, 0.0, 0.0) if linear.value is None else tuple(linear.at(f"linear_{key}").number() for key in "cde")
    if not 0.01 < cde[0] < 100.0:
        raise linear.at("linear_c").error("the proportions of a pixel, near 1")
    kinds = {"angle_to_pixel": "angle_to_pixeldist", "pixel_to_angle": "pixeldist_to_angle"}
    reference = values.at("reference_poly").one_of(kinds)
    polynomial = values.at(kinds[reference])
    numbers = polynomial.numbers(*range(2, 7))
    curve = FTheta(polynomial, numbers, reference == "angle_to_pixel", cde, min(_stated_max_angle(values), math.pi))
    optics = ftheta_optics(curve, values.at("principal_point").numbers(2), size, name, notes)
    _check_max_angle(values, optics, name, notes)
    return optics


@dataclass(frozen=True)
class FTheta:
    """f-theta as NVIDIA's tools have it: ``place`` and numbers of a polynomial from angle [rad] to radius [px].

    ``is_forward``: it is that, or the other way round; ``cde``: the pixel's proportions and skew; ``limit_rad``: the
    angle from the axis at which it ends.
    """

    place: Record
    numbers: list[float]
    is_forward: bool
    cde: tuple[float, ...]
    limit_rad: float


def ftheta_optics(curve: FTheta, centre_px: Sequence[float], size: _Size, name: str, notes: list[str]) -> Optics:
    """The fisheye nearest to an f-theta lens, whose principal point counts from the first pixel's centre."""
    c, d, e = curve.cde
    unit = optics_of(curve.place, c, 1.0, *centre_px, lens=Lens.FISHEYE, width_px=size[0], height_px=size[1])
    angle, radius_px, odd = _ftheta_curve(curve, _farthest(unit))
    off_px = 0.0
    if odd is None:
        odd, off_px = _fitted_fisheye(angle, radius_px)
    off_px = off_px * max(1.0, c) + max(abs(d), abs(e)) * float(radius_px[-1])
    shape = _grown_fisheye(odd, float(angle[-1]))
    if shape is None:
        raise curve.place.error("f-theta that a fisheye with four coefficients comes near to", "another")
    if off_px:
        notes.append(f"camera {name!r}: f-theta is read as a fisheye, which is off by at most {off_px:.2g} px")
    focal_px = (c * float(odd[0]), float(odd[0]))
    lens = {"lens": Lens.FISHEYE, "distortion": shape.distortion, "off_px": off_px}
    return Optics(*size, focal_px=focal_px, centre_px=unit.centre_px, **lens)


def _ftheta_curve(given: FTheta, farthest_px: float) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Angles [rad] and radii [px] of an f-theta image; and its odd coefficients, where it has no others."""
    limit, is_forward, coefficients = given.limit_rad, given.is_forward, given.place
    numbers = np.array(given.numbers)
    if numbers[0] != 0.0:
        raise coefficients.error("a polynomial that begins with 0; any other tears the image's middle")
    series = np.polynomial.Polynomial(numbers)

    def curve(last: float) -> tuple[np.ndarray, np.ndarray, int]:
        """Angles and radii up to the last argument of the polynomial, and how many of them lie in the image."""
        given = np.linspace(0.0, last, _SAMPLES)
        angle, radius_px = (given, series(given)) if is_forward else (series(given), given)
        beyond = np.flatnonzero((radius_px > farthest_px) | (angle > limit))
        return angle, radius_px, int(beyond[0]) if len(beyond) else _SAMPLES

    angle, radius_px, count = curve(limit if is_forward else farthest_px)
    corner = min(count, _SAMPLES - 1)  # it may be near the axis
    angle, radius_px, count = curve((angle if is_forward else radius_px)[corner])
    grows = np.all(np.diff(angle[:count]) > 0.0) and np.all(np.diff(radius_px[:count]) > 0.0)
    if count < len(_POWERS) or angle[count - 1] < _SAME_ANGLE_RAD or not grows:
        raise coefficients.error("a polynomial that grows from the image's middle to its corners")
    odd = None
    if is_forward and not numbers[2::2].any():
        odd = np.pad(numbers[1::2], (0, len(_POWERS) - len(numbers[1::2])))
    return angle[:count], radius_px[:count], odd


def _check_max_angle(values: Record, optics: Optics, name: str, notes: list[str]) -> None:
    """Note where AlpaSim's lens ends before the image does."""
    given = _stated_max_angle(values)
    if None in (optics.width_px, optics.height_px):
        return
    if given < _max_angle(optics) - _SAME_ANGLE_RAD:
        notes.append(
            f"camera {name!r}: max_angle is not read; beyond {math.degrees(given):.1f} deg from its axis AlpaSim's "
            "image is empty, and warpav's is not"
        )


def _stated_max_angle(values: Record) -> float:
    angle = values.at("max_angle")
    if angle.number(math.pi) <= _SAME_ANGLE_RAD:
        raise angle.error("a positive angle")
    return angle.number(math.pi)


def max_angle_rad(model: CameraModel) -> float:
    """Angle from the axis at the farthest corner of an image or the lens's end [rad]; of Brown-Conrady its tangent."""
    (fx, _, cx), (_, fy, cy), _ = model.intrinsics.tolist()
    size = (model.width_px, model.height_px)
    return _max_angle(
        Optics(*size, focal_px=(fx, fy), centre_px=(cx, cy), lens=model.lens, distortion=model.distortion)
    )


def _max_angle(optics: Optics) -> float:
    """Angle from the axis at the image's farthest corner or the lens's end [rad]; of Brown-Conrady its tangent."""
    return float(LensShape(optics.lens, optics.distortion).angle(np.array(_farthest(optics))))


def _farthest(optics: Optics) -> float:
    """Distance of the image's farthest corner from the principal point [focal lengths]."""
    assert optics.width_px is not None
    assert optics.height_px is not None
    assert optics.focal_px is not None
    assert optics.centre_px is not None
    (fx, fy), (cx, cy) = optics.focal_px, optics.centre_px
    return math.hypot(max(cx, optics.width_px - cx) / fx, max(cy, optics.height_px - cy) / fy)


def _fitted_fisheye(angle: np.ndarray, radius: np.ndarray) -> tuple[np.ndarray, float]:
    """The odd powers nearest to a radial lens, of angles [rad] and radii [sample], and how far they are off."""
    share = angle / angle[-1]
    basis = share[:, None] ** _POWERS
    weight = (1.0 + 1e-3 - share**2) ** -0.25  # Chebyshev's: errors at the end of the range weigh more
    scaled = np.linalg.lstsq(basis * weight[:, None], radius * weight, rcond=None)[0]
    return scaled / angle[-1] ** _POWERS, float(np.abs(basis @ scaled - radius).max())


def _grown_fisheye(odd: np.ndarray, angle: float) -> LensShape | None:
    """The lens of coefficients as `_fitted_fisheye` returns them; None where it does not grow up to the angle."""
    if odd[0] <= 0.0:
        return None
    shape = LensShape(Lens.FISHEYE, tuple((odd[1:] / odd[0]).tolist()))
    return shape if shape.limit >= angle else None


def _write(cameras: Sequence[PlacedCamera], target: Path, losses: Losses) -> dict[Path, bytes]:
    rendered, extra = [], []
    for camera in cameras:
        name, model = json.dumps(camera.name), camera.model
        rendered.append(f"{{logical_id: {name}, height: {model.height_px}, width: {model.width_px}}}")
        qw, qx, qy, qz = (quaternion_from_rotation(camera.file_from_camera[:3, :3]) + 0.0).tolist()
        pose = {
            "translation_m": yaml_row(camera.file_from_camera[:3, 3] + 0.0),
            "rotation_xyzw": yaml_row((qx, qy, qz, qw)),
        }
        extra.append(
            {
                "logical_id": name,
                "rig_to_camera": pose,
                "resolution_hw": f"[{model.height_px}, {model.width_px}]",
                "shutter_type": "GLOBAL",
                "intrinsics": _intrinsics(camera, losses),
            }
        )
    others = [camera.name for camera in cameras if camera.name not in _CAMERAS]
    if others:
        losses.notes.append(
            f"AlpaSim replaces cameras of a scene by name and rejects other names, such as {others[0]!r}; NVIDIA's "
            f"scenes have {', '.join(_CAMERAS)}"
        )
    content = {"runtime": {"simulation_config": {"cameras": rendered}, "extra_cameras": extra}}
    return {target: "\n".join(("# @package _global_", *yaml_lines(content), "")).encode()}


def _intrinsics(camera: PlacedCamera, losses: Losses) -> dict[str, Any]:
    model = camera.model
    (fx, _, cx), (_, fy, cy), _ = model.intrinsics.tolist()
    end = {}
    if model.lens in (Lens.PINHOLE, Lens.BROWN_CONRADY):
        _note_empty_parts(camera, losses)
        k1, k2, p1, p2, k3, k4, k5, k6 = model.shape.coefficients.tolist()
        kind = "opencv_pinhole"
        own = {"radial": (k1, k2, k3, k4, k5, k6), "tangential": (p1, p2), "thin_prism": (0.0,) * 4}
    elif model.shape.is_by_angle:
        kind = "opencv_fisheye"
        growth, shape, end_rad = _as_fisheye(camera, losses)
        fx, fy = fx * growth, fy * growth
        own = {"radial": tuple(shape.coefficients[:4].tolist())}
        end = {"max_angle": yaml_number(end_rad)}
    else:
        raise losses.unsupported(camera.name, f"the {model.lens} lens")
    numbers = {"focal_length": (fx, fy), "principal_point": (cx, cy), **own}
    return {"model": kind, kind: {**{key: yaml_row(values) for key, values in numbers.items()}, **end}}


def _as_fisheye(camera: PlacedCamera, losses: Losses) -> tuple[float, LensShape, float]:
    """How much longer the focal length of the fisheye with this image is, its lens, and where it ends [rad]."""
    model = camera.model
    end_rad = max_angle_rad(model)
    if model.lens is Lens.FISHEYE:
        return 1.0, model.shape, end_rad
    angle = np.linspace(0.0, end_rad, _SAMPLES)
    odd, off = _fitted_fisheye(angle, model.shape.radius(angle)[0])
    off_px = off * float(model.intrinsics.diagonal()[:2].max())
    shape = _grown_fisheye(odd, end_rad)
    if shape is None or off_px >= WRITE_PX:
        raise losses.unsupported(
            camera.name, f"this {model.lens} lens, from which its nearest fisheye is off by {off_px:.2g} px"
        )
    losses.notes.append(
        f"camera {camera.name!r}: {model.lens} is written as a fisheye, which is off by at most {off_px:.1g} px"
    )
    return float(odd[0]), shape, end_rad


def _note_empty_parts(camera: PlacedCamera, losses: Losses) -> None:
    """Note where NCore's pinhole has no image for lack of trust in the distortion."""
    shape = camera.model.shape
    if not any(shape.distortion):
        return
    tangent = np.linspace(0.0, max_angle_rad(camera.model), _SAMPLES)[1:]
    factor = shape.radius(tangent)[0] / tangent
    low, high = _RADIAL_FACTOR
    out = (factor <= low) | (factor >= high)
    if out.any():
        losses.notes.append(
            f"camera {camera.name!r}: warning: NCore's projection leaves the image empty where the radial distortion's "
            f"factor is not between {low:g} and {high:g}, here from {math.degrees(math.atan(tangent[out][0])):.1f} deg "
            "from the axis"
        )


FORMATS = (
    RigFormat(
        "alpasim",
        frame="camera to rig (AlpaSim calls it rig_to_camera), rig x forward, y left, z up, right-handed, metres; "
        "quaternions x y z w; cameras x right, y down, z forward",
        origin="on the ground below the centre of the rear axle, as warpav's",
        is_ego_origin=True,
        files=("alpasim.yaml",),
        suffixes=(".yaml", ".yml"),
        read=_read,
        write=_write,
    ),
)
