"""The run folder: everything that a run leaves behind, readable at any moment of the run and ever after.

::

    runs/<name>/  config.yaml  env.json  events.jsonl  metrics.csv  rig_initial.yaml  rig_best.yaml  rig_final.yaml
                  rig_simpler.yaml  rig_start.yaml (where rig.start names a rig)
                  evaluation.json  checkpoints/last.npz  report.html  figures/*.png
                  further_cameras.csv (where optimiser.search is pool)

A file is replaced in one step or extended by one whole line, so a run that is stopped leaves a folder that opens.
One process at a time writes to a folder, and holds it.
"""

from __future__ import annotations

import contextlib
import csv
import io
import json
import shlex
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from warpav.core.bounded_files import DATA_SET_NODES_MAX, read_arrays, read_json, read_text
from warpav.core.cache import digest
from warpav.core.errors import InputError, OptionError, one_line
from warpav.core.files import (
    DRAFT,
    append_line,
    atomic_write,
    held_folder,
    json_ready,
    sync,
    write_json,
    write_text,
    writing,
)
from warpav.core.table import data_frame
from warpav.rig import Rig, copy_catalogue, preset_names, read_rig, read_zones, write_rig, write_zones
from warpav.runs._drawn_run import DrawnRun, draws_runs
from warpav.runs._environment import command_line, environment
from warpav.runs._events import Certificate, flat_numbers, read_events
from warpav.runs.config import BY_HAND, KEPT_FILES, Config, dump_config, load_config, with_absolute_paths
from warpav.sight import copy_requirements
from warpav.view import plot

if TYPE_CHECKING:
    import numpy as np
    import pandas  # pyright: ignore[reportMissingImports]

    from warpav.optimisation import FurtherCameras
    from warpav.scene import Scene

    MultiBlock = Any

