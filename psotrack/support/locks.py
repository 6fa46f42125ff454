"""Locks on files, by which processes on one or several machines agree which process does a piece of work.

A lock is a lease of the library `filelock`: its file names the process, which touches the file as long as it works. The
lock of a process that has ended lapses at once on the same machine; the lock of another machine lapses when its file
was not touched for `LEASE_S`.
"""

from __future__ import annotations

import contextlib
import logging
import time
from collections.abc import Iterator
from pathlib import Path

from filelock import LeaseCompromise, SoftFileLease, Timeout

from psotrack.errors import OutputError, system_errors

logger = logging.getLogger(__name__)

#: A lock lapses when its file was not touched for this long, seconds; every process must use the same value.
LEASE_S = 30.0

#: Time between two touches of a lock's file, seconds: five may fail before the lock lapses.
HEARTBEAT_S = 5.0

#: Time between two attempts to take a lock that another process holds, seconds.
POLL_S = 0.2


class Locks:
    """The locks that one runner takes.

    A runner keeps its `Locks` as long as it waits, because a process finds out whether a lock of another machine has
    lapsed only by watching the lock's file for `LEASE_S`.
    """

    def __init__(self) -> None:
        self._leases: dict[Path, SoftFileLease] = {}

    @contextlib.contextmanager
    def attempt(self, path: Path) -> Iterator[bool]:
        """Try to hold a lock until the block ends; yields whether this thread holds the lock.

        Args:
            path: the lock's file; its folder is made.

        Raises:
            OutputError: the folder cannot be written, or the disk is full.
        """
        lease = self._lease(path)
        remedy = "earlier results are unchanged"
        with system_errors(path.parent, "a folder that can be written", OutputError, remedy):
            is_held = not lease.is_locked and _acquire(lease)
        try:
            yield is_held
        finally:
            if is_held:
                lease.release()

    def holder(self, path: Path) -> str | None:
        """The process that holds a lock; None if no process holds the lock."""
        lease = self._lease(path)
        try:
            if not lease.is_locked and _acquire(lease):
                lease.release()
                return None
            # This process has not watched the file, so the clocks of both machines are compared instead.
            if time.time() - path.stat().st_mtime > LEASE_S:
                return None
        except FileNotFoundError:
            return None
        owner = lease.owner
        # filelock adds the container to the host's name, after a question mark.
        return f"process {owner.pid} on {owner.hostname.partition('?')[0]}" if owner else "a process"

    def _lease(self, path: Path) -> SoftFileLease:
        if path not in self._leases:
            lease = SoftFileLease(
                path, lease_duration=LEASE_S, heartbeat_interval=HEARTBEAT_S, on_compromise=_warn
            )
            # Threads that come at the same time must get the same lease.
            self._leases.setdefault(path, lease)
        return self._leases[path]


def _acquire(lease: SoftFileLease) -> bool:
    try:
        lease.acquire(blocking=False)
        return True
    except Timeout:
        # A machine that fails between making the file and writing it leaves it empty, and filelock keeps such a file.
        with contextlib.suppress(OSError):
            status = Path(lease.lock_file).stat()
            if status.st_size == 0 and time.time() - status.st_mtime > LEASE_S:
                Path(lease.lock_file).unlink()
        return False


def _warn(lost: LeaseCompromise) -> None:
    logger.warning(
        "%s: this process has lost the lock (%s); was the machine asleep?", lost.lock_file, lost.reason
    )
