"""Seals of stored silhouettes: a digest of every byte of a folder.

A seal is a file in the folder. Its content is a digest of the files of the zarr array, so that a changed bit, a file
that was cut short and a missing file are noticed.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path

from psotrack.recordings import ARRAY_FILE
from psotrack.support import digest_record

#: Name of the seal in a folder of stored silhouettes. zarr ignores the file.
SEAL_FILE = "seal"

#: Folder of the chunks of a zarr array.
CHUNKS = "c"


def read_files(folder: Path) -> dict[str, bytes]:
    """Content of the files of the array in a folder, and of its seal, by their paths in the folder.

    Raises:
        OSError: a file cannot be read.
    """
    paths = [folder / ARRAY_FILE, folder / SEAL_FILE, *(folder / CHUNKS).rglob("*")]
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in paths if path.is_file()}


def seal_of(files: Mapping[str, bytes]) -> bytes:
    """The seal of the files of an array."""
    array = {name: content for name, content in files.items() if name != SEAL_FILE}
    return digest_record({name: hashlib.blake2b(array[name]).hexdigest() for name in array}).encode()


def is_whole(folder: Path) -> bool:
    """Whether a folder has a seal, and no byte of the folder was changed since; every byte is read."""
    try:
        files = read_files(folder)
    except OSError:
        return False
    return files.get(SEAL_FILE) == seal_of(files)
