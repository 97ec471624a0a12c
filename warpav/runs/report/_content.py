"""What a run folder holds, checked: what report and terminal show has the form that a run writes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, TypeVar

from pydantic import TypeAdapter, ValidationError

from warpav.core.errors import InputError
from warpav.core.yaml_file import read_yaml
from warpav.optimisation import FurtherCameras
from warpav.rig import Rig
from warpav.runs._events import Certificate, Event
from warpav.runs._rig_evaluation import RigEvaluation
from warpav.runs._run_folder import RunFolder
from warpav.runs.config import Config

Content = TypeVar("Content")


@dataclass(frozen=True)
class RunContent:
    """Everything of a run that is shown; what a run that was stopped does not have is None or empty."""

    name: str = ""
    options: dict[str, Any] = field(default_factory=dict)
    config: Config | None = None
    config_mistake: str = ""
    environment: dict[str, Any] = field(default_factory=dict)
    events: list[Event] = field(default_factory=list)
    evaluation: RigEvaluation | None = None
    start: Rig | None = None
    result: Rig | None = None
    certificate: Certificate | None = None
    further: FurtherCameras | None = None


def read_content(folder: RunFolder) -> RunContent:
    """Everything in a run folder that is shown.

    Raises:
        InputError: A file is not what a run writes; or there is nothing to show.
    """
    options = read_yaml(folder.path / "config.yaml")[0]
    if not isinstance(options, dict):
        raise InputError(f"{folder.path / 'config.yaml'}: expected sections of options, got {options!r:.40}")
    try:
        config, config_mistake = folder.config(), ""
    except InputError as error:  # another version's options, or a file that is gone
        config, config_mistake = None, str(error).splitlines()[0].removeprefix(f"{folder.path}/")
    events = [Event.model_validate(each) for each in folder.events()]
    evaluation = read_evaluation(folder)
    if not events and evaluation is None:
        raise InputError(f"{folder.path}: run folder: expected at least one iteration to report on, got none")
    scenes = None if config is None else config.scenes.search_scene_count
    is_worse = evaluation is not None and evaluation.is_worse_than_start  # then rig_best.yaml is the start
    is_best = not is_worse and (config is None or config.optimiser.keep == "best")
    roles: Sequence[Literal["best", "final"]] = ("best", "final") if is_best else ("final", "best")
    kept: list[Literal["best", "final"]] = [role for role in roles if folder.rig_path(role).is_file()]
    return RunContent(
        name=folder.path.resolve().name,
        options=options,
        config=config,
        config_mistake=config_mistake,
        environment=_checked(dict[str, Any], folder.environment(), folder, "env.json"),
        events=events,
        evaluation=evaluation,
        start=folder.rig("initial") if (folder.path / "rig_initial.yaml").is_file() else None,
        result=folder.rig(kept[0]) if kept else None,
        certificate=Certificate.of([event.model_dump() for event in events], scenes=scenes),
        further=folder.further_cameras(),
    )


def read_evaluation(folder: RunFolder) -> RigEvaluation | None:
    """What ``evaluation.json`` holds; None where the run has not come that far."""
    content = folder.evaluation()
    return None if content is None else _checked(RigEvaluation, content, folder, "evaluation.json")


def _checked(form: type[Content], data: object, folder: RunFolder, name: str) -> Content:
    try:
        return TypeAdapter(form).validate_python(data)
    except ValidationError as error:
        mistake = error.errors()[0]
        place = ".".join(str(part) for part in mistake["loc"])
        place = f"{place}: " if place else ""
        text = mistake["msg"].removeprefix("Value error, ")
        raise InputError(
            f"{folder.path / name}: {place}expected what warpav optimise writes, got {mistake['input']!r:.40} "
            f"({text[0].lower() + text[1:]}); was the file changed?"
        ) from None
