"""The hidden folder that keeps the segments of a sequence until the sequence is complete, and its lock."""

from __future__ import annotations

import contextlib
import errno
import hashlib
import shutil
from collections.abc import Iterator
from pathlib import Path

from filelock import FileLock, Timeout

from psotrack.errors import OutputError

#: Time that a call waits for the lock, seconds: enough to try again where another call has just removed the lock file.
_LOCK_TIMEOUT_S = 0.2
#: Errors of file systems without locks. Two calls at once are not prevented there.
_NO_LOCKS = {errno.ENOLCK, errno.EOPNOTSUPP}


@contextlib.contextmanager
def unfinished(target: Path, record: bytes) -> Iterator[Path]:
    """Folder of the segments that calls with the same record have drawn; it is locked, and removed after the block.

    If the block raises, or the process is killed, the segments stay for the next call.

    Args:
        target: folder of the sequence, beside which the hidden folder is.
        record: everything that decides the content of the sequence.

    Raises:
        OutputError: another call is making the sequence, or the folder of the sequence cannot be written.
    """
    hidden = target.with_name(f".{target.name}.unfinished")
    # A worker that outlives its killed parent for a moment must not leave a segment to a sequence with another record.
    segments = hidden / hashlib.sha256(record).hexdigest()[:16]
    with _locked(target):
        for other in hidden.glob("*"):
            if other != segments:
                shutil.rmtree(other, ignore_errors=True)
        yield segments
        shutil.rmtree(hidden, ignore_errors=True)


@contextlib.contextmanager
def _locked(target: Path) -> Iterator[None]:
    """Lock a sequence. The lock ends with the process, even if the process is killed."""
    lock_file = target.with_name(f".{target.name}.lock")
    lock = FileLock(lock_file)
    try:
        lock_file.parent.mkdir(parents=True, exist_ok=True)
        lock.acquire(timeout=_LOCK_TIMEOUT_S, poll_interval=_LOCK_TIMEOUT_S / 10)
    except Timeout:
        expected = "no other simulation of this sequence at the same time"
        remedy = "wait until it ends, or choose another folder"
        raise OutputError(target, expected=expected, found="another simulation", remedy=remedy) from None
    except OSError as error:
        if error.errno not in _NO_LOCKS:
            found = error.strerror or str(error)
            raise OutputError(target, expected="a path that can be written", found=found) from error
    try:
        yield
    finally:
        # `FileLock` refuses a lock on a removed file, so it is safe to remove the file before the release. Windows
        # cannot remove an open file; `release` removes it there.
        with contextlib.suppress(OSError):
            lock_file.unlink()
        lock.release()
