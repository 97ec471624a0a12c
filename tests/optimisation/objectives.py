"""Objectives from the settings of a configuration, as most tests take them."""

from dataclasses import fields
from typing import Any

import numpy as np
import warp as wp

from warpav.detection import Detector
from warpav.optimisation import (
    METHOD_LOSSES,
    AssignedScene,
    CameraMount,
    CameraProbability,
    LossOptions,
    LossSchedule,
    LossSettings,
    ObjectiveOptions,
    Reference,
    RigObjective,
    losses_of,
    metrics_of,
    observe_scenes,
)
from warpav.optimisation._scene_step import Exchange, Objective, RigViews, SceneStep
from warpav.raster.renderer import Renderer
from warpav.thesis import BoundsAndSpacing


def thesis_losses(**changes: Any) -> LossSettings:
    """The thesis's two losses with other numbers, also such as no configuration may have."""
    return LossSettings(**METHOD_LOSSES["thesis"]).model_copy(update=changes)


def rig_objective(
    mount: CameraMount,
    detector: Detector,
    *,
    settings: LossSettings,
    reference: Reference = Reference.NON_OCCLUDED,
    probability: Any = None,
    differentiable_detector: Any = None,
    **others: Any,
) -> RigObjective:
    """The objective of some settings."""
    options = {each.name: others.pop(each.name) for each in fields(ObjectiveOptions) if each.name in others}
    return RigObjective(
        mount,
        detector,
        camera_probability=CameraProbability.of(settings, probability),
        options=ObjectiveOptions(**options),
        **{
            "losses": losses_of(LossOptions(settings, reference, differentiable_detector)),
            "constraints": BoundsAndSpacing(mount.surface),
            **others,
        },
    )


class OneScene:
    """A `SceneStep` with what an objective keeps for it: the losses of some settings on one scene."""

    def __init__(
        self,
        mount: CameraMount,
        renderer: Renderer,
        assigned: AssignedScene,
        camera_count: int,
        settings: LossSettings,
        *,
        reference: Reference = Reference.NON_OCCLUDED,
        recorded: bool | None = None,
    ) -> None:
        pairs = losses_of(LossOptions(settings, reference))
        self.names = [loss.name for _, loss in pairs]
        self.weight = np.array([weight for weight, _ in pairs], np.float32)
        self.exchange = Exchange(camera_count, 0, len(pairs), device=str(renderer.device))
        self.views = RigViews(mount, self.exchange.pose, mount.rotation_count, [renderer])
        objective = Objective(tuple(loss for _, loss in pairs))
        self.step = SceneStep(self.views, renderer, assigned, self.exchange, objective, recorded=recorded)

    def at(self, pose: np.ndarray, box_px: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Losses of cameras there, and the gradient of their weighted sum to the mount poses."""
        count = np.ones(len(self.weight))
        self.exchange.send(pose, np.zeros(0), LossSchedule(), weight=self.weight, count=count)
        with wp.Tape() as tape:
            self.views.mount.place(self.exchange.pose, self.views.rotation_count, into=self.views.placed)
        self.step.observe()
        self.step.set_boxes(box_px)
        self.step.loss_and_grad()
        loss = self.step.losses.value.numpy().copy()
        tape.backward()
        return loss, self.exchange.pose.grad.numpy().copy()


def evaluate_rig(rig, scenes, objective, **options):
    """Metrics of a rig on scenes; the arguments are those of `observe_scenes`."""
    return metrics_of(observe_scenes(rig, scenes, objective, **options), objective)
