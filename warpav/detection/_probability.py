"""The probability that a given detector finds an object in a view: smooth, calibrated, with a gradient to the pose.

`Appearance.of` measures what a render shows of every object, `DetectionProbability.on_tape` turns that into
probabilities on the tape, and `DetectionProbability.find` fetches the model that was fitted for a detector and its
surroundings. `warpav.detection._probability_fit` fits it; `warpav detector fit` is the command.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from warpav.core.bounded_files import DATA_SET_NODES_MAX, read_json
from warpav.core.cache import user_cache_folder
from warpav.core.errors import InputError
from warpav.core.files import atomic_write
from warpav.raster.areas import Measures
from warpav.raster.camera import CameraModel
from warpav.raster.frame import Frame
from warpav.scene import ROAD_USERS, DeviceScene, UprightBoxes
from warpav_kernels.detection import detection_probability as kernels

_SCHEMA = 2
FEATURE_COUNT = int(kernels.FEATURE_COUNT)


@dataclass(frozen=True)
class _Feature:
    name: str  # short name
    unit: str  # its unit, or the function of it that is taken
    definition: str  # what it is


FEATURES = (
    _Feature("visible_size", "ln(1 + px²)", "unoccluded area in the image"),
    _Feature("visible_share", "0..1", "unoccluded area over the object's whole area, both in the image"),
    _Feature("in_frame_share", "0..1", "solid angle of the object alone in the image over that of its upright box"),
    _Feature("aspect", "ln(px / px)", "width + 1 px over height + 1 px of the extent of the object alone in the image"),
    _Feature("border_distance", "ln(4 + px)", "soft least distance of that extent from the image's border"),
    _Feature("contrast", "RGB in 0..1", "distance of its mean colour from that of what else its surroundings show"),
    _Feature(
        "elevation", "sine", "elevation of the line of sight to the middle of its upright box; seen from above: < 0"
    ),
    _Feature("upright", "cosine", "angle in the image between a vertical edge there and the columns of the image"),
)
VISIBLE_SIZE, VISIBLE_SHARE = int(kernels.VISIBLE_SIZE), int(kernels.VISIBLE_SHARE)
IN_FRAME_SHARE, CONTRAST = int(kernels.IN_FRAME_SHARE), int(kernels.CONTRAST)
ELEVATION, UPRIGHT = int(kernels.ELEVATION), int(kernels.UPRIGHT)


@dataclass(frozen=True)
class Appearance:
    """What a render shows of every vehicle in every view, on the device; the render's buffers are free again."""

    measures: Measures  # from `Frame.measure`
    # Solid angle of every vehicle alone in every view [sr], float [view, vehicle, 1], with Jacobians
    in_frame: Measures
    contrast: wp.array  # of colours; it is held fixed while a view moves, float [view, vehicle]
    box: UprightBoxes  # boxes of the vehicles (and more)
    kind: wp.array  # of road user, index into `ROAD_USERS`, int [vehicle]
    lens: wp.array  # of the views, of the kernels' `Lens` [view]
    width_px: int  # width of the images [px]
    height_px: int  # height of the images [px]

    @classmethod
    def of(cls, frame: Frame, scene: DeviceScene, *, measures: Measures | None = None) -> Appearance:
        """Measure the last render; nothing is taped."""
        measures = frame.measure() if measures is None else measures
        in_frame, contrast = frame.window_area(visible=False), frame.contrast(measures.value)
        size_px = frame.width_px, frame.height_px
        return cls(measures, in_frame, contrast, scene.upright_box, scene.kind, wp.clone(frame.lens), *size_px)


@dataclass(frozen=True)
class Seen:
    """Detection probability of every vehicle in every view, on the tape."""

    # That it finds the vehicle there, in 0..1; 0 where nothing of it is visible, float [view, vehicle]
    probability: wp.array
    feature: wp.array  # in the order of `FEATURES`, 0 where nothing is visible, float [view, vehicle, feature]


