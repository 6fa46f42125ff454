"""The byte layout of C3D files: header, parameters, and the three byte orders.

The layout is that of "The C3D file format user guide" (Motion Lab Systems) and of https://www.c3d.org: blocks of 512
bytes; a header block; a section of groups of parameters; then the frames, with the points and the analogue samples of
each. Numbers are those of Intel, DEC (VAX) or SGI (MIPS) processors.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np
from jaxtyping import Float

BLOCK_BYTES = 512
#: Second byte of every C3D file.
_KEY = 80
#: Values of a parameter by its type: characters, bytes, 16-bit integers, reals.
_ITEM_BYTES = {-1: 1, 1: 1, 2: 2, 4: 4}


class Processor(IntEnum):
    """Processor that wrote a file, by its code in the section of parameters: the byte order of all numbers."""

    INTEL = 84
    DEC = 85
    SGI = 86

    @property
    def order(self) -> str:
        """Byte order of integers, as NumPy writes it."""
        return ">" if self is Processor.SGI else "<"

    def reals(self, data: bytes | memoryview) -> Float[np.ndarray, "values"]:
        """Numbers from 32-bit reals; a whole number of them."""
        if self is not Processor.DEC:
            # A number that is a signalling NaN makes NumPy warn.
            with np.errstate(invalid="ignore"):
                return np.frombuffer(data, f"{self.order}f4").astype(float)
        # A VAX real has its 16-bit words in the other order, and an exponent that is larger by 2.
        words = np.frombuffer(data, "<u2").reshape(-1, 2).astype(np.uint32)
        bits = words[:, 0] << 16 | words[:, 1]
        # A VAX real with the exponent 0 is zero, where IEEE's would be a very small number.
        with np.errstate(invalid="ignore"):
            return np.where(bits & 0x7F800000, bits.view(np.float32).astype(float) / 4, 0.0)


@dataclass(frozen=True)
class Header:
    """Header of a file, as far as points need it.

    Attributes:
        num_points: points per frame.
        num_analog: analogue samples per frame of points.
        first_frame: number of the first frame, from 1 on; above 1 where frames were cut off.
        num_frames: number of frames.
        scale: length units per unit of an integer coordinate; below 0 if coordinates are reals.
        data_block: number of the first block of frames, 1 for the block of the header.
        samples_per_frame: samples of each analogue channel per frame of points.
        rate_hz: frames per second.
    """

    num_points: int
    num_analog: int
    first_frame: int
    num_frames: int
    scale: float
    data_block: int
    samples_per_frame: int
    rate_hz: float


@dataclass(frozen=True)
class Parameters:
    """Parameters of a file by `GROUP:NAME`, in upper case: lists of texts, or arrays of numbers."""

    values: Mapping[str, Any]

    def texts(self, name: str) -> list[str]:
        """Texts of a parameter without spaces around them; none if it is absent or holds numbers."""
        values = self.values.get(name, [])
        return [text.strip() for text in values] if isinstance(values, list) else []

    def number(self, name: str) -> float | None:
        """First number of a parameter; None if it is absent, empty or holds texts."""
        values = self.values.get(name)
        if values is None or isinstance(values, list) or not values.size:
            return None
        return float(values.flat[0])

    def count(self, name: str) -> int | None:
        """First number of a parameter as a count, whose 16 bits have no sign; None if it is not known."""
        number = self.number(name)
        if number is None or not math.isfinite(number):
            return None
        return int(number) + 2**16 if -(2**15) <= number < 0 else int(number)


def read_layout(content: bytes) -> tuple[Processor, Header, Parameters]:
    """Processor, header and parameters of a file.

    Args:
        content: the file, at least as far as its first frame.

    Raises:
        ValueError: the content is not that of a C3D file, or its parameters are damaged; the message is a noun phrase
            for what was found.
    """
    if not content:
        raise ValueError("an empty file")
    if len(content) < BLOCK_BYTES or content[1] != _KEY or not content[0]:
        raise ValueError("no valid c3d file")
    start = (content[0] - 1) * BLOCK_BYTES
    if len(content) < start + BLOCK_BYTES:
        raise ValueError("a file that is cut short in its parameters: copy it again")
    if content[start + 3] not in set(Processor):
        raise ValueError(f"the code {content[start + 3]} for the processor, which is none of 84, 85 and 86")
    processor = Processor(content[start + 3])
    header = _read_header(content, processor)
    end = start + BLOCK_BYTES * content[start + 2]
    # The number of blocks has one byte, and may be wrong: the parameters end where the frames begin.
    first_frame = (header.data_block - 1) * BLOCK_BYTES
    end = max(end, first_frame if first_frame > start else end)
    return processor, header, Parameters(_read_parameters(content[start:end], processor))


def _read_header(content: bytes, processor: Processor) -> Header:
    order = processor.order
    num_points, num_analog, first, last = struct.unpack_from(f"{order}4H", content, 2)
    data_block, samples_per_frame = struct.unpack_from(f"{order}2H", content, 16)
    return Header(
        num_points=num_points,
        num_analog=num_analog,
        first_frame=first,
        num_frames=max(0, last - first + 1),
        scale=float(processor.reals(content[12:16])[0]),
        data_block=data_block,
        samples_per_frame=samples_per_frame,
        rate_hz=float(processor.reals(content[20:24])[0]),
    )


def _read_parameters(section: bytes, processor: Processor) -> dict[str, Any]:
    """Values by `GROUP:NAME`; the first of two parameters with one name counts."""
    groups: dict[int, str] = {}
    found: list[tuple[int, str, Any]] = []
    position = 4
    while position + 4 <= len(section):
        name_length, group = struct.unpack_from("<2b", section, position)
        if name_length == 0 or group == 0:
            break
        after_name = position + 2 + abs(name_length)
        name = _text(section[position + 2 : after_name]).strip().upper()
        if after_name + 2 > len(section) or not name.isprintable():
            raise ValueError(f"parameters that are damaged at byte {position} of their section")
        offset = struct.unpack_from(f"{processor.order}H", section, after_name)[0]
        if group < 0:
            groups.setdefault(-group, name)
        else:
            found.append((group, name, _read_value(section, after_name + 2, processor, name)))
        if offset == 0:
            break
        position = after_name + offset
    if not found and any(section[4:]):
        raise ValueError("parameters that are damaged: none can be read")
    values: dict[str, Any] = {}
    for group, name, value in found:
        values.setdefault(f"{groups.get(group, group)}:{name}", value)
    return values


def _read_value(section: bytes, position: int, processor: Processor, name: str) -> Any:
    """A list of texts, or an array of numbers whose last dimension is the first one of the file."""
    damaged = ValueError(f"parameters that are damaged: {name} has no values")
    if position + 2 > len(section):
        raise damaged
    kind, num_dims = struct.unpack_from("<bB", section, position)
    shape = list(section[position + 2 : position + 2 + num_dims])
    start = position + 2 + num_dims
    if kind not in _ITEM_BYTES or len(shape) < num_dims:
        raise damaged
    data = section[start : start + _ITEM_BYTES[kind] * math.prod(shape)]
    if len(data) < _ITEM_BYTES[kind] * math.prod(shape):
        raise damaged
    if kind == -1:
        length = shape[0] if shape else 1
        return [_text(data[at : at + length]) for at in range(0, len(data), length)] if length else []
    integers = f"{processor.order}i{kind}"
    numbers = processor.reals(data) if kind == 4 else np.frombuffer(data, integers).astype(float)
    return numbers.reshape(shape[::-1])


def _text(data: bytes) -> str:
    data = data.replace(b"\0", b" ")
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError:
        return data.decode("latin-1")
