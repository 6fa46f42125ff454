"""Claims: files by which processes, on one machine or on many, agree who does what. Whoever is killed loses its own.

A claim says whose it is. Its owner touches it as long as it works; one that nobody has touched for a while is nobody's.
Where the owner ran on this machine one need not wait: that its process has ended can be seen.
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import secrets
import socket
import threading
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from psotrack.support import atomic_write

logger = logging.getLogger(__name__)

#: A claim is touched so often; not touched for so long, it is nobody's. Clocks of machines must agree better than that.
HEARTBEAT_S, STALE_S = 5.0, 30.0

#: How often to look again at what somebody else has claimed.
POLL_S = 0.2


@dataclass(frozen=True)
class Owner:
    """Who has a claim.

    Attributes:
        host: the machine's name.
        machine: the same for processes whose numbers mean the same: of one boot and one container; "" if not known.
        process: its number.
        started: when that process began, in ticks since the boot: numbers are used again.
        since: date and time of the claim.
        token: of this claim alone.
        what: is done, in words.
    """

    host: str
    machine: str
    process: int
    started: int
    since: str
    token: str
    what: str


def owner_of(path: Path) -> Owner | None:
    """Who is at work under the claim at `path`, as far as one can see; None for nobody."""
    try:
        untouched_s = time.time() - path.stat().st_mtime
        owner = _read(path)
    except FileNotFoundError:
        return None
    if untouched_s > STALE_S:
        return None
    if owner is None:
        # Being written just now, or by another version.
        return Owner("?", "", 0, 0, "", "", "")
    here = owner.machine == _machine() != ""
    return None if here and _started(owner.process) != owner.started else owner


@contextlib.contextmanager
def claimed(path: Path, what: str = "") -> Iterator[bool]:
    """Whether the claim at `path` is ours until the block ends; it is not where somebody else has it.

    Args:
        path: of the claim; its folder is made.
        what: is done, for others to read.
    """
    owner = _taken(path, what)
    if owner is None:
        yield False
        return
    ended = threading.Event()
    beating = threading.Thread(target=_keep_alive, args=(path, owner, ended), daemon=True)
    beating.start()
    try:
        yield True
    finally:
        ended.set()
        beating.join()
        if _is_of(path, owner):
            path.unlink(missing_ok=True)


@contextlib.contextmanager
def waited_for(path: Path, what: str = "") -> Iterator[None]:
    """Ours until the block ends, after whoever has it now: for work that takes moments."""
    while True:
        with claimed(path, what) as ours:
            if ours:
                yield
                return
        time.sleep(POLL_S)


def _taken(path: Path, what: str) -> Owner | None:
    """Ourselves, if the claim is ours now."""
    path.parent.mkdir(parents=True, exist_ok=True)
    ours = Owner(
        host=socket.gethostname(),
        machine=_machine(),
        process=os.getpid(),
        started=_started(os.getpid()),
        since=datetime.now(UTC).isoformat(timespec="seconds"),
        token=secrets.token_hex(8),
        what=what,
    )
    try:
        with path.open("x", encoding="utf-8") as file:
            json.dump(asdict(ours), file)
    except FileExistsError:
        return ours if _taken_over(path, ours) else None
    return ours


def _taken_over(path: Path, ours: Owner) -> bool:
    """Whether a claim that was nobody's is ours now. Of all who see that it is nobody's one alone may replace it."""
    try:
        # Read before it is looked at: so it is the one that is nobody's, not one that has just replaced it.
        seen = _read(path)
    except FileNotFoundError:
        return False
    if owner_of(path) is not None:
        return False
    right = path.with_name(f".{path.name}.{seen.token if seen else 'unknown'}.stale")
    try:
        right.open("x").close()
    except FileExistsError:
        with contextlib.suppress(FileNotFoundError):
            if time.time() - right.stat().st_mtime > STALE_S:
                right.unlink()  # whoever had the right was killed just then
        return False
    try:
        if _is_of(path, seen):
            with atomic_write(path) as temporary:
                temporary.write_text(json.dumps(asdict(ours)), encoding="utf-8")
            return True
        return False
    finally:
        right.unlink(missing_ok=True)


def _keep_alive(path: Path, owner: Owner, ended: threading.Event) -> None:
    while not ended.wait(HEARTBEAT_S):
        if not _is_of(path, owner):
            logger.warning("%s: somebody else has taken it over; was this machine asleep?", path)
            return
        with contextlib.suppress(OSError):
            os.utime(path)


def _is_of(path: Path, owner: Owner | None) -> bool:
    try:
        return _read(path) == owner
    except FileNotFoundError:
        return False


def _read(path: Path) -> Owner | None:
    """Whom a claim names; None if it cannot be read."""
    try:
        content: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        return Owner(**content)
    except (ValueError, TypeError):
        return None


def _machine() -> str:
    """Alike for processes that see each other's numbers; "" where that is not known."""
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
        return f"{socket.gethostname()} {boot} {os.readlink('/proc/self/ns/pid')}"
    except OSError:
        return ""


def _started(process: int) -> int:
    """When a process began, in ticks since the boot; -1 if it is not there, or has ended and only its parent waits."""
    try:
        # The second field, the program's name in parentheses, may hold anything.
        fields = (
            Path(f"/proc/{process}/stat")
            .read_text(encoding="utf-8", errors="replace")
            .rpartition(")")[2]
            .split()
        )
    except OSError:
        return -1
    return -1 if fields[0] in "ZX" else int(fields[19])
