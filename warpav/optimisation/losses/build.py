"""The losses of a configuration."""

from __future__ import annotations

import importlib

from warpav.core.errors import InputError
from warpav.optimisation.losses.loss import Loss
from warpav.optimisation.losses.options import LossOptions
from warpav.optimisation.losses.registry import LOSSES


def losses_of(options: LossOptions) -> list[tuple[float, Loss]]:
    """The objective of a configuration: every loss of weight above 0, with its weight.

    Raises:
        InputError: A loss needs something that is not there.
    """
    found: list[tuple[float, Loss]] = []
    for name, weight in options.settings.weights.items():
        if weight == 0.0:
            continue
        module, _, kind = LOSSES[name].where.partition(":")
        try:
            found.append((weight, getattr(importlib.import_module(f"{__package__}.{module}"), kind).of(options)))
        except ValueError as error:
            raise InputError(f"losses.{name}: {error}") from None
    return found