_RigRole = Literal["start", "initial", "best", "final", "simpler"]
RUNS_FOLDER = Path("runs")
EVALUATION_SCHEMA = 1
_FURTHER_COLUMNS = ("gain", "x_m", "y_m", "z_m", "yaw_deg", "pitch_deg", "fov_deg")


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
        own_detector: str | None = None,
        hashes: Mapping[str, str] | None = None,
    ) -> RunFolder:
        """A new run folder with ``config.yaml`` and ``env.json``; call it once all inputs are known to be good."""
        check_new_run(config)
        with _made_folder():
            if config.run.out is not None:
                path = config.run.out
                path.mkdir(parents=True, exist_ok=True)
            else:
                path = _numbered_folder(name)
            folder = cls(path)
            for name in ("checkpoints", "figures"):
                (path / name).mkdir(exist_ok=True)
        if start is not None and config.rig.start not in preset_names():
            write_rig(start, folder.rig_path("start"))
        if config.mount.zones is not None:
            write_zones(read_zones(config.mount.zones), path / KEPT_FILES["mount.zones"])
        if config.rig.catalogue is not None:
            copy_catalogue(config.rig.catalogue, path / KEPT_FILES["rig.catalogue"])
        if config.requirements_file is not None:
            copy_requirements(config.requirements_file, path / KEPT_FILES["requirements"])
        known = {"configuration": digest(dump_config(config.replace({"run.out": None}))), **(hashes or {})}
        config = with_absolute_paths(config)
        folder.write_config(config, freeze=freeze)  # from here on a run that is killed can be resumed
        write_json(path / "env.json", {**environment(config, device), "own_detector": own_detector, "hashes": known})
        return folder

    @classmethod
    def open(cls, path: str | Path) -> RunFolder:
        """The run folder at ``path``."""
        folder = Path(path).expanduser()
        if not folder.is_dir():
            raise InputError(f"{path}: run folder: expected an existing folder, got none of that name")
        if not (folder / "config.yaml").is_file():
            raise InputError(
                f"{path}: run folder: expected a folder written by warpav optimise, got one without config.yaml"
            )
        return cls(folder)

    def write_config(self, config: Config, *, freeze: Sequence[str] = ()) -> None:
        """Write ``config.yaml``, which names those of `KEPT_FILES` that lie beside it; ``freeze`` as of `create`."""
        kept: dict[str, object] = {name: file for name, file in KEPT_FILES.items() if (self.path / file).is_file()}
        if "rig.start" in kept:
            kept["rig.freeze"] = list(freeze)
        write_text(self.path / "config.yaml", dump_config(config, kept=kept))

    def rig_path(self, role: _RigRole) -> Path:
        """Where ``rig_<role>.yaml`` is or will be."""
        return self.path / f"rig_{role}.yaml"

    def append_event(self, record: object) -> None:
        """Append one iteration to ``events.jsonl`` and ``metrics.csv``."""
        event = json_ready(record)
        metrics = self.path / "metrics.csv"
        append_line(metrics, _metrics_rows([event], with_names=not metrics.exists()))
        append_line(self.path / "events.jsonl", _event_line(event))

    def first_events(self, count: int) -> list[dict[str, Any]]:
        """So many of `events`, the first ones."""
        file = self.path / "events.jsonl"
        events = read_events(file)[:count]
        if len(events) < count:
            raise InputError(
                f"{file}: expected the {count} iterations of the checkpoint, got {len(events)}; was it changed?"
            )
        return events

    def replace_events(self, events: Sequence[Mapping[str, Any]]) -> None:
        """Make ``events.jsonl`` and ``metrics.csv`` those of these iterations."""
        write_text(self.path / "events.jsonl", "".join(_event_line(event) for event in events))
        metrics = self.path / "metrics.csv"
        if events:
            write_text(metrics, _metrics_rows(events, with_names=True))
        else:
            with writing(metrics):
                metrics.unlink(missing_ok=True)

    def write_checkpoint(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Write the state from which the run can go on to ``checkpoints/last.npz``."""
        import numpy as np

        with writing(self.path / "events.jsonl"):
            sync(self.path / "events.jsonl")
        file = self.path / "checkpoints" / "last.npz"
        with writing(file), atomic_write(file, is_durable=True) as draft, draft.open("wb") as stream:
            np.savez(stream, allow_pickle=False, **arrays)

    def checkpoint(self) -> dict[str, np.ndarray] | None:
        """The content of ``checkpoints/last.npz``, or None where the run was stopped before it had any."""
        file = self.path / "checkpoints" / "last.npz"
        return read_arrays(file, "arrays in NumPy's format (.npz)") if file.exists() else None

    def note_resumed(self, iteration: int) -> None:
        """Write into ``env.json`` that the run goes on after so many iterations, and by which command."""
        now = {"iteration": iteration, "command": command_line(), "started": time.strftime("%Y-%m-%dT%H:%M:%S%z")}
        known = self.environment()
        write_json(self.path / "env.json", {**known, "resumed": [*known.get("resumed", ()), now]})

    def remove_drafts(self) -> None:
        """Remove files that were not whole when their process was killed."""
        for draft in self.path.rglob(f"{DRAFT}*"):
            with writing(draft):
                draft.unlink(missing_ok=True)

    def remove_evaluation(self) -> None:
        """Remove ``evaluation.json`` and ``report.html``, which speak of fewer iterations than are to come."""
        for name in ("evaluation.json", "report.html"):
            with writing(self.path / name):
                (self.path / name).unlink(missing_ok=True)

    def write_evaluation(self, evaluation: Mapping[str, Any]) -> None:
        """Write ``evaluation.json``; NaN becomes null."""
        write_json(self.path / "evaluation.json", {"schema": EVALUATION_SCHEMA, **evaluation})

    def figure_path(self, name: str) -> Path:
        """Where the figure of this name belongs: ``figures/<name>.png``."""
        return self.path / "figures" / f"{name}.png"

    def write_further_cameras(self, further: FurtherCameras) -> None:
        """Write ``further_cameras.csv``: what each camera of the pool would add to the rig that was found."""
        import numpy as np

        angles_deg = np.degrees([further.yaw_rad, further.pitch_rad, further.fov_rad])
        text, table = io.StringIO(), np.column_stack([further.gain, further.position_m, *angles_deg])
        heading = ",".join(_FURTHER_COLUMNS)
        np.savetxt(text, table, ["%.8f", *["%.6f"] * 6], delimiter=",", header=heading, comments="")
        write_text(self.path / "further_cameras.csv", text.getvalue())

    def further_cameras(self) -> FurtherCameras | None:
        """The content of ``further_cameras.csv``, or None: a descent writes none."""
        import numpy as np

        from warpav.optimisation import FurtherCameras

        file = self.path / "further_cameras.csv"
        if not file.exists():
            return None
        try:
            heading, *rows = read_text(file, "rows of numbers").splitlines()
            if heading != ",".join(_FURTHER_COLUMNS):
                raise ValueError(f"columns {heading}")
            table = np.array([row.split(",") for row in rows], np.float64).reshape(len(rows), len(_FURTHER_COLUMNS))
            if not np.isfinite(table).all():
                raise ValueError("a number that is not finite")
        except InputError:
            raise
        except ValueError as error:
            raise InputError(
                f"{file}: expected rows of {', '.join(_FURTHER_COLUMNS)}, got: {one_line(str(error))}; "
                "was the file changed?"
            ) from None
        yaw_rad, pitch_rad, fov_rad = np.radians(table[:, 4:]).T
        return FurtherCameras(table[:, 1:4], yaw_rad, pitch_rad, fov_rad, table[:, 0])

    def certificate(self) -> Certificate | None:
        """What a search by a pool has proven so far; None for a descent, and where the run is older than that."""
        events = self.events()
        if Certificate.of(events) is None:
            return None
        return Certificate.of(events, scenes=self.config().scenes.search_scene_count)

    def write_report(self, html: str) -> Path:
        """Write ``report.html`` and return its path."""
        write_text(self.path / "report.html", html)
        return self.path / "report.html"

    def config(self) -> Config:
        """The configuration of the run, validated again."""
        return load_config(self.path / "config.yaml")

    def environment(self) -> dict[str, Any]:
        """The content of ``env.json``, or an empty mapping."""
        return self._read_json("env.json") or {}

    def events(self) -> list[dict[str, Any]]:
        """All iterations so far; a line that was cut off in the middle of being written is left out."""
        return read_events(self.path / "events.jsonl", least=_iterations_of(self.evaluation()))

    def evaluation(self) -> dict[str, Any] | None:
        """The content of ``evaluation.json``, or None when the run has not come that far."""
        return self._read_json("evaluation.json")

    def figures(self) -> list[Path]:
        """The PNG files of the run, by name."""
        return sorted(each for each in (self.path / "figures").glob("*.png") if not each.name.startswith(DRAFT))

    def rig(self, role: _RigRole | None = None) -> Rig:
        """A rig of the run; see `rig_file`."""
        return read_rig(self.rig_file(role))

    def found_rig(self) -> Rig:
        """The rig that the search found, even where it is worse than its start."""
        keeps_best = self.config().optimiser.keep == "best"
        is_start = (self.evaluation() or {}).get("rig_of_run") in ("start", BY_HAND)
        return self.rig("best" if keeps_best and not is_start else "final")

    def rig_file(self, role: _RigRole | None = None) -> Path:
        """The file of a rig of the run."""
        roles: tuple[_RigRole, ...] = ("best", "initial") if role is None else (role,)
        if role is None and (self.path / "evaluation.json").is_file():  # the run has ended, so it had one
            roles = ("best",)
        for name in roles:
            file = self.rig_path(name)
            if file.is_file():
                return file
        raise InputError(
            f"{self.path}: run folder: expected rig_{roles[0]}.yaml, got none"
            + ("; was it removed?" if len(roles) == 1 and role is None else "; the run has none yet")
        )

    def drawn(self, config: Config | None = None, *, scene: Scene | None = None) -> DrawnRun:
        """The run as its plots show it; ``scene`` by default the first test scene."""
        from warpav.runs._mounts import mount_surface, with_shared_model
        from warpav.runs._scene_set import first_scene

        known = self.config() if config is None else config

        def shown() -> Scene:
            return first_scene(known) if scene is None else scene

        has_start = self.rig_path("initial").is_file()
        start, rig = (with_shared_model(self.rig(role), known) for role in ("initial" if has_start else None, None))
        return DrawnRun(
            str(self.path),
            known,
            BY_HAND if BY_HAND in (self.evaluation() or {}).get("arms", ()) else "start",
            start,
            rig,
            self.events(),
            shown,
            lambda scene: mount_surface(known, scene.ego),
            self.further_cameras,
        )

    def plot(self, out: Path | str | None = None, **options: Any) -> Any:  # noqa: ANN401
        """Show the run in a window or a notebook, or write its image to a file; see `warpav.view.plot`.

        The result on its vehicle in traffic, with the trajectory of every camera and arrows for where the descent would
        still move and turn it; ``.gif`` and ``.mp4`` show the iterations.

        Raises:
            InputError: A file of the folder cannot be used, there is no such iteration, or nothing can be drawn here.
        """
        return plot(self, out=out, **options)

    def to_pandas(self) -> pandas.DataFrame:
        """The numbers of its iterations as a table of pandas, by iteration, under the names of ``metrics.csv``.

        Raises:
            ImportError: pandas is not installed.
            InputError: ``events.jsonl`` cannot be used.
        """
        numbers = map(flat_numbers, self.events())
        return data_frame({row.pop("iteration"): row for row in numbers})

    def to_pyvista(self, *, scene: Scene | None = None) -> MultiBlock:
        """The run as ``pyvista.MultiBlock``: ``start``, ``path``, ``end``, ``scene``.

        See `warpav.view._blocks.run_to_pyvista`.

        Args:
            scene: Traffic and street; by default the first test scene of the run.

        Raises:
            InputError: A file of the folder is missing or cannot be used.
        """
        from warpav.view import run_to_pyvista

        run = self.drawn(scene=scene)
        return run_to_pyvista(run.frames, start=self.rig("initial"), end=run.rig, scene=run.scene)

    def _read_json(self, name: str) -> dict[str, Any] | None:
        file = self.path / name
        return read_json(file, "a readable file of a run", nodes_max=DATA_SET_NODES_MAX) if file.exists() else None


def read_run(path: str | Path) -> RunFolder:
    """The run that a folder holds.

    Args:
        path: The run folder.

    Raises:
        InputError: There is no folder, or it is not one of a run.
    """
    return RunFolder.open(path)


def check_new_run(config: Config) -> None:
    """Reject a ``run.out`` that holds something already; a folder with nothing but empty ones is welcome."""
    out = config.run.out
    if out is None or not out.exists():
        return
    if not out.is_dir():
        raise OptionError("run.out", f"expected a folder to write to, got {str(out)!r}, which is a file")
    # what a run that was killed in its first moment has left is nothing
    first = set() if (out / "config.yaml").is_file() else {out / name for name in KEPT_FILES.values()}
    if any(
        each.is_symlink() or not (each.is_dir() or each in first)
        for each in out.rglob("*")
        if not each.name.startswith(DRAFT)
    ):
        resumes = f"; warpav optimise --resume {shlex.quote(str(out))} goes on with the run in it"
        raise OptionError(
            "run.out",
            f"expected a folder that does not exist yet, got {str(out)!r}; "
            "choose another, or leave run.out away and the run is numbered"
            + (resumes if (out / "config.yaml").is_file() else ""),
        )


@contextlib.contextmanager
def new_run_folder(config: Config) -> Iterator[None]:
    """Make and hold ``run.out``, before anything takes long; removed where the block makes no run of it."""
    out = config.run.out
    check_new_run(config)
    if out is None:  # it is numbered later, so that nobody else has it
        yield
        return
    made = [each for each in (out, *out.parents) if not each.exists()]
    with _made_folder():
        out.mkdir(parents=True, exist_ok=True)
    try:
        with held_folder(out) as is_free:
            if not is_free:
                raise OptionError("run.out", f"expected a folder that no run writes to, got {str(out)!r}; one does now")
            check_new_run(config)
            yield
    finally:
        for each in made:
            with contextlib.suppress(OSError):  # there is something in it
                each.rmdir()


@contextlib.contextmanager
def held_run(folder: RunFolder) -> Iterator[None]:
    """Hold a run folder while the block writes to it."""
    with held_folder(folder.path) as is_free:
        if not is_free:
            raise InputError(
                f"{folder.path}: run folder: expected one that no run writes to; one does now, wait for it"
            )
        yield


@contextlib.contextmanager
def _made_folder() -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise OptionError(
            "run.out", f"expected a folder that can be made, got {error.filename!r}: {error.strerror}"
        ) from None


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


def _event_line(event: Mapping[str, Any]) -> str:
    return json.dumps(event, allow_nan=False) + "\n"


def _metrics_rows(events: Sequence[Mapping[str, Any]], *, with_names: bool) -> str:
    text = io.StringIO()
    for event in events:
        row = flat_numbers(event)
        writer = csv.DictWriter(text, list(row), lineterminator="\n")
        if with_names:
            writer.writeheader()
        writer.writerow(row)
        with_names = False
    return text.getvalue()


def _iterations_of(evaluation: object) -> int:
    descent = evaluation.get("descent") if isinstance(evaluation, dict) else None
    count = descent.get("iterations") if isinstance(descent, dict) else None
    return count if isinstance(count, int) else 0


draws_runs(RunFolder)
