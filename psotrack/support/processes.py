"""Work on several files at once, in processes that end with the one that started them."""

from __future__ import annotations

import contextlib
import multiprocessing
import signal
import threading
import traceback
from collections import deque
from collections.abc import Callable, Iterator
from collections.abc import Sequence as Ordered
from multiprocessing.connection import Connection, wait
from typing import Any, TypeVar

import cv2

from psotrack.errors import PsotrackError
from psotrack.support.progress import Advance

_Task = TypeVar("_Task")
_Result = TypeVar("_Result")

#: How long a worker may take to notice that it is to end, and to clear up, before it is made to.
_GRACE_S = 5.0


def map_in_processes(
    function: Callable[[_Task, Advance], _Result], tasks: Ordered[_Task], *, jobs: int, advance: Advance
) -> list[_Result]:
    """`[function(task, advance) for task in tasks]`, `jobs` of them at once.

    The workers are fresh interpreters, with one thread of OpenCV each. They live as long as this call:
    whatever ends it, Ctrl-C and SIGKILL included, breaks the pipe on which `function` reports, so its next
    `advance` raises `BrokenPipeError` and its own clean-up runs. With one job or one task all is done in this
    process.

    Args:
        function: importable by name; calls `advance` at least a few times per second.
        tasks: picklable, as are the results.
        jobs: at most so many processes.
        advance: called with what the workers report.

    Raises:
        PsotrackError: a worker died.
        Exception: whatever `function` raised first; the other tasks are abandoned.
    """
    if jobs == 1 or len(tasks) < 2:
        return [function(task, advance) for task in tasks]
    waiting = deque(enumerate(tasks))
    results: dict[int, _Result] = {}
    with _workers(function, min(jobs, len(tasks))) as connections:
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
def _workers(function: Callable[..., Any], count: int) -> Iterator[list[Connection]]:
    """Connections to `count` new processes that run `_serve`; at the end of the block they end."""
    # Spawned, not forked: a fork of a process in which JAX or OpenCV has threads may hang.
    context = multiprocessing.get_context("spawn")
    connections: list[Connection] = []
    processes = []
    try:
        with _sigint_ignored():
            for _ in range(count):
                here, there = context.Pipe()
                process = context.Process(target=_serve, args=(function, there), daemon=True)
                process.start()
                there.close()
                connections.append(here)
                processes.append(process)
        yield connections
    finally:
        for connection in connections:
            connection.close()
        for process in processes:
            process.join(_GRACE_S)
            process.terminate()
            process.join()


@contextlib.contextmanager
def _sigint_ignored() -> Iterator[None]:
    """Processes that start here leave Ctrl-C to their parent, which a terminal would send to all of them."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    previous = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, previous)


def _receive(connection: Connection) -> Any:
    try:
        return connection.recv()
    except (EOFError, ConnectionResetError) as error:
        raise PsotrackError(
            "a worker process",
            expected="to finish",
            found="that it died",
            remedy="is memory short? does a script call this outside of `if __name__ == '__main__':`? "
            "jobs=1 needs no other processes",
        ) from error


def _serve(function: Callable[..., Any], connection: Connection) -> None:
    """A worker: tasks come in; progress (int), results (index, result) and errors go out."""
    cv2.setNumThreads(1)
    with contextlib.suppress(EOFError, BrokenPipeError, ConnectionResetError):
        while True:
            index, task = connection.recv()
            try:
                result = function(task, connection.send)
            except Exception as error:
                if not isinstance(error, PsotrackError):  # a mistake of ours: the pipe carries no traceback
                    error.add_note(f"in a worker process:\n{traceback.format_exc()}")
                connection.send(error)
            else:
                connection.send((index, result))
