"""What a study compares: a YAML file of ``studies/``, its setting, its circumstances.

A study is a base configuration with options, arms that find rigs, run seeds and a budget of camera renders, and a judge
of the rigs: the objective of the search on unseen scenes, or the detector.
"""

from __future__ import annotations

import itertools
import operator
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, Literal

import yaml
from pydantic import BaseModel, ConfigDict

from warpav.core.errors import ArgumentError, InputError, OptionError
from warpav.experiments._arms import Arm, find_arm
from warpav.experiments._gradient_magnitude import LOSS_OF
from warpav.experiments._rows import arm_name
from warpav.optimisation import LOSSES
from warpav.runs.config import Config, overridden_option
from warpav.thesis import thesis_table

GRADIENTS = "gradients"  # method of an arm that finds no rig but measures gradients (tables I and V of the thesis)

_FOLDER = Path(__file__).parent
_FILES = _FOLDER / "studies"
_METHOD_OF = {"SGD": "optimiser", "Random": "random_batches", "Highest": "highest"}
_UNPRINTED = ("SGD", "IFR+DOA+SB+OV")  # what the text above table IV announces and the table does not print

Judge = Literal["objective", "detector"]  # who judges rigs


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class _ArmFile(_Part):
    """An arm of a file: a method with options of its search alone, or of search and evaluation."""

    name: str
    method: str = "optimiser"
    options: tuple[str, ...] = ()
    search: tuple[str, ...] = ()


class _Quick(_Part):
    """What makes a study a matter of minutes."""

    options: tuple[str, ...] = ()
    runs: int = 2
    runs_of: dict[str, int] = {}
    budget: int | None = None


class _Setting(_Part):
    """What a word of a setting adds."""

    options: tuple[str, ...] = ()
    budget: int | None = None
    arms: tuple[str | _ArmFile, ...] = ()
    without: tuple[str, ...] = ()
    needs: str | None = None


class _Factor(_Part):
    """A circumstance that varies: ``{}`` in an option stands for its value, ``{last}`` for one less."""

    values: tuple[int | float | str, ...]
    quick: tuple[int | float | str, ...]
    options: tuple[str, ...] = ()
    search: tuple[str, ...] = ()
    options_of: dict[str, tuple[str, ...]] = {}


class _StudyFile(_Part):
    config: str = "default"
    options: tuple[str, ...] = ()
    arms: tuple[str | _ArmFile, ...] = ()
    gradients: str | None = None
    thesis: str | None = None
    runs: int
    runs_of: dict[str, int] = {}
    budget: int | None = None
    reference: str = "default"
    judge: Judge = "detector"
    table: str = "arms"
    quick: _Quick = _Quick()
    vary: dict[str, _Factor] = {}
    words: tuple[dict[str, _Setting], ...] = ()


@dataclass(frozen=True)
class Study:
    name: str
    config: str
    arms: tuple[Arm, ...]
    runs: int
    options: tuple[str, ...] = ()
    runs_of: Mapping[str, int] = field(default_factory=dict)
    references: Mapping[str, str] = field(default_factory=dict)  # the arm that each arm is compared with, if any
    camera_renders_max: int | None = None
    judge: Judge = "detector"
    table: str = "arms"
    needs: str | None = None  # option without which it cannot run

    def overrides(self, given: Sequence[str], arms: Sequence[Arm] | None = None) -> list[str]:
        """All overrides of its configuration: its own, and the user's, which leave alone what arms set."""
        own = {overridden_option(each): arm for arm in arms or self.arms for each in arm.own_overrides}
        for override in given:
            option = overridden_option(override)
            if option in own:
                raise InputError(
                    f"command line ({override}): {option}: expected an option that the arms of {self.name} leave "
                    f"alone, got one that arm {own[option].name} sets; warpav optimise takes it"
                )
        return [*self.options, *given]

    def arms_of(self, text: str | None) -> list[Arm] | None:
        """The arms that a list such as ``sgd_ifr,highest`` names; None for all of the study's."""
        if text is None:
            return None
        own = {arm.name: arm for arm in self.arms}
        if GRADIENTS in own:
            raise ArgumentError(
                "arms", f"expected nothing, as {self.name} measures gradients of one descent, got {text!r}"
            )
        return [find_arm(name, own) for name in dict.fromkeys(each.strip() for each in text.split(","))]

    def check(self, config: Config) -> None:
        """See that the configuration has what only the user can bring."""
        if self.needs is not None and operator.attrgetter(self.needs)(config) is None:
            raise OptionError(
                self.needs,
                f"expected a value for {self.name}, as what it needs does not ship with warpav, got none; give "
                f"{self.needs}=FILE_OR_FOLDER",
            )


