"""Tiny ONNX networks with the exact semantics of the layout, so that no test needs a trained file."""

import importlib.util

import numpy as np
import pytest

# Training and the detector gradient need PyTorch, which nothing else does.
collect_ignore = [] if importlib.util.find_spec("torch") else ["test_training.py", "test_differentiable.py"]

CELL_PX = 32


@pytest.fixture
def one_thread():
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture
def cell_network(tmp_path):
    """Writes a network that sees a box in every 32 px cell: class k's score is the cell's mean of colour channel k.

    ``write(names, batch, rows, columns)``; None leaves an axis dynamic. Returns the file's path.
    """
    pytest.importorskip("onnx")
    from onnx import TensorProto

    from tests.detection.tiny_networks import Graph

    def write(names=("car", "person", "bus"), *, batch=None, rows=None, columns=None, metadata=None):
        count, graph = len(names), Graph()
        weight = np.zeros((count, 3, CELL_PX, CELL_PX), np.float32)
        weight[range(count), [k % 3 for k in range(count)]] = 1.0 / CELL_PX**2
        stride = {"strides": [CELL_PX, CELL_PX]}
        score = graph.op("Conv", "images", weight, **stride)
        ones = graph.op("Conv", "images", np.zeros((1, 3, CELL_PX, CELL_PX)), np.ones(1), **stride)
        last = [graph.op("CumSum", ones, graph.constant(axis, np.int64)) for axis in (3, 2)]
        middle = [graph.op("Sub", graph.op("Mul", each, CELL_PX), CELL_PX / 2) for each in last]
        side = graph.op("Mul", ones, CELL_PX)
        rows_of = graph.op("Concat", *middle, side, side, score, axis=1)
        found = graph.op("Reshape", rows_of, graph.whole([0, 0, -1]))
        cells = None if rows is None or columns is None else rows * columns // CELL_PX**2
        images = ("images", TensorProto.FLOAT, [batch or "batch", 3, rows or "h", columns or "w"])
        outputs = {"output0": (found, TensorProto.FLOAT, [batch or "batch", 4 + count, cells or "n"])}
        known = {"names": str(dict(enumerate(names)))} if metadata is None else metadata
        return graph.saved(tmp_path / f"cells_{batch}_{rows}_{columns}_{count}.onnx", [images], outputs, known)

    return write
