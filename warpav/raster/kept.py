"""Renderers that are kept from call to call, limited by the memory that their buffers hold."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, field

from warpav.raster.renderer import Renderer

KEPT_BYTES = 2**29


@dataclass(eq=False)
class KeptRenderers:
    """Renderers by what they are asked for; those that were not used for the longest time go first.

    Attributes:
        bytes_max: How much all of them may hold. Those of the last call stay even if they hold more.
    """

    bytes_max: int = KEPT_BYTES
    _kept: dict[Hashable, tuple[Renderer, ...]] = field(default_factory=dict, init=False, repr=False)

    def __len__(self) -> int:
        return sum(map(len, self._kept.values()))

    @property
    def held_bytes(self) -> int:
        """What the buffers of all of them hold."""
        return sum(each.held_bytes for renderers in self._kept.values() for each in renderers)

    def clear(self) -> None:
        """Let go of all of them."""
        self._kept.clear()

    def of(self, key: Hashable, make: Callable[[], Sequence[Renderer]]) -> tuple[Renderer, ...]:
        """The renderers of a key; those that ``make`` gives, if none are kept.

        Not to be called while renderers of an earlier call are in use.
        """
        known = self._kept.pop(key, ())
        others_max = self.bytes_max - sum(each.held_bytes for each in known)
        # buffers grow as they are used, so this is the time to look; first, so that new ones find room
        while self._kept and self.held_bytes > others_max:
            del self._kept[next(iter(self._kept))]
        self._kept[key] = known or tuple(make())
        return self._kept[key]
