"""How good the fitted detection probability of detectors is on scenes other than those of the fit, of any source."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from warpav.core.errors import ArgumentError
from warpav.core.files import check_folder, write_json, write_text, writing
from warpav.core.progress import Progress
from warpav.detection.probability_fit import BIN_COUNT, DetectionSamples, ProbabilityScores, score
from warpav.evaluation.statistics import LEVEL, Estimate
from warpav.runs.config import Config
from warpav.runs.detector_fit import ensure_fit, town_config
from warpav.runs.detector_samples import sample_camera
from warpav.runs.networks import networks_in
from warpav.runs.terminal import TextTable

SCHEMA = 1

_FittedOn = Literal["town", "own"]

_RESAMPLES = 999

_HEADS = ("detector", "image px", "objects", "detected", "predicted", "AUC", "Brier (base rate)", "calibration error")
_HEADS = (*_HEADS, "of the fit's own scenes: AUC, error")


@dataclass(frozen=True, eq=False)
class _FitScores:
    """The detection probability of a detector against what the detector finds."""

    name: str  # the detector's name
    width_px: int  # width of its images
    height_px: int  # their height
    objects: int  # objects of which a view shows some pixel, over all views
    detected: int  # how many of them are detected
    predicted: float  # mean probability of them
    auc: Estimate  # see `warpav.detection.probability_fit.ProbabilityScores`; the 95 % interval resamples scenes
    calibration_error: Estimate  # likewise. Noise makes it larger than 0 for a perfect fit as well
    scores: ProbabilityScores  # all scores, with the bins
    of_fit: dict[str, float]  # scores on the scenes that were held out of the fit; empty where the fit does not tell
    probability: np.ndarray  # what the fit says, float64 [object]
    is_detected: np.ndarray  # bool [object]

    def data(self) -> dict[str, Any]:
        """For a JSON file; without the single objects."""
        return {name: value for name, value in vars(self).items() if name not in ("probability", "is_detected")}

    def cells(self) -> list[str]:
        """Its line of the table."""
        of_fit = f"{self.of_fit['auc']:.3f}, {self.of_fit['calibration_error']:.3f}" if self.of_fit else "-"
        return [
            self.name,
            f"{self.width_px} x {self.height_px}",
            str(self.objects),
            f"{self.detected / self.objects:.3f}",
            f"{self.predicted:.3f}",
            _text(self.auc),
            f"{self.scores.brier:.4f} ({self.scores.brier_base_rate:.4f})",
            _text(self.calibration_error),
            of_fit,
        ]


def score_detectors(
    config: Config,
    *,
    panel: Path | None,
    fitted_on: _FittedOn,
    seeds: tuple[int, ...] | None,
    out: Path | None,
    progress: Progress,
) -> list[_FitScores]:
    """Score the fits of the configured detector, or of all networks of a folder; show the scores and write them.

    What has no stored fit is fitted first, as a run would.
    """
    if out is not None:
        check_folder(out, "out")
    seeds = config.scenes.test_seeds if seeds is None else seeds
    configs = {Path(config.detector.model).stem: config}
    if panel is not None:
        configs = {network.name: network.config(config) for network in networks_in(panel, config)}
    found = []
    for name, each in configs.items():
        progress.say(f"{name}: {len(seeds)} scenes")
        found.append(_score(name, each, fitted_on, seeds, progress))
    progress.show(_table(found).terminal())
    if out is not None:
        _write(found, config, fitted_on, seeds, out)
        progress.say(f"wrote {out}")
    return found


def _score(name: str, config: Config, fitted_on: _FittedOn, seeds: tuple[int, ...], progress: Progress) -> _FitScores:
    fit_config = town_config(config) if fitted_on == "town" else config
    model = ensure_fit(fit_config, progress=progress)
    known = model.record.get("fit", {}).get("seeds", [])
    shared = sorted(set(known) & set(seeds)) if fit_config.scenes.source == config.scenes.source else []
    if shared:
        raise ArgumentError(
            "scenes", f"expected scenes that {name} was not fitted on, got {len(shared)} of them, such as {shared[0]}"
        )
    samples = sample_camera(config, seeds, model, progress=progress)
    probability = model.of_features(samples.feature)
    try:
        scores = score(probability, samples.is_detected)
    except ValueError as error:
        raise ArgumentError("scenes", f"{error}; give more `scenes`", place=name) from None
    held_out = model.record.get("held_out", {})
    intervals = _intervals(probability, samples)
    return _FitScores(
        name,
        config.camera.width_px,
        config.camera.height_px,
        len(samples),
        int(samples.is_detected.sum()),
        float(probability.mean()),
        Estimate(scores.auc, *intervals["auc"], len(seeds)),
        Estimate(scores.calibration_error, *intervals["calibration_error"], len(seeds)),
        scores,
        {key: held_out[key] for key in ("auc", "brier", "brier_base_rate", "calibration_error") if key in held_out},
        probability,
        samples.is_detected,
    )


def _intervals(probability: np.ndarray, samples: DetectionSamples) -> dict[str, tuple[float | None, float | None]]:
    """Percentile intervals over resampled scenes; None with fewer than two."""
    members = [np.flatnonzero(samples.seed == seed) for seed in np.unique(samples.seed)]
    names = ("auc", "calibration_error")
    if len(members) < 2:
        return dict.fromkeys(names, (None, None))
    rng = np.random.default_rng(0)
    drawn = []
    for _ in range(_RESAMPLES):
        chosen = np.concatenate([members[k] for k in rng.integers(0, len(members), len(members))])
        try:
            scores = score(probability[chosen], samples.is_detected[chosen])
        except ValueError:  # all of them were detected, or none
            continue
        drawn.append([getattr(scores, name) for name in names])
    if not drawn:
        return dict.fromkeys(names, (None, None))
    low, high = np.quantile(np.array(drawn), [0.5 - LEVEL / 2.0, 0.5 + LEVEL / 2.0], axis=0)
    return {name: (float(low[k]), float(high[k])) for k, name in enumerate(names)}


def _write(
    found: Sequence[_FitScores], config: Config, fitted_on: _FittedOn, seeds: tuple[int, ...], out: Path
) -> None:
    from warpav.view.figures.statistics import reliability_diagram

    with writing(out):
        out.mkdir(parents=True, exist_ok=True)
    source = {"source": config.scenes.source, "level": config.scenes.level, "seeds": list(seeds)}
    write_json(
        out / "scores.json",
        {"schema": SCHEMA, "scenes": source, "fitted_on": fitted_on, "detectors": [each.data() for each in found]},
    )
    write_text(out / "scores.md", _table(found).markdown())
    for each in found:
        reliability_diagram(
            each.scores.bins,
            each.probability,
            each.is_detected,
            out / f"{each.name}_reliability.png",
            title=f"{each.name}: AUC {each.scores.auc:.3f}, calibration error {each.scores.calibration_error:.3f}",
        )


def _table(found: Sequence[_FitScores]) -> TextTable:
    return TextTable(
        "Detection probability against what detectors find",
        _HEADS,
        [each.cells() for each in found],
        "Objects of which a view shows some pixel; detected: their share; predicted: their mean probability. 95 % "
        f"intervals resample scenes. Calibration error: {BIN_COUNT} bins of equal number.",
    )


def _text(number: Estimate) -> str:
    text = f"{number.value:.3f}"
    return text if number.low is None or number.high is None else f"{text} [{number.low:.3f}, {number.high:.3f}]"
