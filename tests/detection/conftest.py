"""Tiny ONNX networks with the exact semantics of the layout, so that no test needs a trained file."""

import importlib.util

import numpy as np
import pytest

# Training and the detector gradient need PyTorch, which nothing else does.
collect_ignore = [] if importlib.util.find_spec("torch") else ["test_training.py", "test_differentiable.py"]

CELL_PX = 32


@pytest.fixture
def cell_network(tmp_path):
    """Writes a network that sees a box in every 32 px cell: class k's score is the cell's mean of colour channel k.

    ``write(names, batch, rows, columns)``; None leaves an axis dynamic. Returns the file's path.
    """
    onnx = pytest.importorskip("onnx")
    from onnx import TensorProto, helper, numpy_helper

    def write(names=("car", "person", "bus"), *, batch=None, rows=None, columns=None, metadata=None):
        count = len(names)
        weight = np.zeros((count, 3, CELL_PX, CELL_PX), np.float32)
        for k in range(count):
            weight[k, k % 3] = 1.0 / CELL_PX**2
        arrays = {
            "weight": weight,
            "nothing": np.zeros((1, 3, CELL_PX, CELL_PX), np.float32),
            "one": np.ones(1, np.float32),
            "row_axis": np.array(2, np.int64),
            "column_axis": np.array(3, np.int64),
            "size": np.array(CELL_PX, np.float32),
            "half": np.array(CELL_PX / 2, np.float32),
            "flat": np.array([0, 0, -1], np.int64),
        }
        node = helper.make_node
        stride = {"strides": [CELL_PX, CELL_PX]}
        nodes = [
            node("Conv", ["images", "weight"], ["score"], **stride),
            node("Conv", ["images", "nothing", "one"], ["ones"], **stride),
            node("CumSum", ["ones", "column_axis"], ["column"]),
            node("CumSum", ["ones", "row_axis"], ["row"]),
            node("Mul", ["column", "size"], ["right"]),
            node("Mul", ["row", "size"], ["bottom"]),
            node("Sub", ["right", "half"], ["center_x"]),
            node("Sub", ["bottom", "half"], ["center_y"]),
            node("Mul", ["ones", "size"], ["side"]),
            node("Concat", ["center_x", "center_y", "side", "side", "score"], ["map"], axis=1),
            node("Reshape", ["map", "flat"], ["output0"]),
        ]
        cells = None if rows is None or columns is None else rows * columns // CELL_PX**2
        graph = helper.make_graph(
            nodes,
            "cells",
            [
                helper.make_tensor_value_info(
                    "images", TensorProto.FLOAT, [batch or "batch", 3, rows or "h", columns or "w"]
                )
            ],
            [helper.make_tensor_value_info("output0", TensorProto.FLOAT, [batch or "batch", 4 + count, cells or "n"])],
            [numpy_helper.from_array(value, name) for name, value in arrays.items()],
        )
        model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
        helper.set_model_props(model, {"names": str(dict(enumerate(names)))} if metadata is None else metadata)
        path = tmp_path / f"cells_{batch}_{rows}_{columns}_{count}.onnx"
        onnx.save(model, str(path))
        return path

    return write
