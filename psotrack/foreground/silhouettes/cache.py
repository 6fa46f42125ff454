"""What a cache folder holds: silhouettes of videos, and compiled programs; and how entries are removed.

Only what psotrack itself put into the folder is an entry: a folder whose name is a key and which holds nothing but an
array and its seal, such a folder that a killed process did not finish, and files of compiled programs. Everything else
in the folder is left alone.
"""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from psotrack.errors import InputError, OutputError
from psotrack.foreground.silhouettes.store import CHUNKS, SEAL_FILE
from psotrack.recordings import ARRAY_FILE
from psotrack.support import left_over

#: Name of a folder of silhouettes, and names of compiled programs in JAX's cache.
_KEY = re.compile(r"[0-9a-f]{40}")
_PROGRAM = re.compile(r"jit_\w+-[0-9a-f]{64}-(cache|atime)")
#: Folder of the compiled programs, in the cache.
_COMPILED = "compiled"


@dataclass(frozen=True)
class CacheEntry:
    """An entry of a cache.

    Attributes:
        path: folder of silhouettes, or file of a compiled program.
        kind: what the entry is.
        video: file name of the video of silhouettes; "" for a program, and where the entry is damaged.
        size_bytes: size of all files.
        used_s: time of the last use, seconds since 1970.
    """

    path: Path
    kind: Literal["silhouettes", "program"]
    video: str
    size_bytes: int
    used_s: float


def list_entries(cache: Path) -> list[CacheEntry]:
    """Entries of a cache, those that were used last at the end.

    Raises:
        InputError: the folder does not exist or cannot be read.
    """
    try:
        paths = [*cache.iterdir(), *(cache / _COMPILED).glob("*")]
        killed = left_over(cache)
    except OSError as error:
        found = (error.strerror or f"{error}").lower()
        raise InputError(cache, expected="a cache folder", found=found) from error
    entries = [entry for path in paths if (entry := _entry(path, is_left_over=path in killed)) is not None]
    return sorted(entries, key=lambda entry: entry.used_s)


def choose_to_prune(
    entries: Sequence[CacheEntry], now_s: float, older_than_days: float | None, max_bytes: float | None
) -> list[CacheEntry]:
    """The entries to remove: those that are too old, and then those that were used longest ago.

    Args:
        entries: entries of a cache, those that were used last at the end.
        now_s: time now, seconds since 1970.
        older_than_days: entries that were not used for this number of days are removed; None removes none.
        max_bytes: largest size of the entries that stay; None sets no limit.
    """
    chosen = []
    size_bytes = sum(entry.size_bytes for entry in entries)
    for entry in entries:
        old = older_than_days is not None and now_s - entry.used_s > older_than_days * 24 * 3600
        if old or (max_bytes is not None and size_bytes > max_bytes):
            chosen.append(entry)
            size_bytes -= entry.size_bytes
    return chosen


def remove_entry(entry: CacheEntry) -> None:
    """Remove an entry; a process that has read it goes on without it.

    Raises:
        OutputError: the entry cannot be removed.
    """
    try:
        if entry.kind == "program":
            entry.path.unlink()
            return
        # First the seal: nobody reads what is left of a folder without it.
        (entry.path / SEAL_FILE).unlink(missing_ok=True)
        shutil.rmtree(entry.path)
    except FileNotFoundError:
        pass  # Another process has removed the entry.
    except OSError as error:
        found = error.strerror or f"{error}"
        raise OutputError(entry.path, expected="an entry that can be removed", found=found) from error


def _entry(path: Path, *, is_left_over: bool) -> CacheEntry | None:
    """The entry at a path; None where there is none, or another process has just removed it."""
    is_program = path.parent.name == _COMPILED and _PROGRAM.fullmatch(path.name)
    key = path.name.split(".")[1] if is_left_over else path.name
    if path.is_symlink() or not (is_program or _KEY.fullmatch(key)):
        return None
    try:
        if is_program:
            status = path.stat()
            return CacheEntry(path, "program", "", status.st_size, status.st_mtime)
        if not {each.name for each in path.iterdir()} <= {ARRAY_FILE, SEAL_FILE, CHUNKS}:
            return None
        size_bytes = sum(file.stat().st_size for file in path.rglob("*") if file.is_file())
        seal = path / SEAL_FILE
        used_s = (seal if seal.exists() else path).stat().st_mtime
    except OSError:
        return None
    return CacheEntry(path, "silhouettes", _video_of(path), size_bytes, used_s)


def _video_of(folder: Path) -> str:
    try:
        return str(json.loads((folder / ARRAY_FILE).read_bytes())["attributes"]["video"])
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return ""
