"""The folder of an experiment: what its results were made with, and every result in a file of its own.

``<folder>/experiment.json`` holds the options of the results, ``<folder>/config.yaml`` and ``<folder>/env.json`` all of
them and the machine, ``<folder>/zones.yaml`` the zones of the cameras where there are any,
``<folder>/results/<arm>_<seed>.json`` one result, ``<folder>/results/<arm>_<seed>.yaml`` its rig.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from warpav.core import bounded_files
from warpav.core.bounded_files import DATA_SET_BYTES_MAX, DATA_SET_NODES_MAX
from warpav.core.cache import digest
from warpav.core.errors import ArgumentError, InputError
from warpav.core.files import write_json
from warpav.core.warp_setup import device_name
from warpav.runs import environment, own_vehicle_digest, recordings_digest, traffic_fleet_digest
from warpav.runs.config import KEPT_FILES, Config, dump_config, option_values

SCHEMA = 3
DESCRIPTION = "experiment.json"
RESULTS = "results"


def open_folder(folder: Path, name: str, config: Config, camera_renders_max: int | None) -> None:
    """Make the folder of an experiment, by its name, or see that the one that is there belongs to it."""
    file = folder / DESCRIPTION
    description = {
        "schema": SCHEMA,
        "experiment": name,
        "camera_renders_max": camera_renders_max,
        "options": _options(config),
    }
    if file.is_file():
        if any((folder / RESULTS).glob("*.json")):
            _check_same(file, read_description(folder), description)
            return
    elif folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise ArgumentError(
            place=folder,
            option="out",
            text="expected a folder of this experiment or one that does not exist yet, got something "
            "else; choose another with `out`",
        )
    try:
        (folder / RESULTS).mkdir(parents=True, exist_ok=True)
        kept: dict[str, object] = {}
        if config.mount.zones is not None:  # so that rigs can be judged where the file of the zones is not
            kept = {"mount.zones": KEPT_FILES["mount.zones"]}
            (folder / KEPT_FILES["mount.zones"]).write_bytes(config.mount.zones.read_bytes())
        (folder / "config.yaml").write_text(dump_config(config, kept=kept), encoding="utf-8")
    except OSError as error:
        raise ArgumentError(
            place=folder, option="out", text=f"expected a folder that can be made, got: {error.strerror}"
        ) from None
    write_json(folder / "env.json", environment(config, device_name(config.device)))
    write_json(file, description)


def read_description(folder: Path) -> dict[str, Any]:
    """What the results in the folder of an experiment were made with."""
    file = folder / DESCRIPTION
    there = read_json(file)
    if not isinstance(there, dict) or there.get("schema") != SCHEMA or "experiment" not in there:
        found = there.get("schema") if isinstance(there, dict) else None
        raise InputError(
            f"{file}: schema: expected {SCHEMA}, got {found!r}, of another version of warpav; choose another folder "
            "with `out`, and run the experiment again"
        )
    return there


def _check_same(file: Path, there: Mapping[str, Any], wanted: Mapping[str, Any]) -> None:
    """See that the results of a folder are of this experiment."""
    fix = "choose another folder with `out`"
    for name, too in (("experiment", ""), ("camera_renders_max", ", or give the same `budget`")):
        if there.get(name) != wanted[name]:
            raise InputError(f"{file}: {name}: expected {wanted[name]}, got {there.get(name)!r}; {fix}{too}")
    options = there.get("options")
    options = options if isinstance(options, dict) else {}
    different = [
        f"{name} is {options.get(name)!r} there and {value!r} here"
        for name, value in wanted["options"].items()
        if options.get(name) != value
    ]
    if different:
        more = f" and {len(different) - 3} more" if len(different) > 3 else ""
        raise InputError(
            f"{file}: options: expected the configuration of its results, got another: "
            f"{', '.join(different[:3])}{more}; {fix}, or give the same options"
        )


def unseeded(config: Config) -> str:
    """All options on which a result depends, but the seed."""
    return json.dumps(_options(config))


def _options(config: Config) -> dict[str, Any]:
    """The options on which a result depends, all but the seed, in JSON's own types."""
    values = {
        name.replace("thesis.rotations", "segregation.rotations"): value  # as results of before call it
        for name, value in option_values(config).items()
        if name not in ("run.seed", "run.out", "run.pictures") and not name.startswith("executor.")
    }
    files = {
        "rig.catalogue": config.rig.catalogue,
        "mount.zones": config.mount.zones,
        "requirements": config.requirements_file,
    }
    values |= {name: f"{file.name} {digest(file.read_bytes())}" for name, file in files.items() if file is not None}
    if config.scenes.ego is not None:  # what it holds, wherever it lies
        values["scenes.ego"] = f"{config.scenes.ego.name} {own_vehicle_digest(config)}"
    if (recordings := recordings_digest(config)) is not None:
        for name in ("test_recordings", "places", "selection_places", "test_places"):
            values.pop(f"scenes.{name}", None)
        values["scenes.recordings"] = recordings
    if (vehicles := traffic_fleet_digest(config)) is not None:
        values["scenes.vehicles"] = vehicles
    return json.loads(json.dumps(values))


def is_there(file: Path, made_with: str) -> bool:
    """Whether a result is there already; ``made_with`` is the hash of all that it depends on but the seed."""
    if not file.is_file():
        return False
    result = read_json(file)
    if not isinstance(result, dict) or (result.get("schema"), result.get("made_with")) != (SCHEMA, made_with):
        raise InputError(
            f"{file}: expected a result of schema {SCHEMA} made with this configuration and budget, got another; "
            "delete it, or choose another folder with `out`"
        )
    return True


def results_in(folder: Path, order: Sequence[str] = ()) -> dict[str, list[dict[str, Any]]]:
    """All results that a folder holds, by arm, arms in this order and then by name, and by run seed."""
    found = []
    for file in sorted((folder / RESULTS).glob("*.json")):
        result = read_json(file)
        if not isinstance(result, dict) or result.get("schema") != SCHEMA or not {"arm", "seed"} <= result.keys():
            schema = result.get("schema") if isinstance(result, dict) else None
            text = f"expected a result of schema {SCHEMA} with an arm and a seed, got {schema!r}; delete it"
            raise InputError(f"{file}: schema: {text}")
        found.append(result)
    there = {run["arm"] for run in found}
    arms = [arm for arm in dict.fromkeys([*order, *sorted(there)]) if arm in there]
    return {arm: sorted((run for run in found if run["arm"] == arm), key=lambda run: run["seed"]) for arm in arms}


def objective_on_tests(result: Mapping[str, Any]) -> float | None:
    """The objective of a result's rig on the test scenes, the mean over all their objects; None for other lenses."""
    of_scene = objective_of_tests(result)
    pairs = [(value, count) for value, count in zip(of_scene, result["objects_of_scene"], strict=True) if count]
    if not pairs or any(value is None for value, _ in pairs):
        return None
    return sum(value * count for value, count in pairs) / sum(count for _, count in pairs)


def objective_of_tests(result: Mapping[str, Any]) -> list[Any]:
    """The objective of a result's rig in every test scene; None where it has none."""
    if "metrics" in result:
        return result["metrics"]["per_scene"]["objective"]
    return result["test_objective_of_scene"]


def read_json(file: Path) -> Any:  # noqa: ANN401 (any JSON value)
    try:
        return bounded_files.read_json(
            file, "a readable JSON file", bytes_max=DATA_SET_BYTES_MAX, nodes_max=DATA_SET_NODES_MAX
        )
    except InputError as error:
        raise InputError(f"{error}; delete it") from None
