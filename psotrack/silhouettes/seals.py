"""Seals of stored silhouettes: a digest of every byte of a folder, and a lock that marks folders in use.

A seal is a file in the folder. Its content is a digest of the files of the zarr array, so that a changed bit, a file
that was cut short and a missing file are noticed. Processes that read the folder hold a shared lock on the seal.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import IO

from psotrack.errors import InputError
from psotrack.recordings import ARRAY_FILE
from psotrack.support import digest_file, digest_record

#: Name of the seal in a folder of stored silhouettes. zarr ignores the file.
SEAL_FILE = "seal"

#: Folder of the chunks of a zarr array.
CHUNKS = "c"


def seal_of(folder: Path) -> str:
    """Digest of every byte of the array in a folder.

    Raises:
        InputError: a file cannot be read.
    """
    files = [folder / ARRAY_FILE, *(path for path in (folder / CHUNKS).rglob("*") if path.is_file())]
    return digest_record({path.relative_to(folder).as_posix(): digest_file(path) for path in files})


def is_whole(folder: Path) -> bool:
    """Whether a folder has a seal, and no byte of the folder was changed since; every byte is read."""
    try:
        return (folder / SEAL_FILE).read_bytes() == seal_of(folder).encode("ascii")
    except (OSError, InputError):
        return False


def lock(folder: Path, *, shared: bool) -> IO[bytes] | None:
    """Lock a folder until the returned file, its seal, is closed.

    None where there is no seal, or where another process has a lock and one of both is not shared. Whoever reads the
    folder shares a lock; whoever removes it does not.
    """
    try:
        seal = (folder / SEAL_FILE).open("rb" if shared else "r+b")
    except OSError:
        return None
    if sys.platform == "win32":  # where a folder with an open file cannot be removed anyway
        return seal
    import fcntl

    try:
        fcntl.flock(seal, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
    except OSError as error:
        # On a file system without locks, reading goes on and nothing is removed.
        if isinstance(error, BlockingIOError) or not shared:
            seal.close()
            return None
    return seal
