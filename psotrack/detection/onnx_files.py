"""Names of the files that an ONNX model reads beside itself.

OpenCV follows such a name to any place: a model of a stranger could read a file of the user's as weights. The numbers
of the fields are those of onnx.proto3 of ONNX 1.16; the encoding is the wire format of Protocol Buffers.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from psotrack.errors import InputError

#: Kind of message -> number of a field -> kind of the message in the field, on the ways from a model to its tensors.
_FIELDS = {
    "model": {7: "graph", 20: "training", 25: "function"},
    "training": {1: "graph", 2: "graph"},
    "function": {7: "node", 11: "attribute"},
    "graph": {1: "node", 5: "tensor", 15: "sparse tensor"},
    "sparse tensor": {1: "tensor", 2: "tensor"},
    "node": {5: "attribute"},
    "attribute": {
        5: "tensor",
        6: "graph",
        10: "tensor",
        11: "graph",
        22: "sparse tensor",
        23: "sparse tensor",
    },
    "tensor": {13: "entry"},
}
#: Fields of an entry of a tensor that lies in another file.
_KEY, _VALUE = 1, 2
#: Wire types: a varint, eight bytes, bytes preceded by their length, and four bytes.
_VARINT, _EIGHT, _LENGTH, _FOUR = 0, 1, 2, 5
#: Largest number of bytes of a varint.
_LONGEST_VARINT = 10


def check_values_beside(model: Path) -> None:
    """Raise `InputError` for a model that cannot be read, or that reads a file outside of its own folder.

    Args:
        model: path of an ONNX file.

    Raises:
        InputError: the file is no ONNX model, or names a file that is in another folder or is a link.
    """
    try:
        names = _outside_files(model.read_bytes())
    except OSError as error:
        raise InputError(
            model, expected="an ONNX model", found=(error.strerror or str(error)).lower()
        ) from error
    except ValueError as error:
        raise InputError(
            model, expected="an ONNX model that OpenCV can read", found="a file of another format, or damaged"
        ) from error
    for name in sorted(names):
        if set(name) & set("/\\:\0") or name in {"", ".", ".."} or (model.parent / name).is_symlink():
            raise InputError(
                model,
                expected="an ONNX model that reads only files beside it",
                found=f"values in {name!r}",
                remedy="export the network as one file",
            )


def _outside_files(content: bytes) -> set[str]:
    """Names of the files with values of a model's tensors. Raises `ValueError` for what is no model."""
    names = set()
    # A list, not recursion: graphs may be nested as deep as the file is long.
    waiting = [("model", memoryview(content))]
    while waiting:
        kind, message = waiting.pop()
        if kind == "entry":
            texts = {number: bytes(value) for number, value in _fields_of(message)}
            if texts.get(_KEY) == b"location":
                names.add(texts.get(_VALUE, b"").decode())
            continue
        inner = _FIELDS[kind]
        waiting.extend((inner[number], value) for number, value in _fields_of(message) if number in inner)
    return names


def _fields_of(message: memoryview) -> Iterator[tuple[int, memoryview]]:
    """Numbers and bytes of a message's fields that are preceded by their length."""
    at = 0
    while at < len(message):
        tag, at = _varint(message, at)
        number, wire = tag >> 3, tag & 7
        if wire == _VARINT:
            _, at = _varint(message, at)
            continue
        if wire not in (_EIGHT, _LENGTH, _FOUR):
            raise ValueError(f"wire type {wire}")
        length, at = _varint(message, at) if wire == _LENGTH else (8 if wire == _EIGHT else 4, at)
        if at + length > len(message):
            raise ValueError("the file ends within a field")
        if wire == _LENGTH:
            yield number, message[at : at + length]
        at += length


def _varint(message: memoryview, at: int) -> tuple[int, int]:
    """Value of a varint, and the place behind it."""
    value = 0
    for index in range(min(_LONGEST_VARINT, len(message) - at)):
        byte = message[at + index]
        value |= (byte & 127) << (7 * index)
        if byte < 128:
            return value, at + index + 1
    raise ValueError("a number does not end")
