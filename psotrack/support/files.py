"""Safe reading and writing of files, and digests of their content.

A file is first written under a temporary name beside its path and then renamed, so that an interrupted write never
damages an older file.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import secrets
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

import msgspec
import platformdirs

from psotrack.errors import InputError, OutputError

#: Longest name that becomes the name of a file, bytes.
_LONGEST_NAME = 180

#: Ending of the names of archives (`psotrack.archives`).
ARCHIVE_SUFFIX = ".psotrack"

#: Hash functions of `digest_file`: BLAKE2b with 512 and with 160 bits, and SHA-256.
Algorithm = Literal["blake2b", "blake2b-160", "sha256"]


def refuse_to_overwrite(path: Path | str, force: bool) -> None:
    """Raise `OutputError` if `path` exists and `force` is not set."""
    path = Path(path)
    if path.exists() and not force:
        found = "an existing folder" if path.is_dir() else "an existing file"
        raise OutputError(
            path, expected="a path that does not exist yet", found=found, remedy="pass --force to replace it"
        )


@contextlib.contextmanager
def atomic_write(path: Path | str) -> Iterator[Path]:
    """Yield a temporary path beside `path`; at the end of the block, rename the file or folder written there to `path`.

    If the block raises (Ctrl-C included), the temporary file or folder is removed and `path` is unchanged. The
    temporary name has the suffix of `path`, because writers of videos and images choose their format by the suffix.

    Raises:
        OutputError: the folder cannot be written, the disk is full, or `path` is a folder and a file was written.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.stem}.{secrets.token_hex(4)}.partial{path.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
        if path.is_dir() and not temporary.is_dir():
            # Even with `force`: a user who names a folder by mistake must not lose the folder's content.
            remedy = "name a file; the content of the folder is unchanged"
            raise OutputError(path, expected="the path of a file", found="a folder", remedy=remedy)
        _replace(temporary, path)
    except OSError as error:
        reason = f"{error.strerror or error} ({temporary.name})"
        raise OutputError(
            path, expected="a path that can be written", found=reason, remedy="earlier results are unchanged"
        ) from error
    finally:
        _remove(temporary)


def read_text(path: Path | str) -> str:
    """Read a UTF-8 text file, without the byte order mark that spreadsheet programs write first.

    Raises:
        InputError: the file cannot be read or is not UTF-8 text.
    """
    try:
        text = Path(path).read_text(encoding="utf-8-sig")
    except OSError as error:
        found = (error.strerror or str(error)).lower()
        raise InputError(path, expected="a file to read", found=found) from error
    except UnicodeDecodeError as error:
        raise InputError(
            path, expected="UTF-8 text", found=f"an invalid byte at offset {error.start}"
        ) from error
    check_no_nul(path, text)
    return text


def check_no_nul(path: Path | str, text: str) -> None:
    """Raise `InputError` for a NUL, which no text has: the file is damaged, or is text in UTF-16 or UTF-32."""
    if "\0" in text:
        raise InputError(path, expected="UTF-8 text", found=f"a NUL at character {text.index(chr(0))}")


def check_file_name(name: str, where: object) -> str:
    """Return a name, such as that of a camera, that becomes the name of a file; on any system it stays in its folder.

    Args:
        name: the name, without a suffix.
        where: where the name comes from, for the message.

    Raises:
        InputError: the name has a mark that leads to another folder, or that no system allows, or is too long.
    """
    is_plain = name.isprintable() and name == name.strip() and name.strip(".")
    # With a suffix, and the marks of a temporary name, names of files have at most 255 bytes.
    if not is_plain or set(name) & set('/\\:*?"<>|') or len(os.fsencode(name)) > _LONGEST_NAME:
        raise InputError(
            where,
            expected="names that can be names of files",
            found=repr(name),
            remedy="rename it: no / \\ : and other marks of paths",
        )
    return name


def digest_file(
    path: Path | str, *, algorithm: Algorithm = "blake2b", expected: str = "a readable file"
) -> str:
    """Digest of a file's content, as hexadecimal digits.

    Args:
        path: path of the file; it is read in pieces.
        algorithm: hash function.
        expected: kind of file, for the message.

    Raises:
        InputError: the file cannot be read.
    """
    new = (lambda: hashlib.blake2b(digest_size=20)) if algorithm == "blake2b-160" else algorithm
    try:
        with Path(path).open("rb") as file:
            return hashlib.file_digest(file, new).hexdigest()
    except OSError as error:
        raise InputError(path, expected=expected, found=error.strerror or f"{error}") from error


def digest_record(record: Any) -> str:
    """Digest of plain data and msgspec records, as 40 hexadecimal digits (BLAKE2b of their JSON with sorted keys)."""
    text = msgspec.json.encode(record, order="deterministic")
    return hashlib.blake2b(text, digest_size=20).hexdigest()


def _replace(temporary: Path, path: Path) -> None:
    if not path.is_dir():
        os.replace(temporary, path)
        return
    # A folder cannot be replaced in one step: the old folder is renamed first, and gets its name back after a failure.
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


def user_cache() -> Path:
    """The user's cache folder for silhouettes and compiled programs: $PSOTRACK_CACHE, or the system's usual place."""
    chosen = os.environ.get("PSOTRACK_CACHE")
    return Path(chosen) if chosen else platformdirs.user_cache_path("psotrack") / "silhouettes"
