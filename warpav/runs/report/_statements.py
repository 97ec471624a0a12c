"""What a run has come to in words, for terminal and page alike: what was reached, what was not, what is still open."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from warpav.core.frames import wrap_angle_rad
from warpav.core.table import Table
from warpav.optimisation import ANGLES, REDUNDANT_WITHIN_M, Difference, Margin, ObjectOutcome
from warpav.rig import Rig
from warpav.runs._drawn_run import heading_of
from warpav.runs._rig_evaluation import LOWER_IS_BETTER, RigEvaluation, Robust
from warpav.runs.report._content import RunContent
from warpav.sight import SECTORS, RuleMargin

_Tone = Literal["good", "bad", "open"]

MINUS, NONE, SPACE = "\N{MINUS SIGN}", "\N{EN DASH}", "\N{NO-BREAK SPACE}"

_MIN_SCENES = 6
"""With fewer, no difference can have a p-value below 0.05: all scenes agree by chance in 2^(1 - scenes) of cases."""

_FEW_SCENES = 30
_FAR_PER_100 = 5.0  # detected misses that exceed the expected ones by so many, and twofold, are warned of
_EASY_PER_100 = 2.0  # misses below which scenes do not tell rigs apart
_MORE_BLIND = 0.05  # share of the near ground that must be blind besides to be named
_HIDING_BODY = 0.5  # share of an image from which on the own body is named as why a rig detects nothing
_BASELINES = {
    "optimised": "the rig that was found",
    "by_hand": "the best rig by hand",
    "start": "the start",
    "highest": "the highest rig",
    "random": "the best random rig",
}
_WORSE = "WORSE THAN ITS START"
_WORTH_NAMING_M, _WORTH_NAMING_DEG = 0.005, 0.5  # smaller moves are none


@dataclass(frozen=True)
class Statement:
    """A sentence or some, under a catchword; ``tone`` says whether that is good or bad news, or neither."""

    about: str
    text: str
    tone: _Tone = "open"


def number(value: float | None, digits: int = 3) -> str:
    """A number with so many decimals, a dash where there is none."""
    return NONE if value is None else f"{value:z.{digits}f}".replace("-", MINUS)


def signed(value: float | None, digits: int = 3) -> str:
    """The same with its sign."""
    return NONE if value is None else f"{value:+z.{digits}f}".replace("-", MINUS)


def percent(value: float | None, digits: int = 1) -> str:
    """A share in percent, a dash where there is none."""
    return NONE if value is None else f"{100.0 * value:.{digits}f}{SPACE}%"


def gain(found: Difference, metric: str, factor: float = 1.0, digits: int = 1) -> str:
    """By how much the first rig is better than another, with its 95 % interval; negative where it is worse."""
    factor *= -1.0 if metric in LOWER_IS_BETTER else 1.0
    mean, low, high = (None if each is None else factor * each for each in (found.mean, found.low, found.high))
    if low is None or high is None:
        return signed(mean, digits)
    return f"{signed(mean, digits)} [{signed(min(low, high), digits)}, {signed(max(low, high), digits)}]"


def tone_of(difference: Difference, *, lower_is_better: bool = False) -> _Tone:
    """In whose favour a difference is, where its interval excludes 0, and the scenes are enough."""
    low, high = difference.low, difference.high
    if low is None or high is None or difference.scenes < _MIN_SCENES or low <= 0.0 <= high:
        return "open"
    return "good" if (high < 0.0) == lower_is_better else "bad"


def headline(run: RunContent) -> Statement:
    """The run in one sentence: what its rig misses at equal false alarms, and the one that it is compared with.

    Before it, whether the rig is worse than its start. Where its objective is higher on the scenes of the search, the
    rig of the run is the start. Where it only misses more on the test scenes, beyond the interval, it stays the rig of
    the run, as these choose none.
    """
    evaluation = run.evaluation
    if evaluation is None:
        return Statement("", f"Stopped after {_counted(len(run.events), 'iteration')}, before any rig was compared.")
    missed, objects = evaluation.misses, objects_name(run)
    first, other, training = evaluation.first, compared_with(evaluation), evaluation.training_objective
    about = worse = ""
    if training is not None and evaluation.is_worse_than_start:
        end = "no number" if training.optimised is None else f"{training.optimised:.4g}"
        about, worse = _WORSE, f"the rig that was found has objective {end}, its start {training.start:.4g}; "
        worse += "the rig of the run, rig_best.yaml, is the start. "
    if missed[first] is None:
        text = f"{worse}No {objects_name(run, 1)} in {_counted(evaluation.scene_count, 'test scene')}."
        return Statement(about, text, "bad")
    unseen = "scene" if training is None else "unseen scene"
    rate = 0.5 if run.config is None else run.config.evaluation.false_alarms_per_image
    text = (
        f"{worse}In {_counted(evaluation.scene_count, unseen)} {_arm(first)} misses {number(missed[first], 1)} of 100 "
        f"{objects} at {rate:g} false alarms an image"
    )
    tone: _Tone = "open"
    found = None if other is None else evaluation.paired.get(other, {}).get("misses_at_equal_false_alarms")
    if other is not None and found is not None and found.mean is not None:
        tone = tone_of(found, lower_is_better=True)
        text += f", {_arm(other)} {number(missed[other], 1)}: {gain(found, 'misses_at_equal_false_alarms')} fewer"
        if found.low is None or found.scenes < _MIN_SCENES:
            text += f"; {_counted(found.scenes, 'scene')} cannot tell them apart"
        else:
            text += f"; the 95{SPACE}% interval {'includes' if tone == 'open' else 'excludes'} 0"
        if tone == "bad" and training is not None and other == evaluation.start:
            about = _WORSE
    return Statement(about, f"{text}.", "bad" if worse else tone)


def verdict(run: RunContent) -> Statement:
    """Rigs side by side in one sentence: which misses least, by how much, and whether that is told apart."""
    evaluation = run.evaluation
    assert evaluation is not None
    missed = {name: each for name, each in evaluation.misses.items() if each is not None}
    scenes, objects = _counted(evaluation.scene_count, "unseen scene"), objects_name(run)
    if not missed:
        return Statement("", f"No {objects_name(run, 1)} in {scenes}.", "bad")
    best = min(missed, key=lambda name: missed[name])
    rate = 0.5 if run.config is None else run.config.evaluation.false_alarms_per_image
    at = f"of 100 {objects} in {scenes} at {rate:g} false alarms an image"
    parts, tones = [], set[str]()
    for other in (name for name in missed if name != best):
        found = evaluation.difference(best, other)
        tone = tone_of(found, lower_is_better=True)
        apart = "told apart" if tone == "good" else "not told apart"
        if found.low is None or found.scenes < _MIN_SCENES:
            apart = f"{_counted(found.scenes, 'scene')} cannot tell them apart"
        elif tone == "open":
            apart += f", as the 95{SPACE}% interval includes 0"
        tones.add(tone)
        parts.append(f"{gain(found, 'misses_at_equal_false_alarms')} fewer than {other} ({apart})")
    if len(set(missed.values())) == 1:
        return Statement("", f"{_listed(missed)} miss equally many, {number(missed[best], 1)} {at}.")
    text = f"{best} misses fewest, {number(missed[best], 1)} {at}: {', '.join(parts)}."
    return Statement("", text, "good" if tones == {"good"} else "open")


def compared_with(evaluation: RigEvaluation) -> str | None:
    """The rig that the first is compared with before all others: the start, else the second."""
    if evaluation.start in evaluation.arms and evaluation.start != evaluation.first:
        return evaluation.start
    return next((name for name in evaluation.arms if name != evaluation.first), None)


def cautions(run: RunContent) -> list[Statement]:
    """What a reader should know before he builds on the rig, the gravest first."""
    evaluation = run.evaluation
    if evaluation is None:
        return []
    found = list[Statement | None]()
    for each in evaluation.met.get(evaluation.first, []):
        if each.is_met:
            continue
        text = f"{each.name} at {percent(each.share)} of {each.points} points"
        text += f", asked {percent(each.need.share, 0)}" if each.need.share not in (None, 1.0) else ""
        if each.worst:
            x, y = each.worst[0].position_m
            text += f"; worst at x = {x:.1f} m, y = {y:.1f} m"
        if each.gap:
            text += f"; largest gap: {each.gap.area_m2:.2f} m², {each.gap.sector}"
        found.append(Statement("REQUIREMENT NOT MET", text, "bad"))
    for name, arm in evaluation.arms.items():
        share = arm.body_share_max or 0.0
        if arm.tp_detection_rate == 0.0 and share >= _HIDING_BODY:
            text = f"the vehicle's own body covers up to {share:.0%} of an image"
            found.append(Statement(f"{name} detects nothing", text, "bad"))
    found += [each for each in (_rules(evaluation),) if each and each.tone == "bad"]
    found += [_unexpected(evaluation), _worse(evaluation)]
    found += [_told_apart(run, evaluation), _false_alarms(run, evaluation), _caution(evaluation), _pitch_limits(run)]
    return [each for each in found if each is not None]


def _worse(evaluation: RigEvaluation) -> Statement | None:
    """In what the first rig is worse than others, where the interval excludes 0, or which ground is.

    `headline` says whether it misses more than the one that it is compared with.
    """
    other, first, parts = compared_with(evaluation), evaluation.first, []
    for name, differences in evaluation.paired.items():
        for metric, (heading, factor, digits) in evaluation.rows.items():
            found = differences.get(metric) if (name == other) != (metric == "misses_at_equal_false_alarms") else None
            if found is not None and tone_of(found, lower_is_better=metric in LOWER_IS_BETTER) == "bad":
                after, before = (getattr(evaluation.arms[each], metric) * factor for each in (first, name))
                parts.append(f"{heading} {number(after, digits)} ({heading_of(name)} {number(before, digits)})")
    ground = evaluation.ground
    if ground is not None and other in ground.blind:
        more, sector, band = max(
            ((ground.share(first, 0, k, band) or 0.0) - (ground.share(other, 0, k, band) or 0.0), k, band)
            for k, _ in enumerate(ground.sectors)
            for band, _ in enumerate(ground.bands_m[:2])
        )
        if more > _MORE_BLIND:
            after, before = (percent(ground.share(name, 0, sector, band), 0) for name in (first, other))
            place = f"{ground.sectors[sector]}, {ground.bands_m[band].replace('-', ' to ')}{SPACE}m"
            parts.append(f"ground {place}, blind for a child on {after} ({heading_of(other)} {before})")
    return Statement("Worse", f"{'; '.join(parts)}.", "bad") if parts else None


def _unexpected(evaluation: RigEvaluation) -> Statement | None:
    outage, missed = evaluation.camera_outage.get(evaluation.first), evaluation.best.misses_per_100
    if outage is None or missed is None:
        return None
    expected = outage.expected_misses_per_100
    if missed <= 2.0 * expected or missed < expected + _FAR_PER_100:
        return None
    text = (
        f"the detector misses {number(missed, 1)} of 100 at its own threshold, where {number(expected, 1)} are "
        "expected: do not rely on the expected misses of this run."
    )
    return Statement("Expected misses", text, "bad")


def _told_apart(run: RunContent, evaluation: RigEvaluation) -> Statement | None:
    missed = [each for each in evaluation.misses.values() if each is not None]
    if len(missed) < 2 or max(missed) >= _EASY_PER_100:
        return None
    text = f"all rigs miss fewer than {_EASY_PER_100:g} of 100 {objects_name(run)}, so these scenes do not tell them "
    level = "" if run.config is None or run.config.scenes.source != "town" else ": try scenes.level=dense"
    return Statement("Too easy", f"{text}apart{level}.")


def _false_alarms(run: RunContent, evaluation: RigEvaluation) -> Statement | None:
    fewer = [name for name, arm in evaluation.arms.items() if arm.confidence_at_equal_false_alarms == 0.0]
    if run.config is None or not fewer:
        return None
    rate = run.config.evaluation.false_alarms_per_image
    text = (
        f"{_listed(map(_arm, fewer))} {'raises' if len(fewer) == 1 else 'raise'} no more than {rate:g} an image, so "
        "all that the detector reports counts."
    )
    return Statement("False alarms", text)


def rigs_of_run(run: RunContent) -> list[tuple[str, Rig | None]]:
    """The rig of a run, and the one that it is compared with, by what they are; a start that is better is first."""
    is_by_hand = run.evaluation is not None and run.evaluation.start == "by_hand"
    start = "The rig by hand" if is_by_hand else "The rig at the start"
    rigs = [("The rig that was found", run.result), (start, run.start)]
    return rigs[::-1] if run.evaluation is not None and run.evaluation.is_worse_than_start else rigs


def summary(run: RunContent) -> list[Statement]:
    """The run in a few statements, the most important first."""
    found: list[Statement | None] = []
    if run.evaluation is not None:
        found += [why(run, run.evaluation), _simpler(run.evaluation), _objective(run, run.evaluation)]
    is_by_hand = run.evaluation is not None and run.evaluation.start == "by_hand"  # another rig, not one that moved
    found += [_bound(run), None if is_by_hand else _moves(run)]
    if run.evaluation is not None:
        found += [_left(run, run.evaluation), _requirements(run.evaluation)]
        found += [_ground(run.evaluation), _rules(run.evaluation), _constraints(run.evaluation)]
    found.append(_end(run))
    if run.config_mistake:
        text = f"It cannot be used here, and what follows from it is left out: {run.config_mistake}"
        found.append(Statement("Configuration", text))
    return [statement for statement in found if statement is not None]


def _moves_of(start: Rig, result: Rig) -> list[tuple[str, float, float]]:
    """How far every camera has moved: its name, the distance [m] and the turn in yaw [deg], left positive."""
    return [
        (
            end.name,
            float(np.linalg.norm(end.position_m - begun.position_m)),
            math.degrees(float(wrap_angle_rad(end.yaw_rad - begun.yaw_rad))),
        )
        for begun, end in zip(start.cameras, result.cameras, strict=True)
    ]


def objects_name(run: RunContent, count: int = 2) -> str:
    """What the objects of a run are called."""
    is_vehicles = run.config is None or run.config.scenes.targets == ("vehicle",)
    return ("vehicle" if is_vehicles else "road user") + ("" if count == 1 else "s")


def why(run: RunContent, evaluation: RigEvaluation) -> Statement | None:
    """What the first rig finds and loses against its start, in terms of road users, seams and heights."""
    first, start = evaluation.first, evaluation.start
    if evaluation.outcomes is None or start not in evaluation.arms or first == start:
        return None
    is_found = {
        name: np.array([seen.outcome[name] == ObjectOutcome.DETECTED for seen in evaluation.outcomes])
        for name in (first, start)
    }
    parts, objects = [], objects_name(run)
    for verb, one, other, where in (("It finds", first, start, "there"), ("It loses", start, first, "here")):
        gained = [evaluation.outcomes[k] for k in np.flatnonzero(is_found[one] & ~is_found[other])]
        text = f"{verb} {_counted(len(gained), objects_name(run, 1))} that {_arm(start)} "
        text += "does not detect" if other == start else "detects"
        if gained:
            reasons = Counter(seen.outcome[other] for seen in gained)
            sectors = Counter(SECTORS[round(seen.bearing_deg / 45.0) % len(SECTORS)] for seen in gained)
            near_m, far_m = (pick(seen.distance_m for seen in gained) for pick in (min, max))
            sides = ", ".join(f"{name} {count}" for name, count in sectors.most_common(3))
            why = ", ".join(f"{count} {each}" for each, count in reasons.most_common())
            text += f" ({sides}; {near_m:.0f} to {far_m:.0f}{SPACE}m; {where} {why})"
        parts.append(f"{text}.")
    text = " ".join(parts)
    shares = [evaluation.arms[name].redundant_rate for name in (first, start)]
    if None not in shares:
        text += f" Two cameras see {percent(shares[0], 0)} of the {objects} within {REDUNDANT_WITHIN_M:g}{SPACE}m"
        text += f" ({heading_of(start)} {percent(shares[1], 0)})."
    if run.start is not None and run.result is not None:
        heights = [[camera.position_m[2] for camera in rig.cameras] for rig in (run.result, run.start)]
        low, high = ([pick(each) for each in heights] for pick in (min, max))
        text += f" Its cameras stand {low[0]:.2f} to {high[0]:.2f}{SPACE}m high ({heading_of(start)} {low[1]:.2f} to "
        text += f"{high[1]:.2f})."
    return Statement("Why", text)


def _simpler(evaluation: RigEvaluation) -> Statement | None:
    known, training = evaluation.simpler, evaluation.training_objective
    if known is None or training is None or training.optimised is None:
        return None
    parts = [f"{_listed(numbers)} of {camera}" for camera, numbers in known.by_hand.items()]
    text = (
        f"{_listed(parts)} may stay as by hand, {sum(map(len, known.by_hand.values()))} of {known.differing} "
        f"differences: objective {number(known.objective, 4)}, not {number(training.optimised, 4)} (rig_simpler.yaml)."
    )
    return Statement("Simpler", text)


def _objective(run: RunContent, evaluation: RigEvaluation) -> Statement | None:
    training = evaluation.training_objective
    if training is None or training.optimised is None:
        return None
    if training.start is None:
        outcomes = evaluation.met.get(evaluation.start, [])
        unmet = [each.name for each in outcomes if each.hard and not each.is_met]
        reason = f", as it does not meet {_listed(unmet)}" if unmet else ""
        return Statement("Objective", f"{number(training.optimised, 4)} at the end; the start is not allowed{reason}.")
    change = _change(training.start, training.optimised)
    validated = run.config is not None and bool(run.config.scenes.validation_seeds)
    on = "validation" if validated else "training"
    text = f"On the {'training and ' if validated and run.certificate is not None else ''}{on} scenes it {change}"
    if evaluation.robust is not None:
        return Statement("Objective", f"{text}: {_robust_text(evaluation.robust)}.")
    more = [text for name, text in _FURTHER_TERMS.items() if name in _terms(run)]
    text += f": {_listed(['expected misses', *more])} together" if more else ""
    broken = sum(not margin.is_kept for margin in (evaluation.rules or {}).get(evaluation.start, ()))
    if broken:
        text += f"; {_arm(evaluation.start)} breaks {_counted(broken, 'rule')}"
    return Statement("Objective", f"{text}.")


def _robust_text(robust: Robust) -> str:
    """What a robust objective is made of at the start and at the end, in a sentence without its full stop."""

    def change(name: str) -> str:
        ends = (robust.start, robust.optimised)
        return " -> ".join("-" if each is None else f"{100.0 * each[name]:.2f}" for each in ends)

    errors = _mount_errors(robust)
    if robust.camera_loss is None:
        return (
            f"the objective is the expected misses in the mean over errors of mounting of {errors}; per 100, start -> "
            f"end: {change('expected_miss_rate')} with errors, {change('as_designed')} as designed"
        )
    lost = "the camera that is worst to lose" if robust.camera_loss == "worst" else "one camera, in the mean"
    weight = robust.weight or 0.0
    text = (
        f"the objective is {1.0 - weight:g} x expected misses + {weight:g} x those without {lost}; per 100, start -> "
        f"end: {change('expected_miss_rate')} with all cameras, {change('without_camera')} without {lost}"
    )
    if not errors:
        return text
    return f"{text}; all in the mean over errors of mounting of {errors}, as designed {change('as_designed')}"


def _mount_errors(robust: Robust) -> str:
    parts = [] if robust.mount_error_m is None else [f"+-{100.0 * robust.mount_error_m:g} cm"]
    parts += [] if robust.mount_error_deg is None else [f"+-{robust.mount_error_deg:g} deg"]
    return " and ".join(parts)


_FURTHER_TERMS = {"false_alarms": "what false alarms cost", "requirements": "unmet points near the vehicle"}
"""Of the objective of a search, besides expected misses."""


def _terms(run: RunContent) -> Collection[str]:
    return (run.events[-1].terms or {}) if run.events else ()


def _bound(run: RunContent) -> Statement | None:
    """How low the objective can be at most: over the cameras of the pool, on the scenes of the search, nowhere else."""
    found = run.certificate
    if found is None:
        return None
    robust = None if run.evaluation is None else run.evaluation.robust
    config = run.config
    has_rules = config.keeps_rules if config is not None else bool(run.evaluation and run.evaluation.rules)
    training = None if run.evaluation is None else run.evaluation.training_objective
    handed_over = None if training is None else training.optimised
    objective = found.objective if handed_over is None else handed_over
    if robust is not None or _FURTHER_TERMS.keys() & set(_terms(run)):
        bound, reached = f"has an objective below {number(found.bound, 4)}", number(objective, 4)
    else:
        bound = f"is expected to miss fewer than {number(100.0 * found.bound, 2)} of 100 {objects_name(run)}"
        reached = number(100.0 * objective, 2)
    text = (
        f"Proven: no rig of the {found.pool_cameras} rendered candidate cameras{' that keeps the rules' * has_rules} "
        f"{bound}, by the modelled probability of detection, on the "
        f"{'scenes' if found.scenes is None else _counted(found.scenes, 'scene')} of the search. The rig has {reached}"
    )
    text += ", below it, as its cameras were moved between the candidates." if objective < found.bound else "."
    loose = " This bound is loose." if robust is not None and robust.camera_loss is not None else ""
    return Statement("Bound", f"{text}{loose} Of other poses and scenes it says nothing.")


def _moves(run: RunContent) -> Statement | None:
    if run.start is None or run.result is None or len(run.start.cameras) != len(run.result.cameras):
        return None
    found = _moves_of(run.start, run.result)
    moved = [each for each in found if each[1] >= _WORTH_NAMING_M or abs(each[2]) >= _WORTH_NAMING_DEG]
    if not moved:
        return Statement("What moved", "Nothing: the rig is the one at the start.")
    parts = [
        f"{name} by {100.0 * moved_m:.0f} cm (turned {abs(turn_deg):.0f}° to the {'left' if turn_deg > 0 else 'right'})"
        for name, moved_m, turn_deg in moved
    ]
    still = len(found) - len(moved)
    text = f"{_listed(parts)}" + (f"; {_counted(still, 'camera')} stayed." if still else ".")
    return Statement("What moved", text)


def _left(run: RunContent, evaluation: RigEvaluation) -> Statement | None:
    if evaluation.outcomes is None:
        return None
    count = Counter(seen.outcome[evaluation.first] for seen in evaluation.outcomes)
    left = len(evaluation.outcomes) - count[ObjectOutcome.DETECTED]
    if left == 0:
        return Statement("Not detected", f"No {objects_name(run, 1)}.", "good")
    reasons = [
        f"{count[outcome]} {text}"
        for outcome, text in (
            (ObjectOutcome.MISSED, "visible to a camera but missed by the detector"),
            (ObjectOutcome.HIDDEN, "hidden behind something"),
            (ObjectOutcome.OUT_OF_FRAME, "in no camera's image"),
        )
        if count[outcome]
    ]
    nearest = min(
        (seen for seen in evaluation.outcomes if seen.outcome[evaluation.first] != ObjectOutcome.DETECTED),
        key=lambda seen: seen.distance_m,
    )
    text = (
        f"{_counted(left, objects_name(run, 1))}: {_listed(reasons)}. The nearest is {nearest.distance_m:.0f} m away."
    )
    return Statement("Not detected", text)


def _requirements(evaluation: RigEvaluation) -> Statement | None:
    outcomes = evaluation.met.get(evaluation.first)
    if not outcomes:
        return None
    parts = []
    for each in outcomes:
        share = each.need.share
        asked = "" if share in (None, 1.0) else f" ({percent(share, 0)} asked)"
        text = f"{each.name} is met at {percent(each.share)} of {each.points} points{asked}"
        if (not each.is_met or share is None) and each.worst:
            x, y = each.worst[0].position_m
            text += f", least at ({number(x, 1)}, {number(y, 1)}){SPACE}m"
        parts.append(text)
    is_met = all(each.is_met for each in outcomes)
    if all(each.need.share is None for each in outcomes):  # terms of the objective that ask for nothing
        return Statement("Seen near the vehicle", f"{_listed(parts)}.", "open")
    lead = "Met: " if is_met else "Not met: "
    parts = parts if is_met else [text for text, each in zip(parts, outcomes, strict=True) if not each.is_met]
    return Statement("Seen near the vehicle", f"{lead}{_listed(parts)}.", "good" if is_met else "bad")


def _ground(evaluation: RigEvaluation) -> Statement | None:
    ground, first = evaluation.ground, evaluation.first
    if ground is None:
        return None
    parts = []
    for height, height_m in enumerate(ground.heights_m):
        others = [
            f"{heading_of(name)} {percent(ground.share(name, height), 0)}" for name in ground.blind if name != first
        ]
        text = f"someone {height_m:g}{SPACE}m tall on {percent(ground.share(first, height), 0)} of the ground"
        parts.append(text + (f" ({', '.join(others)})" if others else ""))
    text = f"Within {ground.radius_m:g}{SPACE}m of the vehicle no camera sees {_listed(parts)}."
    share, sector, band = ground.worst_near(first)
    if share > 0.0:
        text += f" Worst nearby: {sector}, {band.replace('-', ' to ')}{SPACE}m from its middle, {percent(share, 0)}."
    return Statement("Blind ground", text, "bad" if share > 0.5 else "open")


def _constraints(evaluation: RigEvaluation) -> Statement | None:
    violation_m = evaluation.best.constraint_violation
    margins = None if evaluation.constraints is None else evaluation.constraints[evaluation.first]
    if not margins:
        if violation_m is None:
            return None
        is_kept = violation_m == 0.0
        text = "All hold." if is_kept else f"Broken by {number(violation_m)} m in all."
        return Statement("Constraints", text, "good" if is_kept else "bad")
    broken = [margin for margin in margins if not margin.is_kept]
    tightest = min(margins, key=lambda margin: margin.slack_m)
    name = margin_name(tightest)
    if broken:
        worst = f"{name} is {_length(-tightest.slack_m)} too short"
        return Statement("Constraints", f"{len(broken)} of {len(margins)} are broken; {worst}.", "bad")
    text = f"All {len(margins)} hold; the tightest is {name}, with {_length(tightest.slack_m)} to spare."
    return Statement("Constraints", text, "good")


RULES = {
    "own_body": ("own body in the image", "at most", "{:.0%}"),
    "horizon": ("horizon below the top edge of the image", "at least", "{:.0%}"),
    "crossing": ("angle to the line across the vehicle", "at least", "{:.0f}°"),
    "housing": ("another camera's housing in the image", "at most", "{:.1%}"),
    "azimuth_gap": ("widest gap of directions at 15 m", "at most", "{:.0f}°"),
    "near_ground": ("from how far off the body on the ground is seen all round", "at most", "{:g} m"),
}


def rule_table(evaluation: RigEvaluation, arms: Iterable[str | None] | None = None) -> Table | None:
    """What the rules ask for, and what some rigs have; by default the first and the one that it is compared with."""
    names, rules = arms or (evaluation.first, compared_with(evaluation)), evaluation.rules or {}
    known = {name: rules[name] for name in names if name is not None and rules.get(name)}
    if evaluation.first not in known:
        return None

    def told(margin: RuleMargin) -> str:
        shown = "nowhere" if margin.value is None else RULES[margin.rule][2].format(margin.value)
        camera = f", {margin.cameras[0]}" if margin.cameras and margin.value else ""
        return f"{shown}{camera}{'' if margin.is_kept else ' (broken)'}"

    rows = []
    for margin in known[evaluation.first]:
        heading, way, form = RULES[margin.rule]
        limit = NONE if margin.limit is None else f"{way} {form.format(margin.limit)}"
        of_rigs = ({each.rule: told(each) for each in margins} for margins in known.values())
        rows.append((heading, limit, *(each.get(margin.rule, NONE) for each in of_rigs)))
    return Table(("rule, worst camera", "asked", *known), tuple(rows))


def _rules(evaluation: RigEvaluation) -> Statement | None:
    table, margins = rule_table(evaluation), (evaluation.rules or {}).get(evaluation.first, ())
    if table is None:
        return None
    further = ""
    for margin in margins:
        if margin.asked is not None and margin.price is None:
            further += f" No rig of these cameras keeps the {margin.asked:.0f} degrees of gap that were asked."
        elif margin.asked is not None:
            further += f" A gap of {margin.asked:.0f} degrees, as asked, would cost {percent(margin.price)} more."
        elif margin.rule == "near_ground" and margin.limit is None:
            seen = "nowhere up to 6" if margin.value is None else f"from {margin.value:g}"
            further += f" The ground is seen all round {seen}{SPACE}m off the body; no limit was kept."
    broken = [row for row, margin in zip(table.rows, margins, strict=True) if not margin.is_kept]
    if broken:
        told = [f"{heading} {value.removesuffix(' (broken)')}, {asked} asked" for heading, asked, value, *_ in broken]
        return Statement("Rules", f"{len(broken)} of {len(margins)} broken: {'; '.join(told)}.{further}", "bad")
    return Statement("Rules", f"All {len(margins)} kept.{further}", "good")


def _pitch_limits(run: RunContent) -> Statement | None:
    """Which cameras would pitch farther if they might; None where none would, or zones have limits of their own."""
    if run.config is None or run.result is None or run.config.mount.zones is not None:
        return None
    limits_deg = run.config.rig.free.pitch_deg
    if limits_deg is None:
        return None
    free = [camera for camera in run.result.cameras if camera.name not in run.config.rig.freeze]
    pitch_deg = np.rad2deg([camera.pitch_rad for camera in free])
    at_limit = [
        camera.name for camera, each in zip(free, pitch_deg, strict=True) if np.abs(each - limits_deg).min() < 0.1
    ]
    if not at_limit:
        return None
    limits = " to ".join(f"{each:g}" for each in limits_deg).replace("-", MINUS)
    verb = "pitches as far as it may" if len(at_limit) == 1 else "pitch as far as they may"
    text = f"{_listed(at_limit)} {verb} ({limits} degrees): a wider rig.free.pitch_deg may find more."
    return Statement("Limits", text)


def _end(run: RunContent) -> Statement | None:
    end = None if run.evaluation is None else run.evaluation.descent
    if end is None:
        if not run.events:
            return None
        planned = "" if run.config is None else f" of {run.config.run.iterations}"
        text = f"After {_counted(len(run.events), 'iteration')}{planned}; this folder does not say why."
        return Statement("Why it ended", text)
    why = "all were taken" if end.ended is None else end.ended
    kept = "the start is kept: none was better" if end.kept == 0 else f"the rig after {end.kept} is kept"
    return Statement("Why it ended", f"After {end.iterations} of {end.planned} iterations: {why}; {kept}.")


def sensitivity(run: RunContent) -> str:
    """Which error of mounting and the loss of which camera cost most, in a sentence; empty where that is not known."""
    evaluation = run.evaluation
    tolerance = None if evaluation is None else evaluation.mount_tolerance
    if evaluation is None or tolerance is None:
        return ""
    worst, objects = tolerance.worst, objects_name(run)
    is_angle = worst.degree in ANGLES
    angle_deg = f"{math.degrees(tolerance.angle_rad):g}"
    angle = f"{angle_deg} degree{'' if angle_deg == '1' else 's'}"
    off = angle if is_angle else f"{100.0 * tolerance.position_m:g} cm"
    text = (
        f"Most sensitive is {worst.camera} in {worst.degree}: off by {off}, the rig is expected to miss "
        f"{number(worst.change_per_100, 2)} more of 100 {objects} ({_counted(tolerance.scenes, 'scene')})"
        if round(worst.change_per_100, 2) > 0.0
        else f"No camera that is off by {100.0 * tolerance.position_m:g} cm or {angle} in one direction costs anything "
        f"({_counted(tolerance.scenes, 'scene')})"
    )
    outage = evaluation.camera_outage.get(evaluation.first)
    if outage is None:
        return f"{text}."
    lost = outage.worst
    more = lost.difference_per_100 if lost.weighted_difference_per_100 is None else lost.weighted_difference_per_100
    return f"{text}; in traffic the loss of {lost.camera} costs most, {number(more, 1)} more misses of 100."


def _caution(evaluation: RigEvaluation) -> Statement | None:
    count = evaluation.scene_count
    if count >= _FEW_SCENES:
        return None
    text = (
        f"with fewer than {_MIN_SCENES}, no interval can exclude 0"
        if count < _MIN_SCENES
        else (f"the intervals of {count} tend to be too short")
    )
    return Statement("Few scenes", f"{text}; for more: scenes.test_seeds=5000..5049.")


def margin_name(margin: Margin) -> str:
    """What a constraint is about, in words."""
    if margin.kind == "border":
        return f"the distance from {margin.cameras[0]} to the border of where it may stand"
    return f"the distance between {' and '.join(margin.cameras)}"


def _length(length_m: float) -> str:
    return f"{1000.0 * length_m:z.0f} mm" if length_m < 0.1 else f"{length_m:.2f} m"


def _change(before: float, after: float) -> str:
    if round(before, 4) == round(after, 4):
        return f"stayed at {number(after, 4)}"
    share = f" by {percent(abs(after - before) / before)}" if before > 0.0 else ""
    return f"{'fell' if after < before else 'rose'}{share} ({number(before, 4)} to {number(after, 4)})"


def _arm(name: str) -> str:
    return _BASELINES.get(name, name)


def _counted(count: int, noun: str) -> str:
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def _listed(parts: Iterable[str], word: str = "and") -> str:
    words: Sequence[str] = list(parts)
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} {word} {words[-1]}"