@dataclass(frozen=True)
class DetectorUse:
    """A detector, and everything about its surroundings on which its detection probability depends."""

    model: Path  # path of its ONNX file
    # Configuration of the detector and its surroundings: numbers, strings, lists and mappings
    settings: Mapping[str, Any]

    @cached_property
    def model_sha256(self) -> str:
        try:
            return hashlib.sha256(self.model.read_bytes()).hexdigest()
        except OSError as error:
            raise InputError(f"{self.model}: detector.model: cannot be read ({error.strerror})") from None

    @cached_property
    def identity(self) -> str:
        """SHA-256 of file, settings, features and `_SCHEMA`; equal means that a fit can be used again."""
        content = {
            "schema": _SCHEMA,
            "model": self.model_sha256,
            "settings": self.settings,
            "features": [[each.name, each.unit] for each in FEATURES],
        }
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()

    @property
    def file_name(self) -> str:
        """Name of the file that keeps its model of detection probability."""
        return f"{self.model.stem}_p_detected_{self.identity[:12]}.json"

    def folders(self) -> Iterator[Path]:
        """Where that file may lie: beside the ONNX file, and in the user's cache."""
        yield self.model.resolve().parent
        yield user_cache_folder("detection_probability")


@dataclass(frozen=True)
class DetectionProbability:
    """The logit of the probability: a constant and a smooth curve for each of `FEATURES`, by kind of road user.

    A curve is a uniform cubic B-spline; its coefficients go on along straight lines, so it is C2 everywhere, and
    straight beyond its knots. Kinds that have no curves of their own take those of the first.
    """

    start: np.ndarray  # first knot of every curve, float64 [feature]
    step: np.ndarray  # distance between its knots, positive, float64 [feature]
    # B-spline coefficients, one for each knot, at least two, float64 [kind, feature, knot], or without kinds
    coefficient: np.ndarray
    constant: np.ndarray  # float64 [kind], or a number
    # How it was fitted and how good it is, as it is written to files
    record: Mapping[str, Any] = field(default_factory=dict)
    # Pixels of the network's input for one of the image, along x and y, of the camera that it is asked about; features
    # count the network's pixels. It is not written to files
    network_scale: tuple[float, float] = (1.0, 1.0)

    @classmethod
    def unfitted(cls, *, network_scale: tuple[float, float] = (1.0, 1.0)) -> DetectionProbability:
        """A model that knows no detector: every seen object has an even chance, and the features are those of any."""
        curves = (np.zeros(FEATURE_COUNT), np.ones(FEATURE_COUNT), np.zeros((FEATURE_COUNT, 2)))
        return cls(*curves, np.zeros(1), network_scale=network_scale)

    def __post_init__(self) -> None:
        if self.coefficient.ndim == 2:
            object.__setattr__(self, "coefficient", self.coefficient[None])
        object.__setattr__(self, "constant", np.atleast_1d(np.asarray(self.constant, np.float64)))
        shapes = (self.start.shape, self.step.shape, self.coefficient.shape[1:2])
        kinds = len(self.constant)
        if shapes != ((FEATURE_COUNT,),) * 3 or len(self.coefficient) != kinds or self.coefficient.shape[2] < 2:
            raise ValueError(
                f"expected {FEATURE_COUNT} curves with at least 2 knots each for each kind, got shapes {shapes} and "
                f"{self.coefficient.shape} for {kinds}"
            )
        numbers = np.concatenate([self.start, self.step, self.coefficient.ravel(), self.constant])
        if not np.isfinite(numbers).all() or (self.step <= 0.0).any():
            raise ValueError("expected finite numbers and positive steps between knots")
        if not all(0.0 < scale < math.inf for scale in self.network_scale):
            raise ValueError(f"expected a positive, finite network_scale, got {self.network_scale}")
        object.__setattr__(self, "_on_device", {})

    def __reduce__(self) -> tuple[Any, ...]:
        """As it travels to another process: without what is on a device."""
        parts = (self.start, self.step, self.coefficient, self.constant, dict(self.record), self.network_scale)
        return DetectionProbability, parts

    def curve(self, feature: int, value: np.ndarray, kind: int = 0) -> np.ndarray:
        """What a feature adds to the logit of a kind of road user, at given values of it, float64 [value]."""
        knots = self.coefficient.shape[2]
        return spline_basis(value, self.start[feature], self.step[feature], knots) @ self.coefficient[kind, feature]

    def of_features(self, feature: np.ndarray, kind: np.ndarray | int = 0) -> np.ndarray:
        """The probability for features [..., feature] of objects that show at least one pixel, float64 [...].

        ``kind``: of each object, index into `ROAD_USERS`, int [...].
        """
        from scipy.special import expit

        feature = np.asarray(feature, np.float64)
        flat = feature.reshape(-1, FEATURE_COUNT)
        kind = np.broadcast_to(np.where(np.less(kind, len(self.constant)), kind, 0), feature.shape[:-1]).ravel()
        logit = self.constant[kind]
        for f in range(FEATURE_COUNT):
            basis = spline_basis(flat[:, f], self.start[f], self.step[f], self.coefficient.shape[2])
            logit = logit + np.einsum("ok,ok->o", basis, self.coefficient[kind, f])
        return expit(logit).reshape(feature.shape[:-1])

    def on_tape(
        self,
        appearance: Appearance,
        position_ego_m: wp.array,
        camera_from_ego: wp.array,
        log_zoom: wp.array | None = None,
    ) -> Seen:
        """Probabilities as a function of the views, on the active tape; colours are held fixed.

        ``log_zoom``: logarithm of each view's focal length over its lens's, float [view]; None: as rendered.
        """
        measure = appearance.measures.on_tape(position_ego_m, camera_from_ego, log_zoom)
        in_frame_sr = appearance.in_frame.on_tape(position_ego_m, camera_from_ego, log_zoom)
        return self.of_measures(
            measure,
            in_frame_sr,
            whole_objects(position_ego_m, camera_from_ego, appearance.lens, appearance.box, appearance.kind),
            appearance.contrast,
            width_px=appearance.width_px,
            height_px=appearance.height_px,
        )

    def of_coverage(
        self, frame: Frame, scene: DeviceScene, position_ego_m: wp.array, camera_from_ego: wp.array
    ) -> Seen:
        """Probabilities in the views of a render, the same numbers as `on_tape` gives; nothing is taped."""
        coverage = frame.coverage()
        return self.of_measures(
            coverage.value,
            coverage.solid_angle_sr,
            whole_objects(position_ego_m, camera_from_ego, frame.lens, scene.upright_box, scene.kind),
            frame.contrast(coverage.value),
            width_px=frame.width_px,
            height_px=frame.height_px,
        )

    def of_measures(
        self,
        measure: wp.array,
        in_frame_sr: wp.array,
        whole: WholeObjects,
        contrast: wp.array,
        *,
        width_px: float,
        height_px: float,
    ) -> Seen:
        """Probabilities as a function of measures, however they came about, recorded on the active tape.

        Args:
            measure: As `Frame.measure` gives them, float [view, vehicle, measure]; BOX_AREA is not used.
            in_frame_sr: Solid angle of every vehicle alone inside the image [sr], float [view, vehicle, 1].
            whole: The vehicles, whatever the views show of them, from `whole_objects`.
            contrast: As in `Appearance`, float [view, vehicle].
        """
        device = measure.device
        pairs = measure.shape[:2]
        feature = wp.zeros((*pairs, FEATURE_COUNT), dtype=float, device=device, requires_grad=True)
        probability = wp.zeros(pairs, dtype=float, device=device, requires_grad=True)
        coefficient, start, step, constant = self._arrays(device)
        wp.launch(
            kernels.detection_probability_kernel,
            dim=pairs,
            inputs=[
                measure,
                in_frame_sr,
                whole.solid_angle_sr,
                whole.elevation,
                whole.upright,
                contrast,
                whole.kind,
                float(width_px),
                float(height_px),
                *self.network_scale,
                coefficient,
                start,
                step,
                constant,
            ],
            outputs=[feature, probability],
            device=device,
        )
        return Seen(probability, feature)

    def _arrays(self, device: Any) -> list[wp.array]:  # noqa: ANN401 (Warp's)
        """Coefficients, starts, steps and constants on a device, copied once."""
        kept: dict[str, list[wp.array]] = self.__dict__["_on_device"]
        if device.alias not in kept:
            parts = (self.coefficient, self.start, self.step, self.constant)
            kept[device.alias] = [wp.array(part, dtype=float, device=device) for part in parts]
        return kept[device.alias]

    @classmethod
    def builtin(cls, camera: CameraModel) -> DetectionProbability:
        """That of the detector that ships with warpav for vehicles of the town: the shipped fit for any camera."""
        from warpav.detection._onnx_detector import BUILTIN_MODEL_PATH, OnnxDetector

        files = sorted(BUILTIN_MODEL_PATH.parent.glob(f"{BUILTIN_MODEL_PATH.stem}_p_detected_*.json"))
        for_any = next(
            model
            for model in map(cls.read, files)
            if "cameras" in (settings := model.record["settings"])
            and (settings["scenes"]["source"], settings["scenes"]["targets"]) == ("town", ["vehicle"])
        )
        scale = OnnxDetector(BUILTIN_MODEL_PATH).network_scale(camera.height_px, camera.width_px)
        return replace(for_any, network_scale=scale)

    @classmethod
    def find(cls, use: DetectorUse, *, unseen: Collection[int] = ()) -> DetectionProbability:
        """The stored model that was fitted for a detector and its surroundings."""
        file = stored_file(use)
        if file is None:
            raise InputError(
                f"{use.model}: detection probability: expected a fit for this detector, camera and source of scenes, "
                "got none; run warpav detector fit with the same configuration"
            )
        found = cls.read(file, use=use)
        shared = sorted(set(found.record["fit"]["seeds"]) & set(unseen))
        if shared:
            raise InputError(
                f"{file}: fit.seeds: expected other scenes than the evaluation scenes, got {len(shared)} of them, such "
                f"as {shared[0]}; run warpav detector fit --again --scenes SEEDS"
            )
        return found

    @classmethod
    def read(cls, file: Path, *, use: DetectorUse | None = None) -> DetectionProbability:
        """The model of a file that `write` wrote."""
        again = "run warpav detector fit --again"
        try:
            data = read_json(file, "a model of detection probability", nodes_max=DATA_SET_NODES_MAX)
        except InputError as error:
            raise InputError(f"{error}; {again}") from None
        schema = data.get("schema") if isinstance(data, dict) else None
        if schema != _SCHEMA:
            raise InputError(f"{file}: schema: expected {_SCHEMA}, got {schema!r}; {again}")
        if use is not None and data.get("identity") != use.identity:
            raise InputError(f"{file}: identity: expected {use.identity[:12]}, got another detector or camera; {again}")
        try:
            curves, kinds = data["curves"], data["kinds"]
            names = [curve["feature"] for curve in curves]
            if names != [each.name for each in FEATURES] or list(kinds) != list(ROAD_USERS[: len(kinds)]):
                raise ValueError(f"features {names}, kinds {list(kinds)}")
            [int(seed) for seed in data["fit"]["seeds"]]
            return cls(
                np.array([curve["first_knot"] for curve in curves], np.float64),
                np.array([curve["knot_distance"] for curve in curves], np.float64),
                np.array([[curve["coefficients"][kind] for curve in curves] for kind in kinds], np.float64),
                np.array(list(kinds.values()), np.float64),
                {name: value for name, value in data.items() if name not in ("curves", "kinds")},
            )
        except (KeyError, TypeError, ValueError) as error:
            text = " ".join(str(error).split())
            raise InputError(
                f"{file}: expected curves of {FEATURE_COUNT} features, got a damaged file ({type(error).__name__}: "
                f"{text}); {again}"
            ) from None

    def write(self, folder: Path, use: DetectorUse) -> Path:
        """Write the model and its record as JSON into a folder, under the name that `find` expects."""
        data = {
            "schema": _SCHEMA,
            "identity": use.identity,
            "model": {"file": use.model.name, "sha256": use.model_sha256},
            "settings": use.settings,
            "population": "objects of which at least one pixel is visible in the view; the others have p = 0",
            **{name: value for name, value in self.record.items() if name not in _WRITTEN},
            "kinds": dict(zip(ROAD_USERS, self.constant.tolist(), strict=False)),  # and their constants
            "curves": [
                {
                    "feature": each.name,
                    "unit": each.unit,
                    "definition": each.definition,
                    "first_knot": float(self.start[f]),
                    "knot_distance": float(self.step[f]),
                    "coefficients": dict(zip(ROAD_USERS, self.coefficient[:, f].tolist(), strict=False)),
                }
                for f, each in enumerate(FEATURES)
            ],
        }
        folder.mkdir(parents=True, exist_ok=True)
        file = folder / use.file_name
        with atomic_write(file) as draft:
            draft.write_text(json.dumps(data, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
        return file


_WRITTEN = ("schema", "identity", "model", "settings", "population")


def stored_file(use: DetectorUse) -> Path | None:
    """The file that keeps the model for a detector and its surroundings; None where there is none."""
    return next((folder / use.file_name for folder in use.folders() if (folder / use.file_name).is_file()), None)


@dataclass(frozen=True)
class WholeObjects:
    """What views see of objects of which nothing is hidden or cut off."""

    solid_angle_sr: wp.array  # of their upright boxes [sr], float [view, object]
    elevation: wp.array  # see `FEATURES`, float [view, object]
    upright: wp.array  # likewise
    kind: wp.array  # of road user, index into `ROAD_USERS`, int [object]


def whole_objects(
    position_ego_m: wp.array, camera_from_ego: wp.array, lens: wp.array, box: UprightBoxes, kind: wp.array
) -> WholeObjects:
    """The objects of the first boxes, as many as have a kind, recorded on the active tape."""
    solid_angle_sr = whole_solid_angle(position_ego_m, box, vehicle_count=len(kind))
    sight = line_of_sight(position_ego_m, camera_from_ego, lens, box.centre_ego_m, vehicle_count=len(kind))
    return WholeObjects(solid_angle_sr, *sight, kind)


def whole_solid_angle(position_ego_m: wp.array, box: UprightBoxes, *, vehicle_count: int) -> wp.array:
    """Solid angle of the first boxes from every view's centre [sr], recorded on the active tape; [view, vehicle]."""
    device = position_ego_m.device
    solid_angle_sr = wp.zeros((len(position_ego_m), vehicle_count), dtype=float, device=device, requires_grad=True)
    wp.launch(
        kernels.box_solid_angle_kernel,
        dim=len(position_ego_m),
        inputs=[position_ego_m, box.centre_ego_m, box.half_size_m, box.along],
        outputs=[solid_angle_sr],
        device=device,
    )
    return solid_angle_sr


def line_of_sight(
    position_ego_m: wp.array, camera_from_ego: wp.array, lens: wp.array, centre_ego_m: wp.array, *, vehicle_count: int
) -> tuple[wp.array, wp.array]:
    """Elevation and uprightness of `WholeObjects`, recorded on the active tape; both float [view, vehicle]."""
    device, pairs = position_ego_m.device, (len(position_ego_m), vehicle_count)
    elevation, upright = (wp.zeros(pairs, dtype=float, device=device, requires_grad=True) for _ in range(2))
    wp.launch(
        kernels.line_of_sight_kernel,
        dim=len(position_ego_m),
        inputs=[position_ego_m, camera_from_ego, lens, centre_ego_m],
        outputs=[elevation, upright],
        device=device,
    )
    return elevation, upright


def spline_basis(value: np.ndarray, start: float, step: float, knot_count: int) -> np.ndarray:
    """What every coefficient of a curve weighs at given values: the curve is ``basis @ coefficient``; [value, knot]."""
    u = (np.asarray(value, np.float64).reshape(-1) - start) / step
    inside = np.clip(u, 0.0, knot_count - 1.0)
    cell = np.minimum(inside.astype(np.int64), knot_count - 2)
    t = inside - cell
    weight = np.stack([(1 - t) ** 3, 3 * t**3 - 6 * t**2 + 4, 3 * (1 - t) ** 3 - 6 * (1 - t) ** 2 + 4, t**3]) / 6.0
    # one more coefficient at each end, which continues a straight line
    wide = np.zeros((len(u), knot_count + 2))
    rows = np.arange(len(u))
    for k in range(4):
        wide[rows, cell + k] += weight[k]
    basis = wide[:, 1:-1]
    for end, first, second in ((wide[:, 0], 0, 1), (wide[:, -1], -1, -2)):
        basis[:, first] += 2.0 * end
        basis[:, second] -= end
    # beyond the ends, along the end's tangent
    beyond = u - inside
    low, high = np.minimum(beyond, 0.0), np.maximum(beyond, 0.0)
    basis[:, 1] += low
    basis[:, 0] -= low
    basis[:, -1] += high
    basis[:, -2] -= high
    return basis


def natural_range(value: np.ndarray, knot_count: int) -> tuple[float, float]:
    """First knot and distance of knots that span the middle 99 % of some values; never a distance of 0."""
    low, high = np.quantile(value, [0.005, 0.995])
    if not math.isfinite(high - low) or high - low < 1e-3:
        return float(low) - 0.5, 1.0 / (knot_count - 1)
    return float(low), float(high - low) / (knot_count - 1)
