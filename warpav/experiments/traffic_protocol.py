"""The second part of the protocol: what is claimed of misses on hard and on recorded traffic.

`traffic_protocol.yaml` is the only source: ``docs/protocol.md`` shows it, the goals of an experiment and
`warpav.experiments.traffic_judgement` decide by it. The first part, `warpav.experiments.protocol`, seals test scenes.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, field_validator

from warpav.core.errors import ArgumentError
from warpav.core.yaml_file import read_yaml
from warpav.runs.config import read_seeds
from warpav.runs.environment import file_at, running_commit

FILE = Path(__file__).with_name("traffic_protocol.yaml")
PLACE = "warpav/experiments/traffic_protocol.yaml"
"""Where it lies in a checkout."""


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class MissHypothesis(_Strict):
    """A claim about the default method in every decided setting."""

    text: str
    metric: Literal["misses", "attainable_misses"]
    rivals: tuple[str, ...]
    reduction: float | None = None


class TrafficProtocol(_Strict):
    """The content of `traffic_protocol.yaml`; its comments say what each part is."""

    seeds: tuple[int, ...]
    sealed_scenes: int
    decided: tuple[str, ...]
    outside: int
    budget: str
    cameras: str
    scenes: str
    arms: dict[str, str]
    metrics: dict[str, str]
    hypotheses: dict[str, MissHypothesis]

    @field_validator("seeds", mode="before")
    @classmethod
    def _ranges(cls, value: str) -> tuple[int, ...]:
        return read_seeds(value, FILE.name)

    def markdown(self) -> str:
        """Its lists and tables, as ``docs/protocol.md`` shows them."""
        names = {name: ", ".join(f"`{arm}`" for arm in each.rivals) for name, each in self.hypotheses.items()}
        rules = {
            name: f"`{each.metric}` of `default`: the interval of what {names[name]} have more is above 0"
            if each.reduction is None
            else f"`{each.metric}` of `default`: at least {each.reduction:.0%} below the lower of {names[name]}"
            for name, each in self.hypotheses.items()
        }
        parts = [
            _table(
                ("hypothesis", "rule"),
                [(f"{name}: {each.text}", rules[name]) for name, each in self.hypotheses.items()],
            ),
            f"Decided in {', '.join(f'`{name}`' for name in self.decided)}, in each of them by the detector of the "
            f"search and by at least {self.outside} outside networks.",
            _table(("arm", "search"), [(f"`{name}`", text) for name, text in self.arms.items()]),
            _table(("metric", "definition"), [(f"`{name}`", text) for name, text in self.metrics.items()]),
            f"Run seeds of every arm: {self.seeds[0]} to {self.seeds[-1]}; arms without a search run once. Test scenes "
            f"of every setting: {self.sealed_scenes}, sealed.",
            f"Budget: {self.budget}",
            f"Cameras: {self.cameras}",
            f"Scenes: {self.scenes}",
        ]
        return "\n\n".join(part.strip() for part in parts) + "\n"


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    return "\n".join("| " + " | ".join(line) + " |" for line in (head, ["---"] * len(head), *rows))


@cache
def traffic_protocol() -> TrafficProtocol:
    """The second part of the protocol of this version."""
    return TrafficProtocol.model_validate(read_yaml(FILE)[0])


def holds_traffic_protocol(commit: str) -> bool:
    """Whether a commit of the history holds this part as it is now."""
    return file_at(commit, PLACE) == FILE.read_bytes()


def check_sealing(commit: str) -> None:
    """See that a commit may seal test scenes for settings of this part; without a history publication finds out."""
    if running_commit().hash is not None and not holds_traffic_protocol(commit):
        raise ArgumentError(
            "sealed",
            f"expected a commit that holds {PLACE} as it is now, got {commit}, which does not; seal with a later one",
        )
