"""The levels of the embedded town: the same seeds, other streets and more of everything."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, cast

import numpy as np

from warpav.core.cache import fingerprint
from warpav.core.errors import ArgumentError
from warpav.core.records import nearest
from warpav.scene._scene import Scene

if TYPE_CHECKING:
    from warpav.scene._fleet import Fleet

Level = Literal["easy", "urban", "dense", "motorway"]
LEVELS: tuple[Level, ...] = ("easy", "urban", "dense", "motorway")  # names of the levels, the easiest first
_CODE = {"easy": "_town", "urban": "_streets", "dense": "_streets", "motorway": "_motorway"}
FLEET_CODE = ("warpav.scene._fleet", "warpav.scene.reconstruction._surface")
"""Modules that make vehicles of other makers what they are in scenes."""
_LEVEL_STREAM = 0x1E7E1  # keeps the random numbers of levels apart from other uses of the same seed


def level_scene(seed: int, level: Level = "easy", fleet: Fleet | None = None, street: int | None = None) -> Scene:
    """The scene of a seed and a level, around the same ego vehicle.

    ``street`` is the seed whose street it is, of the levels urban and dense; None: its own.
    """
    if level not in LEVELS:
        raise ValueError(f"level must be out of {', '.join(LEVELS)}, got {level!r}")
    if seed < 0:
        raise ValueError(f"seed must be 0 or more, got {seed}")
    exchange = None if fleet is None else fleet.exchange(LEVELS.index(level), seed)
    if level == "easy":
        from warpav.scene.town._town import town_scene

        return town_scene(seed, exchange)
    stream = [_LEVEL_STREAM, LEVELS.index(level), seed]
    rng, users_rng = np.random.default_rng([*stream, 0]), np.random.default_rng([*stream, 1])
    name, source = f"{level}_{seed:04d}", f"town {level} seed {seed}"
    if level == "motorway":
        from warpav.scene.town._motorway import motorway_world

        world = motorway_world(rng, users_rng)
    else:
        from warpav.scene.town._streets import street_world

        if street is None:
            return street_world(level, rng, users_rng).finish(name, source, exchange)
        street_rng = np.random.default_rng([_LEVEL_STREAM, LEVELS.index(level), street, 0])
        world = street_world(level, street_rng, users_rng, rng)
        source += f" street {street}"
    return world.finish(name, source, exchange)


def level_of_seed(levels: Sequence[Level] | None, seed: int) -> Level:
    """The level of a seed's scene: of several, seeds take turns; ``easy`` by default."""
    return levels[seed % len(levels)] if levels else "easy"


def checked_level(level: str) -> Level:
    if level not in LEVELS:
        text = f"expected one of {', '.join(LEVELS)}, got {level!r}{nearest(level, LEVELS)}"
        raise ArgumentError("level", text)
    return cast("Level", level)


@dataclass(frozen=True)
class TownSource:
    """What an embedded scene is made of."""

    seed: int  # any integer from 0
    level: Level = "easy"  # of the town
    fleet: Fleet | None = None  # vehicles of other makers, in the places of some of the town's; None: none
    street: int | None = None  # seed of another scene whose street it is, see `level_scene`

    def scene(self) -> Scene:
        return level_scene(self.seed, self.level, self.fleet, self.street)

    @property
    def fingerprint(self) -> str:
        """Hash of all that the scene depends on; that of ``easy`` knows nothing of the code of other levels."""
        code = (f"warpav.scene.town.{_CODE[self.level]}",)
        code = code if self.level == "easy" else (*code, __name__)
        made_of = (self.seed, self.level) if self.street is None else (self.seed, self.level, self.street)
        if self.fleet is None:
            return fingerprint(*made_of, code=code)
        return fingerprint(*made_of, self.fleet.share, self.fleet.content, code=(*code, *FLEET_CODE))


def level_of(source: str) -> tuple[Level, int] | None:
    """Level and seed of `warpav.scene._scene.Scene.source`; None of scenes that are not of the town."""
    match = re.fullmatch(rf"town (?:({'|'.join(LEVELS[1:])}) )?seed (\d+)", source)
    if match is None:
        return None
    return checked_level(match[1] or "easy"), int(match[2])
