"""Areas, extents and the thesis's pairwise occlusion from silhouettes, by brute force."""

import numpy as np


def pairwise_hidden(depth_m, ego_depth_m):
    """What the thesis calls occluded, bool [vehicle, row, column].

    Of two overlapping silhouettes the one whose part outside the overlap has the smaller median depth hides the other;
    the medians inside the overlap decide where one silhouette has no part outside. The ego vehicle hides everything.
    Depths are those of every vehicle alone, inf outside, [vehicle, row, column], and the ego vehicle's, [row, column].
    """
    inside = np.isfinite(depth_m)
    hidden = inside & np.isfinite(ego_depth_m)
    for a in range(len(depth_m)):
        for b in range(len(depth_m)):
            overlap = inside[a] & inside[b]
            if a == b or not overlap.any():
                continue
            only_a, only_b = depth_m[a][inside[a] & ~inside[b]], depth_m[b][inside[b] & ~inside[a]]
            if len(only_a) == 0 or len(only_b) == 0:
                only_a, only_b = depth_m[a][overlap], depth_m[b][overlap]
            if np.median(only_b) < np.median(only_a):
                hidden[a] |= overlap
    return hidden


def extents(mask):
    """First and one past the last column and row that hold something: left, right, top, bottom; None if empty."""
    rows, columns = np.nonzero(mask)
    if len(rows) == 0:
        return None
    return columns.min(), columns.max() + 1, rows.min(), rows.max() + 1
