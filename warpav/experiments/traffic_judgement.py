"""What became of the second part of the protocol: every hypothesis is decided by its rule and shown, failed ones too.

A hypothesis holds where its rule does in every decided setting, by the detector of the search and by enough outside
networks. Its p-value is the largest of all that it joins; that of "at least so many networks" is the partial
conjunction of Benjamini and Heller (2008).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from warpav.core.errors import InputError
from warpav.evaluation.statistics import RESAMPLES, holm
from warpav.experiments.arms import common_arms
from warpav.experiments.miss_table import OWN_JUDGE, MissTable, miss_table, number_text
from warpav.experiments.result_folder import read_json, results_in
from warpav.experiments.traffic_protocol import MissHypothesis, traffic_protocol

SIGNIFICANT = 0.05


@dataclass(frozen=True)
class JudgedSetting:
    """What all judges say of a setting."""

    own: MissTable | None
    outside: tuple[MissTable, ...]


@dataclass(frozen=True)
class MissComparison:
    """The default method against a rival in one setting, by one judge."""

    setting: str
    rival: str
    judge: str
    holds: bool | None
    numbers: str
    p_value: float | None


@dataclass(frozen=True)
class MissJudgement:
    """What became of a hypothesis."""

    name: str
    text: str
    comparisons: tuple[MissComparison, ...]
    holds: bool | None
    p_value: float | None
    p_holm: float | None = None

    @property
    def verdict(self) -> str:
        """In words."""
        if self.holds is None:
            return "not decided"
        if not self.holds:
            return "failed"
        return "holds" if self.p_holm is not None and self.p_holm < SIGNIFICANT else "holds, but may be chance"


def read_setting(folder: Path, *, resamples: int = RESAMPLES) -> JudgedSetting:
    """What the detector of the search and the panels of a folder say of its rigs."""
    own = miss_table(OWN_JUDGE, results_in(folder), resamples=resamples)
    outside: dict[str, MissTable] = {}
    for file in sorted(folder.glob("panel_*/panel.json")):
        panel = read_json(file)
        try:
            tables = [MissTable.from_data(each) for each in panel["misses"] if each["judge"] in panel["outside"]]
        except (KeyError, TypeError) as error:
            raise InputError(f"{file}: expected the numbers of a panel, got none ({error}); judge again") from None
        outside |= {table.judge: table for table in tables}
    return JudgedSetting(own, tuple(outside.values()))


def judge_traffic(settings: Mapping[str, JudgedSetting]) -> list[MissJudgement]:
    """Decide all hypotheses."""
    found = [_judged(name, each, settings) for name, each in traffic_protocol().hypotheses.items()]
    # hypotheses without a p-value still count among those that were asked
    corrected = holm({each.name: 1.0 if each.p_value is None else each.p_value for each in found})
    return [replace(each, p_holm=None if each.p_value is None else corrected[each.name]) for each in found]


def _judged(name: str, hypothesis: MissHypothesis, settings: Mapping[str, JudgedSetting]) -> MissJudgement:
    protocol = traffic_protocol()
    comparisons: list[MissComparison] = []
    verdicts: list[bool | None] = []
    p_values: list[float | None] = []
    for setting in protocol.decided:
        judged = settings.get(setting, JudgedSetting(None, ()))
        for rival in _rivals(hypothesis, judged.own):
            own = _compared(hypothesis, setting, rival, OWN_JUDGE, judged.own)
            others = [_compared(hypothesis, setting, rival, each.judge, each) for each in judged.outside]
            comparisons += [own, *others]
            known = sorted(each.p_value for each in others if each.p_value is not None)
            agreeing = sum(each.holds is True for each in others)
            possible = agreeing + sum(each.holds is None for each in others)
            if len(known) >= protocol.outside:
                verdicts += [own.holds, agreeing >= protocol.outside]
                conjunction = (len(known) - protocol.outside + 1) * known[protocol.outside - 1]
                p_values += [own.p_value, min(1.0, conjunction)]
            else:  # who have not been asked may still agree
                verdicts += [
                    own.holds,
                    None if len(others) < protocol.outside or possible >= protocol.outside else False,
                ]
                p_values += [own.p_value, None]
    holds = False if False in verdicts else None if None in verdicts else True
    known = [value for value in p_values if value is not None]
    p_value = max(known) if known and len(known) == len(p_values) else None
    return MissJudgement(name, hypothesis.text, tuple(comparisons), holds, p_value)


def _rivals(hypothesis: MissHypothesis, own: MissTable | None) -> list[str]:
    """Those of a hypothesis that a setting has; of a reduction the one that misses least."""
    if own is None:
        return list(hypothesis.rivals[:1])
    there = [rival for rival in hypothesis.rivals if own.row(rival) is not None] or list(hypothesis.rivals[:1])
    return there if hypothesis.reduction is None else [own.practice or there[0]]


def _compared(
    hypothesis: MissHypothesis, setting: str, rival: str, judge: str, table: MissTable | None
) -> MissComparison:
    ours = None if table is None else table.row("default")
    theirs = None if table is None else table.row(rival)
    seeds = set(traffic_protocol().seeds)
    missing = MissComparison(setting, rival, judge, None, "no results", None)
    if table is None or ours is None or theirs is None or not seeds <= set(ours.seeds):
        return missing
    if common_arms()[rival].is_seeded and not seeds <= set(theirs.seeds):
        return missing
    if hypothesis.reduction is not None:
        reduction = ours.reductions.get(table.practice or "")
        if reduction is None or reduction.mean is None or table.reduction_p is None:
            return missing
        text = f"{number_text(reduction, 100.0, '+.1f')} % below {table.practice}"
        return MissComparison(setting, rival, judge, reduction.mean >= hypothesis.reduction, text, table.reduction_p)
    difference = theirs.less.get(hypothesis.metric)
    if difference is None or difference.mean is None or difference.low is None or difference.p_value is None:
        return missing
    p_value = difference.p_value / 2.0 if difference.mean > 0.0 else 1.0 - difference.p_value / 2.0
    return MissComparison(
        setting, rival, judge, difference.low > 0.0, f"{number_text(difference, 1.0, '+.2f')} per 100", p_value
    )


def judgements_text(judgements: Sequence[MissJudgement]) -> str:
    """The verdicts and their numbers as Markdown."""
    lines = ["| hypothesis | verdict | p, Holm |", "| --- | --- | ---: |"]
    for each in judgements:
        p_holm = "-" if each.p_holm is None else f"{each.p_holm:.2g}"
        lines.append(f"| {each.name}: {each.text} | **{each.verdict}** | {p_holm} |")
    lines += ["", "| hypothesis | setting | rival | judge | what default misses less | p |"]
    lines.append("| --- " * 4 + "| ---: " * 2 + "|")
    for each in judgements:
        for one in each.comparisons:
            p_value = "-" if one.p_value is None else f"{one.p_value:.2g}"
            numbers = one.numbers + (" ✗" if one.holds is False else "")
            lines.append(f"| {each.name} | {one.setting} | {one.rival} | {one.judge} | {numbers} | {p_value} |")
    note = (
        "Intervals: BCa bootstrap over test scenes and runs, 95 %. p: one-sided; that of a hypothesis is the largest "
        f"of its comparisons, where at least {traffic_protocol().outside} outside networks have the partial "
        "conjunction of theirs, corrected by Holm's method for the number of hypotheses. ✗: fails here."
    )
    return "\n".join([*lines, "", note, ""])


def traffic_text(folders: Mapping[str, Path]) -> str:
    """Decide the hypotheses by the folders of settings, and say what of other settings is not decided."""
    text = judgements_text(judge_traffic({name: read_setting(folder) for name, folder in folders.items()}))
    others: list[Any] = [name for name in folders if name not in traffic_protocol().decided]
    return text + (f"- No hypothesis is about {', '.join(others)}.\n" if others else "")
