"""Width and height as the header of an image file states them, before anything is decoded.

OpenCV asks for the memory of up to 2^30 pixels that a header claims, whatever the size of the file. Sources: ITU T.81
(JPEG), PNG and TIFF 6.0 and BigTIFF, Microsoft's BITMAPINFOHEADER, RFC 9649 (WebP), Netpbm's manual (PNM).
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Mapping

#: First bytes of a PNG.
PNG = b"\x89PNG\r\n\x1a\n"
#: Space between two words of a PNM header, with comments.
_PNM_SPACE = rb"(?:\s|#[^\r\n]*)*"
_PNM = re.compile(rb"P[1-6]%s(\d{1,10})%s(\d{1,10})" % (_PNM_SPACE, _PNM_SPACE))
#: Second bytes of the markers of a JPEG that have no content: TEM, RST0 to RST7, SOI.
_JPEG_EMPTY = (0x01, *range(0xD0, 0xD9))
#: Second bytes of the markers of a JPEG's frame header, SOF0 to SOF15, among which DHT, JPG and DAC are not.
_JPEG_FRAME = set(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
#: Number of bytes of the types of whole numbers in a TIFF.
_TIFF_BYTES = {1: 1, 3: 2, 4: 4, 6: 1, 8: 2, 9: 4, 16: 8, 17: 8}


def claimed_size_wh(data: bytes) -> tuple[int, int] | None:
    """Width and height that the header of an image states; None for a file of another format or without a whole header.

    The formats are PNG, JPEG, BMP, TIFF, WebP and PNM.
    """
    for beginning, size_wh in _FORMATS.items():
        if data.startswith(beginning):
            try:
                return size_wh(data)
            except (struct.error, IndexError):
                return None
    return None


def _png(data: bytes) -> tuple[int, int]:
    return struct.unpack_from(">II", data, 16)


def _jpeg(data: bytes) -> tuple[int, int] | None:
    at = 0
    # Decoders skip what stands between two segments.
    while (at := data.find(b"\xff", at)) >= 0:
        kind = data[at + 1]
        if kind in _JPEG_FRAME:
            height, width = struct.unpack_from(">HH", data, at + 5)
            return width, height
        if kind == 0xFF:
            at += 1
        elif kind == 0 or kind in _JPEG_EMPTY:
            at += 2
        else:
            at += 2 + struct.unpack_from(">H", data, at + 2)[0]
    return None


def _bmp(data: bytes) -> tuple[int, int]:
    # The oldest header, of OS/2, has 12 bytes. A negative height is that of an image whose first row is the top.
    is_oldest = struct.unpack_from("<I", data, 14) == (12,)
    width, height = struct.unpack_from("<HH" if is_oldest else "<ii", data, 18)
    return abs(width), abs(height)


def _tiff(data: bytes) -> tuple[int, int]:
    order = "<" if data.startswith(b"II") else ">"
    is_big = struct.unpack_from(f"{order}H", data, 2) == (43,)
    (at,) = struct.unpack_from(f"{order}{'Q' if is_big else 'I'}", data, 8 if is_big else 4)
    (count,) = struct.unpack_from(f"{order}{'Q' if is_big else 'H'}", data, at)
    at += 8 if is_big else 2
    length = 20 if is_big else 12
    sides = {256: 0, 257: 0}
    for entry in range(at, min(at + min(count, 2**16) * length, len(data)), length):
        tag, kind = struct.unpack_from(f"{order}HH", data, entry)
        if tag in sides and kind in _TIFF_BYTES:
            value = data[entry + length - (8 if is_big else 4) :][: _TIFF_BYTES[kind]]
            sides[tag] = max(sides[tag], int.from_bytes(value, "little" if order == "<" else "big"))
    return sides[256], sides[257]


def _webp(data: bytes) -> tuple[int, int]:
    # Only the canvas of an extended file can be larger than 16383 x 16383.
    if data[12:16] != b"VP8X":
        return 1, 1
    width, height = (int.from_bytes(data[at : at + 3], "little") + 1 for at in (24, 27))
    return width, height


def _pnm(data: bytes) -> tuple[int, int] | None:
    found = _PNM.match(data)
    return None if found is None else (int(found[1]), int(found[2]))


#: First bytes of a file, and the function that finds the size in its header.
_FORMATS: Mapping[bytes, Callable[[bytes], tuple[int, int] | None]] = {
    PNG: _png,
    b"\xff\xd8\xff": _jpeg,
    b"BM": _bmp,
    b"II*\0": _tiff,
    b"MM\0*": _tiff,
    b"II+\0": _tiff,
    b"MM\0+": _tiff,
    b"RIFF": _webp,
} | {b"P%d" % number: _pnm for number in range(1, 7)}
