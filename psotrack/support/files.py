"""Reading text, and writing files so that nobody ever loses one: beside the target first, then renamed over it."""

from __future__ import annotations

import contextlib
import hashlib
import os
import secrets
import shutil
from collections.abc import Iterator
from pathlib import Path

from psotrack.errors import InputError, OutputError


def refuse_to_overwrite(path: Path, force: bool) -> None:
    """Raise `OutputError` if `path` exists and `force` is not set."""
    if path.exists() and not force:
        raise OutputError(path, expected="no such file yet", found="one", remedy="pass --force to replace it")


@contextlib.contextmanager
def written_whole(path: Path) -> Iterator[Path]:
    """A temporary path beside `path` (file or folder) that takes its place when the block ends well.

    If the block raises, Ctrl-C included, the temporary is removed and `path` is as it was. The temporary keeps
    the suffix of `path`, because writers of videos and images choose their format by it.

    Raises:
        OutputError: the folder cannot be written, the disk is full, or a file is to take a folder's place.
    """
    temporary = path.with_name(f".{path.stem}.{secrets.token_hex(4)}.partial{path.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
        if path.is_dir() and not temporary.is_dir():
            # Whoever names a folder for a file does not mean to lose what is in it.
            remedy = "name a file; what is in the folder is unchanged"
            raise OutputError(path, expected="a file to write", found="a folder", remedy=remedy)
        _replace(temporary, path)
    except OSError as error:
        reason = f"{error.strerror or error} ({temporary.name})"
        raise OutputError(
            path, expected="to write it", found=reason, remedy="earlier results are unchanged"
        ) from error
    finally:
        _remove(temporary)


def read_text(path: Path) -> str:
    """The text in a file, without the byte order mark that spreadsheets put first.

    Raises:
        InputError: the file cannot be read or is no text.
    """
    try:
        return path.read_text(encoding="utf-8-sig")
    except OSError as error:
        found = (error.strerror or str(error)).lower()
        raise InputError(path, expected="a file to read", found=found) from error
    except UnicodeDecodeError as error:
        raise InputError(path, expected="text", found=f"a byte that is none at {error.start}") from error


def digest_of(path: Path, expected: str = "a readable file") -> str:
    """A file's content as hexadecimal digits (BLAKE2b), read piece by piece; `expected` says what it should be.

    Raises:
        InputError: the file cannot be read.
    """
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "blake2b").hexdigest()
    except OSError as error:
        raise InputError(path, expected=expected, found=error.strerror or f"{error}") from error


def _replace(temporary: Path, path: Path) -> None:
    if not path.is_dir():
        os.replace(temporary, path)
        return
    # A folder cannot be replaced in one step: move the old one aside, so that it can come back.
    aside = temporary.with_name(f"{temporary.name}.old")
    os.replace(path, aside)
    try:
        os.replace(temporary, path)
    except OSError:
        os.replace(aside, path)
        raise
    _remove(aside)


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with contextlib.suppress(OSError):
            path.unlink()
