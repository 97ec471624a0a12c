"""Weights outside of an ONNX file come from its folder, or the file is not loaded."""

import numpy as np
import pytest

from warpav.core.errors import InputError
from warpav.detection import BUILTIN_MODEL_PATH, OnnxDetector
from warpav.detection._external_data import check_external_data

onnx = pytest.importorskip("onnx")
from onnx import TensorProto, helper, numpy_helper  # noqa: E402


def saved(path, location, *, inside):
    """A network whose weights lie in another file: of its graph, of a node's attribute, or of a function."""
    tensor = numpy_helper.from_array(np.ones((3, 3), np.float32), "w")
    tensor.ClearField("raw_data")
    tensor.data_location = TensorProto.EXTERNAL
    entry = tensor.external_data.add()
    entry.key, entry.value = "location", location
    constant = helper.make_node("Constant", [], ["w"], value=tensor)
    product = helper.make_node("MatMul", ["x", "w"], ["y"])
    values = [helper.make_tensor_value_info(name, TensorProto.FLOAT, [3, 3]) for name in "xy"]
    nodes = {"initializer": [product], "attribute": [constant, product]}.get(inside, [])
    functions = []
    if inside == "branch":
        branch = helper.make_graph([constant], "branch", [], [values[1]])
        nodes = [helper.make_node("If", ["x"], ["y"], then_branch=branch, else_branch=branch)]
    if inside == "function":
        functions = [helper.make_function("own", "f", ["x"], ["y"], [constant, product], [])]
        nodes = [helper.make_node("f", ["x"], ["y"], domain="own")]
    graph = helper.make_graph(nodes, "g", values[:1], values[1:], [tensor] if inside == "initializer" else [])
    onnx.save(helper.make_model(graph, functions=functions), str(path))
    return path


@pytest.mark.parametrize("inside", ["initializer", "attribute", "branch", "function"])
@pytest.mark.parametrize("location", ["../w.bin", "/etc/hostname", "a/../../w.bin", "..\\w.bin", ""])
def test_files_elsewhere_are_refused(tmp_path, inside, location):
    path = saved(tmp_path / "net.onnx", location, inside=inside)
    with pytest.raises(InputError, match=r"net\.onnx: expected weights in the file itself or beside it, got the file"):
        check_external_data(path)
    with pytest.raises(InputError, match="expected weights in the file itself or beside it"):
        OnnxDetector(path)


@pytest.mark.parametrize("inside", ["initializer", "attribute", "branch", "function"])
def test_files_beside_it_are_welcome(tmp_path, inside):
    check_external_data(saved(tmp_path / "net.onnx", "weights/w.bin", inside=inside))
    check_external_data(BUILTIN_MODEL_PATH)


@pytest.mark.parametrize("content", [b"", b"\x3a\xff\xff\xff\xff\x7f", b"\x3b", b"\xff" * 20, b"\x3a\x05a"])
def test_damaged_files_are_told(tmp_path, content):
    (tmp_path / "net.onnx").write_bytes(content)
    with pytest.raises(
        InputError, match=r"net\.onnx: not an ONNX file that onnxruntime can load: it is empty or damag"
    ):
        check_external_data(tmp_path / "net.onnx")
