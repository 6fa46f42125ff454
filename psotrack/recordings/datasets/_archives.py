"""Joining of ZIP archives with many small files, with constant memory.

Python's `zipfile` keeps half a kilobyte per entry in memory until an archive is closed, and ten minutes of masks are
half a million entries. This module copies the entries of the parts unchanged and collects the central directory in a
temporary file. The format is PKWARE's APPNOTE 6.3.9, sections 4.3.12 to 4.3.16, with 64-bit records for large counts
and offsets.
"""

from __future__ import annotations

import shutil
import struct
import tempfile
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import IO

from psotrack.errors import InputError
from psotrack.support import atomic_write

#: Date of all entries, the first date of the format, so that archives with equal contents have equal bytes.
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


def stored_entry(name: str) -> zipfile.ZipInfo:
    """Entry that `join_archives` can copy: not compressed, with the date `EPOCH`.

    Args:
        name: name of the file in the archive, in ASCII.
    """
    return zipfile.ZipInfo(name, EPOCH)


def join_archives(path: Path, parts: Sequence[Path]) -> None:
    """Join several archives into one archive, which appears at `path` when it is complete.

    Args:
        path: path of the new archive.
        parts: paths of archives whose entries were made by `stored_entry`; no name occurs in two archives.

    Raises:
        InputError: a part is not a ZIP archive.
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
    """Append the entries of a part and their records of the central directory; return the number of entries."""
    base = archive.tell()
    try:
        with zipfile.ZipFile(part) as opened:
            entries = opened.infolist()
    except (OSError, zipfile.BadZipFile) as error:
        raise InputError(part, expected="a ZIP archive", found=str(error)) from error
    for entry in entries:
        assert (entry.compress_type, entry.extra) == (zipfile.ZIP_STORED, b"")
        central.write(_central_record(entry, base + entry.header_offset))
    stop = sum(_LOCAL_SIZE + len(entry.filename) + entry.compress_size for entry in entries)
    with part.open("rb") as data:
        # The bytes of the entries only, without the part's own central directory behind them.
        _copy_bytes(data, archive, stop)
    return len(entries)


def _copy_bytes(data: IO[bytes], archive: IO[bytes], count: int) -> None:
    while count:
        block = data.read(min(count, 1 << 20))
        assert block
        archive.write(block)
        count -= len(block)


def _central_record(entry: zipfile.ZipInfo, offset: int) -> bytes:
    name = entry.filename.encode("ascii")
    far = offset >= _FULL_32
    extra = struct.pack("<HHQ", 1, 8, offset) if far else b""
    version = _VERSION_64 if far else _VERSION
    sizes = (entry.CRC, entry.compress_size, entry.file_size, len(name), len(extra), 0, 0, 0)
    fixed = (b"PK\1\2", _UNIX | version, version, 0, zipfile.ZIP_STORED, 0, _DOS_EPOCH)
    return _CENTRAL.pack(*fixed, *sizes, _READABLE_FILE, min(offset, _FULL_32)) + name + extra


def _end(count: int, start: int, size: int) -> bytes:
    """End records of the archive.

    Args:
        count: number of records in the central directory.
        start: offset of the central directory, bytes.
        size: size of the central directory, bytes.
    """
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
