"""Files of results with a digest of their own content, so that damage is noticed before a file is used.

A Parquet file carries the digest in its footer, under the key "psotrack.digest"; other programs read the file as
before. The digest is that of the whole file with zeros in the place of the digest. A JSON file has the digest of its
other keys under the key "digest". Files of older versions lack the digest, and are read as they are.
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

#: Number of hexadecimal digits of a digest in a Parquet file, and the digest's place before the digest is known.
_DIGITS = 64
_EMPTY = b"0" * _DIGITS


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
    start = _place(content)
    assert start is not None, "a written file has a place for its digest"
    with atomic_write(path) as temporary:
        temporary.write_bytes(content[:start] + _digest(content) + content[start + _DIGITS :])


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
    try:
        content = path.read_bytes()
    except FileNotFoundError:
        raise
    except OSError as error:
        raise InputError(path, expected="a file to read", found=error.strerror or f"{error}") from error
    start = _place(content)
    if start is not None:
        emptied = content[:start] + _EMPTY + content[start + _DIGITS :]
        if _digest(emptied) != content[start : start + _DIGITS]:
            raise _damaged(path, "a file that was changed after it was written", remedy)
    try:
        # In this thread alone: a thread of Arrow's that frees the content while the program ends aborts the program.
        with pq.ParquetFile(pa.BufferReader(content), pre_buffer=False) as file:
            table = file.read(use_threads=False).to_pandas(use_threads=False)
    except Exception as error:  # PyArrow raises whatever a damaged byte leads to.
        raise _damaged(path, "a Parquet file that cannot be read", remedy) from error
    if not table.columns.is_unique:
        raise _damaged(path, "two columns of one name", remedy)
    return table


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
        content: Any = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise
    except OSError as error:
        raise InputError(path, expected="a file to read", found=error.strerror or f"{error}") from error
    except (ValueError, RecursionError) as error:
        raise _damaged(path, "a JSON file that cannot be read", remedy) from error
    if not isinstance(content, dict):
        raise _damaged(path, "a JSON file without keys", remedy)
    digest = content.pop(_JSON_KEY, None)
    if digest is not None and digest != digest_record(content):
        raise _damaged(path, "a file that was changed after it was written", remedy)
    return content


def _place(content: bytes) -> int | None:
    """Where the digits of the digest begin in the bytes of a Parquet file; None for a file without digest."""
    key = content.rfind(_FOOTER_KEY)
    # The footer is coded with Thrift: the key, then a byte for the field's type and one for the length of the value.
    start = key + len(_FOOTER_KEY) + 2
    return None if key < 0 or start + _DIGITS > len(content) else start


def _digest(emptied: bytes) -> bytes:
    return hashlib.sha256(emptied).hexdigest().encode("ascii")


def _damaged(path: Path, found: str, remedy: str) -> DamagedError:
    return DamagedError(path, expected="an undamaged file of a sweep", found=found, remedy=remedy)
