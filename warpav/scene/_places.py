"""Places that scenes come from, apart for search, selection and test: recorded traffic, and levels of the town.

A place is named by a word: ``town:dense`` and the like, a place that ships with warpav, such as ``sind``, or the path
of recordings. The seeds of a part take turns among its places.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np

from warpav.core.errors import InputError
from warpav.core.records import nearest
from warpav.scene._cache import BuiltSource
from warpav.scene.town._levels import LEVELS, Level, TownSource
from warpav.scene.traffic.files import SHIPPED, content_digest, is_recording, recordings_in
from warpav.scene.traffic.moments import Moment, moment_of, moments_of
from warpav.scene.traffic.traffic_scene import TrafficSource

if TYPE_CHECKING:
    from warpav.scene._fleet import Fleet

_TOWN = {f"town:{level}": level for level in LEVELS}
KNOWN_PLACES = (*_TOWN, *SHIPPED)
"""Names of places that need no files."""
_TEST_SHARE = 1.0 / 3.0


def recordings_of(place: str) -> list[Path]:
    """The recordings of a place; none of a town. Raises `InputError` where a path has none."""
    if place in _TOWN:
        return []
    path = Path(place).expanduser()
    if place not in SHIPPED and not path.exists() and not is_recording(path):  # a scene in tables does not exist
        known = f"{', '.join(KNOWN_PLACES)}, or the path of recorded traffic"
        raise InputError(f"expected {known}, got {place!r}{nearest(place, KNOWN_PLACES)}")
    return recordings_in([path])


def parts_of(
    places: Sequence[str], selection: Sequence[str] | None, test: Sequence[str] | None
) -> tuple[tuple[str, ...], tuple[str, ...], tuple[str, ...]]:
    """Places of search, selection and test; without others the last third of ``places`` is for the test.

    Raises:
        InputError: A place cannot be used, or a recording of the test is in another part, too.
    """
    search, kept = tuple(places), tuple(test or ())
    if test is None:
        count = max(round(_TEST_SHARE * len(search)), 1)
        search, kept = search[:-count], search[-count:]
    chosen = search if selection is None else tuple(selection)
    seen = {content_digest(file): file for place in (*search, *chosen) for file in recordings_of(place)}
    for file in (file for place in kept for file in recordings_of(place)):
        if (content := content_digest(file)) in seen:
            raise InputError(f"{file}: expected a recording for the test alone, got the content of {seen[content]}")
    return search, chosen, kept


def sources_of(
    places: Sequence[str],
    seeds: Sequence[int],
    ego_bounds_m: np.ndarray,
    fleet: Fleet | None = None,
    *,
    say: Callable[[str], None] | None = None,
) -> list[BuiltSource]:
    """What the scenes of seeds are built of; ``ego_bounds_m`` [2, 3], ``say`` as of `moments_of`."""

    @cache
    def moments(place: str) -> Sequence[Moment]:
        return moments_of(recordings_of(place), ego_bounds_m, say=None if place in SHIPPED else say)

    def source(place: str, seed: int) -> BuiltSource:
        if place in _TOWN:
            return TownSource(seed, cast("Level", _TOWN[place]), fleet)
        return TrafficSource(moment_of(moments(place), seed // len(places)), seed, fleet)

    return [source(places[seed % len(places)], seed) for seed in seeds]
