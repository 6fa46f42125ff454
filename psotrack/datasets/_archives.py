"""ZIP archives of many small files, joined without copies in memory, however many there are.

Python's own `zipfile` keeps half a kilobyte per entry until an archive is closed; ten minutes of masks have half a
million. Here entries of parts are copied as they are, and the central directory is spooled to disk. The format is
PKWARE's APPNOTE 6.3.9, sections 4.3.12 to 4.3.16, its 64-bit records where counts or offsets need them.
"""

from __future__ import annotations

import shutil
import struct
import tempfile
import zipfile
from collections.abc import Sequence as Ordered
from pathlib import Path
from typing import IO

from psotrack.errors import InputError
from psotrack.support import atomic_write

#: The first day that the format knows: archives of the same contents have the same bytes.
EPOCH = (1980, 1, 1, 0, 0, 0)
_DOS_EPOCH = (1980 - 1980) << 9 | 1 << 5 | 1
_LOCAL_SIZE = 30
_CENTRAL = struct.Struct("<4sHHHHHHLLLHHHHHLL")
_END_64 = struct.Struct("<4sQHHLLQQQQ")
_LOCATOR_64 = struct.Struct("<4sLQL")
_END = struct.Struct("<4sHHHHLLH")
_UNIX, _VERSION, _VERSION_64 = 3 << 8, 20, 45
_READABLE_FILE = 0o100644 << 16
_FULL_16, _FULL_32 = 0xFFFF, 0xFFFFFFFF


def entry(name: str) -> zipfile.ZipInfo:
    """What `join_archives` expects of an entry: stored, with the name in ASCII, and no time."""
    return zipfile.ZipInfo(name, EPOCH)


def join_archives(path: Path, parts: Ordered[Path]) -> None:
    """Write the entries of several archives into one; it appears at `path` when it is whole.

    Args:
        path: of the new archive.
        parts: archives of entries made by `entry`, in the order in which they were written; no name is in two.

    Raises:
        InputError: a part is no archive.
        OutputError: the file cannot be written.
    """
    with (
        atomic_write(path) as temporary,
        temporary.open("wb") as archive,
        tempfile.TemporaryFile() as central,
    ):
        count = 0
        for part in parts:
            count += _copy(part, archive, central)
        start, size = archive.tell(), central.tell()
        central.seek(0)
        shutil.copyfileobj(central, archive)
        archive.write(_end(count, start, size))


def _copy(part: Path, archive: IO[bytes], central: IO[bytes]) -> int:
    """Append the entries of a part, and their records; the number of entries."""
    base = archive.tell()
    try:
        with zipfile.ZipFile(part) as opened:
            entries = opened.infolist()
    except (OSError, zipfile.BadZipFile) as error:
        raise InputError(part, expected="a ZIP archive", found=str(error)) from error
    for one in entries:
        assert (one.compress_type, one.extra) == (zipfile.ZIP_STORED, b"")
        central.write(_central_record(one, base + one.header_offset))
    stop = sum(_LOCAL_SIZE + len(one.filename) + one.compress_size for one in entries)
    with part.open("rb") as data:
        # As many bytes as the entries have; the part's own central directory follows them.
        _copy_bytes(data, archive, stop)
    return len(entries)


def _copy_bytes(data: IO[bytes], archive: IO[bytes], count: int) -> None:
    while count:
        block = data.read(min(count, 1 << 20))
        assert block
        archive.write(block)
        count -= len(block)


def _central_record(one: zipfile.ZipInfo, offset: int) -> bytes:
    name = one.filename.encode("ascii")
    far = offset >= _FULL_32
    extra = struct.pack("<HHQ", 1, 8, offset) if far else b""
    version = _VERSION_64 if far else _VERSION
    sizes = (one.CRC, one.compress_size, one.file_size, len(name), len(extra), 0, 0, 0)
    fixed = (b"PK\1\2", _UNIX | version, version, 0, zipfile.ZIP_STORED, 0, _DOS_EPOCH)
    return _CENTRAL.pack(*fixed, *sizes, _READABLE_FILE, min(offset, _FULL_32)) + name + extra


def _end(count: int, start: int, size: int) -> bytes:
    """What follows the central directory, which has `count` records in `size` bytes from `start` on."""
    end = _END.pack(
        b"PK\5\6",
        0,
        0,
        min(count, _FULL_16),
        min(count, _FULL_16),
        min(size, _FULL_32),
        min(start, _FULL_32),
        0,
    )
    if count < _FULL_16 and size < _FULL_32 and start < _FULL_32:
        return end
    version, rest = _VERSION_64, _END_64.size - 12
    end_64 = _END_64.pack(b"PK\6\6", rest, _UNIX | version, version, 0, 0, count, count, size, start)
    return end_64 + _LOCATOR_64.pack(b"PK\6\7", 0, start + size, 1) + end
