"""Plots of the rigs of runs on their vehicle, with the detector of the run, as kinds of runs."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any, Protocol

from warpav.core.errors import ArgumentError
from warpav.rig.rig import Rig
from warpav.runs.config import Config
from warpav.view import Canvas, drawing_of, draws

if TYPE_CHECKING:
    from warpav.detection.probability import DetectionProbability
    from warpav.raster.camera import CameraModel
    from warpav.scene.scene import Scene

COMPARED_KINDS = ("plan", "range", "near_field", "redundancy", "resolution")
"""Kinds that take several rigs."""

FITTING_KINDS = (*COMPARED_KINDS, "contact", "sheet")
"""Kinds of rigs that runs have as well: start and result side by side, of the last two the result."""


@dataclass(frozen=True, eq=False)
class FittedRigs:
    """Rigs on one vehicle in one scene, and the configuration whose detector looks through them."""

    rigs: Mapping[str, Rig]
    scene: Scene
    config: Config

    def drawing(self, kind: str, canvas: Canvas) -> Any:  # noqa: ANN401 (see warpav.view.plotting.Kind)
        """What a kind out of `FITTING_KINDS` shows of them."""
        if kind not in COMPARED_KINDS:
            return drawing_of(list(self.rigs.values())[-1], canvas, kind=kind, scene=self.scene)
        options = {"probability": self.probability} if kind == "range" else {}
        shown = self.rigs if len(self.rigs) > 1 else next(iter(self.rigs.values()))
        return drawing_of(shown, canvas, kind=kind, scene=self.scene, **options)

    @cached_property
    def probability(self) -> Callable[[CameraModel], DetectionProbability]:
        """Gives the model of detection probability of the configuration's detector for a camera."""
        from warpav.runs.detector_fit import ensure_fit

        if self.config.losses.probability != "fitted":
            raise ArgumentError(
                "kind",
                f"expected losses.probability=fitted for 'range', got {self.config.losses.probability}; nobody knows "
                "how far the detector finds anything",
            )
        return lambda model: ensure_fit(self.config, camera=model)


for _kind in FITTING_KINDS:
    draws(FittedRigs, _kind, is_figure=True)(partial(lambda kind, fitted, canvas: fitted.drawing(kind, canvas), _kind))


class _HasFitted(Protocol):
    def fitted(self, scene: Scene | None = None) -> FittedRigs: ...


def fitting_drawing(kind: str) -> Callable[..., Any]:
    """What draws one of `FITTING_KINDS` of a run or a result, for `warpav.view.draws`."""

    def draw(run: _HasFitted, canvas: Canvas, *, scene: Scene | None = None) -> Any:  # noqa: ANN401
        return run.fitted(scene).drawing(kind, canvas)

    return draw