def find_study(
    name: str, *, setting: str | None = None, vary: Sequence[str] | None = None, quick: bool = False
) -> Study:
    file = _read("table2" if name == "table3" else name)
    if setting is not None and not file.words:
        raise ArgumentError("setting", f"expected nothing, as {name} has no settings, got {setting}")
    if vary is not None and not file.vary:
        raise ArgumentError("vary", f"expected nothing, as it is an option of sweep, got it with {name}")
    parts = _parts(file, setting)
    dropped = {arm for part in parts for arm in part.without}
    arms = [
        find_arm(each, {}) if isinstance(each, str) else Arm(each.name, each.method, each.options, each.search)
        for each in (*file.arms, *(arm for part in parts for arm in part.arms))
        if each not in dropped
    ]
    if file.thesis is not None:
        rows = _thesis_rows(file.thesis)
        arms = [Arm(arm_name(way, loss), _METHOD_OF[way], _loss_overrides(loss)) for way, loss in rows]
    if file.gradients is not None:
        arms = [Arm(GRADIENTS, GRADIENTS, _loss_overrides(file.gradients))]
    others = [arm.name for arm in arms if arm.name != file.reference]
    references = dict.fromkeys(others, file.reference) if len(others) < len(arms) else {}
    if file.vary:
        arms, references = _varied(arms, file, vary, quick=quick)
    budget = next((part.budget for part in parts if part.budget is not None), file.budget)
    ego = "bus" if any("scenes.ego=bus" in part.options for part in parts) else "car"
    of_setting = {"zones": _FOLDER / "zones", "layouts": _FOLDER / "layouts", "ego": ego}
    of_parts = [each.format(**of_setting) for part in parts for each in part.options]
    return Study(
        "_".join([name if name != "table3" else "table2", *([setting] if setting else []), *(["quick"] * quick)]),
        file.config,
        tuple(arms),
        file.quick.runs if quick else file.runs,
        (*file.options, *of_parts, *(file.quick.options if quick else ())),
        file.quick.runs_of if quick else file.runs_of,
        references,
        (file.quick.budget if quick else None) or budget,
        file.judge,
        "thesis III" if name == "table3" else file.table,
        next((part.needs for part in parts if part.needs), None),
    )


def _loss_overrides(expression: str) -> tuple[str, ...]:
    """The weights of a combination of losses as the thesis writes it, such as ``IFR+10*DOA``; all others are 0."""
    weights: dict[str, float] = dict.fromkeys(LOSSES, 0.0)
    for term in expression.removesuffix("*").split("+"):  # the mark of a footnote
        factor, _, name = term.rpartition("*")
        if name not in LOSS_OF or LOSS_OF[name] not in weights:
            raise ValueError(f"expected losses out of {', '.join(LOSS_OF)}, got {name!r} in {expression!r}")
        weights[LOSS_OF[name]] = float(factor or 1.0)
    return tuple(f"losses.{name}={weight}" for name, weight in weights.items())


def _thesis_rows(number: str) -> list[tuple[str, str]]:
    """Method and loss of every row of a table of the thesis."""
    rows = [(row["method"], row["loss"]) for row in thesis_table(number)["rows"]]
    return [*rows, _UNPRINTED] if number == "IV" else rows


@cache
def _read(name: str) -> _StudyFile:
    return _StudyFile.model_validate(yaml.safe_load((_FILES / f"{name}.yaml").read_text(encoding="utf-8")))


def _parts(file: _StudyFile, setting: str | None) -> list[_Setting]:
    """What the words of a setting add."""
    if not file.words:
        return []
    for words in itertools.product(*(each.items() for each in file.words)):
        if "_".join(word for word, _ in words if word) == setting:
            return [part for _, part in words]
    parts = "; ".join(filter(None, (" ".join(filter(None, each)) for each in file.words)))
    raise ArgumentError("setting", f"expected a word of each of these with _ between: {parts}, got {setting or 'none'}")


def _varied(
    arms: Iterable[Arm], file: _StudyFile, vary: Sequence[str] | None, *, quick: bool
) -> tuple[list[Arm], dict[str, str]]:
    """The arms in the middle, which is the configuration, and in every circumstance; what each is compared with."""
    points: list[tuple[str, tuple[str, ...], tuple[str, ...]]] = [("middle", (), ())]
    for name, values in _values(file, vary, quick=quick).items():
        factor = file.vary[name]
        for value in values:
            last = value - 1 if isinstance(value, int) else value
            options, search = (
                tuple(each.format(value, last=last) for each in part)
                for part in (factor.options_of.get(str(value), factor.options), factor.search)
            )
            points.append((f"{name}_{str(value).replace('.', '_')}", options, search))
    every, references = [], {}
    for point, options, search in points:
        for arm in arms:
            every.append(
                Arm(f"{arm.name}_{point}", arm.method, (*arm.overrides, *options), (*arm.search_overrides, *search))
            )
            if arm.name != file.reference:
                references[every[-1].name] = f"{file.reference}_{point}"
    return every, references


def _values(file: _StudyFile, vary: Sequence[str] | None, *, quick: bool) -> dict[str, Sequence[Any]]:
    """The circumstances that vary, and their values."""
    usual: dict[str, Sequence[Any]] = {name: each.quick if quick else each.values for name, each in file.vary.items()}
    if not vary:
        return usual
    found: dict[str, Sequence[Any]] = {}
    for each in vary:
        name, equals, text = each.partition("=")
        if name not in usual:
            raise ArgumentError("vary", f"expected a factor out of {', '.join(usual)}, got {name!r}")
        values = [yaml.safe_load(word) for word in text.split(",")] if equals else usual[name]
        kind = type(usual[name][0])
        known = {*file.vary[name].values, *file.vary[name].options_of}
        for value in values:
            if isinstance(value, str) != (kind is str) or (kind is str and value not in known) or value is None:
                expected = f"out of {', '.join(map(str, sorted(known)))}" if kind is str else "numbers"
                raise ArgumentError("vary", f"expected values of {name} with commas, {expected}, got {text!r}")
        found[name] = tuple(dict.fromkeys(values))
    return found
