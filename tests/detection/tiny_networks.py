"""Tiny ONNX networks of every layout, which compute their boxes from the image.

Two boxes depend on four numbers that a network reads off its input: the mean of the first channel in the upper left
corner, of the second channel everywhere, of the third in the lowest rows, and of the first everywhere, each divided by
what stands for white. Wrong colours, order, scale, place or padding move the boxes.
"""

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

SIDE_PX = 64
EDGE_PX = 8
BOX_BASE_PX = np.array([[4.0, 15.0, 28.0, 28.0], [40.0, 20.0, 60.0, 34.0]])
BOX_GAIN_PX = np.array([[8.0, 4.0, 10.0, 6.0], [0.0, 0.0, 0.0, 0.0]])
CONFIDENCE_BASE = np.array([0.5, 0.3])
CONFIDENCE_GAIN = np.array([0.4, 0.2])
CENTRE_AND_SIZE = np.array([[0.5, 0, -1, 0], [0, 0.5, 0, -1], [0.5, 0, 1, 0], [0, 0.5, 0, 1]])
CELL = (13, 70)  # of the grids of a 64 px input, one of 8 px and one of 16 px
STRIDES = (8, 16, 32)


def numbers_of(network_input):
    """The four numbers, of an input [image, 3, row, column] whose white is 1."""
    return np.stack(
        [
            network_input[:, 0, :EDGE_PX, :EDGE_PX].mean(axis=(1, 2)),
            network_input[:, 1].mean(axis=(1, 2)),
            network_input[:, 2, -EDGE_PX:].mean(axis=(1, 2)),
            network_input[:, 0].mean(axis=(1, 2)),
        ],
        axis=1,
    )


def boxes_of(numbers):
    """Edges [image, 2, 4] in pixels of the input and confidence [image, 2] that a network must give."""
    return BOX_BASE_PX + BOX_GAIN_PX * numbers[:, None], CONFIDENCE_BASE + CONFIDENCE_GAIN * numbers[:, 1:2]


