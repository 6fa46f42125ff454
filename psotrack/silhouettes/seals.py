"""Seals of stored silhouettes: a digest of every byte of a folder, and a lock that marks folders in use.

A seal is a file in the folder. Its content is a digest of the files of the zarr array, so that a changed bit, a file
that was cut short and a missing file are noticed. Processes that read the folder hold a shared lock on the seal.
"""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import IO

from psotrack.errors import InputError
from psotrack.recordings import ARRAY_FILE
from psotrack.support import digest_file, digest_record

#: Name of the seal in a folder of stored silhouettes. zarr ignores the file.
SEAL_FILE = "seal"

#: Folder of the chunks of a zarr array.
CHUNKS = "c"


def write_seal(folder: Path) -> None:
    """Write the seal of a folder whose files are complete.

    Raises:
        OSError: the folder cannot be written.
        InputError: a file cannot be read.
    """
    (folder / SEAL_FILE).write_text(_seal_of(folder), encoding="ascii")


def is_whole(folder: Path) -> bool:
    """Whether a folder has a seal, and no byte of the folder was changed since; every byte is read."""
    try:
        return (folder / SEAL_FILE).read_bytes() == _seal_of(folder).encode("ascii")
    except (OSError, InputError):
        return False


def hold(folder: Path) -> IO[bytes] | None:
    """Open the seal of a folder with a shared lock; None where there is no seal, or a process removes the folder.

    As long as the file is open, `removable` leaves the folder alone. The time of the seal becomes the time of this use.
    """
    with contextlib.suppress(OSError):  # a cache that cannot be written, or no seal
        os.utime(folder / SEAL_FILE)
    try:
        file = (folder / SEAL_FILE).open("rb")
    except OSError:
        return None
    if _lock(file, shared=True):
        return file
    file.close()
    return None


@contextlib.contextmanager
def removable(folder: Path) -> Iterator[bool]:
    """Yield whether no process reads a folder; until the block ends, no process begins to read the folder."""
    try:
        file = (folder / SEAL_FILE).open("r+b")
    except FileNotFoundError:
        # Processes of this version read no folder without a seal.
        yield True
        return
    except OSError:
        yield False
        return
    with file:
        yield _lock(file, shared=False)


def _lock(file: IO[bytes], *, shared: bool) -> bool:
    """Try to lock an open file; True also on Windows, where a folder with an open file cannot be removed."""
    if sys.platform == "win32":
        return True
    import fcntl

    try:
        fcntl.flock(file, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        # A file system without locks: reading goes on, and nothing is removed.
        return shared
    return True


def _seal_of(folder: Path) -> str:
    files = [folder / ARRAY_FILE, *(path for path in (folder / CHUNKS).rglob("*") if path.is_file())]
    return digest_record({path.relative_to(folder).as_posix(): digest_file(path) for path in files})
