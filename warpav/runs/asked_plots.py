"""``warpav plot``: what was asked for, checked before anything is loaded, then drawn."""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from warpav.core.errors import ArgumentError, InputError
from warpav.core.files import check_folder
from warpav.rig.rig import Rig
from warpav.runs.config import Config
from warpav.runs.drawn_run import FittedRigs
from warpav.runs.rig_source import arm_names, find_rig, is_run_folder
from warpav.runs.run_folder import RunFolder
from warpav.runs.scene_set import load_scenes
from warpav.view import kinds_of, plot
from warpav.view.figures.style import checked_figure
from warpav.view.output import check_suffix

if TYPE_CHECKING:
    from warpav.core.progress import Progress


_KINDS_OF = {"run": RunFolder, "rig": Rig, "comparison": dict}


@dataclass(frozen=True)
class AskedPlots:
    """What ``warpav plot`` was asked for, found possible before anything is loaded."""

    source: str
    beside: tuple[str, ...]
    files: Mapping[str, Path]
    is_all: bool

    @classmethod
    def of(cls, source: str, *, kind: str, out: Path | None = None, beside: Sequence[str] = ()) -> AskedPlots:
        """Check what was asked for.

        Args:
            out: File; of ``all`` the folder for the files. None: the kind's name in this folder, or this folder.
        """
        arm_names(source, beside)
        is_run = is_run_folder(source)
        kinds = kinds_of(dict if beside else RunFolder if is_run else Rig)
        figures = [name for name, each in kinds.items() if each.is_figure]
        if kind == "all":
            folder = Path() if out is None else out
            if folder.suffix:
                raise ArgumentError("out", "expected a folder for kind all, got a file", place=folder)
            check_folder(folder, "out")
            return cls(source, tuple(beside), {name: folder / f"{name}.png" for name in figures}, is_all=True)
        if kind not in kinds:
            what = "comparison" if beside else "run" if is_run else "rig"
            of_others = [name for name, each in _KINDS_OF.items() if kind in kinds_of(each)]
            near = difflib.get_close_matches(kind, kinds, 1, 0.5)
            hint = (
                f"; {kind} is a plot of a {of_others[0]}" if of_others else f"; did you mean {near[0]}?" if near else ""
            )
            raise ArgumentError("kind", f"expected all, or a plot of a {what} ({', '.join(kinds)}), got {kind!r}{hint}")
        file = Path(f"{kind}.png") if out is None else out
        if kind in figures:
            checked_figure(file)
        else:
            check_suffix(file)
        return cls(source, tuple(beside), {kind: file}, is_all=False)

    def draw(self, config: Config, *, progress: Progress | None = None) -> tuple[list[Path], dict[str, str]]:
        """Draw them all."""
        scene = next(load_scenes(config, config.scenes.test_seeds[:1]))
        heading = Path(self.source).name if is_run_folder(self.source) else Path(self.source).stem
        written, left_out = [], {}
        names = arm_names(self.source, self.beside)
        rigs = {name: find_rig(each, config, scene.ego) for name, each in names.items()}
        fitted = FittedRigs(rigs, scene, config)
        for kind, file in self.files.items():
            try:
                if is_run_folder(self.source) and not self.beside:
                    plot(
                        RunFolder.open(self.source), kind=kind, out=file, title=heading, progress=progress, scene=scene
                    )
                elif kind == "view":
                    plot(rigs[next(iter(names))], out=file, title=heading, scene=scene, progress=progress)
                else:
                    plot(fitted, kind=kind, out=file, title=None if self.beside else heading, progress=progress)
            except InputError as error:
                if not self.is_all:
                    raise
                left_out[kind] = str(error)
            else:
                written.append(file)
        return written, left_out
