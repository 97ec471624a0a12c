"""The run folder: everything that a run leaves behind, readable at any moment of the run and ever after.

::

    runs/<name>/  config.yaml  env.json  events.jsonl  metrics.csv  rig_initial.yaml  rig_best.yaml  rig_final.yaml
                  rig_start.yaml (where rig.start names a rig)
                  evaluation.json  checkpoints/last.npz  report.html  figures/*.png
                  figures/ground.npz  figures/views.json  figures/views/*.webp

A file is replaced in one step or extended by one whole line, so a run that is stopped leaves a folder that opens.
"""

from __future__ import annotations

import contextlib
import csv
import dataclasses
import io
import json
import math
import os
import platform
import re
import shlex
import subprocess
import sys
import time
import zipfile
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from warpav.core.atomic_write import atomic_write
from warpav.core.errors import InputError, OptionError
from warpav.rig.presets import preset_names
from warpav.runs.config import START_FILE, Config, dump_config, load_config, with_absolute_paths

if TYPE_CHECKING:
    import numpy as np

    from warpav.rig.rig import Rig
    from warpav.scene.scene import Scene

    MultiBlock = Any

RigRole = Literal["start", "initial", "best", "final"]
RUNS_FOLDER = Path("runs")
EVALUATION_SCHEMA = 1
ARM_ROWS = {
    "map50_average": "AP50, mean of the cameras",
    "map50_min_camera": "AP50, worst camera",
    "map50_max_camera": "AP50, best camera",
    "ap50_pooled": "AP50, all images",
    "ap50_small": "AP50, up to 32 x 32 px",
    "ap50_medium": "AP50, to 96 x 96 px",
    "ap50_large": "AP50, larger",
    "ap50_95_pooled": "AP50:95, all images",
    "tp_detection_rate": "recall of the rig",
    "visible_rate": "visible to the rig",
    "rig_recall_visible": "recall of the visible",
    "false_alarms_per_frame": "false alarms a frame",
    "tp_in_frame_rate": "in frame",
    "detection_confidence": "confidence",
    "objective": "objective",
    "constraint_violation": "violation [m]",
    "min_camera_distance_m": "closest [m]",
}
"""Fields of an arm's metrics and the headings they are shown under."""

RECALL_GROUPS = {"road_user": "", "distance_m": " m", "sector": "", "category": ""}
"""Groupings of the objects in ``recall_by``, in the order in which they are shown, and the unit of their names."""


def recall_rows(arms: Mapping[str, Mapping[str, Any]]) -> list[list[list[str]]]:
    """The rig's recall by group as text: for every grouping its rows of group, number of objects, and recall by arm.

    Groups without objects, and road users where there is only one kind of them, are left out.

    Args:
        arms: Metrics by arm, as in ``evaluation.json``; empty for one that was written before there was ``recall_by``.
    """
    tables = [arm["recall_by"] for arm in arms.values() if arm.get("recall_by")]
    if not tables or len(tables) < len(arms):
        return []
    blocks = [
        [
            [f"{name}{unit}", str(group["objects"]), *(f"{table[by][name]['recall']:.3f}" for table in tables)]
            for name, group in tables[0].get(by, {}).items()
            if group["objects"]
        ]
        for by, unit in RECALL_GROUPS.items()
    ]
    return [block for by, block in zip(RECALL_GROUPS, blocks, strict=True) if len(block) > (by == "road_user")]


# worth knowing although warpav does not ask for them itself
_RELATED_PACKAGES = ("onnxruntime-gpu", "vtk")

# what NumPy, the archive and its compression raise; RuntimeError also where a member is encrypted or packed otherwise
_UNREADABLE_ARRAYS = (OSError, ValueError, EOFError, zipfile.BadZipFile, zlib.error, RuntimeError)


