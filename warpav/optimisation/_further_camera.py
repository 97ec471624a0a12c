"""Where one more camera would help most: what each camera of a pool would add to a rig.

A rig S is expected to miss the share f(S) of the objects, cameras erring independently; a camera c that joins it finds
some of what S leaves over::

    f(S) = mean over o of m_o,      m_o = product over i in S of (1 - p_io)
    f(S) - f(S + c) = mean over o of m_o p_co

Where objects have weights, the mean is weighted. The gain on the right is exact for the whole camera. It is also minus
the derivative by x_c of the objective with shares of cameras, the mean of the products of (1 - x_i p_io), at the rig:
the reduced cost of a column there, as `selection.price` has it for the bound.
"""

from __future__ import annotations

import html
from dataclasses import dataclass, fields

import numpy as np

from warpav.detection import further_gain, missed_probability
from warpav.optimisation._constraints import Constraints
from warpav.optimisation._mount import LOG_ZOOM, PITCH_RAD, YAW_RAD, CameraMount
from warpav.optimisation._pool_cache import pose_keys

PLACE_M = 0.2
"""Cameras that stand nearer to each other than this have one place."""
_SHOWN = 10
_COLUMNS = ("gain", "x [m]", "y [m]", "z [m]", "yaw [deg]", "pitch [deg]", "fov [deg]")


@dataclass(frozen=True, eq=False)
class FurtherCameras:
    """Cameras that could join a rig, the one that would help most first."""

    position_m: np.ndarray  # centres in the ego frame [m], float64 [camera, 3]
    yaw_rad: np.ndarray  # turn to the left about z [rad], float64 [camera]
    pitch_rad: np.ndarray  # nose down [rad], float64 [camera]
    fov_rad: np.ndarray  # horizontal field of view [rad], float64 [camera]
    # share of the objects that the rig with this one more camera is expected to find and the rig alone is not
    gain: np.ndarray

    def __len__(self) -> int:
        return len(self.gain)

    @property
    def direction(self) -> np.ndarray:
        """Where they look, unit vectors in the ego frame, float64 [camera, 3]."""
        level = np.cos(self.pitch_rad)
        return np.stack([level * np.cos(self.yaw_rad), level * np.sin(self.yaw_rad), -np.sin(self.pitch_rad)], axis=1)

    def best_places(self, apart_m: float = PLACE_M) -> np.ndarray:
        """The cameras that nobody better stands near to, the best first: their numbers, int [place]."""
        is_left, best = np.ones(len(self), bool), []
        while is_left.any():
            best.append(int(is_left.argmax()))
            is_left &= np.linalg.norm(self.position_m - self.position_m[best[-1]], axis=1) >= apart_m
            is_left[best[-1]] = False
        return np.array(best, int)

    def __getitem__(self, index: slice | np.ndarray) -> FurtherCameras:
        return FurtherCameras(*(getattr(self, each.name)[index] for each in fields(self)))

    def rows(self, count: int = _SHOWN) -> list[dict[str, float]]:
        """The first cameras as numbers by heading: ``gain`` of 100 objects, place [m], angles [deg]."""
        columns = (
            100.0 * self.gain,
            *self.position_m.T,
            np.degrees(self.yaw_rad),
            np.degrees(self.pitch_rad),
            np.degrees(self.fov_rad),
        )
        table = np.stack(columns, axis=1)[:count]
        return [dict(zip(_COLUMNS, map(float, row), strict=True)) for row in table]

    def __repr__(self) -> str:
        best = f", the best finds {100.0 * self.gain[0]:.2f} more of 100 objects" if len(self) else ""
        return f"FurtherCameras({len(self)}{best})"

    def __str__(self) -> str:
        """The first ten as a table of plain text."""
        lines = [[f"{value:.2f}" for value in row.values()] for row in self.rows()]
        width = [max(map(len, column)) for column in zip(_COLUMNS, *lines, strict=True)]
        return "\n".join("  ".join(text.rjust(width[k]) for k, text in enumerate(row)) for row in ([*_COLUMNS], *lines))

    def _repr_html_(self) -> str:
        heading = "".join(f"<th>{html.escape(name)}</th>" for name in _COLUMNS)
        lines = "".join(
            "<tr>" + "".join(f"<td>{value:.2f}</td>" for value in row.values()) + "</tr>" for row in self.rows()
        )
        return f"<table><tr>{heading}</tr>{lines}</table>"


def further_cameras(
    mount_pose: np.ndarray,
    detection_probability: np.ndarray,
    rig: np.ndarray,
    *,
    mount: CameraMount,
    constraints: Constraints,
    weight: np.ndarray | None = None,
) -> FurtherCameras:
    """What each camera of a pool would add to a rig of it, but for those too near to one of its cameras."""
    gain = further_gain(missed_probability(detection_probability[rig]), detection_probability, weight)
    position_m = mount.position_m(mount_pose)
    apart_m = np.linalg.norm(position_m[:, None] - position_m[rig], axis=2).min(axis=1)
    one_of_each = np.unique(pose_keys(mount_pose), return_index=True)[1]
    order = one_of_each[np.argsort(-gain[one_of_each], kind="stable")]
    order = order[apart_m[order] >= constraints.min_spacing_m]
    pose = np.asarray(mount_pose, np.float64)[order]
    module = mount.module_of(pose)
    return FurtherCameras(
        position_m[order],
        pose[:, YAW_RAD],
        pose[:, PITCH_RAD],
        np.array([mount.cameras[k].zoomed(zoom).fov_rad for k, zoom in zip(module, pose[:, LOG_ZOOM], strict=True)]),
        gain[order],
    )
