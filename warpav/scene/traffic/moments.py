"""Moments of recordings: when a scene takes place, who becomes the ego vehicle, and what a seed means.

Search and test have recordings of their own, so no moment of a recording is in both.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from warpav.core.errors import InputError
from warpav.scene.traffic.files import content_digest, read_recording, recordings_in, shipped_recordings
from warpav.scene.traffic.recording import RecordedState, Recording, without_overlaps

REACH_M = 100.0  # who is farther from the ego vehicle is left out
SPACING_S = 1.0  # time between two moments of a recording, at least
OVERLAP_MAX_M = 0.3  # boxes of a moment may overlap so far: drones and cameras err
_CLEAR_M = 10.0  # around the ego vehicle, where nobody may have been left out for an overlap
# length and width of the ego vehicle over those of the road user that it replaces: what is shorter fits as well
LENGTH_RATIO, _WIDTH_RATIO = (0.6, 1.2), (0.8, 1.15)
MOVED_M = 1.0  # way of a road user between two moments in which it is the ego vehicle: who waits counts once
_COMPANY_M, _COMPANY_MIN = 60.0, 2  # other road users near the ego vehicle, one of them no pedestrian
_MIRRORS_M = 0.22  # by which mirrors make a vehicle wider than its box
_SEARCH_SHARE = 2.0 / 3.0
_STREAM = 0x7AF1C


@dataclass(frozen=True)
class Moment:
    """A scene's place in a recording."""

    file: Path  # the recording
    step: int  # when
    ego_id: str  # the road user whose place the ego vehicle takes


def traffic_of(
    recordings: Sequence[Path] | None,
    test_recordings: Sequence[Path] | None,
    ego_bounds_m: np.ndarray,
    *,
    say: Callable[[str], None] | None = None,
) -> list[tuple[Moment, ...]]:
    """Moments of search and test, as seeds take them; ``ego_bounds_m`` [2, 3], ``say`` as of `moments_of`."""
    parts = search_and_test(recordings, test_recordings)
    return [moments_of(part, ego_bounds_m, say=say) for part in parts]


def search_and_test(
    recordings: Sequence[Path] | None, test_recordings: Sequence[Path] | None
) -> tuple[list[Path], list[Path]]:
    search = shipped_recordings() if recordings is None else recordings_in(recordings)
    if test_recordings is not None:
        test = recordings_in(test_recordings)
    elif len(search) < 2:
        raise InputError(
            "recordings: expected at least two, so that one can be kept for the test, got one; name others for the test"
        )
    else:
        count = min(max(round(_SEARCH_SHARE * len(search)), 1), len(search) - 1)
        search, test = search[:count], search[count:]
    content = {content_digest(path): path for path in search}
    for path in test:
        if (digest := content_digest(path)) in content:
            raise InputError(f"{path}: expected a recording for the test alone, got the content of {content[digest]}")
    return search, test


def moments_of(
    files: Sequence[Path], ego_bounds_m: np.ndarray, *, say: Callable[[str], None] | None = None
) -> tuple[Moment, ...]:
    """All moments of recordings in an order that mixes them, the same for the same recordings.

    ``say`` gets a line for every recording of which not everything is used. Raises `InputError` where there is none.
    """
    length, width = np.ptp(np.asarray(ego_bounds_m, np.float64)[:, :2], axis=0).tolist()
    found: list[Moment] = []
    lines: list[str] = []
    for file in files:
        candidates, text = _candidates(file, content_digest(file), round(length, 3), round(width, 3))
        found += [Moment(file, step, ego_id) for step, ego_id in candidates]
        lines += [f"{file}: {text}"] if text else []
    if not found:
        raise InputError(lines[0])
    if say is not None:
        for line in lines:
            say(line)
    order = np.random.default_rng([_STREAM, len(found)]).permutation(len(found))
    return tuple(found[k] for k in order)


def moment_of(moments: Sequence[Moment], seed: int) -> Moment:
    """The moment that a seed means; seeds that are `len(moments)` apart have the same, with other looks."""
    return moments[seed % len(moments)]


@lru_cache(maxsize=4096)
def _candidates(file: Path, content: str, length_m: float, width_m: float) -> tuple[list[tuple[int, str]], str]:
    """Steps and ego vehicles of a recording, and what is not used of it; where there are none the reason."""
    del content
    recording = read_recording(file)
    spacing = max(1, int(np.ceil(SPACING_S / recording.step_s - 1e-9)))
    found: list[tuple[int, str]] = []
    overlapping: set[str] = set()
    clashes = 0
    is_sized = False
    last_m: dict[str, np.ndarray] = {}
    for step in range(0, recording.last_step + 1, spacing):
        states, left_out = without_overlaps(recording.states_at(step), OVERLAP_MAX_M)
        overlapping.update(state.user.user_id for state in left_out)
        for state in states:
            if not _may_be_ego(recording, state, length_m, width_m):
                continue
            is_sized = True
            before_m = last_m.get(state.user.user_id)
            if before_m is not None and np.linalg.norm(state.centre_m - before_m) < MOVED_M:
                continue
            others = (each for each in states if each is not state)
            near = [each for each in others if np.linalg.norm(each.centre_m - state.centre_m) <= _COMPANY_M]
            if len(near) < _COMPANY_MIN or all(each.user.category == "pedestrian" for each in near):
                continue
            last_m[state.user.user_id] = state.centre_m
            if any(np.linalg.norm(each.centre_m - state.centre_m) <= _CLEAR_M for each in left_out):
                clashes += 1
            else:
                found.append((step, state.user.user_id))
    parts = [recording.account] if recording.account else []
    if overlapping:
        parts.append(
            f"{len(overlapping)} of {len(recording.users)} road users left out where they overlap others by more than "
            f"{OVERLAP_MAX_M:g} m" + f", and {clashes} moments with such an overlap at the ego vehicle" * bool(clashes)
        )
    if found:
        return found, "; ".join(parts)
    if clashes:
        reason = f"expected moments without boxes that overlap within {_CLEAR_M:g} m of the ego vehicle, got none"
    elif is_sized:
        reason = (
            f"expected moments with at least {_COMPANY_MIN} road users within {_COMPANY_M:g} m of one that can be the "
            "ego vehicle, got none: they are empty"
        )
    elif recording.ego_id is not None:
        reason = f"expected the ego vehicle {recording.ego_id} at some moment, got none where it is there"
    else:
        reason = (
            f"expected a road user about as large as the ego vehicle, {length_m:.2f} m long and {width_m:.2f} m wide "
            "with mirrors, got none; scenes.ego takes vehicles of other sizes"
        )
    return [], "; ".join([reason, *parts])


def _may_be_ego(recording: Recording, state: RecordedState, length_m: float, width_m: float) -> bool:
    """Whether the ego vehicle can take somebody's place: the recorded one, or one of its size."""
    user = state.user
    if recording.ego_id is not None:
        return user.user_id == recording.ego_id
    if user.category not in ("car", "truck", "bus"):
        return False
    long, wide = length_m / user.size_m[0], width_m / user.size_m[1]
    without_mirrors = (width_m - _MIRRORS_M) / user.size_m[1]
    return LENGTH_RATIO[0] <= long <= LENGTH_RATIO[1] and _WIDTH_RATIO[0] <= wide and without_mirrors <= _WIDTH_RATIO[1]