@dataclass(frozen=True)
class RunFolder:
    """A run folder on disk.

    Attributes:
        path: The folder; it exists and holds ``config.yaml``.
    """

    path: Path

    @classmethod
    def create(
        cls,
        config: Config,
        *,
        name: str,
        device: str = "",
        start: Rig | None = None,
        freeze: Sequence[str] = (),
    ) -> RunFolder:
        """A new run folder with ``config.yaml`` and ``env.json``; call it once all inputs are known to be good.

        Args:
            config: The configuration of the run; ``run.out`` names the folder. Paths of other files are written whole,
                so that the folder can be used from everywhere.
            name: Without ``run.out`` the folder is ``runs/<name>``, or ``runs/<name>-2`` and so on.
            device: What computes, in words.
            start: The rig that the run starts from, where it is a certain one; the folder keeps it, so that it needs no
                file from elsewhere.
            freeze: Names of its cameras that stay as they are.

        Raises:
            InputError: ``run.out`` exists, or no folder can be made there.
        """
        check_new_run(config)
        try:
            if config.run.out is not None:
                path = config.run.out
                path.mkdir(parents=True, exist_ok=True)
            else:
                path = _numbered_folder(name)
            folder = cls(path)
            (path / "checkpoints").mkdir()
            (path / "figures").mkdir()
        except OSError as error:
            raise OptionError(
                "run.out", f"expected a folder that can be made, got {error.filename!r}: {error.strerror}"
            ) from None
        config = with_absolute_paths(config)
        if start is not None and config.rig.start not in preset_names():
            folder.write_rig("start", start)
            rig = config.rig.model_copy(update={"start": START_FILE, "freeze": tuple(freeze)})
            config = config.model_copy(update={"rig": rig})
        write_text(path / "config.yaml", dump_config(config))
        write_json(path / "env.json", environment(config, device))
        return folder

    @classmethod
    def open(cls, path: str | Path) -> RunFolder:
        """The run folder at ``path``.

        Raises:
            InputError: There is no folder, or it is not one of a run.
        """
        folder = Path(path).expanduser()
        if not folder.is_dir():
            raise InputError(f"{path}: run folder: expected an existing folder, got none of that name")
        if not (folder / "config.yaml").is_file():
            raise InputError(
                f"{path}: run folder: expected a folder written by warpav optimise, got one without config.yaml"
            )
        return cls(folder)

    def replace_config(self, config: Config) -> None:
        """Write ``config.yaml`` again, with the same start."""
        rig = self.config().rig
        if (self.path / START_FILE).is_file():
            config = config.model_copy(update={"rig": rig.model_copy(update={"start": START_FILE})})
        write_text(self.path / "config.yaml", dump_config(config))

    def write_rig(self, role: RigRole, rig: Rig) -> None:
        """Write ``rig_<role>.yaml``."""
        from warpav.rig.rig import write_rig

        write_rig(rig, self.path / f"rig_{role}.yaml")

    def append_event(self, record: object) -> None:
        """Append one iteration to ``events.jsonl`` and ``metrics.csv``.

        Args:
            record: A mapping or a dataclass with the fields that the run folder documents for an iteration.
        """
        event = _json_ready(record)
        row = _flat_numbers(event)
        metrics = self.path / "metrics.csv"
        text = io.StringIO()
        writer = csv.DictWriter(text, list(row), lineterminator="\n")
        if not metrics.exists():
            writer.writeheader()
        writer.writerow(row)
        self._append("metrics.csv", text.getvalue())
        self._append("events.jsonl", json.dumps(event, allow_nan=False) + "\n")

    def write_checkpoint(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Write the state from which the run can go on to ``checkpoints/last.npz``."""
        _write_arrays(self.path / "checkpoints" / "last.npz", arrays)

    def write_evaluation(self, evaluation: Mapping[str, Any]) -> None:
        """Write ``evaluation.json``; NaN becomes null."""
        write_json(self.path / "evaluation.json", {"schema": EVALUATION_SCHEMA, **evaluation})

    def figure_path(self, name: str) -> Path:
        """Where the figure of this name belongs: ``figures/<name>.png``."""
        return self.path / "figures" / f"{name}.png"

    def write_ground(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Write ``figures/ground.npz``, the cells of the ground that no camera sees."""
        _write_arrays(self.path / "figures" / "ground.npz", arrays)

    def ground(self) -> dict[str, np.ndarray] | None:
        """The content of ``figures/ground.npz``, or None.

        Raises:
            InputError: It cannot be read.
        """
        import numpy as np

        file = self.path / "figures" / "ground.npz"
        try:
            with np.load(file, allow_pickle=False) as arrays:
                return dict(arrays)
        except FileNotFoundError:
            return None
        except (*_UNREADABLE_ARRAYS, TypeError) as error:  # the last for a single array, which is no archive
            raise InputError(f"{file}: expected arrays in NumPy's format, got: {_one_line(error)}") from None

    def write_views(self, views: Sequence[Mapping[str, Any]], image_of: Mapping[str, bytes]) -> None:
        """Write what cameras see: ``figures/views.json``, and the pictures that it names."""
        folder = self.path / "figures" / "views"
        with _writing(folder):
            folder.mkdir(exist_ok=True)
            for name, encoded in image_of.items():
                with atomic_write(folder / name) as draft:
                    draft.write_bytes(encoded)
        write_json(self.path / "figures" / "views.json", views)

    def views(self) -> Any:  # noqa: ANN401 (JSON)
        """The content of ``figures/views.json``, or None."""
        return self._read_json("figures/views.json")

    def view_path(self, name: str) -> Path:
        """Where the picture of this name in ``figures/views.json`` is."""
        return self.path / "figures" / "views" / name

    def write_report(self, html: str) -> Path:
        """Write ``report.html`` and return its path."""
        write_text(self.path / "report.html", html)
        return self.path / "report.html"

    def config(self) -> Config:
        """The configuration of the run, validated anew."""
        return load_config(self.path / "config.yaml")

    def environment(self) -> dict[str, Any]:
        """The content of ``env.json``, or an empty mapping."""
        return self._read_json("env.json") or {}

    def events(self) -> list[dict[str, Any]]:
        """All iterations so far; a line that was cut off in the middle of being written is left out.

        Raises:
            InputError: The file cannot be read, a line is no iteration of a run, or iterations of a run that has ended
                are missing.
        """
        file = self.path / "events.jsonl"
        try:
            lines = file.read_bytes().split(b"\n")
        except FileNotFoundError:
            return []
        except OSError as error:
            raise InputError(f"{file}: expected a readable file, got: {error.strerror}") from None
        events: list[dict[str, Any]] = []
        for number, line in enumerate(lines, start=1):
            try:
                event = json.loads(line) if line.strip() else None
            except (ValueError, RecursionError):  # also where the bytes are no text
                if number == len(lines):
                    break
                shown = line[:40].decode(errors="backslashreplace")
                raise InputError(
                    f"{file}:{number}: expected one JSON object per line, got {shown!r}; {_MEND_EVENTS}"
                ) from None
            if event is not None:
                count = len(events[0]["positions_m"]) if events else None
                wrong = _event_mistake(event, camera_count=count)
                if wrong:
                    raise InputError(f"{file}:{number}: {wrong}; {_MEND_EVENTS}")
                events.append(event)
        count = _iterations_of(self.evaluation())
        if len(events) < count:
            raise InputError(
                f"{file}: expected the {count} iterations of a run that has ended, got {len(events)}; was it cut off?"
            )
        return events

    def evaluation(self) -> dict[str, Any] | None:
        """The content of ``evaluation.json``, or None when the run has not come that far."""
        return self._read_json("evaluation.json")

    def figures(self) -> list[Path]:
        """The PNG files of the run, by name."""
        return sorted((self.path / "figures").glob("*.png"))

    def rig(self, role: RigRole | None = None) -> Rig:
        """A rig of the run.

        Args:
            role: Which one; None takes the rig of the run, ``rig_best.yaml``. A run that was stopped before its first
                step has only the rig that it started from.

        Raises:
            InputError: The run was stopped before it had one, or it is missing.
        """
        from warpav.rig.rig import read_rig

        roles: tuple[RigRole, ...] = ("best", "initial") if role is None else (role,)
        if role is None and (self.path / "rig_final.yaml").is_file():  # written after the best one
            roles = ("best",)
        for name in roles:
            file = self.path / f"rig_{name}.yaml"
            if file.is_file():
                return read_rig(file)
        raise InputError(
            f"{self.path}: run folder: expected rig_{roles[0]}.yaml, got none"
            + ("; was it removed?" if len(roles) == 1 and role is None else "; the run has none yet")
        )

    def plot(
        self,
        out: Path | str | None = None,
        *,
        iteration: int | None = None,
        scene: Scene | None = None,
        arrows: bool = True,
        sight: bool = False,
        title: str | None = None,
        window_size: tuple[int, int] = (1280, 800),
        zoom: float = 1.0,
        off_screen: bool | None = None,
        **show: Any,  # noqa: ANN401 (those of pyvista)
    ) -> Any:  # noqa: ANN401
        """Show the run in a window or in a notebook, or write it to a file.

        The result on its vehicle in traffic, with the way of every camera and arrows for where the descent wanted to
        move and turn it.

        Args:
            out: ``.png``, ``.html``, or ``.gif`` and ``.mp4`` for a film over the iterations; None: show it.
            iteration: Instead of the result, the rig before the step of this one; negative ones count from the end.
            scene: Traffic and street; by default the first test scene of the run.
            arrows: Whether to draw the arrows, where the run recorded gradients.
            sight: Whether to paint what every camera sees of the scene, up to what stands in the way; not in films.
            title: A line in the upper left corner.
            window_size: Width and height [px].
            zoom: 1 fills the picture with the vehicle, less shows more around it.
            off_screen: Draw without a window; by default when there is no display.
            **show: For ``pyvista.Plotter.show``, such as ``jupyter_backend`` or ``cpos``.

        Returns:
            The file that was written, else what ``pyvista.Plotter.show`` returns.

        Raises:
            InputError: A file of the folder cannot be used, there is no such iteration, or nothing can be drawn here.
        """
        from warpav.runs.inspect import ShownRun

        return ShownRun.of(self, scene=scene).plot(
            out,
            iteration=iteration,
            arrows=arrows,
            sight=sight,
            title=title,
            window_size=window_size,
            zoom=zoom,
            off_screen=off_screen,
            show=show,
        )

    def to_pyvista(self, *, scene: Scene | None = None) -> MultiBlock:
        """The run as ``pyvista.MultiBlock``: ``start``, ``path``, ``end``, ``scene``.

        See `warpav.view.blocks.run_to_pyvista`.

        Args:
            scene: Traffic and street; by default the first test scene of the run.

        Raises:
            InputError: A file of the folder is missing or cannot be used.
        """
        from warpav.runs.inspect import ShownRun

        return ShownRun.of(self, scene=scene).to_pyvista()

    def _append(self, name: str, line: str) -> None:
        with _writing(self.path / name), (self.path / name).open("ab", buffering=0) as file:
            file.write(line.encode())

    def _read_json(self, name: str) -> dict[str, Any] | None:
        file = self.path / name
        try:
            return json.loads(file.read_text(encoding="utf-8"))
        except FileNotFoundError:
            return None
        except OSError as error:
            raise InputError(f"{file}: expected a readable file, got: {error.strerror}") from None
        except (ValueError, RecursionError) as error:
            raise InputError(f"{file}: expected JSON, got: {error}") from None


def read_run(path: str | Path) -> RunFolder:
    """The run that a folder holds.

    Args:
        path: The run folder.

    Raises:
        InputError: There is no folder, or it is not one of a run.
    """
    return RunFolder.open(path)


def write_json(file: Path, data: object) -> None:
    """Write data as JSON in one step; dataclasses and arrays are welcome, NaN becomes null.

    Raises:
        InputError: The file cannot be written.
    """
    write_text(file, json.dumps(_json_ready(data), indent=2, allow_nan=False) + "\n")


def check_new_run(config: Config) -> None:
    """Refuse a ``run.out`` that holds something already; an empty folder is welcome.

    Raises:
        InputError: ``run.out`` is a file, or a folder with content.
    """
    out = config.run.out
    if out is None or not out.exists():
        return
    if not out.is_dir():
        raise OptionError("run.out", f"expected a folder to write to, got {str(out)!r}, which is a file")
    if any(out.iterdir()):
        raise OptionError(
            "run.out",
            f"expected a folder that does not exist yet, got {str(out)!r}; "
            "choose another, or leave run.out away and the run is numbered",
        )


def check_folder(folder: Path, option: str) -> None:
    """Refuse a file where a folder is to be written; what ``option`` is called is told.

    Raises:
        InputError: It is a file.
    """
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{folder}: {option}: expected a folder to write to, got a file")


def trajectory(events: Sequence[dict[str, Any]]) -> np.ndarray | None:
    """Camera positions over the iterations [m], shape [iteration, camera, 3]; None for fewer than two iterations.

    Of several descents it is the way of the one that came upon the best rig.
    """
    import numpy as np

    looks = [event for event in events if event.get("training_objective") is not None]
    best = min(looks, key=lambda event: event["training_objective"], default=None)
    way = [event["positions_m"] for event in events if best is None or event.get("descent") == best.get("descent")]
    return np.array(way) if len(way) > 1 else None


def environment(config: Config, device: str) -> dict[str, Any]:
    """What a run depended on: versions, device, seeds, command, time."""
    return {
        "warpav": metadata.version("warpav"),
        "git_commit": _git_commit(),
        "python": platform.python_version(),
        "platform": platform.platform(),
        "cpu_count": os.cpu_count(),
        "device": device or config.device,
        "packages": package_versions(),
        "seeds": {
            "run": config.run.seed,
            "train": list(config.scenes.train_seeds),
            "validation": list(config.scenes.validation_seeds or ()),
            "test": list(config.scenes.test_seeds),
        },
        "command": command_line(),
        "started": time.strftime("%Y-%m-%dT%H:%M:%S%z"),
    }


def command_line() -> str:
    """The command that runs, as it can be typed again."""
    return shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]])


