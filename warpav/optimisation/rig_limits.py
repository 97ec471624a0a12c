"""What a rig may be made of: how many cameras of which module, and at what cost."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from warpav.core.errors import OptionError
from warpav.optimisation.selection.problem import Row

_LESS_THAN_ANY = 1e-9


def range_text(pair: tuple[int, int]) -> str:
    """A range as it is written: ``2..8``, or ``4``."""
    return f"{pair[0]}..{pair[1]}" if pair[0] < pair[1] else f"{pair[0]}"


@dataclass(frozen=True)
class RigLimits:
    """How many cameras of each module a rig may have.

    Attributes:
        count: Cameras of a rig, least and greatest, at least 1.
        of_module: Of every module least and greatest number, by its name.
        price: Of every module, by its name; what is not there costs nothing.
        cost_max: What all cameras of a rig may cost together; None: anything.
    """

    count: tuple[int, int]
    of_module: Mapping[str, tuple[int, int]]
    price: Mapping[str, float]
    cost_max: float | None = None

    @classmethod
    def of(
        cls,
        of_module: Mapping[str, tuple[int, int]],
        *,
        count: tuple[int, int] | None = None,
        price: Mapping[str, float] | None = None,
        cost_max: float | None = None,
    ) -> RigLimits:
        """Limits that agree with each other.

        Args:
            of_module: Of every module least and greatest number, at least one module.
            count: Cameras of a rig, least and greatest; None: whatever the modules allow.
            price: Of every module.
            cost_max: What all cameras may cost together.

        Raises:
            InputError: No rig satisfies them.
        """
        low, high = (sum(pair[end] for pair in of_module.values()) for end in range(2))
        if high < 1:
            raise OptionError("rig.modules", "expected at least one camera, got none")
        least, greatest = (max(low, 1), high) if count is None else (max(low, count[0]), min(high, count[1]))
        if least > greatest:
            given = "none" if count is None else range_text(count)
            raise OptionError(
                "rig.cameras",
                f"expected {max(low, 1)} to {high}, as many as rig.modules allows, got {given}; change one of the two",
            )
        limits = cls((least, greatest), dict(of_module), dict(price or {}), cost_max)
        cheapest = limits._cheapest(least)
        if cost_max is not None and cheapest > cost_max * (1.0 + _LESS_THAN_ANY):
            raise OptionError(
                "rig.max_cost",
                f"expected at least {cheapest:g}, what the cheapest rig of these modules costs, got {cost_max:g}",
            )
        return limits

    @property
    def modules(self) -> tuple[str, ...]:
        """Names of the modules, in their order."""
        return tuple(self.of_module)

    @property
    def is_fixed(self) -> bool:
        """Whether every module has one number that it may have."""
        return all(low == high for low, high in self.of_module.values())

    def first_modules(self) -> np.ndarray:
        """Modules of a rig to start from, int [camera]: the least of each, then the cheapest up to the least count."""
        counts = [low for low, _ in self.of_module.values()]
        for number in self._by_price():
            room = self.of_module[self.modules[number]][1] - counts[number]
            counts[number] += min(room, max(self.count[0] - sum(counts), 0))
        return np.repeat(np.arange(len(counts)), counts)

    def cost(self, modules: Sequence[str | None]) -> float:
        """What cameras of some modules cost together."""
        return float(sum(self.price.get(name, 0.0) for name in modules if name is not None))

    def cost_range(self) -> tuple[float, float]:
        """What the cheapest and the dearest rig cost, the latter at most `cost_max`."""
        room, counts = self.count[1], [low for low, _ in self.of_module.values()]
        for number in reversed(self._by_price()):
            more = min(self.of_module[self.modules[number]][1] - counts[number], room - sum(counts))
            counts[number] += max(more, 0)
        dearest = self.cost([self.modules[number] for number in np.repeat(np.arange(len(counts)), counts)])
        return self._cheapest(self.count[0]), dearest if self.cost_max is None else min(dearest, self.cost_max)

    def holds(self, module: np.ndarray, *, is_whole: bool = True) -> bool:
        """Whether a rig of cameras of some modules, int [camera], keeps the limits.

        Args:
            module: Number of the module of each.
            is_whole: Whether nothing is added any more; else what must be there at least does not matter yet.
        """
        counts = np.bincount(module, minlength=len(self.modules))
        low, high = np.array(list(self.of_module.values())).T
        cost = self.cost([self.modules[number] for number in module])
        fits = bool((counts <= high).all() and len(module) <= self.count[1])
        fits &= self.cost_max is None or cost <= self.cost_max * (1.0 + _LESS_THAN_ANY)
        return fits and (not is_whole or bool((counts >= low).all() and len(module) >= self.count[0]))

    def rows(self, module: np.ndarray) -> list[Row]:
        """The limits as rows of a selection, for cameras of a pool that are of modules ``module``, int [camera].

        The number of cameras is no row; -1 is a camera that is not there, see `absent`.
        """
        rows = [
            Row(
                f"rig.modules.{name} = {low}{'' if low == high else f'..{high}'}",
                (module == k).astype(float),
                low,
                high,
            )
            for k, (name, (low, high)) in enumerate(self.of_module.items())
            if low > 0 or high < self.count[1]
        ]
        if self.cost_max is not None:
            prices = np.array([*(self.price.get(name, 0.0) for name in self.modules), 0.0])
            # a rig that costs just that must not fail by rounding
            high = self.cost_max * (1.0 + _LESS_THAN_ANY)
            rows.append(Row(f"rig.max_cost = {self.cost_max:g}", prices[module], high=high))
        return rows

    @property
    def absent(self) -> int:
        """How many of the greatest number of cameras a rig may do without."""
        return self.count[1] - self.count[0]

    def _by_price(self) -> list[int]:
        return sorted(range(len(self.of_module)), key=lambda k: self.price.get(self.modules[k], 0.0))

    def _cheapest(self, count: int) -> float:
        """What the cheapest rig of so many cameras costs."""
        assert count == self.count[0]
        return self.cost([self.modules[k] for k in self.first_modules()])
