"""Many tries in processes with limits of memory and time, which are replaced when they die or hang."""

from __future__ import annotations

import argparse
import collections
import logging
import multiprocessing
import os
import resource
import sys
import tempfile
import threading
import time
from multiprocessing.connection import Connection
from pathlib import Path

import click

from fuzz.formats import FORMATS
from fuzz.trial import Judge, Trial

#: Folder of files that failed.
FINDS = Path("build/fuzz")
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


def main() -> None:
    """Make tries until the time is over or the count is reached; exit code 1 if one failed."""
    parser = argparse.ArgumentParser(prog="python -m fuzz", description=__doc__)
    parser.add_argument("--minutes", type=float, default=3.0)
    parser.add_argument("--tries", type=int, default=10**9, help="largest number of tries")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--first", type=int, default=0, help="number of the first try")
    options = parser.parse_args()

    numbers = iter(range(options.first, options.first + options.tries))
    lock, began_s = threading.Lock(), time.monotonic()
    done: list[bool] = []
    finds: dict[tuple[str, str], int] = collections.Counter()

    def work(folder: Path) -> None:
        worker = Worker(folder, options.seed)
        while time.monotonic() - began_s < 60 * options.minutes:
            with lock:
                number = next(numbers, None)
            if number is None:
                break
            trial = worker.attempt(number)
            with lock:
                done.append(trial.is_refused)
                if trial.fault:
                    report(trial)
        worker.stop()

    def report(trial: Trial) -> None:
        """Of equal faults the first one."""
        key = (trial.name, trial.fault[:60])
        finds[key] += 1
        if finds[key] > 1:
            return
        FINDS.mkdir(parents=True, exist_ok=True)
        suffix = Path(FORMATS[trial.name].file).suffix
        path = FINDS / f"{trial.name}-{options.seed}-{trial.number}{suffix}"
        path.write_bytes(trial.content)
        click.echo(f"FAILED try {trial.number}, {trial.name}, {trial.call}: {trial.fault} ({path})")

    threads = []
    with tempfile.TemporaryDirectory(prefix="psotrack-fuzz-", ignore_cleanup_errors=True) as root:
        for job in os.sched_getaffinity(0):
            threads.append(threading.Thread(target=work, args=(Path(root, f"{job}"),)))
            threads[-1].start()
        for thread in threads:
            thread.join()
    click.echo(
        f"{len(done)} tries of {len(NAMES)} formats with seed {options.seed}, from try {options.first} on, in "
        f"{time.monotonic() - began_s:.0f} s: {sum(done)} files refused, {sum(finds.values())} failures"
    )
    sys.exit(bool(finds))


if __name__ == "__main__":
    main()
