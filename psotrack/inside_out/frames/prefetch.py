"""Iteration over items that a thread produces ahead of their use."""

from __future__ import annotations

import contextlib
import queue
import threading
from collections.abc import Iterator
from typing import TypeVar

_Item = TypeVar("_Item")

#: Largest number of items that wait to be used.
_AHEAD = 4


def read_ahead(items: Iterator[_Item], *, newest: bool = False) -> Iterator[_Item]:
    """The same items, produced in a thread, a few ahead of the item in use. Errors of the thread are raised here.

    Args:
        items: iterator that the thread runs.
        newest: leave out older items, instead of waiting, where items are produced faster than they are used.
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
        while (item := waiting.get()) is not done:
            if isinstance(item, BaseException):
                raise item
            yield item  # type: ignore[misc]
    finally:
        stop.set()
        # A camera that does not answer must not block the program.
        thread.join(timeout=1.0)
