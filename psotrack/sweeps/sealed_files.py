"""Files of results with a digest of their own content, so that damage is noticed before a file is used.

A Parquet file carries the digest in its footer, under the key "psotrack.digest"; other programs read the file as
before. The digest is that of the whole file with zeros in the place of the digest. A JSON file has the digest of its
other keys under the key "digest".
"""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from psotrack.errors import InputError
from psotrack.support import atomic_write, digest_record

#: Key of the digest in the footer of a Parquet file, and in a JSON file.
_FOOTER_KEY, _JSON_KEY = b"psotrack.digest", "digest"

#: The digest's place in a Parquet file before the digest is known.
_EMPTY = b"0" * 64

#: What is wrong with a file whose digest is another one, or that has none.
_CHANGED = "a file that was changed after it was written"


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
        writer.add_key_value_metadata({_FOOTER_KEY: _EMPTY})
    content = buffer.getvalue().to_pybytes()
    before, _, after = _parts(content)
    with atomic_write(path) as temporary:
        temporary.write_bytes(before + _digest(before, after) + after)


def read_parquet(path: Path, remedy: str) -> pd.DataFrame:
    """Read a table.

    Args:
        path: the file.
        remedy: what the user can do about a damaged file, for the message.

    Raises:
        DamagedError: the file was changed or cut short after it was written.
        FileNotFoundError: the file does not exist.
        InputError: the file cannot be read.
    """
    content = _read(path)
    before, digest, after = _parts(content)
    if digest != _digest(before, after):
        raise _damaged(path, _CHANGED, remedy)
    # In this thread alone: a thread of Arrow's that frees the content while the program ends aborts the program.
    with pq.ParquetFile(pa.BufferReader(content), pre_buffer=False) as file:
        return file.read(use_threads=False).to_pandas(use_threads=False)


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Write a JSON file with a digest.

    Raises:
        OutputError: the file cannot be written.
    """
    sealed = content | {_JSON_KEY: digest_record(content)}
    with atomic_write(path) as temporary:
        temporary.write_text(json.dumps(sealed, indent=2) + "\n", encoding="utf-8")


def read_json(path: Path, remedy: str) -> dict[str, Any]:
    """Read a JSON file; arguments and errors as of `read_parquet`. The digest is not in the result."""
    try:
        content: Any = json.loads(_read(path).decode())
    except (ValueError, RecursionError) as error:
        raise _damaged(path, "a JSON file that cannot be read", remedy) from error
    digest = content.pop(_JSON_KEY, None) if isinstance(content, dict) else None
    if digest is None or digest != digest_record(content):
        raise _damaged(path, _CHANGED, remedy)
    return content


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except FileNotFoundError:
        raise
    except OSError as error:
        raise InputError(path, expected="a file to read", found=error.strerror or f"{error}") from error


def _parts(content: bytes) -> tuple[bytes, bytes, bytes]:
    """The bytes of a Parquet file before its digest, the digest, and the bytes after it."""
    # The footer is coded with Thrift: the key, then a byte for the field's type and one for the length of the value.
    start = content.rfind(_FOOTER_KEY) + len(_FOOTER_KEY) + 2
    end = start + len(_EMPTY)
    return content[:start], content[start:end], content[end:]


def _digest(before: bytes, after: bytes) -> bytes:
    return hashlib.sha256(before + _EMPTY + after).hexdigest().encode("ascii")


def _damaged(path: Path, found: str, remedy: str) -> DamagedError:
    return DamagedError(path, expected="an undamaged file of a sweep", found=found, remedy=remedy)
