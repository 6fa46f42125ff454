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
from functools import partial
from multiprocessing.connection import Connection, wait
from types import FrameType
from typing import Any, NoReturn, TypeVar

import cv2

from psotrack.errors import PsotrackError
from psotrack.support.files import remove_temporary_files
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
#: Python's warnings are for developers, who see them with one process.
_VARIABLES = {
    "OPENBLAS_NUM_THREADS": "1",
    "PYTHONWARNINGS": "ignore",
    "MALLOC_MMAP_THRESHOLD_": f"{32 * 2**20}",
    "MALLOC_TRIM_THRESHOLD_": f"{256 * 2**20}",
}


def map_in_processes(
    function: Callable[[_Task, Advance], _Result], tasks: Sequence[_Task], *, jobs: int, advance: Advance
) -> list[_Result]:
    """Compute `[function(task, advance) for task in tasks]` in up to `jobs` processes.

    The workers have one OpenCV thread each, and nothing of this process's memory. They end with this call, also if
    Ctrl-C or SIGKILL ends it: the pipe to the worker breaks, the next `advance` in the worker raises `BrokenPipeError`,
    and the clean-up of `function` runs; it also runs in workers that Ctrl-C finds in a long step. With one job or one
    task the work is done in the calling process.

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
    with workers(partial(_serve, function), [()] * min(jobs, len(tasks))) as connections:
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
def workers(
    function: Callable[..., object], arguments: Sequence[tuple[Any, ...]]
) -> Iterator[list[Connection]]:
    """Processes that each call `function(*arguments, connection)`, and end with this block, or with this process.

    Args:
        function: importable by name, or a part of such a function; ends when the pipe to this process breaks.
        arguments: picklable arguments of each process.

    Yields:
        This process's ends of the pipes.
    """
    start_server(getattr(function, "func", function).__module__)
    context = _context()
    connections: list[Connection] = []
    processes = []
    try:
        with _start_of_workers():
            for each in arguments:
                here, there = context.Pipe()
                processes.append(context.Process(target=_work, args=(function, *each, there), daemon=True))
                processes[-1].start()
                there.close()
                connections.append(here)
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


def start_server(module: str) -> None:
    """Start the process from which workers will be forked, with a module imported, without waiting for it.

    A program that calls this first has workers at once where it needs them. Nothing happens if the process is there, or
    where the system cannot fork.
    """
    context = _context()
    if context.get_start_method() == "forkserver":
        from multiprocessing import forkserver

        context.set_forkserver_preload([module] if module != "__main__" else [])
        with _start_of_workers():
            forkserver.ensure_running()


def _context() -> Any:
    # Not forked from this process: a forked copy of a process with JAX or OpenCV threads may hang.
    methods = multiprocessing.get_all_start_methods()
    return multiprocessing.get_context("forkserver" if "forkserver" in methods else "spawn")


@contextlib.contextmanager
def _start_of_workers() -> Iterator[None]:
    """Processes that start in this block have `_VARIABLES`, and ignore Ctrl-C, to which only the parent reacts."""
    added = {name: value for name, value in _VARIABLES.items() if name not in os.environ}
    has_signals = threading.current_thread() is threading.main_thread()
    previous = signal.signal(signal.SIGINT, signal.SIG_IGN) if has_signals else None
    os.environ.update(added)
    try:
        yield
    finally:
        for name in added:
            del os.environ[name]
        if has_signals:
            signal.signal(signal.SIGINT, previous)


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


def _work(function: Callable[..., object], *arguments: Any) -> None:
    """In a worker: the function, until the pipe breaks."""
    cv2.setNumThreads(1)
    signal.signal(signal.SIGTERM, _end_in_silence)
    with contextlib.suppress(EOFError, BrokenPipeError, ConnectionResetError):
        function(*arguments)


def _serve(function: Callable[..., Any], connection: Connection) -> None:
    """In a worker: receive tasks; send progress (int), results (index, result) and errors."""
    steps, sent_s = 0, 0.0

    def advance(more: int) -> None:
        """Tell the parent process some times per second: a message for each step would take its time."""
        nonlocal steps, sent_s
        steps += more
        if time.monotonic() - sent_s > _PROGRESS_S:
            connection.send(steps)
            steps, sent_s = 0, time.monotonic()

    while True:
        index, task = connection.recv()
        try:
            result = function(task, advance)
            if steps:
                connection.send(steps)
            steps = 0
        except Exception as error:
            connection.send(with_traceback(error))
        else:
            connection.send((index, result))


def with_traceback(error: Exception) -> Exception:
    """An error for the parent process: the pipe would lose the traceback of a bug."""
    if not isinstance(error, PsotrackError):
        error.add_note(f"in a worker process:\n{''.join(traceback.format_exception(error))}")
    return error


def _end_in_silence(number: int, frame: FrameType | None) -> NoReturn:
    """End a worker process that the parent process terminates; the clean-up of its function runs.

    What libraries say when they are interrupted is not for the user: the parent process says why it ends.
    """
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
    # The exception may end a clean-up that has already begun.
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    remove_temporary_files()
    sys.exit(1)
