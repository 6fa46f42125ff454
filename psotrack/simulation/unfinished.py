"""The hidden folder in which a sequence grows: whose it is, what is kept of it, and how it becomes the sequence."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import hashlib
import os
import shutil
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from psotrack.errors import OutputError
from psotrack.support import refuse_to_overwrite

#: How the sequence was made. Its name is hidden until everything else is there.
RECORD = "simulation.json"
_GROWING = f".{RECORD}"
#: Named by the record: a worker that outlives its killed parent by a moment cannot leave a segment to another record.
_SEGMENTS = ".segments-{}"
#: What file systems without locks answer; there, nobody is kept out.
_NO_LOCKS = {errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP}


@dataclass(frozen=True)
class Unfinished:
    """A sequence that is being made, locked for this call.

    Attributes:
        folder: hidden, beside the sequence's.
        segments: the folder of what is made bit by bit, in there; not part of the sequence.
        target: where the sequence will be.
        whole: whether an earlier call made all of it, and just did not come to move it.
    """

    folder: Path
    segments: Path
    target: Path
    whole: bool

    def finish(self) -> None:
        """Everything is there: clear up, and put the sequence in its place.

        Raises:
            OutputError: it cannot be moved; a sequence that was there before still is.
        """
        with _output_errors(self.target):
            if not self.whole:
                os.replace(self.folder / _GROWING, self.folder / RECORD)
            _remove_all(self.folder.glob(".*"))
            aside = _aside(self.target)
            if self.target.exists():
                os.replace(self.target, aside)
            try:
                os.replace(self.folder, self.target)
            except OSError:
                if aside.exists():
                    os.replace(aside, self.target)
                raise
            shutil.rmtree(aside, ignore_errors=True)


@contextlib.contextmanager
def unfinished(target: Path, record: bytes, force: bool) -> Iterator[Unfinished]:
    """The folder for a sequence, with what an earlier call of the same record left there, or empty.

    Args:
        target: the sequence's folder.
        record: everything that decides what the sequence will be.
        force: whether one that is there may be replaced.

    Raises:
        OutputError: the sequence exists and `force` is not set, another call is at work on it, or nothing can be
            written there.
    """
    folder = target.with_name(f".{target.name}.unfinished")
    segments = folder / _SEGMENTS.format(hashlib.sha256(record).hexdigest()[:16])
    with _locked(folder, target):
        with _output_errors(target):
            _put_back(target)
            refuse_to_overwrite(target, force)
            whole = _holds(folder / RECORD, record)
            if not whole and not _holds(folder / _GROWING, record):
                _remove_all(folder.iterdir())
                (folder / _GROWING).write_bytes(record)
            _remove_all(_partial(folder))
        yield Unfinished(folder, segments, target, whole)


@contextlib.contextmanager
def _locked(folder: Path, target: Path) -> Iterator[None]:
    """Make the folder, and keep others out. The lock ends with the process, however it ends."""
    with _output_errors(target):
        while True:
            folder.mkdir(parents=True, exist_ok=True)
            descriptor = os.open(folder, os.O_RDONLY)
            _lock(descriptor, target)
            if _is(folder, descriptor):
                break
            # Who had it has just finished, and moved it away.
            os.close(descriptor)
    try:
        yield
    finally:
        with contextlib.suppress(OSError):  # it is not empty, or has become the sequence
            folder.rmdir()
        os.close(descriptor)


def _lock(descriptor: int, target: Path) -> None:
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(descriptor)
        raise OutputError(
            target,
            expected="to be the only one who writes it",
            found="another simulation at work on it",
            remedy="wait until it ends, or choose another folder",
        ) from None
    except OSError as error:
        if error.errno not in _NO_LOCKS:
            raise


def _is(folder: Path, descriptor: int) -> bool:
    try:
        return os.path.samestat(folder.stat(), os.fstat(descriptor))
    except FileNotFoundError:
        return False


def _aside(target: Path) -> Path:
    """Where the old sequence is while the new one takes its place."""
    return target.with_name(f".{target.name}.old")


def _put_back(target: Path) -> None:
    """What a process leaves that dies between the two moves of `finish`."""
    aside = _aside(target)
    if aside.exists():
        if target.exists():
            shutil.rmtree(aside)
        else:
            os.replace(aside, target)


def _holds(path: Path, record: bytes) -> bool:
    return path.exists() and path.read_bytes() == record


def _partial(folder: Path) -> Iterator[Path]:
    """What processes that were killed were just writing (`files.atomic_write`)."""
    # Unlike `rglob`, it bears with folders that vanish meanwhile.
    for place, folders, files in os.walk(folder):
        yield from (Path(place, name) for name in (*folders, *files) if ".partial" in name)


def _remove_all(paths: Iterable[Path]) -> None:
    for path in list(paths):
        if path.is_dir():
            # In hidden ones an orphaned worker may be at work; nobody reads them.
            shutil.rmtree(path, ignore_errors=path.name.startswith("."))
        else:
            path.unlink(missing_ok=True)


@contextlib.contextmanager
def _output_errors(target: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise OutputError(target, expected="to write it", found=error.strerror or str(error)) from error
