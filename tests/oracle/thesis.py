"""The thesis's equations as they are printed, one slow NumPy function each. Letters of the thesis in the comments.

Differences forced by this project's frame: x and y are the plane (the thesis: x and z), and yaw is left-positive, so
Eq. 10 gets a minus sign.
"""

import itertools
import math

import numpy as np


def lagrangian(objective, objective_scale, multiplier, constraint, constraint_scale):
    """Eq. 1: every optimisable loss with all constraints, summed."""
    constraints = sum(m * s * c for m, s, c in zip(multiplier, constraint_scale, constraint, strict=True))
    return sum(scale * loss + constraints for loss, scale in zip(objective, objective_scale, strict=True))


def closest_field_of_view(fov_rad):
    """Eq. 2."""
    remainder = math.fmod(2 * math.pi, fov_rad)
    if min(remainder, fov_rad - remainder) < 1e-6:
        return fov_rad
    return 2 * math.pi / round(round(2 * math.pi / fov_rad, 9))  # halves of whole degrees are halves


def soft_mask(discrete, epsilon):
    """Eq. 4."""
    return discrete * (1 - epsilon) + epsilon


def out_of_bounds_loss(place_m, low_m, high_m):
    """Eqs. 5 and 6."""
    total = 0.0
    for place in place_m:
        for axis in range(2):
            total += math.exp(max(low_m[axis] - place[axis], 0.0)) - 1
            total += math.exp(max(place[axis] - high_m[axis], 0.0)) - 1
    return total


def camera_distancing_loss(centre_m, min_distance_m):
    """Eqs. 7 to 9."""
    losses = []
    for a, b in itertools.combinations(centre_m, 2):
        distance = math.sqrt(sum((p - q) ** 2 for p, q in zip(a, b, strict=True)))
        losses.append(0.0 if distance >= min_distance_m else abs(distance - min_distance_m) / min_distance_m)
    return sum(losses) / math.comb(len(centre_m), 2)


def in_frame_bearing(orientation_rad, fov_rad, column_px, width_px):
    """Eq. 10, sign for left-positive yaw."""
    return orientation_rad - fov_rad * (column_px / width_px - 0.5)


def rotational_difference(bearing_rad, orientation_rad):
    """Eq. 11; both angles are first brought into [0, 2 pi), as the equation assumes."""
    apart = abs(bearing_rad % (2 * math.pi) - orientation_rad % (2 * math.pi))
    return min(apart, 2 * math.pi - apart)


def in_frame_rotation_loss(vehicles, epsilon):
    """Eqs. 12 and 13 over (left bearing, right bearing, camera yaw, visible); None: never seen, counts 1."""
    losses = []
    for item in vehicles:
        if item is None:
            losses.append(1.0)
            continue
        left, right, yaw, visible = item
        least = min(rotational_difference(left, yaw), rotational_difference(right, yaw))
        losses.append(least * (epsilon if visible else 1.0) / math.pi)
    return sum(losses) / len(losses)


def merged_bearings(area, left_column, right_column, *, yaw_rad, fov_rad, width_px):
    """Bearings of the left and right end of one vehicle from its silhouettes in all rotational additions.

    The columns of all views form a circle (view a + 1 lies to the left of view a). The ends are those of the run of
    neighbouring views with something in them that holds the view with the largest silhouette: its first column, and
    one past its last. None: nothing seen.
    """
    count = len(area)
    step = 2 * math.pi / count
    if max(area) == 0:
        return None
    leftmost = rightmost = int(np.argmax(area))
    while leftmost - rightmost < count - 1 and area[(leftmost + 1) % count]:
        leftmost += 1
    while leftmost - rightmost < count - 1 and area[(rightmost - 1) % count]:
        rightmost -= 1
    return (
        in_frame_bearing(yaw_rad + leftmost * step, fov_rad, left_column[leftmost % count], width_px),
        in_frame_bearing(yaw_rad + rightmost * step, fov_rad, right_column[rightmost % count], width_px),
    )


def short_of(visibility, min_visibility):
    """Eqs. 15 and 18, of one vehicle."""
    short = min_visibility - visibility
    return 0.0 if short < 0 else abs(short) / min_visibility


def detected_area_loss(vehicles, min_visibility, epsilon):
    """Eqs. 4 and 14 to 16 over (non-occluded silhouettes [rotation, row, column], box mask of rotation 0 or None).

    A box of None is an undetected vehicle; a vehicle without any pixel counts 1.
    """
    losses = []
    for silhouettes, box_mask in vehicles:
        whole = silhouettes.sum()
        if whole == 0:
            losses.append(1.0)
            continue
        box = np.zeros(silhouettes[0].shape) if box_mask is None else box_mask.astype(float)
        detected = (silhouettes[0] * soft_mask(box, epsilon)).sum()
        lost = whole - detected
        losses.append(short_of((whole - lost) / whole, min_visibility))
    return sum(losses) / len(losses)


def surface_blockage_loss(vehicles, min_visibility):
    """Eqs. 17 to 19 over (silhouettes of the vehicle alone, of the ego vehicle), each [camera, row, column].

    A vehicle in no camera's frame counts 1.
    """
    losses = []
    for alone, ego in vehicles:
        visibilities = []
        for i in range(len(alone)):
            both = alone[i] | ego[i]
            if alone[i].any():
                visibilities.append((both.sum() - ego[i].sum()) / alone[i].sum())
        losses.append(short_of(max(visibilities), min_visibility) if visibilities else 1.0)
    return sum(losses) / len(losses)


def angular_coverage_loss(yaw_rad, fov_rad):
    """Eqs. 20 to 23 by the steps of the text: sort, start from 0, split at 2 pi, add what is new of each range."""
    most = min(len(yaw_rad) * fov_rad, 2 * math.pi)
    if most - fov_rad < 1e-9:
        return 0.0
    starts = sorted((yaw - fov_rad / 2) % (2 * math.pi) for yaw in yaw_rad)
    ranges = []
    for start in (start - starts[0] for start in starts):
        end = start + fov_rad
        ranges += [(start, end)] if end <= 2 * math.pi else [(start, 2 * math.pi), (0.0, end - 2 * math.pi)]
    union, reached = 0.0, 0.0
    for start, end in sorted(ranges):
        union += max(end - max(start, reached), 0.0)
        reached = max(reached, end)
    return (most - union) / (most - fov_rad)


class AdamW:
    """Loshchilov and Hutter, algorithm 2, in double precision."""

    def __init__(self, value, *, weight_decay, beta1=0.9, beta2=0.999, epsilon=1e-8):
        self.value = np.asarray(value, float).copy()
        self.first, self.second, self.count = np.zeros_like(self.value), np.zeros_like(self.value), 0
        self.weight_decay, self.beta1, self.beta2, self.epsilon = weight_decay, beta1, beta2, epsilon

    def step(self, gradient, rate):
        """One step; a negative rate ascends and still decays."""
        self.count += 1
        self.first = self.beta1 * self.first + (1 - self.beta1) * gradient
        self.second = self.beta2 * self.second + (1 - self.beta2) * gradient**2
        first = self.first / (1 - self.beta1**self.count)
        second = self.second / (1 - self.beta2**self.count)
        self.value -= np.abs(rate) * self.weight_decay * self.value
        self.value -= rate * first / (np.sqrt(second) + self.epsilon)
