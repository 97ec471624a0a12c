"""YOLOX, whose boxes belong to the cells of grids."""

from __future__ import annotations

import functools
from typing import ClassVar

import numpy as np

from warpav.detection.families.family import (
    GREY,
    Candidates,
    ImagePlacement,
    NetworkFile,
    ScoredFamily,
    edges_of,
    single_output_shape,
)


class Yolox(ScoredFamily):
    """YOLOX as its exporter leaves it by default: offsets from the cells of three (four) grids."""

    name = "yolox"
    layout = "one output [batch, cells of all grids, 5 + classes] with offsets from the cells"
    placement = ImagePlacement.TOP_LEFT
    is_bgr = True
    white = 255.0
    _decodes: ClassVar[bool] = False

    @classmethod
    def fits(cls, file: NetworkFile) -> bool:
        shape = single_output_shape(file)
        if shape is None or shape[2] is None or shape[2] < 6:
            return False
        if file.labels is not None and shape[2] != 5 + len(file.labels):
            return False
        return file.size_px is None or shape[1] is None or _grid(*file.size_px, shape[1]) is not None

    @classmethod
    def evidence(cls, file: NetworkFile) -> str | None:
        shape = single_output_shape(file)
        assert shape is not None
        if file.is_from_ultralytics or (shape[2] == 6 and (file.size_px is None or shape[1] is None)):
            return None
        if file.labels is None and shape[2] != 85:
            return None
        if cls._decodes != _gives_pixels(file):
            return None
        numbers = f"{shape[2]} numbers for every cell: a box, objectness and {(shape[2] or 0) - 5} classes"
        return f"{numbers}; on a grey image its boxes {'follow the cells' if cls._decodes else 'are offsets'}"

    @property
    def class_count(self) -> int | None:
        return (self.file.outputs[0].shape[2] or 5) - 5

    def decode(
        self, outputs: tuple[np.ndarray, ...], size_px: tuple[int, int], classes: np.ndarray, confidence_min: float
    ) -> Candidates:
        raw = outputs[0]
        label_count = len(self.file.labels or ())
        grid = _grid(*size_px, len(raw)) if raw.ndim == 2 and raw.shape[1] == 5 + label_count else None
        if grid is None:
            raise self._came(0, raw, f"a row of 5 + {label_count} labels for every cell of {size_px} px")
        score = raw[:, 5 + classes] * raw[:, 4:5]
        candidate, confidence, class_index = self._best(score.T, classes, confidence_min)
        box = raw[candidate, :4]
        if not self._decodes:
            cell, stride_px = grid[0][candidate], grid[1][candidate, None]
            with np.errstate(over="ignore"):  # an endless box is cut off at the image's border
                box = np.concatenate([(box[:, :2] + cell) * stride_px, np.exp(box[:, 2:]) * stride_px], axis=1)
        return Candidates(edges_of(box), confidence, class_index)


class YoloxDecoded(Yolox):
    """YOLOX exported with ``--decode_in_inference``: boxes in pixels of the input."""

    name = "yolox-decoded"
    layout = "one output [batch, cells of all grids, 5 + classes] with boxes in pixels"
    _decodes = True


@functools.lru_cache(maxsize=16)
def _grid(rows_px: int, columns_px: int, count: int) -> tuple[np.ndarray, np.ndarray] | None:
    """Column and row of every cell of YOLOX's grids [cell, 2] and their strides [px]; None: not so many cells."""
    for strides in ((8, 16, 32), (8, 16, 32, 64)):
        shapes = [(rows_px // stride, columns_px // stride) for stride in strides]
        if sum(rows * columns for rows, columns in shapes) == count:
            cells = [np.indices(shape).reshape(2, -1)[::-1].T for shape in shapes]
            stride_px = [np.full(len(cell), stride) for cell, stride in zip(cells, strides, strict=True)]
            return np.concatenate(cells).astype(np.float32), np.concatenate(stride_px).astype(np.float32)
    return None


def _gives_pixels(file: NetworkFile) -> bool | None:
    """Whether box centres follow the cells on a grey image, or are offsets; None: not as many boxes as cells."""
    assert file.image is not None
    size_px = file.size_px or (256, 256)
    grey = np.full((file.image.shape[0] or 1, 3, *size_px), GREY, file.image.dtype)
    centre = file.run({file.image.name: grey})[0][0]
    grid = _grid(*size_px, len(centre))
    if grid is None:
        return None
    place_px = (grid[0] + 0.5) * grid[1][:, None]
    centre = centre[:, :2].astype(np.float64)
    if not np.isfinite(centre).all() or (centre.std(axis=0) == 0.0).any():
        return False
    return all(np.corrcoef(centre[:, axis], place_px[:, axis])[0, 1] > 0.8 for axis in (0, 1))
