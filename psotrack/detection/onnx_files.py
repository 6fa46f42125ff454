"""What an ONNX file says of other files, read from its bytes, before OpenCV reads the network.

A tensor may name a file with its numbers. OpenCV reads any such file, also one outside of the folder, and a digest of
the ONNX file says nothing about the numbers. The field numbers are those of onnx.proto; in Protobuf's wire format, a
field is a varint, 4 or 8 bytes, or bytes preceded by their length.
"""

from __future__ import annotations

#: Message -> field number -> message of the field. Only what leads to tensors is listed.
_MESSAGES = {
    "model": {7: "graph", 20: "training", 25: "function"},
    "training": {1: "graph", 2: "graph"},
    "function": {7: "node", 11: "attribute"},
    "graph": {1: "node", 5: "tensor", 15: "sparse"},
    "node": {5: "attribute"},
    "attribute": {5: "tensor", 6: "graph", 10: "tensor", 11: "graph", 22: "sparse", 23: "sparse"},
    "sparse": {1: "tensor", 2: "tensor"},
    "tensor": {},
}
#: Fields of a tensor: the place of its numbers in another file, and whether there is one.
_EXTERNAL = {13, 14}
_VARINT, _EIGHT, _BYTES, _FOUR = 0, 1, 2, 5
#: Deepest nesting of messages that Protobuf reads.
_DEEPEST = 100


def names_other_files(content: bytes) -> bool:
    """Whether a tensor of an ONNX model has its numbers in another file.

    Raises:
        ValueError: the content is not in Protobuf's wire format.
    """
    waiting = [("model", memoryview(content), 0)]
    while waiting:
        kind, data, depth = waiting.pop()
        if depth > _DEEPEST:
            raise ValueError("messages that are nested too deeply")
        at = 0
        while at < len(data):
            tag, at = _varint(data, at)
            number, wire = tag >> 3, tag & 7
            if kind == "tensor" and number in _EXTERNAL:
                return True
            length = {_EIGHT: 8, _FOUR: 4}.get(wire, 0)
            if wire in (_VARINT, _BYTES):
                value, at = _varint(data, at)
                length = value if wire == _BYTES else 0
            elif not length:
                raise ValueError(f"a field of the unknown kind {wire}")
            if at + length > len(data):
                raise ValueError("a field that is cut short")
            if wire == _BYTES and number in _MESSAGES[kind]:
                waiting.append((_MESSAGES[kind][number], data[at : at + length], depth + 1))
            at += length
    return False


def _varint(data: memoryview, at: int) -> tuple[int, int]:
    """A number of 7 bits per byte, the lowest first, and the place after it."""
    value = 0
    for shift in range(0, 70, 7):
        if at >= len(data):
            break
        byte = data[at]
        at += 1
        value |= (byte & 127) << shift
        if byte < 128:
            return value, at
    raise ValueError("a number that is cut short")
