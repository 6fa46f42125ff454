"""Parallel work in worker processes that end when their parent process ends."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import sys
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from multiprocessing.connection import Connection, wait
from types import FrameType
from typing import Any, NoReturn, TypeVar

import cv2

from psotrack.errors import PsotrackError
from psotrack.support.progress import Advance

_Task = TypeVar("_Task")
_Result = TypeVar("_Result")

#: Time that the workers have to notice that the pipe is broken, seconds. `SystemExit` is raised in them after it.
GRACE_S = 0.3
#: Time between two messages of progress, seconds.
_PROGRESS_S = 0.1
#: Time that they have after that to remove their temporary files before they are killed, seconds.
_CLEAN_UP_S = 5.0
#: Variables of the workers, where the user has not set them. The workers are as many as the processors, so threads of
#: NumPy's linear algebra would only wait. Memory of an image is kept for the next image (glibc's names), bytes.
_VARIABLES = {
    "OPENBLAS_NUM_THREADS": "1",
    "MALLOC_MMAP_THRESHOLD_": f"{32 * 2**20}",
    "MALLOC_TRIM_THRESHOLD_": f"{256 * 2**20}",
}


def map_in_processes(
    function: Callable[[_Task, Advance], _Result], tasks: Sequence[_Task], *, jobs: int, advance: Advance
) -> list[_Result]:
    """Compute `[function(task, advance) for task in tasks]` in up to `jobs` processes.

    The workers are new Python interpreters with one OpenCV thread each. They end with this call, also if Ctrl-C or
    SIGKILL ends it: the pipe to the worker breaks, the next `advance` in the worker raises `BrokenPipeError`, and the
    clean-up of `function` runs; it also runs in workers that Ctrl-C finds in a long step. With one job or one task the
    work is done in the calling process.

    Args:
        function: importable by name; calls `advance` at least a few times per second.
        tasks: picklable, as are the results.
        jobs: largest number of processes.
        advance: called with the number of steps that a worker reports.

    Returns:
        The results in the order of the tasks.

    Raises:
        PsotrackError: a worker process died.
        Exception: the first exception that `function` raised; the remaining tasks are abandoned.
    """
    if jobs == 1 or len(tasks) < 2:
        return [function(task, advance) for task in tasks]
    waiting = deque(enumerate(tasks))
    results: dict[int, _Result] = {}
    with worker_processes(_serve, [function] * min(jobs, len(tasks))) as connections:
        for connection in connections:
            connection.send(waiting.popleft())
        while len(results) < len(tasks):
            for ready in wait(connections):
                assert isinstance(ready, Connection)
                message = _receive(ready)
                if isinstance(message, int):
                    advance(message)
                elif isinstance(message, BaseException):
                    raise message
                else:
                    index, results[index] = message
                    if waiting:
                        ready.send(waiting.popleft())
    return [results[index] for index in range(len(tasks))]


@contextlib.contextmanager
def worker_processes(
    target: Callable[[_Task, Connection], None], tasks: Sequence[_Task]
) -> Iterator[list[Connection]]:
    """Connections to new processes, each of which runs `target(task, connection)`.

    At the end of the block the pipes break: `target` shall return then. A process that does not is ended.

    Args:
        target: importable by name.
        tasks: picklable; one for each process.
    """
    # Spawned, not forked: a forked copy of a process with JAX or OpenCV threads may hang.
    context = multiprocessing.get_context("spawn")
    connections: list[Connection] = []
    processes = []
    try:
        with _sigint_ignored(), _variables_of_workers():
            for task in tasks:
                here, there = context.Pipe()
                process = context.Process(target=_run, args=(target, task, there), daemon=True)
                process.start()
                there.close()
                connections.append(here)
                processes.append(process)
        yield connections
    finally:
        for connection in connections:
            connection.close()
        for wait_s, then in ((GRACE_S, "terminate"), (_CLEAN_UP_S, "kill")):
            end_s = time.monotonic() + wait_s
            for process in processes:
                process.join(max(0.0, end_s - time.monotonic()))
            for process in processes:
                getattr(process, then)()
        for process in processes:
            process.join()


@contextlib.contextmanager
def _sigint_ignored() -> Iterator[None]:
    """Processes that start in this block ignore SIGINT: Ctrl-C signals them too, but only the parent reacts."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    previous = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, previous)


@contextlib.contextmanager
def _variables_of_workers() -> Iterator[None]:
    """Processes that start in this block have `_VARIABLES`."""
    added = {name: value for name, value in _VARIABLES.items() if name not in os.environ}
    os.environ.update(added)
    try:
        yield
    finally:
        for name in added:
            del os.environ[name]


def _receive(connection: Connection) -> Any:
    try:
        return connection.recv()
    except (EOFError, ConnectionResetError) as error:
        raise PsotrackError(
            "a worker process",
            expected="a result",
            found="that the process died",
            remedy="is memory short? is the call in a script outside of `if __name__ == '__main__':`? "
            "jobs=1 works without worker processes",
        ) from error


class _Progress:
    """Tells the parent process of progress, some times per second: a message for each step would take its time."""

    def __init__(self, connection: Connection) -> None:
        self._connection, self._steps, self._sent_s = connection, 0, 0.0

    def advance(self, steps: int) -> None:
        """See `Advance`; raises `BrokenPipeError` where the parent process has ended."""
        self._steps += steps
        if time.monotonic() - self._sent_s > _PROGRESS_S:
            self.send()

    def send(self) -> None:
        """Send the steps that were not sent."""
        if self._steps:
            self._connection.send(self._steps)
        self._steps, self._sent_s = 0, time.monotonic()


def _run(target: Callable[[_Task, Connection], None], task: _Task, connection: Connection) -> None:
    """Run `target` in a worker process, until the pipe breaks."""
    cv2.setNumThreads(1)
    signal.signal(signal.SIGTERM, _end_in_silence)
    with contextlib.suppress(EOFError, BrokenPipeError, ConnectionResetError):
        target(task, connection)


def _end_in_silence(number: int, frame: FrameType | None) -> NoReturn:
    """End a worker process that the parent process terminates; the clean-up of its target runs.

    What libraries say when they are interrupted is not for the user: the parent process says why it ends.
    """
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
    sys.exit(1)


def _serve(function: Callable[..., Any], connection: Connection) -> None:
    """Receive tasks; send progress (int), results (index, result) and exceptions."""
    while True:
        index, task = connection.recv()
        try:
            progress = _Progress(connection)
            result = function(task, progress.advance)
            progress.send()
        except Exception as error:
            connection.send(with_traceback(error))
        else:
            connection.send((index, result))


def with_traceback(error: BaseException) -> BaseException:
    """An error of a worker process; with its traceback as a note, which a pipe would lose, where it is a bug."""
    if not isinstance(error, PsotrackError):
        error.add_note(f"in a worker process:\n{''.join(traceback.format_exception(error))}")
    return error