def required_packages() -> list[str]:
    """Distribution names of the packages that an installation of warpav needs, extras left out."""
    requirements = [each for each in metadata.requires("warpav") or [] if "extra ==" not in each]
    return [re.split(r"[^A-Za-z0-9._-]", each, maxsplit=1)[0] for each in requirements]


def package_versions() -> dict[str, str]:
    """Installed versions of the packages that warpav builds on, by distribution name; absent ones are left out."""
    versions = {}
    for package in (*required_packages(), *_RELATED_PACKAGES):
        with contextlib.suppress(metadata.PackageNotFoundError):
            versions[package] = metadata.version(package)
    return versions


def _git_commit() -> str | None:
    """Commit of the checkout that runs, with ``+`` when it has changes; None for an installed package."""
    checkout = Path(__file__).resolve().parents[2]
    if not (checkout / ".git").exists():
        return None
    command = ["git", "-C", str(checkout), "describe", "--always", "--abbrev=40", "--exclude=*", "--dirty=+"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=5, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout.strip() or None


def _numbered_folder(name: str) -> Path:
    number = 1
    while True:
        path = RUNS_FOLDER / (name if number == 1 else f"{name}-{number}")
        try:
            path.mkdir(parents=True)
        except FileExistsError:
            number += 1
        else:
            return path


def _write_arrays(file: Path, arrays: Mapping[str, np.ndarray]) -> None:
    import numpy as np

    with _writing(file), atomic_write(file) as draft, draft.open("wb") as stream:
        np.savez_compressed(stream, allow_pickle=False, **arrays)


def _iterations_of(evaluation: object) -> int:
    """How many iterations ``evaluation.json`` speaks of; 0 where it does not."""
    descent = evaluation.get("descent") if isinstance(evaluation, dict) else None
    count = descent.get("iterations") if isinstance(descent, dict) else None
    return count if isinstance(count, int) else 0


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())


