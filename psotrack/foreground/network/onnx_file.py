"""A trained network as an ONNX file, for `psotrack detect` and for other programs.

The file sees one image, without a background, as YOLO networks do: RGB in [0, 1]. Its output has the layout "v8" of
`psotrack.foreground.detection`: for each cell the middle and size of a box in pixels, and the confidence.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from psotrack.errors import SettingsError
from psotrack.foreground.network.network import (
    CELL_PX,
    LOG_SIZE,
    MULTIPLE,
    Conv,
    Network,
)
from psotrack.support import atomic_write

#: Version of ONNX's operators, which OpenCV and ONNX Runtime know.
_OPSET = 17


def write_onnx(path: Path, network: Network, size: int) -> None:
    """Write a network for square images of a size.

    Args:
        path: path of the file.
        network: the network.
        size: height and width of the images, pixels; a multiple of 8.

    Raises:
        SettingsError: the package onnx is missing, or the size is no multiple of 8.
        OutputError: the file cannot be written.
    """
    if size < MULTIPLE or size % MULTIPLE:
        raise SettingsError("--size", expected=f"a multiple of {MULTIPLE}", found=f"{size}")
    try:
        import onnx
    except ImportError as error:
        expected, remedy = "the package onnx", "pip install 'psotrack[onnx]'"
        raise SettingsError("ONNX files", expected=expected, found="none", remedy=remedy) from error
    graph = _Graph()
    half = graph.conv(graph.add("Sub", graph.add("Mul", "images", 2.0), 1.0), network.enter, bgr_to_rgb=True)
    quarter = graph.conv(half, network.down[0])
    quarter = graph.add("Add", quarter, graph.conv(quarter, network.middle))
    eighth = graph.conv(quarter, network.down[1])
    for conv in network.around:
        eighth = graph.add("Add", eighth, graph.conv(eighth, conv))
    up = graph.doubled(graph.conv(eighth, network.up[0], relu=False))
    quarter = graph.conv(graph.add("Add", quarter, up), network.joined[0])
    up = graph.doubled(graph.conv(quarter, network.up[1], relu=False))
    half = graph.conv(graph.add("Add", half, up), network.joined[1])
    heads = graph.conv(half, network.heads, relu=False)
    rows = size // CELL_PX
    told = graph.add("Reshape", heads, np.array([1, CELL_PX**2 + 5, rows * rows]))
    first = CELL_PX**2
    score = graph.add("Sigmoid", graph.part(told, first, first + 1))
    place = np.stack(np.meshgrid(np.arange(rows), np.arange(rows))).reshape(1, 2, -1) + 0.5
    middle = graph.add("Mul", graph.add("Add", graph.part(told, first + 1, first + 3), place), float(CELL_PX))
    log_half = graph.add("Clip", graph.part(told, first + 3, first + 5), *map(float, LOG_SIZE))
    whole = graph.add("Mul", graph.add("Exp", log_half), 2.0 * CELL_PX)
    boxes = graph.add("Concat", middle, whole, score, axis=1)
    model = graph.model(boxes, size, rows * rows)
    onnx.checker.check_model(model)
    with atomic_write(path) as temporary:
        temporary.write_bytes(model.SerializeToString())


class _Graph:
    """Nodes of an ONNX graph; a value is the name of what a node puts out."""

    def __init__(self) -> None:
        self._nodes: list[Any] = []
        self._constants: list[Any] = []

    def add(self, kind: str, *inputs: str | float | np.ndarray, **attributes: Any) -> str:
        """A node; inputs that are numbers become constants."""
        from onnx import helper, numpy_helper

        names = []
        for value in inputs:
            if isinstance(value, str):
                names.append(value)
                continue
            array = np.asarray(value)
            names.append(f"constant{len(self._constants)}")
            array = array if array.dtype.kind == "i" else array.astype(np.float32)
            self._constants.append(numpy_helper.from_array(array, names[-1]))
        out = f"value{len(self._nodes)}"
        self._nodes.append(helper.make_node(kind, names, [out], **attributes))
        return out

    def conv(self, images: str, conv: Conv, *, relu: bool = True, bgr_to_rgb: bool = False) -> str:
        """A convolution, and what is above 0 of it."""
        weight: Float[np.ndarray, "side side inputs outputs"] = np.asarray(conv.weight)
        if bgr_to_rgb:
            # Without a background the difference from it is 0, and its weights play no part.
            weight = weight[:, :, 2::-1]
        pads = conv.padding((0, 0))
        out = self.add(
            "Conv",
            images,
            weight.transpose(3, 2, 0, 1),
            np.asarray(conv.bias),
            kernel_shape=list(weight.shape[:2]),
            strides=[conv.stride] * 2,
            dilations=[conv.dilation] * 2,
            pads=[pads[0][0], pads[1][0], pads[0][1], pads[1][1]],
        )
        return self.add("Relu", out) if relu else out

    def doubled(self, images: str) -> str:
        """Images of twice the size."""
        scales = np.array([1, 1, 2, 2], np.float32)
        settings = {
            "mode": "nearest",
            "nearest_mode": "floor",
            "coordinate_transformation_mode": "asymmetric",
        }
        return self.add("Resize", images, "", scales, **settings)

    def part(self, values: str, start: int, stop: int) -> str:
        """Channels `start` to `stop`."""
        return self.add("Slice", values, np.array([start]), np.array([stop]), np.array([1]))

    def model(self, boxes: str, size: int, count: int) -> Any:
        """The whole, whose output is `boxes`."""
        from onnx import TensorProto, helper

        images = helper.make_tensor_value_info("images", TensorProto.FLOAT, [1, 3, size, size])
        found = helper.make_tensor_value_info(boxes, TensorProto.FLOAT, [1, 5, count])
        graph = helper.make_graph(self._nodes, "psotrack", [images], [found], self._constants)
        opset = [helper.make_opsetid("", _OPSET)]
        return helper.make_model(graph, opset_imports=opset, ir_version=8, producer_name="psotrack")
