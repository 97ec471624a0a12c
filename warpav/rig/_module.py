"""Modules of cameras and LiDARs: a sensor, a lens or beams, what the network gets, a housing, and what it all costs."""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import numpy as np

from warpav.core.errors import InputError
from warpav.core.records import nearest
from warpav.raster.beams import Beams
from warpav.raster.camera import MAX_IMAGE_PX, CameraModel
from warpav.raster.lens import COEFFICIENT_COUNTS, Lens, LensShape

_MIN_IMAGE_PX = 8
"""Minimum image width and height [px], that of a `CameraModel`."""

_MAX_HOUSING_M = 1.0
"""Maximum size of a housing [m]: a larger number is one of millimetres."""

_VERTICAL_TOLERANCE_DEG = 1.0
"""How far a stated vertical field of view may be from that of lens and sensor [deg]: data sheets round."""

_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]*")
_SAME_PX = 1e-9


class Fitting(StrEnum):
    """How the image of the sensor becomes that of the network."""

    SCALING = "scaling"
    """The whole image with other numbers of columns and rows."""

    CROP = "crop"
    """Its middle, pixel by pixel."""


@dataclass(frozen=True)
class Housing:
    """A box around the optical centre, along the axes of the camera (x right, y down, z forward)."""

    size_m: tuple[float, float, float]
    offset_m: tuple[float, float, float] = (0.0, 0.0, 0.0)


class Role(StrEnum):
    """What a module is for, which bounds where it stands and looks."""

    FRONT = "front"
    """Stands ahead of the vehicle's middle and looks at most 20 degrees aside of straight ahead."""

    SIDE = "side"
    """Stands on a side and looks at most 60 degrees ahead of or behind straight to it."""

    REAR = "rear"
    """Stands behind the middle and looks at most 20 degrees aside of straight back."""

    SURROUND = "surround"
    """For the near field all round: may see more of the own body, and stands and looks as zones allow."""

    ANY = "any"
    """Stands and looks as zones allow."""


PLAIN = "camera"
"""What cameras that are no modules are called where modules have names."""

PLAIN_HOUSING = Housing((0.08, 0.08, 0.08))
"""Of a camera that is no module: what an automotive camera takes with its bracket."""


@dataclass(frozen=True)
class Price:
    value: float
    unit: str = "relative"


@dataclass(frozen=True)
class _Problem:
    field: str
    expected: str
    got: str
    remedy: str

    def __str__(self) -> str:
        return f"expected {self.expected}, got {self.got}; {self.remedy}"


class ModuleError(InputError):
    def __init__(self, name: object, problems: tuple[_Problem, ...]) -> None:
        super().__init__(*(f"module {name!r}: {each.field}: {each}" for each in problems))
        self.name, self.problems = name, problems

    def __reduce__(self) -> tuple[Any, ...]:
        return ModuleError, (self.name, self.problems)


