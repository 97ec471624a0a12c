"""What a rig is chosen from, and what the choice must satisfy."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse

from warpav.core.errors import ArgumentError

ROW_TOLERANCE = 1e-6
"""How far a row may be missed, per unit of its largest coefficient: what HiGHS allows itself."""


@dataclass(frozen=True, eq=False)
class Row:
    """A linear constraint on a rig: ``low <= sum of coefficient over its cameras <= high``.

    Attributes:
        name: What an error calls it.
        coefficient: Of every camera of the pool, float [camera].
        low: Least sum; -inf: none.
        high: Greatest sum; inf: none.
    """

    name: str
    coefficient: np.ndarray
    low: float = -math.inf
    high: float = math.inf


@dataclass(frozen=True, eq=False)
class SelectionProblem:
    """Single cameras, and the rigs that may be made of them. Its objects are those that some camera sees.

    Attributes:
        missed: Probability that a camera does not detect an object, float64 [object, camera].
        weight: Of the objects, float64 [object].
        unseen: Weight of the objects that no camera of the pool sees, 0..1.
        seen: Which of the objects some camera sees, as they were counted at first, int [object].
        every_weight: Of all objects, those that no camera sees among them, 1 in sum, float64 [every object].
        count: Number of cameras of a rig.
        required: Cameras that every rig has, int [required].
        conflict: Pairs that exclude each other, symmetric bool CSR [camera, camera].
        coefficient: Of the rows, divided by the largest of each, float64 [row, camera].
        low: Least sums of the rows, likewise, float64 [row].
        high: Greatest sums of the rows, likewise, float64 [row].
        row_scale: What the rows were divided by, > 0, float64 [row].
        row_name: Their names.
    """

    missed: np.ndarray
    weight: np.ndarray
    unseen: float
    seen: np.ndarray
    every_weight: np.ndarray
    count: int
    required: np.ndarray
    conflict: sparse.csr_array
    coefficient: np.ndarray
    low: np.ndarray
    high: np.ndarray
    row_scale: np.ndarray
    row_name: tuple[str, ...]

    @classmethod
    def create(
        cls,
        detection_probability: np.ndarray,
        count: int,
        *,
        conflict: np.ndarray | sparse.sparray | sparse.spmatrix | None,
        required: Sequence[int] | np.ndarray,
        rows: Sequence[Row],
        weight: np.ndarray | None,
    ) -> SelectionProblem:
        """The arguments of `select`, checked.

        Raises:
            ArgumentError: One of them cannot be used.
        """
        probability = np.asarray(detection_probability, np.float64)
        if probability.ndim != 2 or 0 in probability.shape:
            raise ArgumentError(
                "detection_probability", f"expected [camera, object], at least one of each, got {probability.shape}"
            )
        cameras, objects = probability.shape
        wrong = ~((probability >= 0.0) & (probability <= 1.0))  # NaN compares with nothing
        if wrong.any():
            camera, seen = np.argwhere(wrong)[0]
            raise ArgumentError(
                "detection_probability",
                f"expected probabilities 0..1, got {probability[camera, seen]:g} at camera {camera}, object {seen}",
            )
        if not probability.any():
            raise ArgumentError(
                "detection_probability",
                f"none of the {cameras} cameras sees any of the {objects} objects; check scenes, targets and poses",
            )
        if not 1 <= count <= cameras:
            raise ArgumentError("count", f"expected 1 to {cameras}, the cameras of the pool, got {count}")
        fixed = np.unique(np.asarray(required, np.int64))
        if len(fixed) != np.size(required) or (len(fixed) and not 0 <= fixed[0] <= fixed[-1] < cameras):
            raise ArgumentError("required", f"expected different cameras, 0..{cameras - 1}, got {list(required)}")
        if len(fixed) > count:
            raise ArgumentError("required", f"expected at most `count` = {count} cameras, got {len(fixed)}")
        share = _checked_weight(weight, objects)
        is_seen = probability.any(axis=0)
        coefficient, low, high, scale = _checked_rows(rows, cameras)
        return cls(
            missed=np.ascontiguousarray(1.0 - probability[:, is_seen].T),
            weight=share[is_seen],
            unseen=float(share[~is_seen].sum()),
            seen=np.flatnonzero(is_seen),
            every_weight=share,
            count=int(count),
            required=fixed,
            conflict=_checked_conflict(conflict, cameras),
            coefficient=coefficient,
            low=low,
            high=high,
            row_scale=scale,
            row_name=tuple(row.name for row in rows),
        )

    @property
    def camera_count(self) -> int:
        """Cameras of the pool."""
        return self.missed.shape[1]

    @property
    def object_count(self) -> int:
        """Objects that some camera of the pool sees."""
        return self.missed.shape[0]

    def excluded_by(self, camera: Sequence[int] | np.ndarray) -> np.ndarray:
        """Which cameras conflict with one of these, bool [camera]."""
        excluded = np.zeros(self.camera_count, bool)
        for each in camera:  # a slice of a sparse matrix would take many times as long
            excluded[self.conflict.indices[self.conflict.indptr[each] : self.conflict.indptr[each + 1]]] = True
        return excluded

    def whole_clique(self, clique: Sequence[int] | np.ndarray, allowed: np.ndarray) -> np.ndarray:
        """A clique of conflicting cameras with all that fit into it one after the other, bool [camera].

        Args:
            clique: Cameras that exclude each other, at least one.
            allowed: Which others may be added, bool [camera].
        """
        member = np.zeros(self.camera_count, bool)
        member[clique] = True
        common = allowed & (np.asarray(self.conflict[clique].sum(axis=0)).ravel() == len(clique))
        while common.any():
            camera = int(np.argmax(common))
            member[camera] = True
            neighbour = np.zeros(self.camera_count, bool)
            neighbour[self.conflict.indices[self.conflict.indptr[camera] : self.conflict.indptr[camera + 1]]] = True
            common &= neighbour
        return member

    def restricted(self, camera: np.ndarray) -> SelectionProblem:
        """The same problem without the other cameras; ``camera`` holds those required, int [kept], ascending."""
        return replace(
            self,
            missed=np.ascontiguousarray(self.missed[:, camera]),
            required=np.searchsorted(camera, self.required),
            conflict=self.conflict[camera][:, camera],
            coefficient=self.coefficient[:, camera],
        )

    def miss_rate(self, rig: np.ndarray) -> float:
        """Expected miss rate of a rig, 0..1; its cameras are int [camera]."""
        return self.unseen + float(self.weight @ np.prod(self.missed[:, rig], axis=1))

    def is_feasible(self, rig: np.ndarray) -> bool:
        """Whether a rig, int [camera], satisfies all constraints."""
        chosen = np.zeros(self.camera_count, bool)
        chosen[rig] = True
        if len(rig) != self.count or chosen.sum() != self.count or not chosen[self.required].all():
            return False
        total = self.coefficient @ chosen
        return bool(
            not self.conflict[rig][:, rig].nnz
            and (total >= self.low - ROW_TOLERANCE).all()
            and (total <= self.high + ROW_TOLERANCE).all()
        )


def _checked_weight(weight: np.ndarray | None, objects: int) -> np.ndarray:
    share = np.ones(objects) if weight is None else np.asarray(weight, np.float64)
    if share.shape != (objects,) or not (np.isfinite(share) & (share >= 0.0)).all() or not share.any():
        raise ArgumentError("weight", f"expected [{objects}] finite numbers >= 0, not all 0, got {share}")
    return share / share.sum()


def _checked_conflict(conflict: np.ndarray | sparse.sparray | sparse.spmatrix | None, cameras: int) -> sparse.csr_array:
    if conflict is None:
        return sparse.csr_array((cameras, cameras), dtype=bool)
    pairs = sparse.csr_array(conflict, dtype=bool)
    if pairs.shape != (cameras, cameras):
        raise ArgumentError("conflict", f"expected [{cameras}, {cameras}], got {pairs.shape}")
    pairs = sparse.csr_array(pairs + pairs.T)
    pairs.setdiag(False)  # no camera excludes itself
    pairs.eliminate_zeros()
    return pairs


def _checked_rows(rows: Sequence[Row], cameras: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Coefficients, bounds and scales."""
    coefficient = np.zeros((len(rows), cameras))
    for k, row in enumerate(rows):
        values = np.asarray(row.coefficient, np.float64)
        if values.shape != (cameras,) or not np.isfinite(values).all():
            raise ArgumentError("rows", f"{row.name}: expected [{cameras}] finite coefficients, got {values}")
        if math.isnan(row.low) or math.isnan(row.high):
            raise ArgumentError("rows", f"{row.name}: expected numbers as bounds, got {row.low} and {row.high}")
        coefficient[k] = values
    scale = np.abs(coefficient).max(axis=1, initial=0.0)
    scale[scale == 0.0] = 1.0
    low, high = (np.array([getattr(row, name) for row in rows], float) / scale for name in ("low", "high"))
    return coefficient / scale[:, None], low, high, scale
