"""The search for new drones in a process of its own, so that no frame waits for the search."""

from __future__ import annotations

import contextlib
import gc
import os
import queue
import signal
import threading
from collections.abc import Iterator
from dataclasses import replace
from multiprocessing.connection import Connection
from typing import Any

from psotrack.errors import PsotrackError
from psotrack.initiation import DroneSearch, FoundCandidates, SeenFrame
from psotrack.live.front_end import Ready
from psotrack.live.packed_image import PackedImage
from psotrack.support import use_device, with_traceback, worker_processes

#: Priority of the search below that of the cameras and the tracker, as of `nice`.
_NICE = 5
#: Number of frames that wait for the search; where it is farther behind, frames are left out.
_MOST_WAITING = 50


@contextlib.contextmanager
def search_beside(search: DroneSearch) -> Iterator[SearchProcess]:
    """A search that runs in a worker process, in this block.

    Args:
        search: the search; picklable, and has seen no frame.
    """
    with worker_processes(_search, [search]) as (connection,):
        yield SearchProcess(connection)


class SearchProcess:
    """The search in the worker process; `see` does not wait for the search."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection

    def compile(self) -> None:
        """Wait until the process has compiled what it needs."""
        assert isinstance(self._receive(), Ready)

    def see(self, frame: SeenFrame) -> list[FoundCandidates]:
        """Send a frame; the results that the process has sent by now."""
        with contextlib.suppress(OSError):  # the process has died, which the next line tells
            self._connection.send(_packed(frame))
        found = []
        while self._connection.poll():
            found += self._receive()
        return found

    def _receive(self) -> Any:
        try:
            message = self._connection.recv()
        except (EOFError, OSError) as error:
            raise PsotrackError(
                "the process that searches for new drones",
                expected="that it runs",
                found="that it died",
                remedy="is memory short?",
            ) from error
        if isinstance(message, BaseException):
            raise message
        return message


def _packed(frame: SeenFrame) -> tuple[SeenFrame, PackedImage]:
    return replace(frame, coverage=frame.coverage[:, :0, :0]), PackedImage.of(frame.coverage)


def _unpacked(frame: SeenFrame, coverage: PackedImage) -> SeenFrame:
    return replace(frame, coverage=coverage.unpacked())


def _search(search: DroneSearch, connection: Connection) -> None:
    """The worker process: compile, tell that all is ready, search in the frames that come."""
    # Where the session ends, nothing needs to be cleaned up.
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    use_device("cpu")  # JAX would take most of a GPU's memory, which the tracker needs.
    search.compile()
    frames: queue.SimpleQueue[tuple[SeenFrame, PackedImage] | None] = queue.SimpleQueue()

    def listen() -> None:
        # The session must not wait while the pipe is full, so the frames are taken while a search is under way.
        with contextlib.suppress(EOFError, OSError):
            while True:
                frames.put(connection.recv())
        frames.put(None)

    threading.Thread(target=listen, daemon=True).start()
    # What was made so far is not searched for garbage again and again.
    gc.freeze()
    connection.send(Ready())
    # The search gets what the cameras leave, and a quarter of a processor where they leave nothing.
    with contextlib.suppress(AttributeError):  # there is no such thing on Windows
        os.nice(_NICE)
    while (packed := frames.get()) is not None:
        if frames.qsize() > _MOST_WAITING:
            continue
        try:
            found = search.see(_unpacked(*packed))
        except Exception as error:
            connection.send(with_traceback(error))
            return
        if found:
            connection.send(found)
