"""The thesis's losses with its weights, as most tests take them."""

from typing import Any

from warpav.optimisation.settings import METHOD_LOSSES, LossSettings


def thesis_losses(**changes: Any) -> LossSettings:
    """The thesis's two losses with other numbers, also such as no configuration may have."""
    return LossSettings(**METHOD_LOSSES["thesis"]).model_copy(update=changes)
