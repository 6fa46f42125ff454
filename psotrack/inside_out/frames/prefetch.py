"""Iteration over items that threads produce, or work on, ahead of their use."""

from __future__ import annotations

import contextlib
import queue
import threading
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from concurrent.futures import TimeoutError as NotYetError
from typing import TypeVar

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")

#: Largest number of items that wait to be used.
_AHEAD = 4
#: Longest uninterrupted wait for an item, seconds. Python handles Ctrl-C in the main thread only; if another thread
#: received the signal, or on Windows, the signal does not end the wait.
_WAIT_S = 0.1


def read_ahead(items: Iterator[_Item], *, newest: bool = False) -> Iterator[_Item]:
    """Iterate over items that a thread produces, a few items ahead of the item in use.

    Errors of the thread are raised here. Ctrl-C ends the iteration within about a second, even if the thread hangs.

    Args:
        items: iterator that the thread runs.
        newest: leave out older items if items are produced faster than they are used; else the thread waits.
    """
    done = object()
    waiting: queue.Queue[object] = queue.Queue(maxsize=1 if newest else _AHEAD)
    stop = threading.Event()

    def put(item: object, *, force: bool = False) -> None:
        while not stop.is_set():
            with contextlib.suppress(queue.Full):
                waiting.put(item, timeout=0.0 if newest and not force else 0.1)
                return
            if newest and not force:
                with contextlib.suppress(queue.Empty):
                    waiting.get_nowait()

    def work() -> None:
        try:
            for item in items:
                if stop.is_set():
                    break
                put(item)
            put(done, force=True)
        except BaseException as error:
            # Any error is raised where the items are used.
            put(error, force=True)
        finally:
            close = getattr(items, "close", None)
            if close is not None:
                close()

    thread = threading.Thread(target=work, daemon=True, name="psotrack-frames")
    thread.start()
    try:
        while (item := _get(waiting)) is not done:
            if isinstance(item, BaseException):
                raise item
            yield item  # type: ignore[misc]
    finally:
        stop.set()
        # A camera that does not respond must not block the program.
        thread.join(timeout=1.0)


def _get(waiting: queue.Queue[object]) -> object:
    """Get the next item; Ctrl-C can interrupt the wait."""
    while True:
        with contextlib.suppress(queue.Empty):
            return waiting.get(timeout=_WAIT_S)


def map_ahead(
    function: Callable[[_Item], _Result], items: Iterator[_Item], workers: int
) -> Iterator[_Result]:
    """Results of a function for items, in their order, computed by threads a few items ahead of the result in use.

    Errors of the function and of the items are raised here, in their order. Ctrl-C ends the iteration.

    Args:
        function: called in several threads at once.
        items: its arguments.
        workers: number of threads; 0 computes each result when it is asked for, so that no item waits.
    """
    if workers < 1:
        yield from map(function, items)
        return
    pool = ThreadPoolExecutor(workers, thread_name_prefix="psotrack-map")
    waiting: deque[Future[_Result]] = deque()
    try:
        for item in items:
            waiting.append(pool.submit(function, item))
            # One item more than threads, so that no thread is idle while a result is in use.
            if len(waiting) > workers:
                yield _result(waiting.popleft())
        while waiting:
            yield _result(waiting.popleft())
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def _result(future: Future[_Result]) -> _Result:
    """Wait for a result; Ctrl-C can interrupt the wait."""
    while True:
        with contextlib.suppress(NotYetError):
            return future.result(timeout=_WAIT_S)
