"""The trained network as an ONNX file, in the layout of an ultralytics export without suppression."""

from __future__ import annotations

import logging
import warnings
from pathlib import Path

import numpy as np
import torch

from warpav.detection.training import CLASS_NAMES
from warpav.detection.training.network import STRIDES_PX, ExportedNetwork, TownNetwork

OPSET = 17
MAX_ERROR = 1e-3

_logger = logging.getLogger(__name__)


def export_network(network: TownNetwork, path: Path) -> float:
    """Write the network as ONNX with dynamic batch and size, and compare the two.

    Args:
        network: The network; its mode and device are left as they are.
        path: Where to.

    Returns:
        The largest difference between PyTorch and onnxruntime, in pixels or score, relative to values above 1.

    Raises:
        RuntimeError: They differ by more than `MAX_ERROR`.
    """
    import onnx
    import onnxruntime

    copy = TownNetwork(network.class_count)
    copy.load_state_dict({name: value.detach().cpu() for name, value in network.state_dict().items()})
    exported = ExportedNetwork(copy).eval()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        torch.onnx.export(
            exported,
            (torch.zeros(2, 3, 64, 96),),
            str(path),
            input_names=["images"],
            output_names=["output0"],
            dynamic_axes={
                "images": {0: "batch", 2: "rows", 3: "columns"},
                "output0": {0: "batch", 2: "candidates"},
            },
            opset_version=OPSET,
            dynamo=False,
        )
    model = onnx.load(str(path))
    onnx.helper.set_model_props(
        model,
        {
            "description": "Road users in renders of warpav's town scenes",
            "author": "The warpav authors",
            "license": "Apache-2.0",
            "task": "detect",
            "stride": str(max(STRIDES_PX)),
            "names": str(dict(enumerate(CLASS_NAMES[: network.class_count]))),
        },
    )
    model.producer_name, model.producer_version = "warpav", ""
    onnx.save(model, str(path))

    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    error = 0.0
    for shape in ((1, 3, 256, 256), (3, 3, 160, 224)):
        images = np.random.default_rng(0).random(shape, np.float32)
        with torch.no_grad():
            expected = exported(torch.from_numpy(images)).numpy()
        got = session.run(None, {"images": images})[0]
        error = max(error, float((np.abs(got - expected) / np.maximum(np.abs(expected), 1.0)).max()))
    if not error < MAX_ERROR:
        raise RuntimeError(f"{path}: PyTorch and onnxruntime differ by {error:.2g}, at most {MAX_ERROR} is fine")
    _logger.info("%s: %.1f MB, differs from PyTorch by %.1g", path, path.stat().st_size / 1e6, error)
    return error