@dataclass(frozen=True, kw_only=True)
class Module:
    """A module of a camera, or of a LiDAR or radar (`of_beams`).

    Attributes:
        name: Short name; letters, digits, ``_``, ``-`` and ``.``.
        sensor_px: Columns and rows of the sensor [px], each 8 to 16384.
        fov_rad: Horizontal field of view of the whole sensor [rad], along the row of its middle.
        housing: The box around the optical centre.
        price: What it costs.
        source: Where these figures come from.
        network_px: Columns and rows of the image that the network gets [px]; None: those of the sensor.
        network_by: Whether that is the whole image scaled, or a crop of its middle.
        lens: A `Lens` or its name.
        distortion: Coefficients of the lens, as of `CameraModel`.
        vertical_fov_rad: Vertical field of view of the whole sensor [rad], a check alone: it follows from the others.
            None: not stated.
        power_w: What it draws [W], at least 0; None: unknown.
        zones: Names or kinds of the zones that it fits, such as ``windscreen``; empty: all.
        role: A `Role` or its name.
        beams: Those of a LiDAR or radar, whose panorama sensor, field of view and lens then are; None: a camera.
        least_range_m: From where on these measure [m], positive; nearer things do not hide. None: a camera.

    Raises:
        ModuleError: Numbers out of range, or that contradict each other; an `InputError`.
        TypeError: Something else than a `Housing` and a `Price`.
    """

    name: str
    sensor_px: tuple[int, int]
    fov_rad: float
    housing: Housing
    price: Price
    source: str
    network_px: tuple[int, int] = None  # pyright: ignore[reportAssignmentType]  # what sensor_px says
    network_by: Fitting = Fitting.SCALING
    lens: Lens = Lens.PINHOLE
    distortion: tuple[float, ...] = ()
    vertical_fov_rad: float | None = None
    power_w: float | None = None
    zones: tuple[str, ...] = ()
    role: Role = Role.ANY
    beams: Beams | None = None
    least_range_m: float | None = None

    @classmethod
    def of_beams(cls, name: str, beams: Beams, least_range_m: float, **others: Any) -> Module:  # noqa: ANN401
        """A LiDAR or a radar; ``others``: what all kinds have: housing, price, source, power_w, zones, role."""
        width, height, _, _ = beams.panorama
        image = {"sensor_px": (width, height), "fov_rad": beams.sector_rad, "lens": Lens.EQUIRECTANGULAR}
        return cls(name=name, beams=beams, least_range_m=least_range_m, **image, **others)

    def __post_init__(self) -> None:
        for name, value, kind in (("housing", self.housing, Housing), ("price", self.price, Price)):
            if not isinstance(value, kind):
                raise TypeError(f"{name}: expected a {kind.__name__}, got {type(value).__name__}")
        if self.network_px is None:
            self._set("network_px", self.sensor_px)
        problems = tuple(_problems(self))
        if problems:
            raise ModuleError(self.name, problems)
        self._set("sensor_px", (int(self.sensor_px[0]), int(self.sensor_px[1])))
        self._set("network_px", (int(self.network_px[0]), int(self.network_px[1])))
        self._set("lens", Lens(self.lens))
        self._set("role", Role(self.role))
        self._set("network_by", Fitting(self.network_by))
        self._set("distortion", tuple(float(value) for value in self.distortion))
        self._set("zones", tuple(self.zones))

    def _set(self, name: str, value: object) -> None:
        object.__setattr__(self, name, value)

    def sensor_model(self) -> CameraModel:
        """The camera with all pixels of the sensor."""
        if self.beams is not None and self.least_range_m is not None:
            return CameraModel.of_beams(self.beams, self.least_range_m)
        return CameraModel(*self.sensor_px, self.fov_rad, lens=self.lens, distortion=self.distortion)

    def camera_model(self) -> CameraModel:
        """The camera with the image that the network gets.

        A scaled image shows the same field of view; other proportions than the sensor's give pixels that are not
        square. A crop shows the middle of the field through the same lens, with the focal length of the sensor's
        pixels. Where an odd number of columns or rows is cut away, one more of them lies right or below, and the
        principal point half a pixel beside the middle. Distortion counts in focal lengths and stays.
        """
        sensor = self.sensor_model()
        if self.beams is not None:
            return sensor
        fx, fy, cx, cy = sensor.intrinsics[[0, 1, 0, 1], [0, 1, 2, 2]]
        if self.network_by is Fitting.SCALING:
            grow_x, grow_y = (new / old for new, old in zip(self.network_px, self.sensor_px, strict=True))
            fx, fy, cx, cy = fx * grow_x, fy * grow_y, cx * grow_x, cy * grow_y
        else:
            cut_x, cut_y = ((old - new) // 2 for new, old in zip(self.network_px, self.sensor_px, strict=True))
            cx, cy = cx - cut_x, cy - cut_y
        model = CameraModel(
            *self.network_px, lens=self.lens, distortion=self.distortion, focal_px=(fx, fy), centre_px=(cx, cy)
        )
        middle_px = 0.5 * model.width_px, 0.5 * model.height_px
        is_plain = math.isclose(fx, fy, rel_tol=_SAME_PX) and np.allclose((cx, cy), middle_px, rtol=0.0, atol=_SAME_PX)
        if not is_plain:
            return model
        # square pixels around the axis: the field of view says it all, and every format can hold it
        is_whole = self.network_by is Fitting.SCALING or self.network_px == self.sensor_px
        fov_rad = self.fov_rad if is_whole else model.fov_rad
        return dataclasses.replace(model, fov_rad=fov_rad, focal_px=None, centre_px=None)

    @property
    def pixels_per_degree(self) -> float:
        """Pixels of the network's image for each degree on the optical axis, along the row."""
        model = self.camera_model()
        return float(model.intrinsics[0, 0]) * model.shape.growth_on_axis * math.pi / 180.0

    def fits(self, zone: str) -> bool:
        """Whether the module may stand in a zone of this name or kind."""
        return not self.zones or zone in self.zones


def vertical_angle_rad(model: CameraModel) -> float:
    """Angle between the upper and the lower edge of an image along the principal point's column [rad]."""
    fy, cy = model.intrinsics[1, 1], model.intrinsics[1, 2]
    edge = np.array([-cy, model.height_px - cy]) / fy
    if model.lens is Lens.EQUIRECTANGULAR:
        angle = edge
    elif model.lens is Lens.PANORAMA:
        angle = np.arctan(edge)
    else:
        angle = np.sign(edge) * model.shape.angle(np.abs(edge))
        angle = angle if model.shape.is_by_angle else np.arctan(angle)
    return float(angle[1] - angle[0])


def _problems(module: Module) -> Iterator[_Problem]:
    if not (isinstance(module.name, str) and _NAME.fullmatch(module.name)):
        yield _Problem("name", "letters, digits, '_', '-' and '.'", repr(module.name), "such as front_8mp_30")
    of_image = [] if module.beams else [*_size_problems(module), *_lens_problems(module)]
    yield from of_image
    if not of_image and not module.beams:
        yield from _image_problems(module)
    if module.beams:
        yield from _range_problems(module)
    yield from _housing_problems(module.housing)
    if not _is_number(module.price.value, 0.0):
        yield _Problem("price.value", "a number from 0 on", f"{module.price.value}", "write what the module costs")
    if not (isinstance(module.price.unit, str) and module.price.unit.strip()):
        yield _Problem("price.unit", "a unit, such as EUR or relative", repr(module.price.unit), "name the unit")
    if module.power_w is not None and not _is_number(module.power_w, 0.0):
        got = f"{module.power_w:g}" if isinstance(module.power_w, float) else f"{module.power_w}"
        yield _Problem("power_w", "watts from 0 on", got, "write null where it is unknown")
    if module.role not in list(Role):
        hint = _suggestion(module.role, list(Role))
        yield _Problem("role", f"one of {', '.join(Role)}", repr(module.role), hint)
    for i, zone in enumerate(module.zones):
        if not (isinstance(zone, str) and _NAME.fullmatch(zone)):
            yield _Problem(
                f"zones[{i}]", "letters, digits, '_', '-' and '.'", repr(zone), "name a zone, such as windscreen"
            )
        elif zone in module.zones[:i]:
            yield _Problem(f"zones[{i}]", "every zone once", f"{zone!r} again", "remove it")
    if not (isinstance(module.source, str) and module.source.strip()):
        yield _Problem(
            "source", "where the figures come from", repr(module.source), "name a data sheet, or say a guess"
        )


def _size_problems(module: Module) -> Iterator[_Problem]:
    are_sizes = True
    sizes = {"sensor_px": module.sensor_px, "network_px": module.network_px}
    if module.network_px == module.sensor_px:  # as where it is not given
        del sizes["network_px"]
    for name, size in sizes.items():
        if not (len(size) == 2 and all(_is_size(pixels) for pixels in size)):
            are_sizes = False
            expected = f"columns and rows from {_MIN_IMAGE_PX} to {MAX_IMAGE_PX} px"
            yield _Problem(name, expected, f"{list(size)}", "write whole pixels, such as [1920, 1080]")
    if module.network_by not in list(Fitting):
        hint = _suggestion(module.network_by, list(Fitting))
        yield _Problem("network_by", f"one of {', '.join(Fitting)}", repr(module.network_by), hint)
        return
    is_crop = are_sizes and module.network_by == Fitting.CROP
    if is_crop and any(new > old for new, old in zip(module.network_px, module.sensor_px, strict=True)):
        expected = "a crop of at most {} x {} px, the sensor".format(*module.sensor_px)
        got = "{} x {} px".format(*module.network_px)
        yield _Problem("network_px", expected, got, "crop less, or write network_by: scaling")


def _lens_problems(module: Module) -> Iterator[_Problem]:
    if module.lens not in list(Lens):
        yield _Problem("lens", f"one of {', '.join(Lens)}", repr(module.lens), _suggestion(module.lens, list(Lens)))
        return
    lens = Lens(module.lens)
    counts = COEFFICIENT_COUNTS[lens]
    if len(module.distortion) not in counts:
        expected = f"{' or '.join(map(str, counts))} coefficients of a {lens} lens"
        yield _Problem("distortion", expected, f"{len(module.distortion)}", "see the lenses of CameraModel")
        return
    try:
        CameraModel(lens=lens, fov_rad=1e-3, distortion=module.distortion)
    except ValueError as error:
        yield _Problem("distortion", "coefficients of a lens", f"{list(module.distortion)}", f"{error}")
        return
    shape = LensShape(lens, tuple(map(float, module.distortion)))
    for name, angle_rad in (("fov_rad", module.fov_rad), ("vertical_fov_rad", module.vertical_fov_rad)):
        if name == "vertical_fov_rad" and angle_rad is None:
            continue
        widest_deg = 360.0 if shape.has_unit_rays else 180.0
        is_all_round = shape.is_panorama and name == "fov_rad" and angle_rad == 2.0 * math.pi
        if not (is_all_round or (_is_number(angle_rad) and 0.0 < math.degrees(angle_rad or 0.0) < widest_deg)):
            up_to = "up to" if shape.is_panorama and name == "fov_rad" else "below"
            remedy = "write that of the whole sensor" if widest_deg > 180.0 else "a fisheye sees more"
            yield _Problem(
                name, f"more than 0 and {up_to} {widest_deg:g} degrees ({lens})", _degrees(angle_rad), remedy
            )
            return
    bends = lens is Lens.BROWN_CONRADY or shape.is_by_angle
    if bends and 0.5 * module.fov_rad > shape.limit_rad:
        expected = f"at most {math.degrees(2.0 * shape.limit_rad):.1f} degrees, where these coefficients fold back"
        yield _Problem("fov_rad", expected, _degrees(module.fov_rad), "correct one of the two")


def _image_problems(module: Module) -> Iterator[_Problem]:
    sensor = CameraModel(*module.sensor_px, module.fov_rad, lens=module.lens, distortion=tuple(module.distortion))
    blind = _blind_place(sensor)
    if blind:
        if sensor.shape.is_panorama:
            got = f"rows beyond them at the {blind}"
            yield _Problem("sensor_px", "rows between the poles", got, "take fewer rows, or a narrower field")
        else:
            expected = "coefficients under which the image grows up to its border"
            remedy = "correct them, the field of view or the sensor"
            yield _Problem("distortion", expected, f"a fold-back before the {blind}", remedy)
    elif module.vertical_fov_rad is not None:
        found_deg = math.degrees(vertical_angle_rad(sensor))
        if abs(found_deg - math.degrees(module.vertical_fov_rad)) > _VERTICAL_TOLERANCE_DEG:
            expected = f"{found_deg:.1f} degrees, as horizontal field, lens and sensor give"
            remedy = "correct one of them, or leave it out"
            yield _Problem("vertical_fov_rad", expected, _degrees(module.vertical_fov_rad), remedy)


def _blind_place(model: CameraModel) -> str | None:
    """The part of an image's border in which the lens sees nothing (of an angle lens, of edges); None: none."""
    width, height = model.width_px, model.height_px
    place_px = {
        "left edge": (0.5, 0.5 * height),
        "right edge": (width - 0.5, 0.5 * height),
        "upper edge": (0.5 * width, 0.5),
        "lower edge": (0.5 * width, height - 0.5),
    }
    if not model.shape.is_by_angle:
        corners = ((0.5, 0.5), (width - 0.5, 0.5), (0.5, height - 0.5), (width - 0.5, height - 0.5))
        names = ("upper left corner", "upper right corner", "lower left corner", "lower right corner")
        place_px |= dict(zip(names, corners, strict=True))
    ray = model.rays(np.array(list(place_px.values())))
    return next((name for name, each in zip(place_px, ray, strict=True) if not np.isfinite(each).all()), None)


def _range_problems(module: Module) -> Iterator[_Problem]:
    sizes = zip(module.housing.size_m, module.housing.offset_m, strict=True)
    reach_m = math.hypot(*(0.5 * size + abs(at) for size, at in sizes))
    least_m, most_m = module.least_range_m, module.beams.range_m[0] if module.beams else math.inf
    if not (_is_number(least_m, reach_m) and (least_m or 0.0) < most_m):
        expected = f"metres from {reach_m:.3f}, the housing's farthest corner, to less than the range of {most_m:g}"
        yield _Problem("least_range_m", expected, f"{least_m}", "see its data sheet, or give a smaller housing")


def _housing_problems(housing: Housing) -> Iterator[_Problem]:
    for name, values in (("size_m", housing.size_m), ("offset_m", housing.offset_m)):
        if not (len(values) == 3 and all(_is_number(value) for value in values)):
            got = f"{list(values)}"
            yield _Problem(f"housing.{name}", "three finite numbers of metres", got, "write x right, y down, z forward")
            return
    if not all(0.0 < value <= _MAX_HOUSING_M for value in housing.size_m):
        expected = f"positive metres up to {_MAX_HOUSING_M:g}"
        yield _Problem("housing.size_m", expected, f"{list(housing.size_m)}", "write metres: 0.03 for 30 mm")
    elif any(abs(at) > 0.5 * size for at, size in zip(housing.offset_m, housing.size_m, strict=True)):
        expected = "an offset of at most half the size: the box holds the optical centre"
        yield _Problem("housing.offset_m", expected, f"{list(housing.offset_m)}", "write metres to the box's middle")


def _is_number(value: object, least: float = -math.inf) -> bool:
    if not isinstance(value, (int, float)) or isinstance(value, bool):
        return False
    return math.isfinite(value) and value >= least


def _is_size(value: object) -> bool:
    if not isinstance(value, (int, np.integer)) or isinstance(value, bool):
        return False
    return _MIN_IMAGE_PX <= int(value) <= MAX_IMAGE_PX


def _degrees(angle_rad: float | None) -> str:
    return f"{math.degrees(angle_rad):.6g} degrees" if _is_number(angle_rad) and angle_rad is not None else "nothing"


def _suggestion(value: object, known: list[Any]) -> str:
    return nearest(value, map(str, known)).removeprefix("; ") or "choose one of them"