def write_text(file: Path, text: str) -> None:
    """Write a text in one step.

    Raises:
        InputError: The file cannot be written.
    """
    with _writing(file), atomic_write(file) as draft:
        draft.write_text(text, encoding="utf-8")


@contextlib.contextmanager
def _writing(place: Path) -> Iterator[None]:
    """What keeps a file from being written is one line that names it."""
    try:
        yield
    except OSError as error:
        raise InputError(f"{place}: expected a place to write to, got: {error.strerror}") from None


def _json_ready(value: object) -> Any:  # noqa: ANN401
    """The value in JSON's own types: arrays become lists, numbers that are not finite become None."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: _json_ready(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {str(key): _json_ready(inner) for key, inner in value.items()}
    if isinstance(value, (list, tuple)):
        return [_json_ready(inner) for inner in value]
    if hasattr(value, "tolist"):  # NumPy arrays and scalars
        return _json_ready(value.tolist())  # pyright: ignore[reportAttributeAccessIssue]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, Path):
        return str(value)
    return value


_MEND_EVENTS = "remove the line, or the file to go without the iterations"


def _event_mistake(event: object, *, camera_count: int | None) -> str | None:
    """What keeps a line of ``events.jsonl`` from being an iteration of a run of so many cameras; None: nothing."""
    if not isinstance(event, dict):
        return f"expected one JSON object per line, got {str(event)[:40]!r}"
    missing = [name for name in ("iteration", "loss", "positions_m", "yaw_deg") if name not in event]
    if missing:
        return f"expected an iteration of a run with {missing[0]}, got {', '.join(list(event)[:5]) or 'no field'}"
    places, yaws = event["positions_m"], event["yaw_deg"]
    if not (isinstance(places, list) and places and all(_are_finite(place, 3) for place in places)):
        return f"positions_m: expected [x, y, z] of every camera, got {str(places)[:40]}"
    if camera_count not in (None, len(places)):
        return f"positions_m: expected {camera_count} cameras as in the lines before, got {len(places)}"
    if not _are_finite(yaws, len(places)):
        return f"yaw_deg: expected a number for each of {len(places)} cameras, got {str(yaws)[:40]}"
    for name in ("loss", "training_objective"):
        if not _is_number_or_none(event.get(name)):
            return f"{name}: expected a number or null, got {str(event[name])[:40]!r}"
    return _part_mistake(event, len(places))


def _part_mistake(event: Mapping[str, Any], camera_count: int) -> str | None:
    """The same for what is under a name: terms, multipliers, gradient and free, where they are there."""
    for name in ("terms", "multipliers", "gradient", "free"):
        if not isinstance(event.get(name, {}), dict):
            return f"{name}: expected values by name, got {str(event[name])[:40]}"
    for name in ("terms", "multipliers"):
        for key, value in event.get(name, {}).items():
            is_list = name == "multipliers" and isinstance(value, list)
            if not all(_is_number_or_none(each) for each in (value if is_list else [value])):
                return f"{name}.{key}: expected a number or null, got {str(value)[:40]!r}"
    gradient = event.get("gradient")
    if gradient:
        slopes = gradient.get("position_per_m")
        has_slopes = isinstance(slopes, list) and len(slopes) == camera_count
        if not has_slopes or not all(_are_finite(slope, 2) for slope in slopes):
            return f"gradient.position_per_m: expected [x, y] of {camera_count} cameras, got {str(slopes)[:40]}"
    turns = {"gradient.yaw_per_rad": gradient.get("yaw_per_rad")} if gradient else {}
    for name, values in {**turns, **{f"free.{key}": value for key, value in event.get("free", {}).items()}}.items():
        if not _are_finite(values, camera_count):
            return f"{name}: expected a number for each of {camera_count} cameras, got {str(values)[:40]}"
    return None


def _is_number_or_none(value: object) -> bool:
    return value is None or (isinstance(value, (int, float)) and math.isfinite(value))


def _are_finite(numbers: object, count: int) -> bool:
    return (
        isinstance(numbers, list)
        and len(numbers) == count
        and all(isinstance(number, (int, float)) and math.isfinite(number) for number in numbers)
    )


def _flat_numbers(event: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """The numbers of an event by dotted name; lists are left to ``events.jsonl``."""
    row: dict[str, Any] = {}
    for name, value in event.items():
        if isinstance(value, dict):
            row |= _flat_numbers(value, f"{prefix}{name}.")
        elif not isinstance(value, (list, str)):
            row[prefix + name] = value
    return row
