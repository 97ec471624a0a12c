"""Fit p(detected) for the configured detector, camera and scenes; keep it, its scores and its figures."""

from __future__ import annotations

import contextlib
import shlex
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from warpav.core.errors import InputError
from warpav.detection.probability import DetectionProbability, DetectorUse, stored_file
from warpav.detection.probability_fit import BIN_COUNT, Sightings, fit_probability, look, random_cameras, score
from warpav.raster.chunks import chunk_view_count
from warpav.raster.decide import Occlusion
from warpav.raster.renderer import Renderer
from warpav.runs.config import Config
from warpav.runs.sources import (
    camera_model,
    checked_device,
    detector_use,
    free_ranges,
    load_detector,
    load_scenes,
    mount_surface,
)
from warpav.scene.device_scene import DeviceScene
from warpav.view.figures import detection_curves, reliability_diagram

if TYPE_CHECKING:
    from warpav.runs.progress import RunDisplay

# Embedded scenes for this purpose alone: no experiment takes these seeds, and the shipped detector has not seen them.
TOWN_SEEDS = tuple(range(500_000, 500_050))
TOWN_HELD_OUT = tuple(range(500_050, 500_080))
VIEWS_PER_SCENE = 24
# streams of random numbers
_CAMERAS, _FOLDS = 11, 12


@dataclass(frozen=True)
class FitSeeds:
    """Which scenes the curves are fitted on, and which the scores come from."""

    fit: tuple[int, ...]
    held_out: tuple[int, ...]


def chosen_seeds(config: Config, fit: tuple[int, ...] | None, held_out: tuple[int, ...] | None) -> FitSeeds:
    """The scenes to use: the given ones, else embedded ones of their own, else three to two of the training scenes.

    Raises:
        InputError: A scene is in both parts, or the fit would see a test scene.
    """
    if config.scenes.source == "town":
        usual = FitSeeds(TOWN_SEEDS, TOWN_HELD_OUT)
    else:
        train = config.scenes.train_seeds
        usual = FitSeeds(
            tuple(seed for k, seed in enumerate(train) if k % 5 < 3),
            tuple(seed for k, seed in enumerate(train) if k % 5 >= 3),
        )
    seeds = FitSeeds(usual.fit if fit is None else fit, usual.held_out if held_out is None else held_out)
    shared = sorted(set(seeds.fit) & set(seeds.held_out))
    if shared:
        raise InputError(
            f"command line (--held-out): expected scenes that the curves are not fitted on, got {len(shared)} of "
            f"them, such as {shared[0]}; change --scenes or --held-out"
        )
    tested = sorted(set(seeds.fit) & set(config.scenes.test_seeds))
    if tested:
        raise InputError(
            f"command line (--scenes): expected other scenes than scenes.test_seeds, got {len(tested)} of them, such "
            f"as {tested[0]}; change --scenes or scenes.test_seeds"
        )
    if not seeds.held_out:
        raise InputError(
            f"scenes.train_seeds: expected at least 4 scenes to fit and to judge by, got {len(seeds.fit)}; "
            "give --scenes and --held-out"
        )
    return seeds


def fit_detector(
    config: Config,
    *,
    words: Sequence[str],
    fit_seeds: tuple[int, ...] | None,
    held_out_seeds: tuple[int, ...] | None,
    out: Path | None,
    again: bool,
    display: RunDisplay,
) -> Path:
    """Fit p(detected), or take the stored fit, and show how good it is.

    Args:
        config: Detector, camera, scenes.
        words: The command, for the record.
        fit_seeds: Scenes to fit; None: see `chosen_seeds`.
        held_out_seeds: Scenes to judge by; None: see `chosen_seeds`.
        out: Folder to keep it in; None: beside the detector's file, or in the user's cache.
        again: Whether to fit even if there is a stored fit.
        display: Where to show it.

    Returns:
        The file of the model.

    Raises:
        InputError: The input is wrong, or there are too few objects to fit or to judge by.
    """
    began = time.perf_counter()
    use = detector_use(config)
    seeds = chosen_seeds(config, fit_seeds, held_out_seeds)
    if out is not None:
        try:
            out.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(
                f"command line (--out): expected a folder to write to, got {str(out)!r} ({error.strerror})"
            ) from None
    stored = stored_file(use) if out is None else _existing(out / use.file_name)
    if stored is not None and not again:
        model = DetectionProbability.read(stored, use=use)
        as_asked = (fit_seeds is None or list(fit_seeds) == model.record["fit"]["seeds"]) and (
            held_out_seeds is None or list(held_out_seeds) == model.record["held_out"]["seeds"]
        )
        if as_asked and not set(model.record["fit"]["seeds"]) & set(config.scenes.test_seeds):
            display.say(f"{stored} fits this detector, camera and source of scenes already; --again fits it again")
            _show(model.record, display)
            return stored
    sightings = _look_at_scenes(config, (*seeds.fit, *seeds.held_out), display)
    display.stage("fitting")
    known, unseen = sightings.of_seeds(seeds.fit), sightings.of_seeds(seeds.held_out)
    try:
        model, penalty = fit_probability(known, rng=np.random.default_rng([config.run.seed, _FOLDS]))
    except ValueError as error:
        raise InputError(
            f"{use.model}: p(detected): {error}; give more scenes by --scenes, or other sizes of image"
        ) from None
    probability = model.of_features(unseen.feature)
    try:
        scores = score(probability, unseen.is_detected)
    except ValueError as error:
        raise InputError(f"{use.model}: held-out scenes: {error}; give more scenes by --held-out") from None
    model = replace(
        model,
        record={
            "command": shlex.join(words),
            "seconds": round(time.perf_counter() - began, 1),
            "fit": {"seeds": list(seeds.fit), "views_per_scene": VIEWS_PER_SCENE, **_counts(known), "penalty": penalty},
            "held_out": {"seeds": list(seeds.held_out), **_counts(unseen), **asdict(scores)},
        },
    )
    file = _write(model, use, out)
    reliability_diagram(
        scores.bins,
        probability,
        unseen.is_detected,
        file.with_name(f"{file.stem}_reliability.png"),
        title=f"AUC {scores.auc:.3f}, Brier {scores.brier:.3f}, calibration error {scores.calibration_error:.3f}",
    )
    detection_curves(model, known.feature, file.with_name(f"{file.stem}_curves.png"))
    _show(model.record, display)
    return file


