"""The protocol of the comparison of searches: what is claimed, and test scenes that nobody has seen.

`protocol.yaml` is the only source: ``docs/protocol.md`` shows it, and `warpav.experiments.judgement` decides by it. The
seeds of the test scenes are drawn from the hash of a commit, which nobody knows before the commit exists. So who
freezes a method by a commit cannot have looked at the scenes it is judged on.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, field_validator

from warpav.core.errors import ArgumentError
from warpav.core.yaml_file import read_yaml
from warpav.runs.config import overridden_option, read_seeds
from warpav.runs.environment import changed_files, code_of, file_at, history, is_known, running_commit
from warpav.scene.files import MAX_SEED

FILE = Path(__file__).with_name("protocol.yaml")
PLACE = "warpav/experiments/protocol.yaml"
"""Where the protocol lies in a checkout."""

TEST_SCENES = "test scenes"
"""The purpose for which the seeds of the sealed test scenes are drawn."""


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Setting(_Strict):
    """A task that all arms do."""

    text: str
    pitch_free: bool


class Hypothesis(_Strict):
    """A claim about the objective on the test scenes."""

    text: str
    claim: Literal["not_above", "below", "spread"]
    arms: tuple[str, ...]
    rivals: tuple[str, ...]
    margin: float = 0.0
    ratio: float = 1.0
    pitch_free: bool | None = None
    settings: tuple[str, ...] | None = None


class Protocol(_Strict):
    """The content of `protocol.yaml`; its comments say what each part is."""

    seeds: tuple[int, ...]
    seedless: tuple[str, ...]
    development_seeds: tuple[int, ...]
    shown_seeds: tuple[int, ...]
    sealed_from: int
    sealed_scenes: int
    budget: str
    settings: dict[str, Setting]
    arms: dict[str, str]
    metrics: dict[str, str]
    hypotheses: dict[str, Hypothesis]

    @field_validator("seeds", "development_seeds", "shown_seeds", mode="before")
    @classmethod
    def _ranges(cls, value: str) -> tuple[int, ...]:
        return read_seeds(value, FILE.name)

    def settings_of(self, hypothesis: Hypothesis) -> list[str]:
        """Names of the settings that a hypothesis is about."""
        return [
            name
            for name, setting in self.settings.items()
            if (hypothesis.settings is None or name in hypothesis.settings)
            and hypothesis.pitch_free in (None, setting.pitch_free)
        ]

    def markdown(self) -> str:
        """Its lists and tables, as ``docs/protocol.md`` shows them."""
        parts = [
            _table(("hypothesis", "claim", "settings"), self._hypothesis_rows()),
            _table(("setting", "what is placed"), [(f"`{name}`", each.text) for name, each in self.settings.items()]),
            _table(("arm", "search"), [(f"`{name}`", text) for name, text in self.arms.items()]),
            _table(("metric", "definition"), [(f"`{name}`", text) for name, text in self.metrics.items()]),
            f"Run seeds of every arm: {_range(self.seeds)}; once: {', '.join(f'`{arm}`' for arm in self.seedless)}. "
            f"Test scenes of every setting: {self.sealed_scenes}, sealed. Scene seeds of development: "
            f"{_range(self.development_seeds)}; shown ones: {_range(self.shown_seeds)}; sealed ones: from "
            f"{self.sealed_from}, above all scenes that the detector and its probability were fitted on.",
            f"Budget: {self.budget}",
        ]
        return "\n\n".join(parts) + "\n"

    def _hypothesis_rows(self) -> list[tuple[str, str, str]]:
        rows = []
        for name, each in self.hypotheses.items():
            arms, rivals = (", ".join(f"`{arm}`" for arm in arms) for arms in (each.arms, each.rivals))
            rule = {
                "not_above": f"every run of {arms}: objective at most that of {rivals} with the same seed",
                "below": f"mean objective of {arms} over runs: at most {1.0 - each.margin:g} times that of {rivals}",
                "spread": f"standard deviation of {arms} over runs: at most {each.ratio:g} times that of {rivals}",
            }[each.claim]
            settings = self.settings_of(each)
            where = "all" if len(settings) == len(self.settings) else ", ".join(f"`{name}`" for name in settings)
            rows.append((f"{name}: {each.text}", rule, where))
        return rows


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def _range(seeds: Sequence[int]) -> str:
    return f"{seeds[0]} to {seeds[-1]}"


@cache
def protocol() -> Protocol:
    """The protocol of this version."""
    return Protocol.model_validate(read_yaml(FILE)[0])


def sealed_seeds(commit: str, purpose: str, count: int) -> tuple[int, ...]:
    """Seeds that nobody could know before a commit existed.

    Number k is the first four bytes of SHA-256 of the text ``COMMIT/PURPOSE/k`` as a big-endian integer, without its
    highest bit. Those below `Protocol.sealed_from`, where development, documentation and the training of the detector
    have their scenes, and those that were there already are left out.
    """
    seeds: list[int] = []
    counter = 0
    while len(seeds) < count:
        beacon = hashlib.sha256(f"{commit}/{purpose}/{counter}".encode()).digest()
        seed = int.from_bytes(beacon[:4], "big") & MAX_SEED
        counter += 1
        if seed >= protocol().sealed_from and seed not in seeds:
            seeds.append(seed)
    return tuple(seeds)


def sealed_test_seeds(commit: str) -> tuple[int, ...]:
    """Seeds of the test scenes that a commit seals.

    A copy without history, on a GPU machine say, takes any full hash; the seal shows when its results are published
    from a checkout (`seal_of`).
    """
    if running_commit().hash is None and re.fullmatch("[0-9a-f]{40}", commit):
        return sealed_seeds(commit, TEST_SCENES, protocol().sealed_scenes)
    if not is_known(commit):
        raise ArgumentError(
            "sealed",
            f"expected the full hash of a commit that the checkout goes back to, got {commit!r}; git rev-parse HEAD "
            "prints one",
        )
    there = file_at(commit, PLACE)
    if there != FILE.read_bytes():
        raise ArgumentError(
            "sealed",
            f"expected a commit with the protocol of this version, got {commit} "
            f"{'without one' if there is None else 'with another'}; seal with a commit that holds {PLACE} as it is now",
        )
    return sealed_seeds(commit, TEST_SCENES, protocol().sealed_scenes)


def sealed_override(commit: str, overrides: Sequence[str], *, quick: bool) -> str:
    """The override that sets the sealed test scenes."""
    if quick:
        raise ArgumentError(
            "sealed", "expected the whole experiment, got `quick`; sealed scenes are looked at once: leave one out"
        )
    own = next((each for each in overrides if overridden_option(each) == "scenes.test_seeds"), None)
    if own is not None:
        raise ArgumentError("sealed", f"expected the test scenes of the seal alone, got {own} as well; leave one out")
    return f"scenes.test_seeds={list(sealed_test_seeds(commit))}"


def seal_of(test_seeds: Sequence[int]) -> str | None:
    """The commit of the history that seals these test seeds; None if they are not sealed."""
    if len(test_seeds) != protocol().sealed_scenes:
        return None
    first = tuple(test_seeds[:1])
    for commit in history():
        if sealed_seeds(commit, TEST_SCENES, 1) == first:
            is_whole = sealed_seeds(commit, TEST_SCENES, len(test_seeds)) == tuple(test_seeds)
            return commit if is_whole and file_at(commit, PLACE) == FILE.read_bytes() else None
    return None


def unknown_code(commits: Sequence[Mapping[str, Any]]) -> list[str]:
    """What keeps published results from being checked against the history, one line each; none if nothing does."""
    if not commits:
        return ["no commit of the code that made them"]
    complaints = []
    for commit in commits:
        name = commit.get("hash")
        if name is None:
            complaints.append("made by an installed package or a copy whose code no commit of the history has")
        elif not is_known(name):
            complaints.append(f"commit {name} is not in the history")
        elif code_of(name) != commit.get("code"):
            complaints.append(f"made by changed code, not by that of commit {name}")
    return complaints


def code_since_seal(seal: str, commits: Sequence[Mapping[str, Any]]) -> list[str]:
    """Files of code and shipped configurations that changed between a seal and the commits that made the results."""
    changed = {file for commit in commits if commit.get("hash") for file in changed_files(seal, commit["hash"])}
    return sorted(file for file in changed if not file.endswith(".md"))
