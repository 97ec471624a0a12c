"""Count the road users of recorded traffic by class and distance: ``python docs/traffic_statistics.py [PATH ...]``.

Counted around every ego vehicle of every moment that scenes are made of; without paths, of the recordings that ship.
"""

from __future__ import annotations

import sys
from collections import Counter
from itertools import pairwise
from pathlib import Path

import numpy as np

from warpav.scene import ego_vehicle
from warpav.scene.traffic.files import read_recording, recordings_in, shipped_recordings
from warpav.scene.traffic.moments import REACH_M, moments_of
from warpav.scene.traffic.recording import CLASSES

EDGES_M = (0.0, 10.0, 20.0, 40.0, REACH_M)


def main(paths: list[str]) -> None:
    """Print a table: a row for a class, road users per scene at distances from the ego vehicle."""
    files = recordings_in(map(Path, paths)) if paths else shipped_recordings()
    moments = moments_of(files, ego_vehicle().bounds_m())
    count: Counter[tuple[str, int]] = Counter()
    for moment in moments:
        states = read_recording(moment.file).states_at(moment.step)
        own = next(state for state in states if state.user.user_id == moment.ego_id)
        for state in states:
            away_m = float(np.linalg.norm(state.centre_m - own.centre_m))
            if state is not own and away_m <= REACH_M:
                count[state.user.category, int(np.searchsorted(EDGES_M[1:], away_m))] += 1
    spans = [f"{low:g} to {high:g} m" for low, high in pairwise(EDGES_M)]
    lines = [
        f"{len(moments)} scenes of {len(files)} recordings; road users a scene",
        "",
        f"| class | {' | '.join(spans)} |",
    ]
    lines.append("|---" * (len(spans) + 1) + "|")
    for name in CLASSES:
        row = [count[name, k] / len(moments) for k in range(len(spans))]
        if any(row):
            lines.append(f"| {name} | {' | '.join(f'{each:.2f}' for each in row)} |")
    sys.stdout.write("\n".join(lines) + "\n")


if __name__ == "__main__":
    main(sys.argv[1:])
