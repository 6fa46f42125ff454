"""The hidden folder in which a sequence is made: its lock, the parts that are kept, and the move to its final place."""

from __future__ import annotations

import contextlib
import errno
import hashlib
import os
import shutil
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from filelock import FileLock, Timeout

from psotrack.errors import OutputError
from psotrack.support import end_of_links, refuse_to_overwrite

#: File that says how the sequence was made. Its name is hidden until everything else is there.
RECORD = "simulation.json"
_HIDDEN_RECORD = f".{RECORD}"
#: Folder of the segments. It is named by the record, because a worker that outlives its killed parent for a moment must
#: not leave a segment to a sequence with another record.
_SEGMENTS = ".segments-{}"
#: Time that a call waits for the lock, seconds: enough to try again where another call has just removed the lock file.
_LOCK_TIMEOUT_S = 0.2
#: Errors of file systems without locks. Two calls at once are not prevented there.
_NO_LOCKS = {errno.ENOLCK, errno.EOPNOTSUPP}


@dataclass(frozen=True)
class Unfinished:
    """A sequence that is being made, locked for this call.

    Attributes:
        folder: hidden folder beside the sequence's.
        segments: folder of the segments, inside `folder`; not part of the sequence.
        target: final folder of the sequence.
        complete: whether an earlier call made the whole sequence and only did not move it to `target`.
    """

    folder: Path
    segments: Path
    target: Path
    complete: bool

    def finish(self) -> None:
        """Remove what is not part of the sequence, and move the sequence to its place.

        Raises:
            OutputError: the sequence cannot be moved; a sequence that was there before is still there.
        """
        with _output_errors(self.target):
            if not self.complete:
                os.replace(self.folder / _HIDDEN_RECORD, self.folder / RECORD)
            _remove_all(self.folder.glob(".*"))
            old = _old_folder(self.target)
            if self.target.exists():
                os.replace(self.target, old)
            try:
                os.replace(self.folder, self.target)
            except OSError:
                if old.exists():
                    os.replace(old, self.target)
                raise
            shutil.rmtree(old, ignore_errors=True)


def is_made(target: Path, record: bytes) -> bool:
    """Whether the sequence exists and was made with this record."""
    return _holds(target / RECORD, record)


@contextlib.contextmanager
def unfinished(target: Path, record: bytes, force: bool) -> Iterator[Unfinished]:
    """Folder for a sequence that is being made: empty, or with the parts that an earlier call made for the same record.

    Args:
        target: final folder of the sequence.
        record: everything that decides the content of the sequence.
        force: whether an existing sequence may be replaced.

    Raises:
        OutputError: the sequence exists and `force` is not set, another call is making it, or the folder cannot be
            written.
    """
    target = end_of_links(target)
    folder = target.with_name(f".{target.name}.unfinished")
    segments = folder / _SEGMENTS.format(hashlib.sha256(record).hexdigest()[:16])
    with _locked(folder, target):
        with _output_errors(target):
            _restore(target)
            refuse_to_overwrite(target, force)
            complete = _holds(folder / RECORD, record)
            if not complete and not _holds(folder / _HIDDEN_RECORD, record):
                _remove_all(folder.iterdir())
                (folder / _HIDDEN_RECORD).write_bytes(record)
            _remove_all(_partial_files(folder))
        yield Unfinished(folder, segments, target, complete)


@contextlib.contextmanager
def _locked(folder: Path, target: Path) -> Iterator[None]:
    """Make the folder and lock it. The lock ends with the process, even if the process is killed."""
    lock_file = target.with_name(f".{target.name}.lock")
    lock = FileLock(lock_file)
    with _output_errors(target):
        folder.parent.mkdir(parents=True, exist_ok=True)
        _acquire(lock, target)
        folder.mkdir(exist_ok=True)
    try:
        yield
    finally:
        with contextlib.suppress(OSError):  # the folder is not empty, or has become the sequence
            folder.rmdir()
        # `FileLock` refuses a lock on a removed file, so it is safe to remove the file before the release. Windows
        # cannot remove an open file; `release` removes it there.
        with contextlib.suppress(OSError):
            lock_file.unlink()
        lock.release()


def _acquire(lock: FileLock, target: Path) -> None:
    try:
        lock.acquire(timeout=_LOCK_TIMEOUT_S, poll_interval=_LOCK_TIMEOUT_S / 10)
    except Timeout:
        raise OutputError(
            target,
            expected="no other simulation of this sequence at the same time",
            found="another simulation",
            remedy="wait until it ends, or choose another folder",
        ) from None
    except OSError as error:
        if error.errno not in _NO_LOCKS:
            raise


def _old_folder(target: Path) -> Path:
    """Place of the old sequence while the new one is moved to the old one's place."""
    return target.with_name(f".{target.name}.old")


def _restore(target: Path) -> None:
    """Undo the first move of a process that died between the two moves of `finish`."""
    old = _old_folder(target)
    if old.exists():
        if target.exists():
            shutil.rmtree(old)
        else:
            os.replace(old, target)


def _holds(path: Path, record: bytes) -> bool:
    return path.exists() and path.read_bytes() == record


def _partial_files(folder: Path) -> Iterator[Path]:
    """Files that killed processes left half-written (`support.atomic_write`)."""
    # Unlike `rglob`, `os.walk` tolerates folders that vanish meanwhile.
    for place, folders, files in os.walk(folder):
        yield from (Path(place, name) for name in (*folders, *files) if ".partial" in name)


def _remove_all(paths: Iterable[Path]) -> None:
    for path in list(paths):
        if path.is_dir():
            # An orphaned worker may still write into a hidden folder. What it writes there is never read.
            shutil.rmtree(path, ignore_errors=path.name.startswith("."))
        else:
            path.unlink(missing_ok=True)


@contextlib.contextmanager
def _output_errors(target: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise OutputError(
            target, expected="a path that can be written", found=error.strerror or str(error)
        ) from error
