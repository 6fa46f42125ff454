"""A process that makes tries, with limits of memory and time, and is replaced when it dies or hangs.

Its function stands in a module of its own, because a process that is started cannot import it from the program.
"""

from __future__ import annotations

import logging
import multiprocessing
import os
import resource
from multiprocessing.connection import Connection
from pathlib import Path

from fuzz.formats import FORMATS
from fuzz.trial import Judge, Trial

NAMES = tuple(FORMATS)
#: Longest time of a try before its process is ended, seconds.
_HANGS_S = 60.0
#: Address space of a process beyond what the libraries take, bytes; threads and arenas reserve much of it.
_ADDRESSES = 4 << 30


def _serve(connection: Connection, folder: Path, seed: int) -> None:
    """Make the tries whose numbers come through the connection, in a process of its own."""
    # Warnings of the log are no text of libraries.
    logging.getLogger().addHandler(logging.NullHandler())
    # What commands print is no part of the report.
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    judge = Judge(folder, seed)
    held = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    resource.setrlimit(resource.RLIMIT_AS, (held + _ADDRESSES, resource.RLIM_INFINITY))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    connection.send(None)
    while True:
        connection.send(judge.attempt(connection.recv()))


class Worker:
    """A process that makes tries, and is replaced when it dies or hangs."""

    def __init__(self, folder: Path, seed: int) -> None:
        self._folder, self._seed = folder, seed
        self._process = None
        self._starts = 0

    def attempt(self, number: int) -> Trial:
        """The try of a number; without a content if the process ended."""
        if self._process is None:
            self._start()
        try:
            self._connection.send(number)
            if self._connection.poll(_HANGS_S):
                return self._connection.recv()
            ended = f"hangs for {_HANGS_S:g} s"
        except (EOFError, OSError):
            self._process.join(5)
            ended = f"the process died with exit code {self._process.exitcode}"
        self.stop()
        return Trial(number, NAMES[number % len(NAMES)], "", ended, False, b"")

    def _start(self) -> None:
        context = multiprocessing.get_context("spawn")
        self._connection, other = context.Pipe()
        self._starts += 1
        words = (other, self._folder / f"{self._starts}", self._seed)
        self._process = context.Process(target=_serve, args=words, daemon=True)
        self._process.start()
        other.close()
        self._connection.recv()

    def stop(self) -> None:
        """End the process."""
        if self._process is not None:
            self._process.kill()
            self._process.join()
            self._process = None