def grid(side_px=SIDE_PX):
    """Column, row and stride of every cell of YOLOX, written out as loops."""
    return np.array(
        [
            (column, row, stride)
            for stride in STRIDES
            for row in range(side_px // stride)
            for column in range(side_px // stride)
        ],
        float,
    )


class Graph:
    """A graph that is written like an expression."""

    def __init__(self):
        self.nodes, self.constants = [], []

    def constant(self, value, dtype: type = np.float32):
        name = f"constant_{len(self.constants)}"
        self.constants.append(numpy_helper.from_array(np.asarray(value, dtype), name))
        return name

    def op(self, kind, *inputs, **attributes):
        name = f"{kind}_{len(self.nodes)}"
        names = [it if isinstance(it, str) else self.constant(it) for it in inputs]
        self.nodes.append(helper.make_node(kind, names, [name], **attributes))
        return name

    def whole(self, value):
        return self.constant(value, np.int64)

    def saved(self, path, inputs, outputs, metadata):
        """Write it; outputs by name are what they are called inside, number type and shape."""
        for name, (value, dtype, _) in outputs.items():
            self.nodes.append(helper.make_node("Cast", [value], [name], to=dtype))
        ends = [(name, dtype, shape) for name, (_, dtype, shape) in outputs.items()]
        ends = [[helper.make_tensor_value_info(*each) for each in some] for some in (inputs, ends)]
        graph = helper.make_graph(self.nodes, "tiny", *ends, self.constants)
        model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
        helper.set_model_props(model, metadata)
        onnx.save(model, str(path))
        return path


def _features(graph, image, white, has_batch):
    """Edges [b, 2, 4] and confidence [b, 2]."""
    op, whole = graph.op, graph.whole
    image = op("Cast", image, to=TensorProto.FLOAT)
    if not has_batch:
        image = op("Unsqueeze", image, whole([0]))
    image = op("Div", image, white)
    last = 2**31
    windows = [
        ((0, 0, 0), (1, EDGE_PX, EDGE_PX)),
        ((1, 0, 0), (2, last, last)),
        ((2, -EDGE_PX, 0), (3, last, last)),
        ((0, 0, 0), (1, last, last)),
    ]
    means = [
        op("ReduceMean", op("Slice", image, whole(start), whole(stop), whole([1, 2, 3])), axes=[1, 2, 3], keepdims=0)
        for start, stop in windows
    ]
    numbers = op("Concat", *(op("Unsqueeze", mean, whole([1])) for mean in means), axis=1)
    edges = op("Add", op("Mul", op("Unsqueeze", numbers, whole([1])), BOX_GAIN_PX), BOX_BASE_PX)
    green = op("Slice", numbers, whole([1]), whole([2]), whole([1]))
    return edges, op("Add", op("Mul", green, CONFIDENCE_GAIN), CONFIDENCE_BASE)


def _yolox(graph, edges, confidence, classes, class_count, decoded, boxes):
    op, whole = graph.op, graph.whole
    cells = np.tile(grid(), (boxes, 1))
    place = np.eye(len(cells))[:, list(CELL)]
    box = op("MatMul", edges, CENTRE_AND_SIZE)
    if not decoded:
        centre = op("Slice", box, whole([0]), whole([2]), whole([2]))
        size = op("Slice", box, whole([2]), whole([4]), whole([2]))
        stride = cells[list(CELL), 2:]
        centre = op("Sub", op("Div", centre, stride), cells[list(CELL), :2])
        box = op("Concat", centre, op("Log", op("Div", size, stride)), axis=2)
    # objectness .8, so that a reader who leaves it out is found out
    score = op("Mul", op("Unsqueeze", confidence, whole([2])), np.eye(class_count)[classes] / 0.8)
    objectness = op("Add", op("Mul", op("Unsqueeze", confidence, whole([2])), 0.0), 0.8)
    rows = op("MatMul", place, op("Concat", box, objectness, score, axis=2))
    rest = np.zeros((len(cells), 5 + class_count))
    if decoded:
        rest[:, :2] = (cells[:, :2] + 0.5) * cells[:, 2:]
        rest[:, 2:4] = cells[:, 2:]
        rest[list(CELL)] = 0.0
    return op("Add", rows, rest)


def write_network(
    path,
    layout,
    *,
    classes=(0, 1),
    class_count=3,
    metadata=None,
    batch=None,
    size_px=SIDE_PX,
    has_batch=True,
    order=("boxes", "labels", "scores"),
    transposed=False,
    poison=None,
    add_output=False,
    symbolic=False,
    images_max=None,
):
    """Write a network; `classes` are those of its two boxes, `poison` replaces the first edge of the first box.

    ``symbolic`` leaves every side of the first output open; images behind the first ``images_max`` find nothing.
    """
    graph = Graph()
    op, whole = graph.op, graph.whole
    kind = TensorProto.FLOAT
    white = 255.0 if layout.startswith("yolox") else 1.0
    edges, confidence = _features(graph, "images", white, has_batch)
    if poison is not None:
        edges = op("Add", edges, np.array([poison, 0.0, 0.0, 0.0]))
    column = op("Unsqueeze", confidence, whole([2]))
    label = op("Add", op("Mul", column, 0.0), np.array(classes, float).reshape(1, 2, 1))
    inputs = [("images", kind, ([batch or "batch"] if has_batch else []) + [3, size_px or "h", size_px or "w"])]
    axis = [batch or "batch"] if has_batch else []
    outputs = {}
    if layout == "ultralytics":
        score = op("Mul", column, np.eye(class_count)[list(classes)])
        rows = op("Concat", op("MatMul", edges, CENTRE_AND_SIZE), score, axis=2)
        rows = rows if transposed else op("Transpose", rows, perm=[0, 2, 1])
        shape = ["n", 4 + class_count] if transposed else [4 + class_count, "n"]
        outputs["output0"] = (rows, kind, [*axis, *shape])
    elif layout in ("ultralytics-end2end", "rtdetr-single"):
        outputs["output0"] = (op("Concat", edges, column, label, axis=2), kind, [*axis, 2, 6])
    elif layout == "ultralytics-rtdetr":
        box = op("Div", op("MatMul", edges, CENTRE_AND_SIZE), np.full(4, SIDE_PX))
        outputs["output0"] = (op("Concat", box, column, label, axis=2), kind, [*axis, 2, 6])
    elif layout.startswith("yolo"):
        boxes = 3 if layout == "yolov5" else 1
        rows = _yolox(graph, edges, confidence, list(classes), class_count, layout != "yolox", boxes)
        outputs["output"] = (rows, kind, [*axis, boxes * len(grid()), 5 + class_count])
    else:
        numbers = op("Cast", op("Squeeze", label, whole([2])), to=TensorProto.INT64)
        if layout == "rtdetr":
            inputs.append(("orig_target_sizes", TensorProto.INT64, [batch or "batch", 2]))
            size = op("Cast", "orig_target_sizes", to=TensorProto.FLOAT)
            size = op("Unsqueeze", op("Concat", size, size, axis=1), whole([1]))
            edges = op("Mul", op("Div", edges, np.full(4, SIDE_PX)), size)
        found = {
            "boxes": (edges, kind, [4]),
            "labels": (numbers, TensorProto.INT64, []),
            "scores": (confidence, kind, []),
        }
        for name in order:
            value, dtype, rest = found[name]
            value = value if has_batch else op("Squeeze", value, whole([0]))
            # torchvision's exporter leaves outputs without a name that means anything
            outputs[name if layout == "rtdetr" else f"tensor_{name[::-1]}"] = (value, dtype, [*axis, "n", *rest])
    if images_max is not None:
        name, (value, *rest) = next(iter(outputs.items()))
        ends = ([0], [images_max], [2**31])
        kept, others = (op("Slice", value, *map(whole, (*each, [0]))) for each in (ends[:2], ends[1:]))
        outputs[name] = (op("Concat", kept, op("Mul", others, 0.0), axis=0), *rest)
    if symbolic:
        name, (value, dtype, shape) = next(iter(outputs.items()))
        outputs[name] = (value, dtype, [f"side_{k}" for k in range(len(shape))])
    if add_output:
        outputs["extra"] = (op("Cast", edges, to=kind), kind, [*axis, 2, 4])
    return graph.saved(path, inputs, outputs, metadata or {})