def _existing(file: Path) -> Path | None:
    return file if file.is_file() else None


def _look_at_scenes(config: Config, seeds: Sequence[int], display: RunDisplay) -> Sightings:
    """What the detector finds of the scenes through random cameras on the mount surface."""
    device = checked_device(config.device)
    detector = load_detector(config)
    model = camera_model(config)
    at_once = min(VIEWS_PER_SCENE, chunk_view_count(model, supersampling=config.camera.supersampling))
    renderer = Renderer(
        [model] * at_once,
        supersampling=config.camera.supersampling,
        occlusion=Occlusion(config.visibility.occlusion),
        device=device,
    )

    def parts() -> Iterator[Sightings]:
        surface = None
        for seed, scene in zip(seeds, load_scenes(config, seeds), strict=True):
            surface = surface or mount_surface(config, scene.ego)
            packed = DeviceScene.pack(scene, device=device)
            if packed.vehicle_count == 0:
                yield Sightings.join([])
                continue
            cameras = random_cameras(
                np.random.default_rng([config.run.seed, _CAMERAS, seed]),
                surface,
                model,
                height_offset_m=config.rig.height_offset_m,
                count=-(-VIEWS_PER_SCENE // at_once) * at_once,
                **vars(free_ranges(config)),
            )
            yield Sightings.join(
                [
                    look(
                        renderer,
                        packed,
                        cameras[first : first + at_once],
                        detector,
                        seed=seed,
                        confidence_min=config.detector.confidence_min,
                        iou_min=config.detector.iou_min,
                    )
                    for first in range(0, len(cameras), at_once)
                ]
            )

    return Sightings.join(list(display.steps("looking at scenes", parts(), count=len(seeds))))


def _counts(sightings: Sightings) -> dict[str, int]:
    return {"objects": len(sightings), "detected": int(sightings.is_detected.sum())}


def _write(model: DetectionProbability, use: DetectorUse, out: Path | None) -> Path:
    """Write the model into the folder asked for, else beside its detector, else into the user's cache.

    What warpav ships is never written beside: an installed package stays as it is.
    """
    if out is not None:
        folders = [out]
    else:
        beside, cache = use.folders()
        folders = [cache] if beside.is_relative_to(Path(__file__).resolve().parents[1]) else [beside, cache]
    for folder in folders[:-1]:
        with contextlib.suppress(OSError):
            return model.write(folder, use)
    try:
        return model.write(folders[-1], use)
    except OSError as error:
        raise InputError(f"{folders[-1]}: expected a folder to write to, got {error.strerror}; give --out") from None


def _show(record: Any, display: RunDisplay) -> None:  # noqa: ANN401 (JSON)
    fit, held_out = record["fit"], record["held_out"]
    for name, part in (("fitted on", fit), ("judged on", held_out)):
        display.say(
            f"{name} {part['objects']} objects in views of {len(part['seeds'])} scenes, {part['detected']} detected"
        )
    display.say(
        f"AUC {held_out['auc']:.3f}, Brier score {held_out['brier']:.4f} (of the base rate "
        f"{held_out['brier_base_rate']:.4f}), "
        f"expected calibration error {held_out['calibration_error']:.4f} ({BIN_COUNT} bins of equal number)"
    )
