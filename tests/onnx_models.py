"""Tiny ONNX networks, encoded by hand: a convolution finds bright squares, and the output has a layout of YOLO.

The field numbers are from onnx.proto. Protobuf's wire format has varints, and bytes preceded by their length.
"""

import numpy as np

_FLOAT, _INT64 = 1, 7
#: Side of the network's square boxes, and distance between neighbouring boxes, both in pixels of the input.
SIDE, STRIDE = 32, 8


def _varint(value: int) -> bytes:
    value &= 2**64 - 1
    out = b""
    while value > 127:
        out, value = out + bytes([value & 127 | 128]), value >> 7
    return out + bytes([value])


def _field(number: int, value) -> bytes:
    """Encode one field: an int as a varint, other values preceded by their length."""
    if isinstance(value, int):
        return _varint(number << 3) + _varint(value)
    content = value.encode() if isinstance(value, str) else value
    return _varint(number << 3 | 2) + _varint(len(content)) + content


def _message(*fields) -> bytes:
    return b"".join(_field(number, value) for number, value in fields)


def _tensor(name: str, values: np.ndarray) -> bytes:
    kind = _INT64 if values.dtype == np.int64 else _FLOAT
    dims = [(1, int(side)) for side in values.shape]
    return _message(*dims, (2, kind), (8, name), (9, values.tobytes()))


def _attribute(name: str, value) -> bytes:
    if isinstance(value, int):
        return _message((1, name), (3, value), (20, 2))
    return _message((1, name), *((8, item) for item in value), (20, 7))


def _node(kind: str, inputs: list[str], output: str, **attributes) -> bytes:
    return _message(
        *((1, name) for name in inputs),
        (2, output),
        (3, f"make_{output}"),
        (4, kind),
        *((5, _attribute(*item)) for item in attributes.items()),
    )


def _value(name: str, shape) -> bytes:
    sides = _message(*((1, _message((1, side))) for side in shape))
    return _message((1, name), (2, _message((1, _message((1, _FLOAT), (2, sides))))))


def model(nodes: list[bytes], tensors: dict[str, np.ndarray], input_shape, output_shape) -> bytes:
    """Encode a model whose input is called `images` and whose output is called `output`."""
    graph = _message(
        *((1, node) for node in nodes),
        (2, "tiny"),
        *((5, _tensor(*item)) for item in tensors.items()),
        (11, _value("images", input_shape)),
        (12, _value("output", output_shape)),
    )
    return _message((1, 8), (2, "tests"), (7, graph), (8, _message((1, ""), (2, 13))))


def bright_squares(layout: str, size: int) -> bytes:
    """Encode a network for images (1, 3, size, size) that gives each square box a score from its mean brightness.

    The score is sigmoid(40 (mean - 0.75)): 0.9999 for white, 0.5 if a quarter is black, 1e-13 for black.

    Args:
        layout: layout of the output: "v5", "v8", "v10" (the first 300 boxes only), "suppressed" (the same of class 0),
            "swapped" (class before score), "middles" (three classes), "shares" ("v8" in shares of the side), "oriented"
            ("v8" with angles), "yolox" (of an image BGR in [0, 255]), "logits" ("v8" without the sigmoid), or "none"
            (one that the detector does not know).
        size: side of the input image, pixels.
    """
    # The boxes of YOLOX may begin in each cell.
    beyond = SIDE - STRIDE if layout == "yolox" else 0
    cells = (size + beyond - SIDE) // STRIDE + 1
    n = cells * cells
    row, column = np.divmod(np.arange(n), cells)
    x0, y0 = STRIDE * column, STRIDE * row
    side = np.full(n, SIDE)
    middles = np.stack([x0 + SIDE / 2, y0 + SIDE / 2, side, side])
    corners = np.stack([x0, y0, x0 + SIDE, y0 + SIDE])
    tensors = {
        "kernel": np.full((1, 3, SIDE, SIDE), 40 / (3 * SIDE * SIDE), np.float32),
        "bias": np.array([-30.0], np.float32),
        "flat": np.array([1, 1, n], np.int64),
        "boxes": (corners if layout in ("v10", "suppressed", "swapped") else middles)[None].astype(
            np.float32
        ),
        "one": np.ones((1, 1, n), np.float32),
        "zero": np.zeros((1, 1, n), np.float32),
        "first": np.arange(300, dtype=np.int64),
        "class": np.arange(n, dtype=np.float32)[None, None] % 3,
        "angle": np.full((1, 1, n), -0.5, np.float32),
    }
    if layout == "shares":
        tensors["boxes"] /= size
    if layout == "yolox":
        tensors["kernel"] /= 255
        tensors["boxes"] = np.tile(np.float32([2, 2, np.log(4), np.log(4)])[:, None], n)[None]
        rest = (size // 16) ** 2 + (size // 32) ** 2
        tensors["rest"] = np.tile(np.float32([0, 0, -1, -1, 0, 1])[:, None], rest)[None]
    kernel_shape, strides, pads = [SIDE, SIDE], [STRIDE, STRIDE], [0, 0, beyond, beyond]
    nodes = [
        _node(
            "Conv",
            ["images", "kernel", "bias"],
            "sums",
            kernel_shape=kernel_shape,
            strides=strides,
            pads=pads,
        ),
        _node("Identity" if layout == "logits" else "Sigmoid", ["sums"], "map"),
        _node("Reshape", ["map", "flat"], "scores"),
    ]
    shape = (1, 3, size, size)
    if layout == "none":
        nodes.append(_node("Identity", ["map"], "output"))
        return model(nodes, tensors, shape, (1, 1, cells, cells))
    if layout in ("v8", "logits", "shares", "oriented"):
        # Two classes; the score of the first class is always 0.
        last = ["scores", "angle"] if layout == "oriented" else ["zero", "scores"]
        nodes.append(_node("Concat", ["boxes", *last], "output", axis=1))
        return model(nodes, tensors, shape, (1, 6, n))
    last = {"suppressed": ["scores", "zero"], "swapped": ["zero", "scores"], "middles": ["scores", "class"]}
    nodes.append(_node("Concat", ["boxes", *last.get(layout, ["scores", "one"])], "columns", axis=1))
    chosen = "columns"
    if layout == "v10":
        chosen, n = "chosen", 300
        nodes.append(_node("Gather", ["columns", "first"], chosen, axis=2))
    if layout == "yolox":
        chosen, n = "all", n + rest
        nodes.append(_node("Concat", ["columns", "rest"], chosen, axis=2))
    nodes.append(_node("Transpose", [chosen], "output", perm=[0, 2, 1]))
    return model(nodes, tensors, shape, (1, n, 6))
