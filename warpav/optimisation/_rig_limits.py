"""What a rig may be made of: how many cameras of which module, and at what cost."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from warpav.core.errors import OptionError
from warpav.optimisation.selection._problem import Row

_LESS_THAN_ANY = 1e-9


def range_text(pair: tuple[int, int]) -> str:
    """A range as it is written: ``2..8``, or ``4``."""
    return f"{pair[0]}..{pair[1]}" if pair[0] < pair[1] else f"{pair[0]}"


@dataclass(frozen=True)
class RigLimits:
    """How many cameras of each module a rig may have.

    A rig is chosen out of columns: single cameras, or pairs of a symmetric rig. A column's kind is its module, and
    whether it is a pair.
    """

    count: tuple[int, int]  # cameras of a rig, least and greatest, at least 1
    of_module: Mapping[str, tuple[int, int]]  # of every module least and greatest number, by its name
    price: Mapping[str, float]  # of every module, by its name; what is not there costs nothing
    cost_max: float | None  # what all cameras of a rig may cost together; None: anything
    kinds: tuple[tuple[str, int], ...]  # module of every kind and the cameras that it stands for, 1 or 2

    @classmethod
    def of(
        cls,
        of_module: Mapping[str, tuple[int, int]],
        *,
        count: tuple[int, int] | None = None,
        price: Mapping[str, float] | None = None,
        cost_max: float | None = None,
        kinds: Sequence[tuple[str, int]] | None = None,
    ) -> RigLimits:
        """Limits that agree with each other."""
        low, high = (sum(pair[end] for pair in of_module.values()) for end in range(2))
        if high < 1:
            raise OptionError("rig.modules", "expected at least one camera, got none")
        least, greatest = (max(low, 1), high) if count is None else (max(low, count[0]), min(high, count[1]))
        if count is not None and least > greatest:
            expected = f"expected {max(low, 1)} to {high}, as many as rig.modules allows"
            raise OptionError("rig.cameras", f"{expected}, got {range_text(count)}; change one of the two")
        every = tuple((name, 1) for name in of_module) if kinds is None else tuple(kinds)
        limits = cls((least, greatest), dict(of_module), dict(price or {}), cost_max, every)
        cheapest = limits.cost_range()[0]
        if cost_max is not None and cheapest > cost_max * (1.0 + _LESS_THAN_ANY):
            expected = f"expected at least {cheapest:g}, what the cheapest rig of these modules costs"
            raise OptionError("rig.max_cost", f"{expected}, got {cost_max:g}")
        return limits

    def within(self, *, count: tuple[int, int] | None = None, cost_max: float | None = None) -> RigLimits:
        """The same with another number of cameras or another budget."""
        return RigLimits.of(
            self.of_module,
            count=self.count if count is None else count,
            price=self.price,
            cost_max=self.cost_max if cost_max is None else cost_max,
            kinds=self.kinds,
        )

    def first_kinds(self) -> np.ndarray:
        """Kinds of the columns of a rig to start from, int [column]: the least of each module, then the cheapest."""
        columns: list[int] = []
        for name, count in self._filled(self.count[0]).items():
            left = count
            for number, (module, size) in sorted(enumerate(self.kinds), key=lambda each: -each[1][1]):
                taken = left // size if module == name else 0
                columns += [number] * taken
                left -= taken * size
            if left:
                raise OptionError(
                    "rig.modules",
                    f"expected an even number of {name}, as rig.symmetric takes pairs and the module fits no centred "
                    f"zone, got {range_text(self.of_module[name])}",
                )
        return np.array(sorted(columns), int)

    def cost(self, modules: Sequence[str | None]) -> float:
        """What cameras of some modules cost together."""
        return float(sum(self.price.get(name, 0.0) for name in modules if name is not None))

    def cost_range(self) -> tuple[float, float]:
        """What the cheapest and the dearest rig cost, the latter at most `cost_max`."""
        cheapest, dearest = (
            sum(count * self.price.get(name, 0.0) for name, count in counts.items())
            for counts in (self._filled(self.count[0]), self._filled(self.count[1], is_dearest=True))
        )
        return cheapest, dearest if self.cost_max is None else min(dearest, self.cost_max)

    def _filled(self, wanted: int, *, is_dearest: bool = False) -> dict[str, int]:
        """The least of each module, then of the cheapest or the dearest until there are as many as wanted."""
        counts = {name: low for name, (low, _) in self.of_module.items()}
        for name in sorted(counts, key=lambda each: self.price.get(each, 0.0), reverse=is_dearest):
            counts[name] += min(self.of_module[name][1] - counts[name], max(wanted - sum(counts.values()), 0))
        return counts

    def size(self, kind: np.ndarray) -> int:
        """Cameras that columns of some kinds stand for."""
        return int(self._sizes[kind].sum())

    def holds(self, kind: np.ndarray, *, is_whole: bool = True) -> bool:
        """Whether a rig of columns of some kinds, int [column], keeps the limits."""
        names = [self.kinds[number][0] for number in kind for _ in range(self.kinds[number][1])]
        counts = {name: names.count(name) for name in self.of_module}
        fits = all(counts[name] <= high for name, (_, high) in self.of_module.items()) and len(names) <= self.count[1]
        fits = fits and (self.cost_max is None or self.cost(names) <= self.cost_max * (1.0 + _LESS_THAN_ANY))
        is_enough = (
            all(counts[name] >= low for name, (low, _) in self.of_module.items()) and len(names) >= self.count[0]
        )
        return fits and (is_enough or not is_whole)

    def rows(self, kind: np.ndarray) -> list[Row]:
        """The limits as rows of a selection, for columns of a pool that are of kinds ``kind``, int [column].

        -1 is a column that is not there, see `absent`.
        """
        rows = []
        size = self._sizes[kind]
        names = np.array([*(name for name, _ in self.kinds), ""])[kind]
        if (self._sizes > 1).any():
            rows.append(Row(f"rig.cameras = {range_text(self.count)}", size.astype(float), *self.count))
        for name, (low, high) in self.of_module.items():
            if low > 0 or high < self.count[1]:
                text = f"rig.modules.{name} = {range_text((low, high))}"
                rows.append(Row(text, np.where(names == name, size, 0).astype(float), low, high))
        if self.cost_max is not None:
            price = np.array([self.price.get(name, 0.0) for name in names]) * size
            # a rig that costs just that must not fail by rounding
            rows.append(Row(f"rig.max_cost = {self.cost_max:g}", price, high=self.cost_max * (1.0 + _LESS_THAN_ANY)))
        return rows

    @property
    def absent(self) -> int:
        """How many of as many columns as a rig has cameras at most may not be there."""
        largest = int(self._sizes.max())
        return self.count[1] - -(-self.count[0] // largest)

    @property
    def _sizes(self) -> np.ndarray:
        """Cameras that a column of each kind stands for; the last, for those that are not there, 0."""
        return np.array([*(size for _, size in self.kinds), 0])
