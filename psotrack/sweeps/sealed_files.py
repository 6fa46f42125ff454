"""Parquet files with a digest of their own content, so that damage is noticed before a file is used.

The digest stands in the file's footer, under the key "psotrack.digest"; other programs read the file as any other. It
is that of the whole file with zeros in the place of the digest. Arrow itself ends the process at some damaged files.
"""

from __future__ import annotations

import hashlib
from pathlib import Path

import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from psotrack.errors import InputError
from psotrack.support import atomic_write

_KEY = b"psotrack.digest"
#: The digest's place before the digest is known.
_EMPTY = b"0" * 64


class DamagedError(InputError):
    """A file was changed or cut short after it was written."""


def write_parquet(path: Path, table: pd.DataFrame) -> None:
    """Write a table as a Parquet file with a digest.

    Raises:
        OutputError: the file cannot be written.
    """
    rows, buffer = pa.Table.from_pandas(table, preserve_index=False), pa.BufferOutputStream()
    with pq.ParquetWriter(buffer, rows.schema) as writer:
        writer.write_table(rows)
        writer.add_key_value_metadata({_KEY: _EMPTY})
    content = buffer.getvalue().to_pybytes()
    before, _, after = _parts(content)
    with atomic_write(path) as temporary:
        temporary.write_bytes(before + _digest(before, after) + after)


def read_parquet(path: Path) -> pd.DataFrame:
    """Read a table.

    Raises:
        DamagedError: the file was changed or cut short after it was written.
        FileNotFoundError: the file does not exist.
        InputError: the file cannot be read.
    """
    try:
        content = path.read_bytes()
    except FileNotFoundError:
        raise
    except OSError as error:
        raise InputError(path, expected="a file to read", found=error.strerror or f"{error}") from error
    before, digest, after = _parts(content)
    if digest != _digest(before, after):
        raise DamagedError(
            path,
            expected="an undamaged file of a sweep",
            found="a file that was changed after it was written",
            remedy="run the same `psotrack sweep` again",
        )
    # In this thread alone: a thread of Arrow's that frees the content while the program ends aborts the program.
    with pq.ParquetFile(pa.BufferReader(content), pre_buffer=False) as file:
        return file.read(use_threads=False).to_pandas(use_threads=False)


def _parts(content: bytes) -> tuple[bytes, bytes, bytes]:
    """The bytes of a file before its digest, the digest, and the bytes after it."""
    # The footer is coded with Thrift: the key, then a byte for the field's type and one for the length of the value.
    start = content.rfind(_KEY) + len(_KEY) + 2
    end = start + len(_EMPTY)
    return content[:start], content[start:end], content[end:]


def _digest(before: bytes, after: bytes) -> bytes:
    return hashlib.sha256(before + _EMPTY + after).hexdigest().encode("ascii")
